"""Counters and durations of a running server, in Prometheus' text format.

Of streams nothing is counted for this purpose alone: the figures are read on request from those that streams keep for
their clients.
"""

import platform
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from importlib.metadata import version
from typing import Protocol, get_args

from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, InfoMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from server.api.http_durations import HttpDurations
from server.api.kept_streams import KeptStreams
from server.api.process_peers import Ending, ProcessPeers
from server.api.request_log import RefusedRequests
from server.api.response_cache import ResponseCache
from server.api.stream_counts import StreamLedger, StreamTotals
from server.assets.clips import ClipLibrary
from server.core.durations import DurationHistogram
from server.core.stores import StoreCalls
from server.runtime.readiness import Readiness
from server.runtime.thread_watch import ThreadWatch
from server.streaming.admission import Admission
from server.streaming.audio_engine import AudioEngine
from server.streaming.plan_audit import RegretRecord
from server.streaming.quality_steps import Offer
from server.streaming.stream import Stream

_PROCESS = ProcessCollector(registry=None)
"""One for good. It tells when the process began by the clock as it was when this was made, so a clock that is set later
does not look like a restart."""
_SHORTEST_S, _LONGEST_S = 3e-5, 10.0
"""Range of the histograms' buckets."""


class Host(Protocol):
    """The parts of a server that metrics are read from."""

    @property
    def audio(self) -> AudioEngine: ...

    @property
    def kept(self) -> KeptStreams: ...

    @property
    def clips(self) -> Mapping[str, ClipLibrary]: ...

    @property
    def offers(self) -> Mapping[str, Offer]: ...

    @property
    def refused_bundles(self) -> int: ...

    @property
    def stores(self) -> Mapping[str, StoreCalls]: ...

    @property
    def refused_requests(self) -> RefusedRequests: ...

    @property
    def peers(self) -> ProcessPeers | None: ...

    @property
    def http_durations(self) -> HttpDurations: ...

    @property
    def responses(self) -> ResponseCache: ...

    @property
    def ledger(self) -> StreamLedger: ...

    @property
    def readiness(self) -> Readiness: ...

    @property
    def admission(self) -> Admission: ...


