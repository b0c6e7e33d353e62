"""Under load, blocks are rendered several at once, of which none is later than it would be alone."""

from itertools import pairwise
from queue import Empty, SimpleQueue

import numpy as np
import pytest

from server.protocol.blocks import DryBlock
from server.protocol.client_messages import PROTOCOL, AddEmitter, Hello, RemoveEmitter
from server.streaming import audio_engine
from server.streaming.audio_engine import PHASES, AudioEngine, AudioThread
from server.streaming.load_policy import RenderAhead, ThreadState
from server.streaming.load_thresholds import THRESHOLDS
from tests.engine_stage import BLOCK_S, Patient, Stage, blocks, open_stream, spy_on_batches

MOST = THRESHOLDS.blocks_at_once[-1]


@pytest.fixture
def stage(field, filters):
    return Stage(field, filters)


def open_sounding(stage, **emitter):
    """A stream with one emitter that is heard."""
    stream, delivered = stage.open(lead=8, window=10_000)
    stream.offer(AddEmitter(id="a", position=(1.0, 2.0, 1.0), **(emitter or {"clip": "tone"})))
    for _ in range(3):
        stage.run(2 * BLOCK_S)
        stage.workers.run()
    return stream, delivered


def render_at_once(monkeypatch, count):
    monkeypatch.setattr(AudioThread, "blocks_at_once", count)


@pytest.fixture(params=[2, 4, 8])
def count(request, monkeypatch):
    """Blocks that are rendered at once from now on."""
    render_at_once(monkeypatch, request.param)
    return request.param


def test_a_thread_that_had_no_streams_begins_with_one(stage):
    stream, _ = stage.open()
    stage.run(BLOCK_S)
    stage.thread._load = ThreadState(RenderAhead(MOST))
    stage.engine.close(stream)
    stage.run(BLOCK_S)
    stage.open()
    stage.run(BLOCK_S)
    assert stage.thread.blocks_at_once == 1


def test_a_busy_thread_renders_several_at_once_and_an_idle_one_block_by_block(stage, monkeypatch):
    stream, _ = open_sounding(stage)
    busy = 0.0
    follow_poses = stream.session.begin_block

    def take_time():
        follow_poses()
        stage.clock.now_s += busy * BLOCK_S * stage.thread._blocks_of(stream)

    stream.session.begin_block = take_time
    # Blocks are nearly late twice within seconds, so that it takes a while to be trusted that the load has gone.
    a_while_s = 2 * THRESHOLDS.relapse_s + 5.0
    for busy, count, for_s in [
        (0.2, 1, 4.0),
        (0.75, 2, 4.0),
        (0.9, 8, 4.0),
        (0.75, 8, 4.0),
        (0.65, 2, 4.0),
        (0.87, 8, 4.0),
        (0.2, 1, a_while_s),
    ]:
        stage.run(for_s)
        batches = spy_on_batches(monkeypatch)
        stage.run(20 * BLOCK_S)
        assert {len(batch) for batch in batches} == {count}, busy


def test_streams_of_an_instant_take_turns(stage, monkeypatch, count):
    """So that no tick is longer than before."""
    for _ in range(count * PHASES):
        stage.open(lead=8, window=10_000)
    stage.run(1.0)
    batches = spy_on_batches(monkeypatch)
    stage.run(40 * BLOCK_S)
    # With the most, those of both instants.
    streams = PHASES if count == MOST else 1
    assert {len(batch) for batch in batches} == {streams * count}
    assert {len(set(map(id, batch))) for batch in batches} == {streams}


def test_who_comes_takes_the_turn_of_who_left(stage):
    """The fewest streams of an instant have their turn together, however many blocks a turn is."""
    streams = [stage.open()[0] for _ in range(MOST * PHASES)]
    stage.run(BLOCK_S)
    left = stage.thread._streams[streams[5]]
    stage.engine.close(streams[5])
    newcomer, _ = stage.open()
    stage.run(BLOCK_S)
    assert stage.thread._streams[newcomer] == left
    assert len(set(stage.thread._streams.values())) == MOST * PHASES


