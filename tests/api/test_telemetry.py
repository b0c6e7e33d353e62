from dataclasses import replace

import numpy as np
import pytest
from prometheus_client import ProcessCollector
from prometheus_client.parser import text_string_to_metric_families

from server.api.http_durations import HttpDurations
from server.api.kept_streams import KeptStreams
from server.api.process_peers import ProcessPeers, merged
from server.api.request_log import RefusedRequests
from server.api.response_cache import ResponseCache
from server.api.stream_counts import StreamLedger
from server.api.telemetry import ServerCollector, exposition
from server.core.durations import DurationHistogram
from server.core.stores import StoreCalls
from server.field.fields_by_level import FieldsByLevel
from server.protocol.client_messages import PROTOCOL, AddEmitter, Hello
from server.runtime.drain import Drain
from server.runtime.readiness import Readiness
from server.runtime.thread_watch import ThreadWatch
from server.streaming.admission import Admission, Refusal
from server.streaming.audio_engine import AudioEngine
from server.streaming.load_policy import Ladder, RenderAhead, ThreadState
from server.streaming.quality_steps import Offer
from server.streaming.session import Session
from server.streaming.stream import Stream
from tests.engine_stage import Patient

BLOCK_S = 256 / 24_000


class Clips:
    names = ("knock", "speech")


class Host:
    def __init__(self, audio, offers, responses):
        self.audio, self.offers, self.clips = audio, offers, {"flat": Clips()}
        self.responses, self.http_durations = responses, HttpDurations()
        self.refused_bundles = 0
        self.peers = None
        self.stores = {"clips": StoreCalls()}
        self.refused_requests = RefusedRequests()
        self.ledger = StreamLedger()
        self.admission = Admission(audio, most_streams=1, cores=2)
        self.kept = KeptStreams(keep_s=1.0, most=1, give_up=self.admission.leave)
        self.readiness = Readiness(Drain(8.0), ThreadWatch((audio,)), warm_up="done")


@pytest.fixture
def host(field):
    offer = Offer((field.level,), {"standard": 2.5})
    audio = AudioEngine(lambda call: call(), Patient(), time_s=lambda: 50.0)
    with ResponseCache(workers=1, waiting=1) as responses:
        yield Host(audio, {"flat": offer}, responses)


def open_stream(host, field, filters):
    ladder = Ladder(host.offers["flat"].steps("auto", block_s=BLOCK_S))
    hello = Hello(protocol=PROTOCOL, scene="flat")
    session = Session(hello, FieldsByLevel([field]), filters, lambda _: np.ones(9, np.float32), quality=ladder.step)
    stream = Stream(
        session,
        FieldsByLevel([field]),
        offer=host.offers["flat"],
        ladder=ladder,
        block_s=BLOCK_S,
        lead=1,
        deliver=lambda _: None,
    )
    host.ledger.open(stream)
    host.audio.open(stream)
    return stream