class ServerCollector(Collector):
    """Collects all metrics of a host. Any thread may collect."""

    def __init__(self, host: Host) -> None:
        self._host = host

    def collect(self) -> Iterator[Metric]:
        streams = self._host.audio.streams
        totals = self._host.ledger.totals()
        yield InfoMetricFamily(
            "nafir_build",
            "Versions of Nafir and Python.",
            value={"version": version("nafir"), "python": platform.python_version()},
        )
        readiness = self._host.readiness
        is_ready = readiness.obstacle is None
        yield GaugeMetricFamily("nafir_ready", "1 if streams may be opened.", value=is_ready)
        is_draining = readiness.drain.has_begun
        yield GaugeMetricFamily("nafir_draining", "1 if the server is shutting down.", value=is_draining)
        yield from _threads(readiness.watch)
        yield _endings(self._host.peers)
        yield _histogram(
            "nafir_event_loop_lag_seconds",
            "How much later than it was due the event loop came to a timer, ten times a second.",
            readiness.watch.lag,
        )
        yield from self._streams(streams)
        yield from self._blocks(totals)
        yield from _regrets(totals.regrets)
        yield CounterMetricFamily(
            "nafir_ir_exchanges", "Blocks that faded to other impulse responses.", value=totals.counts["exchanges"]
        )
        yield GaugeMetricFamily(
            "nafir_ir_requests_waiting",
            "Streams that wait for impulse responses, either for their turn to request them or for the result.",
            value=sum(stream.awaits_irs_since_s is not None for stream in streams),
        )
        yield self._level_steps()
        yield GaugeMetricFamily(
            "nafir_blocks_at_once",
            "Blocks of a stream that the busiest audio thread renders at once; more under load.",
            value=max(thread.blocks_at_once for thread in self._host.audio.threads),
        )
        yield from self._audio_threads()
        yield self._level_costs()
        yield from _admission(self._host.admission)
        yield _refused(self._host.refused_requests)
        yield _http(self._host.http_durations)
        yield from _cache(self._host.responses)
        yield from _kept(self._host.kept)
        clips = {name for library in self._host.clips.values() for name in library.names}
        yield GaugeMetricFamily("nafir_clips", "Clips that emitters can play.", value=len(clips))
        yield GaugeMetricFamily(
            "nafir_bundles_refused",
            "Scene bundles of `bundle_folder` that cannot be loaded; the log says why.",
            value=self._host.refused_bundles,
        )
        yield from _stores(self._host.stores)

    def _audio_threads(self) -> Iterator[Metric]:
        streams = GaugeMetricFamily("nafir_audio_thread_streams", "Open streams of an audio thread.", labels=["thread"])
        busy = GaugeMetricFamily(
            "nafir_audio_thread_busy",
            "Share of the last quarter of a second in which an audio thread rendered.",
            labels=["thread"],
        )
        for name, (count, share) in self._host.audio.loads().items():
            streams.add_metric([name], count)
            busy.add_metric([name], share)
        yield streams
        yield busy
        yield CounterMetricFamily(
            "nafir_stream_moves",
            "Moves of a stream to another audio thread, because the threads were unevenly busy.",
            value=self._host.audio.moves,
        )

    def _streams(self, streams: Collection[Stream]) -> Iterator[Metric]:
        levels = Counter((stream.scene, stream.session.quality.level) for stream in streams)
        eased = Counter(stream.scene for stream in streams if stream.ladder.is_eased)
        by_level = GaugeMetricFamily(
            "nafir_streams", "Open streams by scene and quality level.", labels=["scene", "level"]
        )
        for scene, offer in tuple(self._host.offers.items()):
            for level in offer.levels:
                by_level.add_metric([scene, level.name], levels[scene, level.name])
        yield by_level
        counts: Counter[str] = Counter()
        for stream in streams:
            counts[stream.scene] += len(stream.audience.members)
        listeners = GaugeMetricFamily(
            "nafir_listeners", "Listeners of open streams: one of each, and those added to it.", labels=["scene"]
        )
        for scene in tuple(self._host.offers):
            listeners.add_metric([scene], counts[scene])
        yield listeners
        below = GaugeMetricFamily(
            "nafir_streams_eased", "Streams below their best quality because of load.", labels=["scene"]
        )
        for scene in tuple(self._host.offers):
            below.add_metric([scene], eased[scene])
        yield below

    def _blocks(self, totals: StreamTotals) -> Iterator[Metric]:
        yield CounterMetricFamily("nafir_blocks_sent", "Audio blocks sent.", value=totals.counts["sent"])
        yield CounterMetricFamily(
            "nafir_blocks_late", "Blocks sent later than the client needed them.", value=totals.counts["late"]
        )
        yield CounterMetricFamily(
            "nafir_blocks_dropped",
            "Blocks not sent because too many were unacknowledged.",
            value=totals.counts["dropped"],
        )
        yield CounterMetricFamily(
            "nafir_blocks_limited", "Blocks that were too loud and turned down.", value=totals.counts["limited"]
        )
        yield CounterMetricFamily(
            "nafir_samples_not_finite",
            "Rendered samples that were not finite and were sent as silence; a fault unless it is 0.",
            value=totals.counts["silenced"],
        )
        yield _histogram("nafir_block_render_seconds", "Time to render a block.", totals.durations["render"])
        yield _histogram(
            "nafir_block_lateness_seconds",
            "Time from when a block is due until it is ready.",
            totals.durations["lateness"],
        )
        yield _histogram(
            "nafir_ir_seconds", "Time of a worker for one request for impulse responses.", totals.durations["ir"]
        )
        yield _histogram(
            "nafir_pose_to_audio_seconds",
            "Time from a pose to the first block that follows it.",
            totals.durations["pose"],
        )

    def _level_steps(self) -> Metric:
        steps = CounterMetricFamily(
            "nafir_level_steps",
            "Changes of a stream to a cheaper quality (load) or back to a better one (recovered).",
            labels=["reason"],
        )
        counted = self._host.audio.steps
        steps.add_metric(["load"], counted["load"])
        steps.add_metric(["recovered"], counted["recovered"])
        return steps

    def _level_costs(self) -> Metric:
        costs = GaugeMetricFamily(
            "nafir_level_ir_seconds",
            "Time for an impulse response of a level, measured at start.",
            labels=["scene", "level"],
        )
        for scene, offer in tuple(self._host.offers.items()):
            for name, ms in offer.ms_here.items():
                costs.add_metric([scene, name], ms / 1000)
        return costs


def _threads(watch: ThreadWatch) -> Iterator[Metric]:
    states = watch.states
    healthy = GaugeMetricFamily(
        "nafir_thread_healthy", "1 if the thread works, 0 if it is stuck or dead.", labels=["thread"]
    )
    restarts = CounterMetricFamily(
        "nafir_thread_restarts",
        "How often the thread died and was replaced; a fault unless it is 0.",
        labels=["thread"],
    )
    for name, state in states.items():
        healthy.add_metric([name], state == "working")
        restarts.add_metric([name], watch.restarts[name])
    yield healthy
    yield restarts


def _endings(peers: ProcessPeers | None) -> Metric:
    replaced = CounterMetricFamily(
        "nafir_process_restarts",
        "How often a process of several was replaced, since it had ended (died) or was ended because its event loop "
        "did nothing any more (hung); a fault unless it is 0.",
        labels=["reason"],
    )
    for reason in get_args(Ending):
        replaced.add_metric([reason], 0 if peers is None else peers.endings.get(reason, 0))
    return replaced


