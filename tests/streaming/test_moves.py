"""Streams that move from one audio thread to another, in engines ticked by hand, and once on real threads."""

import itertools
import random
import threading
import time
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from server.protocol.client_messages import (
    PROTOCOL,
    Acknowledge,
    AddEmitter,
    Hello,
    ListenerPose,
    MoveEmitter,
    RemoveEmitter,
    SetGain,
)
from server.protocol.server_messages import EmitterAdded
from server.runtime.workers import Workers
from server.streaming.audio_engine import PHASES, AudioEngine
from server.streaming.load_policy import RenderAhead, ThreadState
from server.streaming.load_thresholds import THRESHOLDS
from server.streaming.stream import PAUSE_AFTER_S, StreamFailed, TimedBlock
from tests.engine_stage import BLOCK_S, Clock, Patient, blocks, open_stream

CLIP = np.random.default_rng(3).standard_normal(24_000).astype(np.float32)


class TwoThreads:
    """An engine of two threads, ticked by hand. What threads post happens at once, or when told to."""

    def __init__(self, field, filters):
        self.clock, self.workers, self.field, self.filters = Clock(), Patient(), field, filters
        self.posted = None
        self.engine = AudioEngine(self._post, self.workers, threads=2, time_s=self.clock)

    def _post(self, call):
        call() if self.posted is None else self.posted.append(call)

    def hold(self):
        """Have posted calls wait for `let_go`."""
        self.posted = []

    def let_go(self):
        posted, self.posted = self.posted, None
        for call in posted:
            call()

    def open(self, *, lead=4, window=100_000):
        delivered = []
        stream = open_stream(
            Hello(protocol=PROTOCOL, scene="flat"),
            self.field,
            self.filters,
            lambda _: CLIP,
            window=window,
            lead=lead,
            deliver=delivered.extend,
        )
        self.engine.open(stream)
        return stream, delivered

    def number_of(self, stream):
        return self.engine.threads.index(self.engine._thread_of[stream])

    def move(self, stream):
        """Have a stream go to the other thread, as if the policy had said so."""
        number = self.number_of(stream)
        source = self.engine.threads[number]
        source.hand_over(stream, partial(self.engine._take_over, stream, source, 1 - number))

    def tick(self):
        for thread in self.engine.threads:
            while (wait_s := thread.tick()) is not None and wait_s <= 0:
                pass

    def run(self, duration_s, step_s=BLOCK_S / 8):
        end_s = self.clock.now_s + duration_s
        while self.clock.now_s < end_s:
            self.tick()
            self.clock.now_s += step_s

    def holders(self, stream):
        return [number for number, thread in enumerate(self.engine.threads) if stream in thread._streams]


@pytest.fixture
def pair(field, filters):
    return TwoThreads(field, filters)


def messages_at(block):
    """What a client says when its stream comes to a block."""
    number = block // 3
    if block == 4:
        return [AddEmitter(id="a", clip="any", loop=True, position=(2.0, 3.0, 1.5))]
    if block == 20:
        return [AddEmitter(id="b", clip="any", loop=True, position=(4.0, 2.0, 1.2))]
    if block == 160:
        return [RemoveEmitter(id="a")]
    if block < 8 or block % 3:
        return []
    told = [ListenerPose(pose_id=number, position=(2.0 + 0.005 * number, 2.0, 1.5), yaw=0.07 * number)]
    if block > 24:
        told.append(MoveEmitter(id="b", position=(4.0, 2.0 + 0.01 * number, 1.2), pose_id=10_000 + number))
    if block % 12 == 0:
        told.append(SetGain(id="b" if block > 24 else "a", gain_db=-(number % 5)))
    return told


def play(pair, *, until_block, move_every=None, others=0):
    """What a stream delivers that is told the same at the same sample clocks, moved or not."""
    for _ in range(others):
        pair.open()
    stream, delivered = pair.open()
    said, moved = 0, 0
    while stream.next_block < until_block:
        pair.tick()
        while said < stream.next_block:
            said += 1
            pair.workers.run()
            for message in messages_at(said):
                assert stream.offer(message)
            if move_every is not None and said % move_every == 0:
                pair.move(stream)
                moved += 1
        pair.clock.now_s += BLOCK_S / 16
    assert pair.engine.moves == pytest.approx(moved, abs=4)  # the first blocks come at once
    return delivered


def facts(delivered):
    return [
        (item.block.sequence, item.block.sample_clock, item.block.pose_id, item.block.reverberation_pose_id,
         item.block.is_exchange, item.block.samples.tobytes())
        if isinstance(item, TimedBlock) else item
        for item in delivered
        if isinstance(item, TimedBlock | EmitterAdded)
    ]  # fmt: skip


