"""Streams in time, ticked by hand with a clock that only a test moves; and once, for real."""

import os
import sys
import threading
import time

import numpy as np
import pytest

from server.protocol.blocks import DryBlock
from server.protocol.client_messages import PROTOCOL, Acknowledge, AddEmitter, Hello, ListenerPose, MoveEmitter
from server.protocol.server_messages import EmitterAdded, Error, Status
from server.runtime.thread_watch import ThreadWatch
from server.runtime.workers import Workers
from server.streaming import audio_engine
from server.streaming.audio_engine import PHASES, AudioEngine
from server.streaming.inbox import MAX_WAITING_MESSAGES
from server.streaming.stream import PAUSE_AFTER_S, StreamFailed
from tests.engine_stage import BLOCK_S, Clock, Patient, Stage, blocks, open_stream, spy_on_batches
from tests.killing import kill, threads_may_die

pytestmark = pytest.mark.timed


@pytest.fixture
def stage(field, filters):
    return Stage(field, filters)


def add(stream):
    # So near that its sound arrives within the first block.
    assert stream.offer(AddEmitter(id="a", clip="any", position=(2.0, 3.0, 1.5)))


def test_nothing_to_do_without_streams(stage):
    assert stage.thread.tick() is None


def test_a_stream_starts_with_its_lead_and_then_keeps_the_pace_of_time(stage):
    _, delivered = stage.open(lead=4)
    stage.run(BLOCK_S / 2)
    assert len(blocks(delivered)) == 4
    stage.run(100 * BLOCK_S)
    assert len(blocks(delivered)) == pytest.approx(104, abs=1)
    assert [item.block.sequence for item in blocks(delivered)] == list(range(len(blocks(delivered))))


def test_the_pace_does_not_depend_on_how_badly_the_thread_sleeps(stage):
    _, delivered = stage.open(lead=8)
    stage.run(600 * BLOCK_S, step_s=2.7 * BLOCK_S)
    assert len(blocks(delivered)) == pytest.approx(608, abs=3)


def test_streams_take_turns(stage):
    (_, first), (_, second) = stage.open(lead=8), stage.open(lead=8)
    for count in range(1, 8):
        stage.thread.tick()
        assert (len(blocks(first)), len(blocks(second))) == (count, count)


def test_streams_are_spread_over_the_block_and_those_of_an_instant_rendered_together(stage, monkeypatch):
    streams = [stage.open(lead=1)[0] for _ in range(3 * PHASES)]
    stage.run(3 * BLOCK_S)
    due = sorted((stream.due_s - stage.clock.now_s) % BLOCK_S for stream in streams)
    instants = np.unique(np.round(np.array(due) / BLOCK_S, 6))
    np.testing.assert_allclose(np.diff(instants), 1 / PHASES, rtol=1e-4)
    batches = spy_on_batches(monkeypatch)
    stage.run(10 * BLOCK_S)
    assert {len(batch) for batch in batches} == {3}


def test_after_a_stall_streams_still_fall_due_apart(stage):
    streams = [stage.open(lead=1)[0] for _ in range(PHASES)]
    stage.run(3 * BLOCK_S)
    stage.clock.now_s += 7.0
    stage.run(3 * BLOCK_S)
    due = np.sort([(stream.due_s - stage.clock.now_s) % BLOCK_S for stream in streams])
    np.testing.assert_allclose(np.diff(due), BLOCK_S / PHASES, rtol=1e-3)


def test_the_gap_that_a_stream_leaves_is_filled_first(stage):
    _, leaving, *_ = [stage.open(lead=1)[0] for _ in range(2 * PHASES)]
    stage.run(3 * BLOCK_S)
    gap = (leaving.due_s - stage.clock.now_s) % BLOCK_S
    stage.engine.close(leaving)
    late, _ = stage.open(lead=1)
    stage.run(3 * BLOCK_S)
    assert (late.due_s - stage.clock.now_s) % BLOCK_S == pytest.approx(gap, abs=1e-6)


