"""Gains of nothing, of far too much, and of less than nothing."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.acoustics.geometry import Pose
from server.core.errors import RequestError
from server.offline.render import RenderedEmitter
from server.protocol.client_messages import SetGain, parse_client_message
from server.rendering.ingest import LOUDEST, LOUDEST_GAIN
from tests.hard_cases.listening import (
    IR_SAMPLES,
    SIZE,
    Listening,
    ahead,
    convolved,
    hear,
    not_finite,
    play,
    played,
    renderer,
    room,
)
from tests.signals import error_db, noise

TOO_MUCH = [1e30, -1e30, math.nan, math.inf, -math.inf, 1.01 * LOUDEST_GAIN]
RUNG_OUT = (IR_SAMPLES + 4096) // SIZE + 40


@pytest.mark.parametrize("zero", [0.0, -0.0])
def test_a_gain_of_zero_is_silence_to_the_bit(measured, filters, zero):
    engine = renderer(filters)
    play(engine, noise(1, 3_000), room(2), path=ahead(), gain=zero)
    measured("largest sample", np.abs(hear(engine, 60)).max(), 0.0)


@pytest.mark.parametrize("zero", [0.0, -0.0])
def test_a_gain_that_becomes_zero_ends_in_silence_to_the_bit(measured, filters, zero):
    engine = renderer(filters)
    play(engine, noise(1, 3_000), room(2), path=ahead())
    hear(engine, 20)
    engine.set_gain("a", zero)
    hear(engine, 1 + RUNG_OUT)
    measured("largest sample", np.abs(hear(engine, 20)).max(), 0.0)


def test_gain_comes_back_from_zero_as_if_it_had_not_been_away(measured):
    engine, clip, ir = renderer(), noise(1, 5_000), room(2)
    play(engine, clip, ir)
    for gain in (0.0, 1.0):
        engine.set_gain("a", gain)
        hear(engine, RUNG_OUT)
    clock = engine.sample_clock
    expected = convolved(played(clip, clock + 10 * SIZE), ir, clock + 10 * SIZE)[:, clock:]
    measured("error", error_db(hear(engine, 10), expected), -120, "dB")


@pytest.mark.parametrize("gain", TOO_MUCH)
def test_a_gain_that_would_overflow_is_refused_and_sound_goes_on(measured, gain):
    engine, clip, ir = renderer(), noise(1, 5_000), room(2)
    play(engine, clip, ir)
    hear(engine, 3)
    with pytest.raises(ValueError, match="a gain is finite and at most"):
        engine.set_gain("a", gain)
    with pytest.raises(ValueError, match="a gain is finite and at most"):
        engine.set_reverberation_gain("a", gain)
    expected = convolved(played(clip, 13 * SIZE), ir, 13 * SIZE)[:, 3 * SIZE :]
    measured("error", error_db(hear(engine, 10), expected), -120, "dB")


@pytest.mark.parametrize("gain", TOO_MUCH)
def test_an_emitter_of_such_a_gain_is_not_added_and_takes_no_room(gain):
    engine = renderer(max_emitters=1)
    for _ in range(10):
        with pytest.raises(ValueError, match="a gain is finite"):
            play(engine, noise(1, 100), room(2), gain=gain)
    play(engine, noise(1, 100), room(2))


@pytest.mark.parametrize("gain", TOO_MUCH)
def test_nothing_is_rendered_offline_at_such_a_gain(gain):
    with pytest.raises(ValueError, match="a gain is finite"):
        RenderedEmitter(noise(1, 100), Pose((1.0, 1.0, 1.0)), gain=gain)


@pytest.mark.parametrize(
    "text", ["1e30", "-1e30", "24.001", "-80.001", "NaN", "Infinity", "-Infinity", "1e999", "null"]
)
def test_a_message_of_such_a_gain_is_refused_by_name(text):
    with pytest.raises(RequestError) as caught:
        parse_client_message(f'{{"type": "set_gain", "id": "a", "gain_db": {text}}}')
    assert (caught.value.code, caught.value.field) == ("malformed_message", "gain_db")


@pytest.mark.parametrize("gain", [1e-30, 1e-3, LOUDEST_GAIN, -1.0])
def test_a_gain_scales_and_does_nothing_else(measured, gain):
    engine, clip, ir = renderer(), noise(1, 5_000), room(2)
    play(engine, clip, ir, gain=gain)
    expected = gain * convolved(played(clip, 40 * SIZE), ir, 40 * SIZE)
    measured("error", error_db(hear(engine, 40), expected), -120, "dB")


def test_the_loudest_there_may_be_is_finite(measured, filters):
    """The loudest samples at the highest gain, in every slot at once, at the head, through the loudest response."""
    engine = renderer(filters, max_emitters=4)
    for name in "abcd":
        play(
            engine,
            np.full(1_000, LOUDEST, np.float32),
            np.full((2, IR_SAMPLES), LOUDEST, np.float32),
            path=ahead(0.0),
            name=name,
            gain=LOUDEST_GAIN,
        )
    measured("samples not finite", not_finite(hear(engine, 60)), 0)


def test_after_the_loudest_there_may_be_one_hears_a_whisper(measured):
    """Recovery: what was heard before leaves with the response, and its rounding errors with it."""
    engine, clip, ir = renderer(), noise(1, 5_000), room(2)
    loud = np.full(4 * SIZE, LOUDEST, np.float32)
    play(engine, loud, ir, loop=False)
    hear(engine, 4 + RUNG_OUT)
    play(engine, 1e-3 * clip, ir, name="b")
    samples = 20 * SIZE
    measured("error", error_db(hear(engine, 20), convolved(1e-3 * played(clip, samples), ir, samples)), -120, "dB")


@given(st.lists(st.floats(-10, 10), min_size=1, max_size=12))
def test_a_gain_on_its_way_is_between_where_it_comes_from_and_where_it_goes(measured, gains):
    engine = renderer()
    play(engine, np.ones(SIZE, np.float32), np.ones((2, 1), np.float32), gain=gains[0])
    before = gains[0]
    for gain in gains:
        engine.set_gain("a", gain)
        block = hear(engine, 1)[0]
        low, high = min(before, gain), max(before, gain)
        beyond = max(float(block.max()) - high, low - float(block.min()))
        measured("beyond either", beyond, 2e-5)
        before = gain


@pytest.mark.parametrize("gain_db", [-80.0, 24.0])
def test_a_session_takes_gains_to_their_limits(measured, field, filters, gain_db):
    listening = Listening(field, filters)
    listening.add()
    listening.hear(20)
    assert listening.say(SetGain(id="talker", gain_db=gain_db)) == []
    measured("samples not finite", not_finite(listening.hear(40)), 0)