@pytest.mark.parametrize("others", [0, 3])
@pytest.mark.parametrize("move_every", [1, 7, 40])
def test_a_stream_that_moves_sounds_as_one_that_stays_to_the_last_bit(field, filters, move_every, others):
    stays = play(TwoThreads(field, filters), until_block=240, others=others)
    moves = play(TwoThreads(field, filters), until_block=240, move_every=move_every, others=others)
    assert facts(moves) == facts(stays)
    assert [item.deadline_s for item in blocks(moves)] == [item.deadline_s for item in blocks(stays)]
    sounding = [item.block for item in blocks(moves) if np.abs(item.block.samples).max() > 1e-3]
    assert len(sounding) > 200
    assert sum(block.is_exchange for block in sounding) > 20


def test_after_a_move_blocks_are_rendered_at_an_instant_of_the_new_thread_and_not_later(pair):
    first, _ = pair.open(lead=1)
    pair.clock.now_s += 0.3 * BLOCK_S
    second, _ = pair.open(lead=1)
    pair.run(10 * BLOCK_S)
    assert [pair.number_of(stream) for stream in (first, second)] == [0, 1]
    natural_s = first.due_s
    pair.move(first)
    pair.run(4.2 * BLOCK_S)
    assert pair.number_of(first) == 1
    assert ((first.due_s - second.due_s) * PHASES / BLOCK_S) % 1 == pytest.approx(0.0, abs=1e-6)
    early = (natural_s - first.due_s) / BLOCK_S % 1
    assert 0 < first.clock.early_s < BLOCK_S
    assert early == pytest.approx(first.clock.early_s / BLOCK_S, abs=1e-6)
    # And at the other instant than the stream that is there.
    assert abs(first.due_s - second.due_s) % BLOCK_S == pytest.approx(BLOCK_S / PHASES, abs=1e-6)
    pair.move(first)
    pair.run(2 * BLOCK_S)
    assert first.clock.early_s == pytest.approx(0.0, abs=1e-9), "back at home its blocks are due as before"


@pytest.mark.parametrize(("before", "after"), [(1, 8), (8, 1), (8, 8), (2, 4)])
def test_no_block_is_lost_or_made_twice_between_threads_that_render_ahead_differently(pair, before, after):
    stream, delivered = pair.open(lead=8)
    for thread, count in zip(pair.engine.threads, (before, after), strict=True):
        thread._look = lambda *_: None
        thread._load = ThreadState(RenderAhead(count))
    staying = pair.open(lead=8), pair.open(lead=8)
    for _ in range(6):
        pair.run(17 * BLOCK_S)
        pair.move(stream)
    pair.run(17 * BLOCK_S)
    assert pair.engine.moves == 6
    for each in (delivered, *(other for _, other in staying)):
        sent = blocks(each)
        assert [item.block.sequence for item in sent] == list(range(len(sent)))
        assert [item.block.sample_clock for item in sent] == list(range(0, 256 * len(sent), 256))
        np.testing.assert_allclose(np.diff([item.deadline_s for item in sent]), BLOCK_S, rtol=1e-6)
    assert len(blocks(delivered)) >= 7 * 17


def test_between_two_threads_a_stream_belongs_to_neither_and_then_goes_on(pair):
    stream, delivered = pair.open(lead=4)
    pair.run(10 * BLOCK_S)
    pair.hold()
    pair.move(stream)
    pair.run(2 * BLOCK_S)
    assert pair.holders(stream) == []
    clock = stream.session.sample_clock
    stream.offer(AddEmitter(id="a", clip="any", position=(2.0, 3.0, 1.5)))
    pair.run(BLOCK_S)
    assert stream.session.sample_clock == clock
    pair.let_go()
    pair.run(BLOCK_S)
    assert pair.holders(stream) == [1]
    assert len(pair.workers.work) == 1, "what was said meanwhile is heard"
    pair.run(10 * BLOCK_S)
    assert [item.block.sequence for item in blocks(delivered)] == list(range(len(blocks(delivered))))


def test_an_answer_that_was_asked_for_on_one_thread_comes_on_the_other(pair):
    stream, delivered = pair.open()
    pair.run(2 * BLOCK_S)
    stream.offer(AddEmitter(id="a", clip="any", position=(2.0, 3.0, 1.5)))
    pair.run(2 * BLOCK_S)
    assert len(pair.workers.work) == 1
    pair.move(stream)
    pair.run(2 * BLOCK_S)
    assert pair.number_of(stream) == 1
    pair.workers.run()
    assert pair.engine.threads[1]._wake.is_set()
    pair.run(2 * BLOCK_S)
    assert any(isinstance(item, EmitterAdded) for item in delivered)