@pytest.mark.parametrize("streams", [MOST * PHASES + more for more in (2, 3, 4)])
def test_long_instants_lie_between_shorter_ones(stage, monkeypatch, streams):
    """What else a core has to do gets its time between them."""
    render_at_once(monkeypatch, MOST)
    for _ in range(streams):
        stage.open(lead=8, window=10_000)
    stage.run(1.0)
    batches = spy_on_batches(monkeypatch)
    stage.run(4 * MOST * BLOCK_S)
    sizes = [len(batch) // MOST for batch in batches]
    assert set(sizes) == {PHASES, PHASES + 1}
    in_a_row = list(pairwise(sizes)).count((PHASES + 1, PHASES + 1))
    assert in_a_row <= len(sizes) / MOST, "once in a cycle at the most"


def test_a_thread_that_fell_behind_begins_with_who_waits_longest(stage, monkeypatch):
    """And has that sent, rather than have it wait for all others."""
    streams = [stage.open(lead=8, window=10_000)[0] for _ in range(7)]
    stage.run(1.0)
    for stream in streams:
        stream.load = 0.5
    stage.clock.now_s += 1.5 * BLOCK_S
    first = sorted(streams, key=lambda stream: stream.due_s)[:3]
    batches = spy_on_batches(monkeypatch)
    assert stage.thread.tick() < 0
    assert [len(batch) for batch in batches] == [3]
    assert set(batches[0]) == {stream.session.renderer for stream in first}


def test_a_thread_without_time_to_sleep_gives_way_until_what_it_made_has_arrived(field, filters, monkeypatch):
    """On one core with the event loop, it would keep that from sending anything."""
    monkeypatch.setattr(audio_engine, "_GIVE_WAY_S", 60.0)
    posted = SimpleQueue()
    engine = AudioEngine(posted.put, Patient())
    hello = Hello(protocol=PROTOCOL, scene="flat")
    stream = open_stream(hello, field, filters, lambda _: np.ones(64, np.float32), lead=8, deliver=lambda _: None)
    engine.start()
    engine.open(stream)
    for _ in range(3):
        arrive = posted.get(timeout=5)
        with pytest.raises(Empty):
            posted.get(timeout=4 * BLOCK_S)
        arrive()
    engine.stop()


def test_time_that_is_given_away_in_arrears_is_taken_for_work(stage):
    """A thread that cannot render in it is as full as if it did."""
    thread = stage.thread

    def wait(longest_s):
        stage.clock.now_s += longest_s

    thread._has_arrived.clear()
    thread._has_arrived.wait = wait
    thread._rest(0.5 * audio_engine._GIVE_WAY_S)
    assert thread._busy_s == 0.0
    thread._rest(-BLOCK_S)
    assert thread._busy_s == pytest.approx(audio_engine._GIVE_WAY_S)


def test_a_thread_with_time_to_sleep_sleeps(field, filters):
    """Whatever the event loop does meanwhile."""
    posted, waited = SimpleQueue(), []
    engine = AudioEngine(posted.put, Patient())
    engine.threads[0]._has_arrived.wait = waited.append
    hello = Hello(protocol=PROTOCOL, scene="flat")
    stream = open_stream(hello, field, filters, lambda _: np.ones(64, np.float32), lead=8, deliver=lambda _: None)
    engine.start()
    engine.open(stream)
    for _ in range(16):  # with those that its lead has it make at once
        posted.get(timeout=5)
    waited.clear()
    for _ in range(10):
        posted.get(timeout=5)
    engine.stop()
    assert len(waited) < 5  # none, but for a test that gets no core for as long as blocks last


@pytest.mark.usefixtures("count")
def test_what_a_client_plays_live_is_never_rendered_ahead(stage, monkeypatch):
    """It has not come yet."""
    stream, delivered = open_sounding(stage, live=True)
    stage.run(1.0)
    batches = spy_on_batches(monkeypatch)
    for sequence in range(10):
        stream.offer(DryBlock("a", sequence, np.ones(256, np.float32)))
        stage.run(BLOCK_S)
    assert {len(batch) for batch in batches} == {1}
    assert len(blocks(delivered)) > 10


@pytest.mark.usefixtures("count")
def test_who_has_something_looked_after_is_rendered_block_by_block_from_then_on(stage, monkeypatch):
    """An emitter that leaves fades out in one block, and lets go of its place after it."""
    stream, _ = open_sounding(stage)
    stage.run(1.0)
    batches = spy_on_batches(monkeypatch)
    stream.offer(RemoveEmitter(id="a"))
    while not batches:
        stage.run(BLOCK_S / 8)
    assert [len(batch) for batch in batches] == [1]


@pytest.mark.usefixtures("count")
def test_no_block_is_later_than_alone(stage):
    stream, delivered = open_sounding(stage)
    stage.run(1.0)
    delivered.clear()
    ready_s = {}
    for _ in range(200):
        stage.run(BLOCK_S / 4)
        for item in blocks(delivered):
            ready_s.setdefault(item.block.sequence, (stage.clock.now_s, item.deadline_s))
        delivered.clear()
    lead_s = 8 * BLOCK_S
    assert len(ready_s) > 40
    assert all(now_s <= deadline_s - lead_s + BLOCK_S / 2 for now_s, deadline_s in ready_s.values())
    assert stream.session.blocks_dropped == 0
    assert stream.times.lateness.total_s >= 0  # what is early makes up for nothing