def samples(host):
    """Values by name and labels, as Prometheus would read them."""
    text = exposition(ServerCollector(host)).decode()
    return {
        (sample.name, *sorted(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_a_server_without_streams_tells_what_it_is(host):
    told = samples(host)
    assert told["nafir_streams", ("level", "standard"), ("scene", "flat")] == 0
    assert told["nafir_level_ir_seconds", ("level", "standard"), ("scene", "flat")] == pytest.approx(0.0025)
    assert (told["nafir_clips",], told["nafir_ready",], told["nafir_blocks_sent_total",]) == (2, 1, 0)
    assert any(name == "nafir_build_info" and value == 1 for (name, *_), value in told.items())


def test_streams_are_counted_together_and_stay_counted_when_they_end(host, field, filters):
    streams = [open_stream(host, field, filters) for _ in range(2)]
    for stream in streams:
        stream.session.receive(AddEmitter(id="a", clip="any", position=(2.0, 3.0, 1.5)))
        for _ in range(5):
            stream.session.render_block()
        stream.times.render.add(0.001)
        stream.blocks_late += 1
    streams[0].ladder = replace(streams[0].ladder, at=1)
    told = samples(host)
    assert told["nafir_streams", ("level", "standard"), ("scene", "flat")] == 2
    assert told["nafir_streams_eased", ("scene", "flat")] == 1
    assert (told["nafir_blocks_sent_total",], told["nafir_blocks_late_total",]) == (10, 2)
    host.audio.close(streams[0])
    host.ledger.close(streams[0])
    after = samples(host)
    assert after["nafir_streams", ("level", "standard"), ("scene", "flat")] == 1
    assert {name: value for name, value in after.items() if name[0].startswith("nafir_block")} == {
        name: value for name, value in told.items() if name[0].startswith("nafir_block")
    }


def test_durations_are_buckets_that_contain_each_other(host, field, filters):
    times_s = [1e-4, 2e-4, 2e-4, 0.03, 100.0]
    stream = open_stream(host, field, filters)
    for time_s in times_s:
        stream.times.render.add(time_s)
    told = samples(host)
    counts = sorted(
        (float(dict(labels)["le"]), value)
        for (name, *labels), value in told.items()
        if name == "nafir_block_render_seconds_bucket"
    )
    assert [value for _, value in counts] == sorted(value for _, value in counts)
    assert counts[-1] == (float("inf"), len(times_s))
    for bound_s, value in counts[:-1]:
        assert value == sum(time_s < bound_s for time_s in times_s)
    assert told["nafir_block_render_seconds_sum",] == pytest.approx(sum(times_s))


def test_steps_are_counted_by_reason(host):
    host.audio.threads[0].steps["load"] += 3
    told = samples(host)
    assert told["nafir_level_steps_total", ("reason", "load")] == 3
    assert told["nafir_level_steps_total", ("reason", "recovered")] == 0


def test_how_many_blocks_are_rendered_at_once_is_told(host):
    assert samples(host)["nafir_blocks_at_once",] == 1
    host.audio.threads[0]._load = ThreadState(RenderAhead(4))
    assert samples(host)["nafir_blocks_at_once",] == 4


def test_streams_and_busy_share_of_each_audio_thread_are_told(host, field, filters):
    stream = open_stream(host, field, filters)
    (thread,) = host.audio.threads
    thread._busy = 0.25
    host.audio.moves = 3
    told = samples(host)
    of_thread = ("thread", thread.name)
    assert told["nafir_audio_thread_streams", of_thread] == 1
    assert told["nafir_audio_thread_busy", of_thread] == 0.25
    assert told["nafir_stream_moves_total",] == 3
    host.audio.close(stream)
    assert samples(host)["nafir_audio_thread_streams", of_thread] == 0


def test_a_histogram_sums_what_it_counts():
    first, second = DurationHistogram(), DurationHistogram()
    first.add(0.5)
    second.add(0.25)
    first.merge(second)
    assert first.total_s == pytest.approx(0.75)
    assert first.cumulative()[-1][1] == 2


def test_headroom_and_refusals_by_reason_are_told(host, field, filters):
    assert samples(host)["nafir_headroom",] == 1.0
    assert samples(host)["nafir_refusals_total", ("asked", "upgrade"), ("reason", "streams")] == 0
    open_stream(host, field, filters)
    assert not isinstance(host.admission.admit(None, host.offers["flat"].steps("auto", block_s=BLOCK_S)), Refusal)
    host.admission.turn_away()
    host.admission.measure()
    assert samples(host)["nafir_headroom",] == 0.0
    assert samples(host)["nafir_refusals_total", ("asked", "upgrade"), ("reason", "streams")] == 1


def test_refused_callers_are_counted_by_code_and_nothing_else_makes_a_label(host):
    before = samples(host)
    refused = {key: value for key, value in before.items() if key[0] == "nafir_requests_refused_total"}
    assert ("nafir_requests_refused_total", ("reason", "scope_missing"), ("status", "403")) in refused
    assert set(refused.values()) == {0}
    for status, code in ((401, "key_refused"), (401, "made up"), (429, None), (404, "not_found"), (200, None)):
        host.refused_requests.note(status, code)
    told = samples(host)
    assert told.keys() == before.keys()
    counted = {dict(key[1:])["status"] + dict(key[1:])["reason"]: told[key] for key in refused if told[key]}
    assert counted == {"401key_refused": 1, "401other": 1, "429other": 1}


def http_times(told, suffix):
    """By method, route and status."""
    name = f"nafir_http_request_duration_seconds_{suffix}"
    found = {
        tuple(dict(labels)[each] for each in ("method", "route", "status")): labels
        for first, *labels in told
        if first == name
    }
    return {key: told[(name, *labels)] for key, labels in found.items()}


def test_answers_are_timed_by_method_route_and_status_and_clients_make_no_labels(host):
    clips = "/v1/clips/{clip}"
    for duration_s in (0.001, 0.3, 0.005, 20.0):
        host.http_durations.note("GET", clips, 200, duration_s)
    for method in ("BREW", "PROPFIND", "get"):
        host.http_durations.note(method, None, 405, 0.001)
    host.http_durations.note("DELETE", clips, 204, 0.25)
    told = samples(host)
    counts = http_times(told, "count")
    assert counts == {("GET", clips, "2xx"): 4, ("other", "other", "4xx"): 3, ("DELETE", clips, "2xx"): 1}
    assert http_times(told, "sum")["GET", clips, "2xx"] == pytest.approx(20.306)
    of_get = {
        dict(labels)["le"]: value
        for (name, *labels), value in told.items()
        if name == "nafir_http_request_duration_seconds_bucket" and ("method", "GET") in labels
    }
    assert of_get == {"0.005": 2, "0.025": 2, "0.1": 2, "0.5": 3, "2.5": 3, "10": 3, "+Inf": 4}


def test_lookups_of_the_cache_and_the_lag_of_the_event_loop_are_told(host):
    before = samples(host)
    results = {("result", result) for result in ("hit", "shared", "miss")}
    assert {before["nafir_response_cache_lookups_total", each] for each in results} == {0}
    assert before["nafir_event_loop_lag_seconds_count",] == 0
    host.responses.lookups["shared"] += 2
    host.readiness.watch.lag.add(0.02, times=3)
    told = samples(host)
    assert told["nafir_response_cache_lookups_total", ("result", "shared")] == 2
    assert told["nafir_response_cache_bytes",] == 0
    assert told["nafir_event_loop_lag_seconds_count",] == 3
    assert told["nafir_event_loop_lag_seconds_sum",] == pytest.approx(0.06)


def test_of_several_processes_each_tells_its_own(host):
    host.http_durations.note("GET", "/livez", 200, 0.001)
    first = exposition(ServerCollector(host))
    host.http_durations.note("GET", "/livez", 200, 0.001)
    host.responses.lookups["hit"] += 1
    text = merged({0: first, 1: exposition(ServerCollector(host))}).decode()
    told = {
        (sample.name, sample.labels["process"], sample.labels.get("route") or sample.labels.get("result")): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }
    assert [told["nafir_http_request_duration_seconds_count", each, "/livez"] for each in "01"] == [1, 2]
    assert [told["nafir_response_cache_lookups_total", each, "hit"] for each in "01"] == [0, 1]
    assert [told["nafir_event_loop_lag_seconds_count", each, None] for each in "01"] == [0, 0]


def test_how_often_a_process_was_replaced_is_told_and_why(host):
    name, reasons = "nafir_process_restarts_total", [("reason", "died"), ("reason", "hung")]
    alone = samples(host)
    host.peers = ProcessPeers(1, (1, 2), endings={"hung": 2})
    told = samples(host)
    assert [alone[name, reason] for reason in reasons] == [0, 0]
    assert [told[name, reason] for reason in reasons] == [0, 2]


def test_calls_of_stores_are_told_by_what_was_asked_and_how_it_failed(host):
    calls = host.stores["clips"] = StoreCalls(time_s=lambda: 1_000.0, clock_s=iter((0.0, 0.5, 1.0, 4.0)).__next__)
    with pytest.raises(OSError, match="lost"), calls.call("write"):
        raise OSError("lost")
    silent = samples(host)
    with pytest.raises(FileNotFoundError), calls.call("write"):
        raise FileNotFoundError
    calls.fail("list", "timeout")
    told = samples(host)
    of_clips = ("store", "clips")
    writes = (("operation", "write"), of_clips)
    assert silent["nafir_store_last_answer_timestamp_seconds", of_clips] == 0
    assert told["nafir_store_last_answer_timestamp_seconds", of_clips] == 1_000
    assert told["nafir_store_call_seconds_count", *writes] == 2
    assert told["nafir_store_call_seconds_sum", *writes] == 3.5
    below = {
        dict(labels)["le"]: value
        for (name, *labels), value in told.items()
        if name == "nafir_store_call_seconds_bucket" and ("operation", "write") in labels
    }
    assert sorted(set(below.values())) == [0, 1, 2]
    failures = {
        tuple(labels): value
        for (name, *labels), value in told.items()
        if name == "nafir_store_failures_total" and value
    }
    assert failures == {
        (("operation", "write"), ("reason", "error"), of_clips): 1,
        (("operation", "list"), ("reason", "timeout"), of_clips): 1,
    }


def test_a_clock_that_is_set_does_not_look_like_a_restart(host, monkeypatch):
    """The kernel tells when it started by the clock of the wall."""
    began = samples(host)["process_start_time_seconds",]
    monkeypatch.setattr(ProcessCollector, "_boot_time", lambda _: 0.0)
    assert samples(host)["process_start_time_seconds",] == began