@pytest.mark.parametrize("when", ["before", "between", "after"])
def test_a_stream_that_is_closed_while_it_moves_is_nowhere_afterwards(pair, when):
    stream, delivered = pair.open()
    stream.offer(AddEmitter(id="a", clip="any", position=(2.0, 3.0, 1.5)))
    pair.run(4.1 * BLOCK_S)
    (asked, *_) = (future for future, _, _ in pair.workers.work)
    pair.hold()
    pair.move(stream)
    if when == "before":
        pair.engine.close(stream)
        pair.run(2 * BLOCK_S)
        pair.let_go()
    else:
        pair.run(2 * BLOCK_S)
        if when == "between":
            pair.engine.close(stream)
        pair.let_go()
        pair.engine.close(stream)
    pair.run(2 * BLOCK_S)
    count = len(delivered)
    pair.run(20 * BLOCK_S)
    assert pair.holders(stream) == []
    assert pair.engine.streams == ()
    assert len(delivered) == count
    assert asked.cancelled()
    assert not pair.engine.threads[0]._leaving


def test_a_stream_that_fails_before_it_is_let_go_moves_nowhere(pair, monkeypatch):
    stream, delivered = pair.open()
    pair.run(4 * BLOCK_S)

    def explode(*_):
        raise ZeroDivisionError

    monkeypatch.setattr(stream.session, "begin_block", explode)
    pair.move(stream)
    pair.run(10 * BLOCK_S)
    assert isinstance(delivered[-1], StreamFailed)
    assert pair.holders(stream) == []
    assert pair.engine.moves == 0
    assert not pair.engine.threads[0]._leaving


def test_a_paused_stream_moves_at_once_and_resumes_where_it_was(pair):
    stream, delivered = pair.open(window=10)
    pair.run(10 * BLOCK_S + PAUSE_AFTER_S + 1.0)
    clock = stream.session.sample_clock
    pair.move(stream)
    pair.run(BLOCK_S)
    assert pair.number_of(stream) == 1
    pair.run(1.0)
    assert stream.session.sample_clock == clock
    delivered.clear()
    stream.offer(Acknowledge(sequence=9))
    assert pair.engine.threads[1]._wake.is_set()
    resumed_s = pair.clock.now_s
    pair.run(5 * BLOCK_S)
    sent = blocks(delivered)
    assert [item.block.sequence for item in sent] == list(range(10, 10 + len(sent)))
    assert sent[0].block.sample_clock == clock
    assert 4 <= len(sent) <= 6
    assert all(item.deadline_s > resumed_s for item in sent)


def test_when_the_old_thread_dies_at_rest_its_successor_keeps_the_stream(pair, monkeypatch):
    """Whether it died before it let go of the stream or after, with the message on its way."""
    for has_let_go in (False, True):
        stream, delivered = pair.open()
        pair.run(5 * BLOCK_S)
        number = pair.number_of(stream)
        source = pair.engine.threads[number]
        pair.hold()
        pair.move(stream)
        if has_let_go:
            pair.run(2 * BLOCK_S)
            assert pair.holders(stream) == []
        successor = source.successor()
        monkeypatch.setattr(successor, "start", lambda: None)
        monkeypatch.setattr(source, "successor", lambda successor=successor: successor)
        pair.engine.replace(source)
        pair.let_go()
        pair.run(10 * BLOCK_S)
        assert pair.holders(stream) == [number]
        assert [item.block.sequence for item in blocks(delivered)] == list(range(len(blocks(delivered))))
        pair.engine.close(stream)
        pair.run(BLOCK_S)


def test_a_stream_goes_to_the_successor_of_a_thread_that_died_meanwhile(pair, monkeypatch):
    stream, _ = pair.open()
    pair.run(5 * BLOCK_S)
    target = pair.engine.threads[1]
    pair.hold()
    pair.move(stream)
    pair.run(2 * BLOCK_S)
    successor = target.successor()
    monkeypatch.setattr(successor, "start", lambda: None)
    monkeypatch.setattr(target, "successor", lambda: successor)
    pair.engine.replace(target)
    pair.let_go()
    pair.run(2 * BLOCK_S)
    assert pair.engine._thread_of[stream] is successor
    assert pair.holders(stream) == [1]


def busy_with(pair, shares):
    """Have blocks of streams take these shares of a core."""
    for thread in pair.engine.threads:
        render = thread._render

        def slowly(due, made, render=render):
            render(due, made)
            for each in due:
                share = shares.get(each.stream, 0.0)
                pair.clock.now_s += share * each.blocks * BLOCK_S
                each.stream.load = share

        thread._render = slowly


def test_threads_that_have_become_uneven_become_even_again(pair):
    streams = [pair.open(lead=8)[0] for _ in range(6)]
    shares = dict.fromkeys(streams, 0.05)
    busy_with(pair, shares)
    pair.run(4.0)
    assert pair.engine.moves == 0
    for stream in streams:
        if pair.number_of(stream) == 0:
            shares[stream] = 0.18
    pair.run(20.0, step_s=BLOCK_S / 32)
    assert pair.engine.moves == 1
    demand = [sum(shares[stream] for stream in thread._streams) for thread in pair.engine.threads]
    assert max(demand) == pytest.approx(0.36)
    assert [count for count, _ in pair.engine.loads().values()] == [2, 4]
    pair.run(20.0, step_s=BLOCK_S / 32)
    assert pair.engine.moves == 1


