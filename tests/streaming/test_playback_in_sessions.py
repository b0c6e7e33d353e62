"""A client's start, stop and end of a clip, ramps of its gain, and that short sounds leave nothing behind."""

import gc
import tracemalloc

import numpy as np
import pytest

from server.core.errors import RequestError
from server.field.fields_by_level import FieldsByLevel
from server.protocol.blocks import DryBlock
from server.protocol.client_messages import (
    PROTOCOL,
    AddEmitter,
    Hello,
    RemoveEmitter,
    SetGain,
    StopEmitter,
    parse_client_message,
)
from server.protocol.server_messages import EmitterAdded, EmitterEnded
from server.rendering.convolver import Sharing
from server.responses.ir_request import compute_irs
from server.streaming.quality_steps import QualityStep
from server.streaming.session import Session

RATE = 24_000
CLIP = 0.005 * np.random.default_rng(3).standard_normal(3_000).astype(np.float32)  # an eighth of a second
THERE = (6.0, 3.0, 1.5)
FULL = QualityStep("standard", None, Sharing.NOTHING, 1.0)
RUNG_OUT = 100
"""Blocks after which nothing of a clip is heard any more."""


def open_session(field, filters, **options):
    hello = Hello(protocol=PROTOCOL, scene="flat")
    levels = FieldsByLevel([field])
    return Session(hello, levels, filters, lambda _: CLIP, quality=FULL, window=10**6, **options)


@pytest.fixture
def session(field, filters):
    return open_session(field, filters)


def add(session, identifier="talker", **changes):
    return session.receive(AddEmitter(**{"id": identifier, "clip": "noise", "position": THERE, **changes}))


def answer(session, field):
    """Compute what the session wants, at once, and hand it in."""
    request = session.take_request()
    return [] if request is None else session.accept(compute_irs(FieldsByLevel([field]), request, session.renderer))


def hear(session, blocks, told=None):
    """(2, n); what the client is told meanwhile is appended to `told`."""
    heard = []
    for _ in range(blocks):
        heard.append(session.render_block().samples)
        events = session.follow_clock()
        if told is not None:
            told += events
    return np.concatenate(heard, axis=1).astype(float)


def test_a_clip_that_starts_later_sounds_the_same_so_much_later(field, filters):
    at_once, later = open_session(field, filters), open_session(field, filters)
    add(at_once, loop=False)
    assert answer(at_once, field) == [EmitterAdded(id="talker", sample_clock=0)]
    add(later, loop=False, start_at=1_001)
    assert answer(later, field) == [EmitterAdded(id="talker", sample_clock=1_001)]
    first, second = hear(at_once, 40), hear(later, 40)
    assert not second[:, :1_001].any()
    np.testing.assert_allclose(second[:, 1_001:], first[:, :-1_001], atol=1e-7)


def test_what_should_have_started_already_starts_now_and_the_client_is_told_when(session, field):
    hear(session, 10)
    add(session, start_at=100)
    assert answer(session, field) == [EmitterAdded(id="talker", sample_clock=2_560)]


def test_a_loop_with_points_and_an_offset_is_the_clip_between_them(field, filters):
    def heard(**how):
        session = open_session(field, filters)
        add(session, loop_start_s=0.05, loop_end_s=0.1, **how)
        answer(session, field)
        return hear(session, 80)

    early = heard(offset_s=0.02, start_at=480)
    later = heard(offset_s=0.03, start_at=480 + 240)  # ten milliseconds further on, ten milliseconds later
    settled = early[:, 12_000:]
    assert settled.any()
    np.testing.assert_allclose(settled, later[:, 12_000:], atol=1e-7)
    np.testing.assert_allclose(settled[:, 1_200:], settled[:, :-1_200], atol=1e-7)


def test_the_end_is_told_once_when_all_is_silent_and_the_emitter_stays(session, field):
    add(session, loop=False)
    answer(session, field)
    told = []
    hear(session, RUNG_OUT, told)
    (ended,) = told
    assert ended == EmitterEnded(id="talker", sample_clock=ended.sample_clock, removed=False)
    assert session.emitter_count == 1
    assert ended.sample_clock > CLIP.size + field.ir_samples
    assert not hear(session, 20, told).any()
    session.receive(StopEmitter(id="talker"))
    hear(session, 20, told)
    assert told == [ended], "it cannot end twice"


