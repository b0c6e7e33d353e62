"""Under load, blocks are rendered several at once, of which none is later than it would be alone."""

import numpy as np
import pytest

from server import audio_engine
from server.audio_engine import PHASES
from server.blocks import DryBlock
from server.load import NUMBERS_AT_ONCE, blocks_at_once
from server.protocol import AddEmitter
from tests.engine_stage import BLOCK_S, Stage, blocks, spy_on_batches

MOST = max(NUMBERS_AT_ONCE)


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


@pytest.fixture(params=[2, 4, 8])
def count(request, monkeypatch):
    """Blocks that are rendered at once from now on."""
    monkeypatch.setattr(audio_engine, "blocks_at_once", lambda _busy, **_: request.param)
    return request.param


def test_more_blocks_at_once_begin_under_load_and_end_well_below_it():
    busy = (0.3, 0.5, 0.57, 0.7, 0.8, 0.9)
    assert [blocks_at_once(share, before=1) for share in busy] == [1, 1, 1, 2, 4, 8]
    assert [blocks_at_once(share, before=2) for share in busy] == [1, 2, 2, 2, 4, 8]
    assert [blocks_at_once(share, before=4) for share in busy] == [1, 2, 4, 4, 4, 8]
    assert [blocks_at_once(share, before=8) for share in busy] == [1, 2, 4, 8, 8, 8]


def test_a_busy_thread_renders_several_at_once_and_an_idle_one_block_by_block(stage, monkeypatch):
    stream, _ = open_sounding(stage)
    busy = 0.0
    follow_poses = stream.session.begin_block

    def take_time():
        follow_poses()
        stage.clock.now_s += busy * BLOCK_S * stage.thread._blocks_of(stream)

    stream.session.begin_block = take_time
    for busy, count in [(0.2, 1), (0.7, 2), (0.8, 4), (0.95, 8), (0.65, 8), (0.57, 4), (0.5, 2), (0.2, 1)]:
        stage.run(1.0)
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
    assert stream.latenesses.total_s >= 0  # what is early makes up for nothing