def test_a_stream_goes_to_the_thread_that_is_least_busy(field, filters):
    clock = Clock()
    engine = AudioEngine(lambda call: call(), Patient(), threads=2, time_s=clock)

    def opened(load=0.0):
        hello, clip = Hello(protocol=PROTOCOL, scene="flat"), np.ones(64, np.float32)
        stream = open_stream(hello, field, filters, lambda _: clip, lead=1, deliver=lambda _: None)
        engine.open(stream)
        stream.load = load
        return stream

    def counts():
        for thread in engine.threads:
            thread.tick()
        return [len(thread._streams) for thread in engine.threads]

    heavy = opened(load=0.5)
    for expected in ([1, 1], [1, 2], [1, 3]):
        opened(load=0.1)
        assert counts() == expected
    engine.close(heavy)
    newest = opened()
    assert counts() == [1, 3]
    assert len(engine.streams) == 4
    assert engine.streams[-1] is newest


def test_a_pose_asks_for_its_response_at_once_and_renders_nothing_early(stage):
    stream, delivered = stage.open(lead=1)
    add(stream)
    stage.run(4 * BLOCK_S)
    stage.workers.run()
    stage.run(4 * BLOCK_S)
    stage.clock.now_s = stream.due_s - 0.5 * BLOCK_S
    count, woken = len(blocks(delivered)), []
    stream.attach(wake=lambda: woken.append(True), time_s=stage.clock, turns=stage.thread.turns)
    stream.offer(ListenerPose(pose_id=1, position=(2.0, 2.0, 1.5)))
    assert woken == [True]
    stage.thread.tick()
    assert len(stage.workers.work) == 1
    assert len(blocks(delivered)) == count
    # As long as no answer came, nothing more would be asked for, and nobody is woken.
    stream.offer(ListenerPose(pose_id=2, position=(2.0, 2.1, 1.5)))
    assert woken == [True]
    stage.workers.run()
    assert woken == [True, True]
    stage.thread.tick()
    assert [work[2][1].pose_id for work in stage.workers.work] == [2]
    assert len(blocks(delivered)) == count


def test_a_closed_stream_makes_no_more_sound_and_closing_twice_does_no_harm(stage):
    stream, delivered = stage.open()
    stage.run(10 * BLOCK_S)
    stage.engine.close(stream)
    stage.engine.close(stream)
    count = len(delivered)
    stage.run(10 * BLOCK_S)
    assert len(delivered) == count


def test_nothing_more_is_computed_for_a_stream_that_has_left(stage):
    stream, _ = stage.open()
    staying, delivered = stage.open()
    for each in (stream, staying):
        add(each)
    stage.run(2 * BLOCK_S)
    asked = {arguments[-1]: future for future, _, arguments in stage.workers.work}
    assert set(asked) == {stream.session, staying.session}
    stage.engine.close(stream)
    stage.run(BLOCK_S)
    assert asked[stream.session].cancelled()
    assert not asked[staying.session].cancelled()
    stage.workers.work = [work for work in stage.workers.work if not work[0].cancelled()]
    stage.workers.run()
    stage.run(BLOCK_S)
    assert any(isinstance(item, EmitterAdded) for item in delivered)


def test_an_answer_takes_effect_with_the_next_block_and_no_block_waits_for_it(stage):
    stream, delivered = stage.open(lead=1)
    add(stream)
    stage.run(5 * BLOCK_S)
    assert len(blocks(delivered)) == pytest.approx(5, abs=1)
    assert len(stage.workers.work) == 1
    stage.workers.run()
    stage.run(BLOCK_S)
    (added,) = [item for item in delivered if isinstance(item, EmitterAdded)]
    sounding = [item.block.sample_clock for item in blocks(delivered) if item.block.samples.any()]
    assert sounding[0] == added.sample_clock
    # The message leaves before the block it speaks of.
    place = delivered.index(added)
    assert delivered[place + 1].block.sample_clock == added.sample_clock


