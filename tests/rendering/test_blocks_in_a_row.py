"""Several blocks of one listener in one call are those that as many calls make."""

from functools import partial

import numpy as np
import pytest

from server.rendering.direct_path import PathTarget
from server.rendering.limiter import CEILING
from server.rendering.renderer import Renderer, render_all
from server.rendering.sources import ClipPlayer, LiveSource
from tests.signals import decaying_noise, noise

SIZE, IR_SAMPLES, SAMPLE_RATE = 64, 500, 24_000
room = partial(decaying_noise, samples=IR_SAMPLES, decay_samples=100, gain=0.1)


@pytest.fixture
def open_renderer(filters):
    def make():
        engine = Renderer(
            block_size=SIZE,
            ir_samples=IR_SAMPLES,
            sample_rate=SAMPLE_RATE,
            filters=filters,
            speed_of_sound=343.0,
            air_db_per_m=np.zeros(7),
            ceiling=CEILING,
        )
        for name in ("a", "b"):
            engine.add_emitter(name, ClipPlayer(noise(ord(name), 900), loop=True), gain=0.02)
            engine.set_ir(name, room(ord(name)))
        return engine

    return make


def tell(engine, turn):
    """What comes before a row of blocks: poses always, responses and gains now and then."""
    for name, offset in (("a", 0.0), ("b", 1.0)):
        angle = 0.05 * turn + offset
        arrival = np.array([np.cos(angle), np.sin(angle), 0.0])
        engine.set_path(name, PathTarget(2.0 + 0.02 * turn, arrival, np.full(7, -0.1 * turn)))
    if turn % 5 == 3:
        engine.set_ir("a", room(200 + turn), token=turn)
    if turn in {11, 14}:
        engine.set_gain("b", 4.0 if turn == 11 else 0.02)  # loud enough for the limiter, for a while


@pytest.mark.parametrize("count", [2, 8])
def test_several_in_one_call_are_as_many_calls_to_the_bit(open_renderer, count):
    alone, together = open_renderer(), open_renderer()
    seen = set()
    for turn in range(30):
        for engine in (alone, together):
            tell(engine, turn)
        one_by_one = [render_all([alone])[0] for _ in range(count)]
        assert together.runs_by_itself
        row = render_all([together] * count)
        for single, of_row in zip(one_by_one, row, strict=True):
            np.testing.assert_array_equal(single.samples, of_row.samples)
            assert (single.is_exchange, single.is_limited) == (of_row.is_exchange, of_row.is_limited)
        seen |= {(number, block.is_exchange, block.is_limited) for number, block in enumerate(row)}
        assert alone.sample_clock == together.sample_clock == count * SIZE * (turn + 1)
    # An exchange is of the first of a row alone, and what is too loud may be any.
    assert {(0, True, False), (1, False, False), (0, False, True), (1, False, True)} <= seen
    assert not {flags for flags in seen if flags[0] > 0 and flags[1]}


def test_listeners_may_be_mixed_in_one_call(open_renderer):
    alone, paired = [open_renderer() for _ in range(3)], [open_renderer() for _ in range(3)]
    for turn in range(6):
        for engine in (*alone, *paired):
            tell(engine, turn)
        expected = [alone[0].process(), alone[0].process(), alone[1].process(), alone[2].process(), alone[2].process()]
        one, two, three = paired
        made = render_all([one, one, two, three, three])
        for samples, rendered in zip(expected, made, strict=True):
            np.testing.assert_array_equal(samples, rendered.samples)


def test_a_renderer_that_has_to_be_asked_or_looked_after_does_not_run_by_itself(open_renderer):
    engine = open_renderer()
    tell(engine, 0)
    engine.process()
    assert engine.runs_by_itself
    engine.remove_emitter("a")  # to ramp down, and ring out
    assert not engine.runs_by_itself
    while not engine.runs_by_itself:
        engine.process()
    engine.add_emitter("live", LiveSource(capacity=4096, lead=2 * SIZE))
    engine.set_ir("live", room(5))
    engine.set_path("live", PathTarget(2.0, np.array([1.0, 0.0, 0.0]), np.zeros(7)))
    engine.process()
    assert not engine.runs_by_itself


def test_who_is_about_to_play_live_is_asked_for_each_block(open_renderer):
    """Its samples wait with it for its first response, and were played as often as there were blocks at once."""
    engine = open_renderer()
    render_all([engine])
    assert engine.runs_by_itself
    live = LiveSource(capacity=4096, lead=2 * SIZE)
    engine.add_emitter("c", live, gain=0.02)
    live.push(noise(1, 8 * SIZE))
    assert engine.runs_by_itself
    engine.set_ir("c", room(3))
    assert not engine.runs_by_itself