def _admission(admission: Admission) -> Iterator[Metric]:
    yield GaugeMetricFamily(
        "nafir_headroom",
        "Share of the server that is free for more streams, from 0 to 1, of what is scarcest.",
        value=admission.headroom,
    )
    refusals = CounterMetricFamily(
        "nafir_refusals",
        "What was refused because it would have broken somebody's sound, and what there was too little of.",
        labels=["asked", "reason"],
    )
    for (asked, scarce), count in admission.refusals.items():
        refusals.add_metric([asked, scarce], count)
    yield refusals


def _refused(refused: RefusedRequests) -> Metric:
    counted = CounterMetricFamily(
        "nafir_requests_refused",
        "Requests and openings of streams that were refused because of who asked: without a valid key (401), without "
        "the right to it (403), or too often (429). The reason is the code of the answer.",
        labels=["status", "reason"],
    )
    for (status, reason), count in tuple(refused.counts.items()):
        counted.add_metric([status, reason], count)
    return counted


def _http(durations: HttpDurations) -> Metric:
    times = HistogramMetricFamily(
        "nafir_http_request_duration_seconds",
        "Time from a request until its answer was sent, by the path with names of parameters (`other` for files of the "
        "page and unknown paths) and the first digit of the status. Streams count only if they are refused.",
        labels=["method", "route", "status"],
    )
    for labels, buckets, total_s in durations.told():
        times.add_metric(labels, buckets, total_s)
    return times


def _cache(responses: ResponseCache) -> Iterator[Metric]:
    lookups = CounterMetricFamily(
        "nafir_response_cache_lookups",
        "Requests for a body that takes time to compute, by whether it was in the cache (hit), was being computed for "
        "another request (shared), or had to be computed (miss). What a client has itself is not asked for (304).",
        labels=["result"],
    )
    for result, count in responses.lookups.items():
        lookups.add_metric([result], count)
    yield lookups
    yield GaugeMetricFamily(
        "nafir_response_cache_bytes", "Size of the bodies in the cache.", value=responses.kept_bytes
    )


def _kept(streams: KeptStreams) -> Iterator[Metric]:
    yield GaugeMetricFamily(
        "nafir_streams_kept", "Streams that have lost their clients and wait for them.", value=len(streams)
    )
    outcomes = CounterMetricFamily(
        "nafir_stream_resumptions",
        "Streams that were kept after they lost their clients, were found by their tokens, or expired; and tokens that "
        "were not known.",
        labels=["outcome"],
    )
    for outcome, count in streams.outcomes.items():
        outcomes.add_metric([outcome], count)
    yield outcomes


def _stores(stores: Mapping[str, StoreCalls]) -> Iterator[Metric]:
    times = HistogramMetricFamily(
        "nafir_store_call_seconds",
        "Time of a call of the store of `bundle_url` (bundles) or `clips_url` (clips), whether or not it succeeds.",
        labels=["store", "operation"],
    )
    failures = CounterMetricFamily(
        "nafir_store_failures",
        "Calls of a store that raised an error, did not end in time (timeout), or left or brought a file of another "
        "size (incomplete).",
        labels=["store", "operation", "reason"],
    )
    answered = GaugeMetricFamily(
        "nafir_store_last_answer_timestamp_seconds",
        "When a call of a store last succeeded, in seconds since 1970; 0 before the first.",
        labels=["store"],
    )
    for store, calls in stores.items():
        answered.add_metric([store], calls.answered_s)
        for operation, durations in calls.durations.items():
            times.add_metric([store, operation], _buckets(durations), durations.total_s)
        for (operation, reason), count in calls.failures.items():
            failures.add_metric([store, operation, reason], count)
    yield from (times, failures, answered)


def _regrets(record: RegretRecord) -> Iterator[Metric]:
    yield CounterMetricFamily(
        "nafir_effect_checks", "Audits that compared a plan with a rendering of all effects.", value=record.checks
    )
    yield CounterMetricFamily(
        "nafir_effect_check_failures",
        "Audits in which an effect that was off was audibly missing; it is on from then on.",
        value=record.failures,
    )
    worst = GaugeMetricFamily(
        "nafir_effect_regret_jnd",
        "The greatest difference that any audit found, in just-noticeable differences.",
        labels=["parameter"],
    )
    for parameter, jnd in sorted(record.worst_jnd.items()):
        worst.add_metric([parameter], jnd)
    yield worst


def exposition(collector: Collector) -> bytes:
    """All metrics as text, with memory, CPU time and open files of the process."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(collector)
    registry.register(_PROCESS)
    return generate_latest(registry)


def _histogram(name: str, documentation: str, durations: DurationHistogram) -> Metric:
    return HistogramMetricFamily(name, documentation, buckets=_buckets(durations), sum_value=durations.total_s)


def _buckets(durations: DurationHistogram) -> list[tuple[str, float]]:
    counts = durations.cumulative()
    buckets = [(f"{bound_s:.6g}", float(count)) for bound_s, count in counts if _SHORTEST_S < bound_s < _LONGEST_S]
    return [*buckets, ("+Inf", float(counts[-1][1]))]