def test_a_field_that_fails_costs_an_error_message_and_no_sound(stage):
    stream, delivered = stage.open()
    add(stream)
    stage.run(BLOCK_S)
    stage.workers.run()
    stage.run(BLOCK_S)
    works = stage.field.impulse_responses
    stage.field.impulse_responses = lambda *_, **__: np.full((1, 2, 100), np.inf, np.float32)
    stream.offer(ListenerPose(pose_id=1, position=(2.0, 2.0, 1.5)))
    stage.run(2 * BLOCK_S)
    stage.workers.run()
    stage.run(3 * BLOCK_S)
    assert [item.code for item in delivered if isinstance(item, Error)] == ["field_failure"]
    assert blocks(delivered)[-1].block.samples.any()
    stage.field.impulse_responses = works
    stream.offer(ListenerPose(pose_id=2, position=(2.0, 2.0, 1.5)))
    stage.run(2 * BLOCK_S)
    stage.workers.run()
    stage.run(2 * BLOCK_S)
    assert blocks(delivered)[-1].block.pose_id == 2


@pytest.mark.parametrize("step", ["receive", "take_request", "begin_block", "finish_blocks"])
def test_a_stream_that_breaks_leaves_the_others_sounding(stage, step):
    broken, complaints = stage.open()
    _, delivered = stage.open()

    def explode(*_):
        raise ZeroDivisionError

    add(broken)
    setattr(broken.session, step, explode)
    stage.run(20 * BLOCK_S)
    assert complaints == [StreamFailed()]
    assert [item.block.sequence for item in blocks(delivered)] == list(range(len(blocks(delivered))))
    assert len(blocks(delivered)) > 20


def test_a_renderer_that_breaks_is_found_among_those_it_was_rendered_with(stage, monkeypatch):
    (broken, complaints), *others = [stage.open() for _ in range(2 * PHASES)]
    stage.run(5 * BLOCK_S)
    complaints.clear()
    rendered = audio_engine.render_all

    def render_all(renderers):
        if broken.session.renderer in renderers:
            raise ZeroDivisionError
        return rendered(renderers)

    monkeypatch.setattr(audio_engine, "render_all", render_all)
    stage.run(20 * BLOCK_S)
    assert complaints == [StreamFailed()]
    for _, delivered in others:
        clocks = [item.block.sample_clock for item in blocks(delivered)]
        assert clocks == list(range(0, 256 * len(clocks), 256))
        assert len(clocks) > 20


def test_a_status_comes_once_a_second_and_tells_what_happened(stage):
    stream, delivered = stage.open(lead=8)
    add(stream)
    stage.run(0.1)
    stage.workers.run()
    stage.run(2.95)
    first, second, third = (item for item in delivered if isinstance(item, Status))
    assert [round(status.sample_clock / 24_000) for status in (first, second, third)] == [1, 2, 3]
    assert third.blocks_sent == pytest.approx(3 / BLOCK_S, abs=2)
    assert first.buffer_ms == pytest.approx(8 * BLOCK_S * 1000, abs=12)
    assert first.ir_ms.p50 is not None
    assert third.lateness_ms.p99_9 is not None
    assert third.unacknowledged == third.blocks_sent


def test_a_status_tells_how_long_poses_take_to_be_heard(stage):
    stream, delivered = stage.open(lead=1)
    add(stream)
    stage.run(5 * BLOCK_S)
    stage.workers.run()
    stage.run(5 * BLOCK_S)
    for pose_id in range(1, 40):
        stage.clock.now_s = stream.due_s - 0.001
        stream.offer(ListenerPose(pose_id=pose_id, position=(2.0, 2.0 + pose_id / 100, 1.5)))
        stage.thread.tick()
        stage.clock.now_s += 0.001
        stage.thread.tick()
        stage.clock.now_s += 0.005
        stage.workers.run()
    stage.run(1.0)
    status = [item for item in delivered if isinstance(item, Status)][-1]
    assert status.pose_ms.p50 == pytest.approx(1.0, rel=0.03)
    # The answer comes 6 ms after the pose and has to wait for the next block.
    assert status.reverberation_ms.p50 == pytest.approx(1.0 + 1000 * BLOCK_S, rel=0.03)


