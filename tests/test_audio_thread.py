import threading
from concurrent.futures import Executor, Future, ThreadPoolExecutor

import numpy as np
import pytest

from server.audio_thread import MAX_WAITING_MESSAGES, AudioThread, Stream, StreamFailed, TimedBlock
from server.protocol import AddEmitter, EmitterAdded, Error, Hello, ListenerPose, Status
from server.session import Session

BLOCK_S = 256 / 24_000


class Clock:
    """Time passes only when a test says so."""

    now_s = 50.0

    def __call__(self):
        return self.now_s


class Patient(Executor):
    """Runs what it was given when told to."""

    def __init__(self):
        self.work = []

    def submit(self, function, /, *arguments):
        future = Future()
        self.work.append((future, function, arguments))
        return future

    def run(self):
        for future, function, arguments in self.work:
            try:
                future.set_result(function(*arguments))
            except ValueError as exc:
                future.set_exception(exc)
        self.work.clear()


class Stage:
    """An audio thread that is not running, ticked by hand, and what its streams delivered."""

    def __init__(self, field):
        self.clock, self.workers, self.field = Clock(), Patient(), field
        self.audio = AudioThread(lambda call: call(), self.workers, time_s=self.clock)

    def open(self, *, lead=4, window=1_000):
        clip = np.ones(64, np.float32)
        session = Session(Hello(protocol=1, scene="flat"), self.field, lambda _: clip, window=window)
        delivered = []
        stream = Stream(session, self.field, block_s=BLOCK_S, lead=lead, deliver=delivered.extend)
        self.audio.open(stream)
        return stream, delivered

    def run(self, duration_s, step_s=BLOCK_S / 4):
        end_s = self.clock.now_s + duration_s
        while self.clock.now_s < end_s:
            while (wait_s := self.audio.tick()) is not None and wait_s <= 0:
                pass
            self.clock.now_s += step_s


@pytest.fixture
def stage(field):
    return Stage(field)


def blocks(delivered):
    return [item for item in delivered if isinstance(item, TimedBlock)]


def add(stream):
    # So near that its sound arrives within the first block.
    assert stream.offer(AddEmitter(id="a", clip="any", position=(2.0, 3.0, 1.5)))


def test_nothing_to_do_without_streams(stage):
    assert stage.audio.tick() is None


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
    for count in range(1, 9):
        stage.audio.tick()
        assert (len(blocks(first)), len(blocks(second))) == (count, count)


def test_a_closed_stream_makes_no_more_sound_and_closing_twice_does_no_harm(stage):
    stream, delivered = stage.open()
    stage.run(10 * BLOCK_S)
    stage.audio.close(stream)
    stage.audio.close(stream)
    count = len(delivered)
    stage.run(10 * BLOCK_S)
    assert len(delivered) == count


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
    stage.field.impulse_responses = lambda *_: np.full((1, 2, 100), np.inf, np.float32)
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


def test_a_stream_that_breaks_leaves_the_others_sounding(stage):
    broken, complaints = stage.open()
    _, delivered = stage.open()

    def explode():
        raise ZeroDivisionError

    broken.session.render_block = explode
    stage.run(20 * BLOCK_S)
    assert complaints == [StreamFailed()]
    assert len(blocks(delivered)) > 20


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
    assert third.ir_ms.p50 is None
    assert third.unacknowledged == third.blocks_sent


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
    accepted = [stream.offer(ListenerPose(pose_id=k + 1, position=(2.0, 2.0, 1.5))) for k in range(300)]
    assert accepted == [True] * MAX_WAITING_MESSAGES + [False] * (300 - MAX_WAITING_MESSAGES)
    stage.run(BLOCK_S)
    assert stream.offer(ListenerPose(pose_id=900, position=(2.0, 2.0, 1.5)))


def test_the_real_thread_keeps_time_and_stops(field):
    arrived, enough = [], threading.Event()

    def deliver(items):
        arrived.extend(blocks(items))
        if len(arrived) >= 60:
            enough.set()

    with ThreadPoolExecutor(1) as workers:
        audio = AudioThread(lambda call: call(), workers)
        session = Session(Hello(protocol=1, scene="flat"), field, lambda _: np.ones(64, np.float32), window=1_000)
        audio.start()
        stream = Stream(session, field, block_s=BLOCK_S, lead=8, deliver=deliver)
        audio.open(stream)
        add(stream)
        assert enough.wait(5)
        audio.stop()
    assert arrived[-1].block.samples.any()
    assert "nafir-audio" not in {thread.name for thread in threading.enumerate()}
