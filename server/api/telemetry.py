"""Counters and durations of a running server, in Prometheus' text format.

Nothing is counted for it: the figures are those that streams keep for their own clients, read when they are asked for.
"""

import platform
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from importlib.metadata import version
from typing import Protocol

from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, InfoMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from server.api.stream_counts import StreamLedger, StreamTotals
from server.assets.clips import ClipLibrary
from server.core.durations import DurationHistogram
from server.runtime.readiness import Readiness
from server.runtime.thread_watch import ThreadWatch
from server.streaming.audio_engine import AudioEngine
from server.streaming.plan_audit import RegretRecord
from server.streaming.quality_steps import Offer
from server.streaming.stream import Stream

_SHORTEST_S, _LONGEST_S = 3e-5, 10.0
"""Bounds of what durations are told apart."""


class Host(Protocol):
    """What is asked of a server."""

    @property
    def audio(self) -> AudioEngine: ...

    @property
    def clips(self) -> Mapping[str, ClipLibrary]: ...

    @property
    def offers(self) -> Mapping[str, Offer]: ...

    @property
    def ledger(self) -> StreamLedger: ...

    @property
    def readiness(self) -> Readiness: ...


class ServerCollector(Collector):
    """All metrics of a host, as they are when they are collected; on any thread."""

    def __init__(self, host: Host) -> None:
        self._host = host

    def collect(self) -> Iterator[Metric]:
        streams = self._host.audio.streams
        totals = self._host.ledger.totals()
        yield InfoMetricFamily(
            "nafir_build", "What runs.", value={"version": version("nafir"), "python": platform.python_version()}
        )
        readiness = self._host.readiness
        is_ready = readiness.obstacle is None
        yield GaugeMetricFamily("nafir_ready", "1 where streams may be opened.", value=is_ready)
        is_draining = readiness.drain.has_begun
        yield GaugeMetricFamily("nafir_draining", "1 where the server is shutting down.", value=is_draining)
        yield from _threads(readiness.watch)
        yield from self._streams(streams)
        yield from self._blocks(totals)
        yield from _regrets(totals.regrets)
        yield CounterMetricFamily(
            "nafir_ir_exchanges", "Blocks that faded to other impulse responses.", value=totals.counts["exchanges"]
        )
        yield GaugeMetricFamily(
            "nafir_ir_requests_waiting",
            "Streams that wait for impulse responses, for their turn to ask or for an answer.",
            value=sum(stream.awaits_irs_since_s is not None for stream in streams),
        )
        yield self._level_steps()
        yield GaugeMetricFamily(
            "nafir_blocks_at_once",
            "Blocks of a stream that the busiest audio thread renders together: more under load.",
            value=max(thread.blocks_at_once for thread in self._host.audio.threads),
        )
        yield self._level_costs()
        clips = {name for library in self._host.clips.values() for name in library.names}
        yield GaugeMetricFamily("nafir_clips", "Recordings an emitter can play.", value=len(clips))

    def _streams(self, streams: Iterable[Stream]) -> Iterator[Metric]:
        levels = Counter((stream.scene, stream.session.quality.level) for stream in streams)
        eased = Counter(stream.scene for stream in streams if stream.ladder.is_eased)
        by_level = GaugeMetricFamily("nafir_streams", "Open streams, by what they hear.", labels=["scene", "level"])
        for scene, offer in tuple(self._host.offers.items()):
            for level in offer.levels:
                by_level.add_metric([scene, level.name], levels[scene, level.name])
        yield by_level
        below = GaugeMetricFamily("nafir_streams_eased", "Streams below the best quality for them.", labels=["scene"])
        for scene in tuple(self._host.offers):
            below.add_metric([scene], eased[scene])
        yield below

    def _blocks(self, totals: StreamTotals) -> Iterator[Metric]:
        yield CounterMetricFamily("nafir_blocks_sent", "Audio blocks sent.", value=totals.counts["sent"])
        yield CounterMetricFamily("nafir_blocks_late", "Of those sent, later than needed.", value=totals.counts["late"])
        yield CounterMetricFamily(
            "nafir_blocks_dropped",
            "Blocks not sent: too many unacknowledged.",
            value=totals.counts["dropped"],
        )
        yield CounterMetricFamily(
            "nafir_blocks_limited", "Blocks that were too loud and turned down.", value=totals.counts["limited"]
        )
        yield CounterMetricFamily(
            "nafir_samples_not_finite",
            "Samples rendered as no number and sent as silence: a fault wherever it is not 0.",
            value=totals.counts["silenced"],
        )
        yield _histogram("nafir_block_render_seconds", "What a block costs.", totals.durations["render"])
        yield _histogram(
            "nafir_block_lateness_seconds",
            "From when a block is due until it is ready.",
            totals.durations["lateness"],
        )
        yield _histogram(
            "nafir_ir_seconds", "What one request for impulse responses takes a worker.", totals.durations["ir"]
        )
        yield _histogram(
            "nafir_pose_to_audio_seconds", "From a pose to the first block that follows it.", totals.durations["pose"]
        )

    def _level_steps(self) -> Metric:
        steps = CounterMetricFamily(
            "nafir_level_steps",
            "Times that a stream was moved to cheaper quality (load), or back to better (recovered).",
            labels=["reason"],
        )
        counted = self._host.audio.steps
        steps.add_metric(["load"], counted["load"])
        steps.add_metric(["recovered"], counted["recovered"])
        return steps

    def _level_costs(self) -> Metric:
        costs = GaugeMetricFamily(
            "nafir_level_ir_seconds", "What an impulse response of a level took at start.", labels=["scene", "level"]
        )
        for scene, offer in tuple(self._host.offers.items()):
            for name, ms in offer.ms_here.items():
                costs.add_metric([scene, name], ms / 1000)
        return costs


def _threads(watch: ThreadWatch) -> Iterator[Metric]:
    states = watch.states
    healthy = GaugeMetricFamily(
        "nafir_thread_healthy", "1 where a thread does its work, 0 where it is stuck or dead.", labels=["thread"]
    )
    restarts = CounterMetricFamily(
        "nafir_thread_restarts", "Times that a thread died and was replaced: a fault wherever not 0.", labels=["thread"]
    )
    for name, state in states.items():
        healthy.add_metric([name], state == "working")
        restarts.add_metric([name], watch.restarts[name])
    yield healthy
    yield restarts


def _regrets(record: RegretRecord) -> Iterator[Metric]:
    yield CounterMetricFamily(
        "nafir_effect_checks", "Moments heard as planned and with every effect on.", value=record.checks
    )
    yield CounterMetricFamily(
        "nafir_effect_check_failures",
        "Of these, where an effect that was off was heard to be; it is on from then on.",
        value=record.failures,
    )
    worst = GaugeMetricFamily(
        "nafir_effect_regret_jnd",
        "The most that any check found, in just-noticeable differences.",
        labels=["parameter"],
    )
    for parameter, jnd in sorted(record.worst_jnd.items()):
        worst.add_metric([parameter], jnd)
    yield worst


def exposition(collector: Collector) -> bytes:
    """All of it as text, and beside it what the process takes: memory, CPU time, open files."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(collector)
    ProcessCollector(registry=registry)
    return generate_latest(registry)


def _histogram(name: str, documentation: str, durations: DurationHistogram) -> Metric:
    counts = durations.cumulative()
    buckets = [(f"{bound_s:.6g}", count) for bound_s, count in counts if _SHORTEST_S < bound_s < _LONGEST_S]
    return HistogramMetricFamily(
        name, documentation, buckets=[*buckets, ("+Inf", counts[-1][1])], sum_value=durations.total_s
    )