def test_a_full_window_costs_blocks_and_the_clock_runs_on(stage):
    stream, delivered = stage.open(lead=2, window=5)
    stage.run(20 * BLOCK_S)
    assert len(blocks(delivered)) == 5
    assert stream.session.blocks_dropped == pytest.approx(17, abs=1)
    assert stream.session.sample_clock == pytest.approx(22 * 256, abs=256)


def test_after_a_long_stall_sound_resumes_at_its_pace_instead_of_in_a_burst(stage):
    _, delivered = stage.open(lead=4)
    stage.run(1.0)
    before = len(blocks(delivered))
    stage.clock.now_s += 60.0
    stage.run(1.0)
    assert len(blocks(delivered)) - before == pytest.approx(1.0 / BLOCK_S, abs=6)
    # The block that the stall held up is late, and says when it should have been there.
    assert blocks(delivered)[before].deadline_s < stage.clock.now_s - 60.0


def test_a_short_stall_is_made_up_for(stage):
    _, delivered = stage.open(lead=4)
    stage.run(1.0)
    stage.clock.now_s += 0.2
    stage.run(1.0)
    assert len(blocks(delivered)) == pytest.approx(2.2 / BLOCK_S + 4, abs=2)


def test_messages_beyond_the_limit_are_refused_until_the_next_block(stage):
    stream, _ = stage.open()
    accepted = [stream.offer(Acknowledge(sequence=k)) for k in range(300)]
    assert accepted == [True] * MAX_WAITING_MESSAGES + [False] * (300 - MAX_WAITING_MESSAGES)
    stage.run(BLOCK_S)
    assert stream.offer(Acknowledge(sequence=900))


def test_a_pose_takes_the_place_of_an_older_one_that_nobody_has_heard(stage):
    """But not across anything else, and never of a newer one, which has to be refused."""
    stream, delivered = stage.open()
    stage.run(4 * BLOCK_S)

    def say(*messages):
        assert all(stream.offer(message) for message in messages)
        delivered.clear()
        stage.run(2 * BLOCK_S)
        errors = [each.code for each in delivered if isinstance(each, Error)]
        return errors, blocks(delivered)[-1].block.pose_id

    poses = [ListenerPose(pose_id=number, position=(2.0, 2.0, 1.5)) for number in range(1, 1_001)]
    assert say(*poses) == ([], 1_000)
    assert stream.times.pose.durations.count == 1
    later = [ListenerPose(pose_id=number, position=(2.0, 2.0, 1.5)) for number in (1_002, 1_001)]
    assert say(*later) == (["stale_pose"], 1_002)
    between = MoveEmitter(id="ghost", position=(2.0, 2.0, 1.5), pose_id=2_000)
    assert say(poses[0].model_copy(update={"pose_id": 1_003}), between, later[0]) == (
        ["unknown_emitter", "stale_pose"],
        1_003,
    )


def test_the_real_threads_keep_time_and_stop(field, filters):
    arrived, enough = [], threading.Event()

    def deliver(items):
        arrived.extend(blocks(items))
        if len(arrived) >= 60:
            enough.set()

    with Workers(1) as workers:
        engine = AudioEngine(lambda call: call(), workers, threads=2)
        hello = Hello(protocol=PROTOCOL, scene="flat")
        clip = np.ones(64, np.float32)
        engine.start()
        stream = open_stream(hello, field, filters, lambda _: clip, window=1_000, lead=8, deliver=deliver)
        engine.open(stream)
        add(stream)
        assert enough.wait(5)
        engine.stop()
    assert arrived[-1].block.samples.any()
    assert not [thread.name for thread in threading.enumerate() if thread.name.startswith("nafir-audio")]