@pytest.mark.parametrize("had_ended", [False, True])
def test_a_clip_that_is_over_when_its_stream_goes_on_from_a_snapshot_is_silent(session, field, filters, had_ended):
    add(session, loop=False)
    answer(session, field)
    hear(session, RUNG_OUT if had_ended else 3)
    snapshot = session.snapshot(session="s", handled=1)
    again = open_session(field, filters)
    assert again.restore(snapshot) == []
    again.continue_at(snapshot.sample_clock + RUNG_OUT * 256, RUNG_OUT)
    told = []
    silent = [hear(again, 2, told)]
    assert answer(again, field) == [], "the client knows that it was heard"
    assert not np.concatenate([*silent, hear(again, RUNG_OUT, told)], axis=1).any()
    assert [type(each) for each in told] == ([] if had_ended else [EmitterEnded])
    assert again.emitter_count == 1


def test_nothing_is_heard_after_an_end(session, field):
    add(session, loop=False)
    answer(session, field)
    was_told = False
    for _ in range(RUNG_OUT):
        is_heard = session.render_block().samples.any()
        assert not (was_told and is_heard)
        was_told |= bool(session.follow_clock())
    assert was_told


@pytest.mark.parametrize("how", ["stop_at", "message", "message at once"])
def test_a_loop_that_is_stopped_ends(session, field, how):
    add(session, **({"stop_at": 5_000} if how == "stop_at" else {}))
    answer(session, field)
    hear(session, 10)
    if how != "stop_at":
        at = 5_000 if how == "message" else None
        assert session.receive(StopEmitter(id="talker", stop_at=at, fade_s=0.001)) == []
    told = []
    heard = hear(session, RUNG_OUT, told)
    assert [type(each) for each in told] == [EmitterEnded]
    assert heard[:, :2_000].any()
    assert not heard[:, -10 * 256 :].any()


def test_it_is_removed_when_it_has_ended_and_its_id_is_free(session, field):
    add(session, loop=False, remove_when_ended=True)
    answer(session, field)
    told = []
    hear(session, RUNG_OUT, told)
    (ended,) = told
    assert ended.removed
    assert session.emitter_count == 0
    (refusal,) = session.receive(RemoveEmitter(id="talker"))
    assert refusal.code == "unknown_emitter"
    assert add(session) == []


@pytest.mark.parametrize(
    ("fields", "field_at_fault"),
    [
        ({"offset_s": 0.2, "loop": False}, "offset_s"),
        ({"offset_s": 0.2}, "offset_s"),
        ({"offset_s": 0.05, "loop_end_s": 0.04}, "offset_s"),
        ({"loop_end_s": 0.13}, "loop_end_s"),
        ({"loop_start_s": 0.125}, "loop_start_s"),
        ({"loop_start_s": 0.05, "loop_end_s": 0.05}, "loop_start_s"),
        ({"loop_end_s": 0.0}, "loop_start_s"),
    ],
)
def test_places_outside_a_clip_are_refused_by_name_and_add_nothing(session, fields, field_at_fault):
    (refusal,) = add(session, **fields)
    assert (refusal.code, refusal.field) == ("outside_clip", field_at_fault)
    assert "0.125 s" in refusal.message
    assert session.emitter_count == 0


def test_a_live_emitter_cannot_be_stopped(session):
    session.receive(AddEmitter(id="me", live=True, position=THERE))
    (refusal,) = session.receive(StopEmitter(id="me"))
    assert (refusal.code, refusal.field, refusal.emitter) == ("is_live", "id", "me")
    (refusal,) = session.receive(StopEmitter(id="nobody"))
    assert refusal.code == "unknown_emitter"


@pytest.mark.parametrize(
    ("fields", "field_at_fault"),
    [
        ('"live":true,"start_at":5', "start_at"),
        ('"live":true,"remove_when_ended":true', "remove_when_ended"),
        ('"clip":"a","loop":false,"loop_end_s":1', "loop_end_s"),
        ('"clip":"a","start_at":-1', "start_at"),
        ('"clip":"a","start_at":1.5', "start_at"),
        ('"clip":"a","offset_s":1e9', "offset_s"),
    ],
)
def test_fields_that_do_not_go_together_are_refused_by_name(fields, field_at_fault):
    with pytest.raises(RequestError) as caught:
        parse_client_message(f'{{"type":"add_emitter","id":"a","position":[1,1,1],{fields}}}')
    assert (caught.value.code, caught.value.field) == ("malformed_message", field_at_fault)