def test_neither_thread_steps_a_stream_up_or_down_for_what_was_before_a_move(pair):
    stream, _ = pair.open()
    pair.run(5 * BLOCK_S)
    busy = RenderAhead(4, mean_busy=0.9, periods=20, long_mean=0.9, caution=2)
    for thread in pair.engine.threads:
        thread._look = lambda *_: None
        thread._load = ThreadState(busy, overloaded_periods=1, well_since_s=1.0)
    there, _ = pair.open()
    pair.run(BLOCK_S)
    pair.engine.threads[1]._load = ThreadState(busy, overloaded_periods=1, well_since_s=1.0)
    ladder = stream.ladder = replace(stream.ladder, caution=4, moved_s=40.0)
    pair.move(stream)
    pair.run(3 * BLOCK_S)
    assert pair.number_of(stream) == pair.number_of(there) == 1
    for thread in pair.engine.threads:
        assert thread._load == ThreadState(RenderAhead(4, caution=2))
    assert stream.ladder is ladder


def test_streams_that_come_together_are_taken_to_need_what_others_need(pair):
    """Not the least that there is, or all of them would go to the thread with one stream less."""
    old = [pair.open()[0] for _ in range(2)]
    pair.run(3.0)
    for stream in old:
        stream.load = 0.2
    pair.engine.close(old[1])
    pair.run(BLOCK_S)
    came = [pair.open()[0] for _ in range(5)]
    assert [pair.number_of(stream) for stream in came] == [1, 0, 1, 0, 1]


def test_no_stream_opens_on_a_thread_that_is_stuck(pair):
    for _ in range(2):
        pair.open()
    pair.run(1.0)
    pair.engine.threads[0]._is_ticking = True
    pair.clock.now_s += 3.0
    pair.engine.threads[1].tick()
    assert pair.engine.threads[0].busy_share is None
    assert [pair.number_of(pair.open()[0]) for _ in range(3)] == [1, 1, 1]


@pytest.mark.timed
@pytest.mark.parametrize("seconds", [2.0, pytest.param(6.0, marks=pytest.mark.long)])
def test_on_real_threads_streams_move_to_and_fro_and_end_and_none_loses_a_block(field, filters, seconds):
    loop = threading.Lock()  # posted calls run one at a time, as on an event loop
    rng = random.Random(7)

    def post(call):
        with loop:
            call()

    with Workers(1) as workers:
        engine = AudioEngine(post, workers, threads=3)
        engine.start()
        delivered = {}

        def opened():
            items = []
            stream = open_stream(
                Hello(protocol=PROTOCOL, scene="flat"),
                field,
                filters,
                lambda _: CLIP,
                window=100_000,
                lead=8,
                deliver=items.extend,
            )
            delivered[stream] = items
            with loop:
                engine.open(stream)
            stream.offer(AddEmitter(id="a", clip="any", loop=True, position=(2.0, 3.0, 1.5)))

        for _ in range(9):
            opened()
        until_s = time.monotonic() + seconds
        for number in itertools.count():
            if time.monotonic() > until_s:
                break
            time.sleep(0.002)
            with loop:
                stream = rng.choice(engine.streams)
                source = engine._thread_of[stream]
                source.hand_over(stream, partial(engine._take_over, stream, source, rng.randrange(3)))
            if number % 50 == 0:
                with loop:
                    engine.close(rng.choice(engine.streams))
                opened()
        with loop:
            left, moves = engine.streams, engine.moves
            counts = {stream: len(blocks(delivered[stream])) for stream in left}
        time.sleep(1.0)
        held = [stream for thread in engine.threads for stream in thread._streams]
        engine.stop()
    assert moves > 100
    assert len(left) == 9
    assert sorted(map(id, held)) == sorted(map(id, left))
    for stream, items in delivered.items():
        sent = [item.block for item in blocks(items)]
        assert [block.sequence for block in sent] == list(range(len(sent)))
        assert [block.sample_clock for block in sent] == list(range(0, 256 * len(sent), 256))
        assert not any(isinstance(item, StreamFailed) for item in items)
        if stream in counts:
            assert len(sent) > counts[stream]


def test_the_threshold_of_a_move_lies_above_what_a_period_can_show_by_chance():
    assert THRESHOLDS.stay_s > THRESHOLDS.uneven_periods * THRESHOLDS.period_s
    assert THRESHOLDS.full_periods < THRESHOLDS.uneven_periods