@pytest.mark.skipif(sys.platform != "linux", reason="priorities of single threads are Linux's")
def test_where_real_time_is_refused_the_engine_says_so_once_and_runs(field, filters, monkeypatch, caplog):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    ticked = threading.Event()
    with Workers(1) as workers:
        engine = AudioEngine(lambda call: call(), workers, threads=3, is_real_time=True)
        hello, clip = Hello(protocol=PROTOCOL, scene="flat"), np.ones(64, np.float32)
        engine.start()
        engine.open(open_stream(hello, field, filters, lambda _: clip, lead=1, deliver=lambda _: ticked.set()))
        assert ticked.wait(5)
        engine.stop()
    assert [record.getMessage() for record in caplog.records] == [
        "audio threads run at ordinary priority: Operation not permitted"
    ]


def test_samples_that_are_no_audio_are_told_of_once_a_second_and_the_stream_goes_on(stage):
    stream, delivered = stage.open()
    stream.offer(AddEmitter(id="voice", live=True, position=(2.0, 3.0, 1.5)))
    for sequence in range(3):
        stream.offer(DryBlock("voice", sequence, np.full(512, np.nan, np.float32)))
    stage.run(0.1)
    stage.workers.run()
    stage.run(2.5)
    errors = [item for item in delivered if isinstance(item, Error)]
    assert [(error.code, error.field) for error in errors] == [("bad_samples", "samples")]
    assert "1536 samples" in errors[0].message
    first, second = (item.live[0] for item in delivered if isinstance(item, Status))
    assert (first.id, first.samples_gated, second.samples_gated) == ("voice", 1536, 1536)
    assert second.underruns == 1
    assert all(np.isfinite(item.block.samples).all() for item in blocks(delivered))


def test_for_a_client_that_acknowledges_nothing_rendering_stops_soon(stage):
    stream, delivered = stage.open(window=10)
    stage.run(10 * BLOCK_S + PAUSE_AFTER_S + 0.1)
    clock = stream.session.sample_clock
    assert len(blocks(delivered)) == 10
    assert stage.thread.tick() is None, "there is nothing to do until somebody says something"
    stage.run(5.0)
    assert stream.session.sample_clock == clock
    assert 6.0 < stream.stalled_s < 6.3


def test_a_stream_that_stood_still_goes_on_where_it_was(stage):
    """Its blocks are due from now on, and none is late for what was before."""
    stream, delivered = stage.open(window=10)
    stage.run(10 * BLOCK_S + PAUSE_AFTER_S + 3.0)
    clock = stream.session.sample_clock
    delivered.clear()
    assert stream.offer(Acknowledge(sequence=9))
    assert stream.has_news
    resumed_s = stage.clock.now_s
    stage.run(5.5 * BLOCK_S)
    sent = blocks(delivered)
    assert [each.block.sequence for each in sent] == list(range(10, 10 + len(sent)))
    assert [each.block.sample_clock for each in sent] == [clock + 256 * number for number in range(len(sent))]
    assert 5 <= len(sent) <= 6
    assert all(each.deadline_s > resumed_s for each in sent)
    assert stream.stalled_s == 0


def test_a_stream_that_stands_still_calls_for_no_responses(stage):
    stream, _ = stage.open(window=10)
    stage.run(10 * BLOCK_S + PAUSE_AFTER_S + 0.1)
    stage.workers.work.clear()
    stream.offer(AddEmitter(id="a", clip="any", position=(2.0, 3.0, 1.5)))
    stage.run(1.0)
    assert stage.workers.work == []
    stream.offer(Acknowledge(sequence=9))
    stage.run(BLOCK_S)
    assert stage.workers.work


def test_a_short_stall_costs_only_what_there_was_no_room_for(stage):
    stream, delivered = stage.open(window=10)
    stage.run(10 * BLOCK_S + PAUSE_AFTER_S / 2)
    delivered.clear()
    stream.offer(Acknowledge(sequence=9))
    stage.run(2.5 * BLOCK_S)
    (first, *_) = blocks(delivered)
    dropped = stream.session.blocks_dropped
    assert (first.block.sequence, first.block.sample_clock) == (10, 256 * (10 + dropped))
    assert dropped * BLOCK_S == pytest.approx(PAUSE_AFTER_S / 2, abs=6 * BLOCK_S)