def test_during_a_ramp_plans_go_by_its_louder_end(session, field):
    add(session)
    answer(session, field)
    emitter = session._emitters["talker"]
    session.receive(SetGain(id="talker", gain_db=-40.0, ramp_s=0.1))
    hear(session, 9)  # to 2304
    assert emitter.state.gain_db == 0.0
    hear(session, 1)
    assert emitter.state.gain_db == -40.0
    session.receive(SetGain(id="talker", gain_db=-20.0, ramp_s=10.0))
    assert emitter.state.gain_db == -20.0
    session.receive(SetGain(id="talker", gain_db=-60.0))
    assert emitter.state.gain_db == -60.0


def test_a_ramp_is_heard_in_direct_sound_and_reverberation(field, filters):
    def heard(ramp):
        session = open_session(field, filters)
        add(session)
        answer(session, field)
        hear(session, 60)
        session.receive(SetGain(id="talker", gain_db=-40.0, ramp_s=0.5 if ramp else 0.0))
        return hear(session, 150)

    at_once, slowly = heard(False), heard(True)
    assert np.std(slowly[:, 4_000:6_000]) > 10 * np.std(at_once[:, 4_000:6_000])
    np.testing.assert_allclose(at_once[:, -12_800:], slowly[:, -12_800:], atol=1e-7)


def play_short_sounds(session, field, count):
    """Add so many sounds, each as soon as there is room, and hear them out; return how many responses were asked
    for."""
    added = gone = asked = 0
    while gone < count:
        if added < count and session.emitter_count < 8:
            start_at = session.sample_clock + added % 300
            assert add(session, f"shot-{added}", loop=False, start_at=start_at, remove_when_ended=True) == []
            added += 1
        events = []
        if (request := session.take_request()) is not None:
            asked += len(request.asked)
            events = session.accept(compute_irs(FieldsByLevel([field]), request, session.renderer))
        session.render_block()
        for event in [*events, *session.follow_clock()]:
            assert isinstance(event, EmitterAdded | EmitterEnded)
            gone += isinstance(event, EmitterEnded)
    return asked


def held(session):
    """Whatever of a session could grow with the number of its emitters."""
    mixers = list(session.renderer._mixers)
    return {
        "emitters": session.emitter_count,
        "in the renderer": len(session.renderer._emitters) + len(session.renderer._changed),
        "sources": sum(len(mixer._clips) + len(mixer._sources) for mixer in mixers),
        "slots taken": sum(mixer.slots - len(mixer.free_slots) for mixer in mixers),
        "ringing": len(session.renderer._mixers._ringing),
    }


@pytest.mark.parametrize("count", [150, pytest.param(5_000, marks=pytest.mark.long)])
def test_short_sounds_leave_nothing_behind(field, filters, count):
    session = open_session(field, filters, max_emitters=8)
    tracemalloc.start()
    try:
        play_short_sounds(session, field, 100)  # until Python's own stores of small objects are full
        hear(session, RUNG_OUT)
        assert set(held(session).values()) == {0}
        gc.collect()
        before = tracemalloc.get_traced_memory()[0]
        asked = play_short_sounds(session, field, count)
        hear(session, RUNG_OUT)
        gc.collect()
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert set(held(session).values()) == {0}
    assert asked == count, "one response each, and none for what has ended"
    assert grown < 120_000, f"{grown / count:.0f} bytes a sound"


@pytest.mark.parametrize(("jitter_ms", "awaited"), [(None, 512), (50.0, 1_200), (2.0, 65)])
def test_a_live_emitter_begins_when_as_much_waits_as_it_asked_for(session, jitter_ms, awaited):
    session.receive(AddEmitter(id="me", live=True, position=THERE, jitter_ms=jitter_ms))
    (status,) = session.live_statuses()
    assert status.samples_awaited == awaited


def test_lost_blocks_are_counted_and_their_time_is_silent(session, field):
    session.receive(AddEmitter(id="me", live=True, position=THERE, jitter_ms=50.0))
    answer(session, field)
    for sequence in (0, 1, 2, 3, 4, 7):
        session.receive(DryBlock("me", sequence, np.full(256, 0.01, np.float32)))
        if sequence == 4:
            hear(session, 1)
    (status,) = session.live_statuses()
    assert (status.blocks_lost, status.samples_queued, status.underruns) == (2, 4 * 256 + 2 * 256 + 256, 0)


def test_a_wait_for_live_samples_belongs_to_a_live_emitter():
    with pytest.raises(RequestError) as caught:
        parse_client_message('{"type":"add_emitter","id":"a","position":[1,1,1],"clip":"a","jitter_ms":20}')
    assert (caught.value.code, caught.value.field) == ("malformed_message", "jitter_ms")