@pytest.fixture
def running(field, filters):
    """An engine with two threads that run, and a watch over them; opens a stream that plays, and gives what it is
    delivered."""
    with Workers(1) as workers:
        engine = AudioEngine(lambda call: call(), workers, threads=2)
        engine.start()

        def opened():
            delivered = []
            clip = np.ones(64, np.float32)
            hello = Hello(protocol=PROTOCOL, scene="flat")
            stream = open_stream(
                hello, field, filters, lambda _: clip, window=100_000, lead=8, deliver=delivered.extend
            )
            engine.open(stream)
            add(stream)
            return delivered

        yield engine, ThreadWatch((engine,)), opened
        engine.stop()


def wait_until(condition):
    until_s = time.monotonic() + 10
    while not condition():
        assert time.monotonic() < until_s
        time.sleep(0.005)


@threads_may_die
def test_streams_of_a_thread_that_died_between_two_ticks_go_on_where_they_were_on_another(running):
    engine, watch, opened = running
    streams = [opened() for _ in range(4)]
    wait_until(lambda: all(len(blocks(delivered)) > 50 for delivered in streams))
    dead = engine.threads[0]
    dead.tick = lambda: 60.0  # so that it dies at rest
    wait_until(lambda: dead.work_number is None)
    kill(dead._thread)
    dead._wake.set()
    wait_until(lambda: dead.is_dead)
    before = [len(blocks(delivered)) for delivered in streams]
    watch.look()
    wait_until(
        lambda: all(len(blocks(delivered)) > count + 50 for delivered, count in zip(streams, before, strict=True))
    )
    for delivered in streams:
        assert not any(isinstance(item, StreamFailed) for item in delivered)
        sent = [item.block for item in blocks(delivered)]
        assert [block.sequence for block in sent] == list(range(len(sent)))
        assert [block.sample_clock for block in sent] == list(range(0, 256 * len(sent), 256))
        assert sent[-1].samples.any()
    assert watch.restarts == {"nafir-audio-0": 1}
    # The pace is that of time again: what comes is due now, and not a minute ago or hence.
    now_s = time.monotonic()
    assert all(abs(stream.due_s - now_s) < 1 for stream in engine.streams)


@threads_may_die
def test_streams_that_a_thread_died_at_are_told_and_new_ones_are_served(running):
    engine, watch, opened = running
    at_work = [opened() for _ in range(4)]
    wait_until(lambda: all(blocks(delivered) for delivered in at_work))
    dead, elsewhere = engine.threads
    dead.turns.deal = lambda _: sys.exit()  # which no boundary between streams holds back
    wait_until(lambda: dead.is_dead)
    watch.look()
    told = [delivered for delivered in at_work if isinstance(delivered[-1], StreamFailed)]
    assert len(told) == 2
    assert engine.threads[1] is elsewhere
    for stream in engine.streams[:1]:
        engine.close(stream)
    newcomers = [opened() for _ in range(4)]
    wait_until(lambda: all(len(blocks(delivered)) > 20 for delivered in newcomers))


def test_of_a_thread_that_is_stuck_the_streams_are_told_and_stopping_does_not_wait_for_it(running):
    engine, watch, opened = running
    streams = [opened() for _ in range(2)]
    wait_until(lambda: all(blocks(delivered) for delivered in streams))
    stuck, release = engine.threads[1], threading.Event()
    stuck.turns.deal = lambda _: release.wait(30)
    wait_until(lambda: not stuck._thread.is_alive() or stuck.work_number is not None)
    number = stuck.work_number
    wait_until(lambda: stuck.work_number == number)
    for _ in range(11):
        watch.look()
    assert watch.stuck == ("nafir-audio-1",)
    for _ in range(20):
        watch.look()
    assert [isinstance(delivered[-1], StreamFailed) for delivered in streams].count(True) == 1
    began_s = time.monotonic()
    engine.stop()
    assert time.monotonic() - began_s < 5
    release.set()


def test_what_was_counted_stays_counted_when_a_thread_is_replaced(stage):
    stage.thread.steps["load"] += 3
    stage.engine.replace(stage.thread)
    assert stage.engine.steps["load"] == 3
    stage.engine.stop()
