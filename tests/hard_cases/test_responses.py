"""Impulse responses that are empty, silent, too short, too long, too loud, or exchanged faster than they can fade."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.rendering.convolver import Convolver
from tests.hard_cases.listening import (
    IR_SAMPLES,
    SIZE,
    convolved,
    energy_db,
    hear,
    not_finite,
    passive_energy_db,
    play,
    played,
    renderer,
    room,
)
from tests.signals import error_db, noise

ENDURANCE = 2 * SIZE + IR_SAMPLES
"""After so many samples whatever was heard before has left."""


def undisturbed(measured, engine, clip, ir, blocks, started=0):
    """What follows is the clip in that response, as if nothing had happened."""
    samples = (started + blocks) * SIZE
    expected = convolved(played(clip, samples), ir, samples)[:, started * SIZE :]
    measured("error of what goes on", error_db(hear(engine, blocks), expected), -120, "dB")


@pytest.mark.parametrize(
    "ir",
    [
        np.zeros((2, 0), np.float32),
        np.zeros((0, 10), np.float32),
        np.zeros((3, 10), np.float32),
        np.zeros(10, np.float32),
        np.zeros((2, IR_SAMPLES + 1), np.float32),
    ],
    ids=["empty", "no channel", "three channels", "flat", "too long"],
)
def test_a_response_of_an_impossible_shape_is_refused_and_sound_goes_on(measured, ir):
    engine, clip = renderer(), noise(1, 5_000)
    play(engine, clip, room(2))
    hear(engine, 3)
    with pytest.raises(ValueError, match="shape"):
        engine.set_ir("a", ir)
    undisturbed(measured, engine, clip, room(2), 10, started=3)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e30])
def test_a_response_with_a_sample_that_is_no_sound_is_refused_and_sound_goes_on(measured, bad):
    engine, clip = renderer(), noise(1, 5_000)
    play(engine, clip, room(2))
    hear(engine, 3)
    spoilt = room(3)
    spoilt[1, 4_000] = bad
    with pytest.raises(ValueError, match="not finite, or beyond"):
        engine.set_ir("a", spoilt)
    undisturbed(measured, engine, clip, room(2), 10, started=3)


def test_an_all_zero_response_is_silence_to_the_bit(measured):
    engine = renderer()
    play(engine, noise(1, 5_000), np.zeros((2, IR_SAMPLES), np.float32))
    measured("largest sample", np.abs(hear(engine, 40)).max(), 0.0)


@pytest.mark.parametrize("position", [0, 1, SIZE - 1, SIZE, IR_SAMPLES - 1])
def test_a_response_of_one_sample_delays_and_nothing_else(measured, position):
    ir = np.zeros((2, position + 1), np.float32)
    ir[:, position] = (0.5, -2.0)
    engine, clip = renderer(), noise(1, 5_000)
    play(engine, clip, ir)
    undisturbed(measured, engine, clip, ir, 40)


@pytest.mark.parametrize("samples", [1, 2, SIZE - 1, SIZE, SIZE + 1, 4 * SIZE + 3, 5_003, IR_SAMPLES - 1])
def test_a_response_need_not_fill_its_partitions(measured, samples):
    engine, clip, ir = renderer(), noise(1, 5_000), room(4)[:, :samples]
    play(engine, clip, ir)
    undisturbed(measured, engine, clip, ir, 40)


def test_a_response_that_never_decays_is_no_louder_than_it_says(measured):
    """A reverberation time of minutes: the end is as loud as the beginning."""
    ir = (0.02 * noise(5, 2, IR_SAMPLES)).astype(np.float32)
    engine, clip = renderer(), noise(1, 5_000)
    play(engine, clip, ir, loop=False)
    heard = hear(engine, 60)
    measured("error", error_db(heard, convolved(played(clip, 60 * SIZE, loop=False), ir, 60 * SIZE)), -115, "dB")
    measured("energy beyond what the response allows", energy_db(heard) - passive_energy_db(clip, ir), 0.0, "dB")


def test_a_reverberation_time_of_zero_is_an_echo_and_then_silence(measured):
    ir = np.zeros((2, IR_SAMPLES), np.float32)
    ir[:, 0] = 1
    engine, clip = renderer(), noise(1, SIZE)
    play(engine, clip, ir, loop=False)
    hear(engine, 1)
    measured("after the echo", np.abs(hear(engine, 30)).max(), 2e-6)


def test_a_response_of_denormal_numbers_is_all_but_silent(measured):
    engine = renderer()
    play(engine, noise(1, 5_000), np.full((2, IR_SAMPLES), 1e-40, np.float32))
    heard = hear(engine, 30)
    measured("largest sample", np.abs(heard).max(), 1e-33)


@pytest.mark.parametrize("seed", range(4))
def test_wet_energy_is_never_more_than_the_response_allows(measured, seed):
    engine, clip, ir = renderer(), noise(seed, 3_000), room(seed + 10)
    play(engine, clip, ir, loop=False)
    heard = hear(engine, 40)
    measured("energy beyond what the response allows", energy_db(heard) - passive_energy_db(clip, ir), 0.0, "dB")


def test_a_tone_at_the_loudest_frequency_comes_as_near_to_the_bound_as_can_be(measured):
    """So that the law above is one that a little more would break."""
    ir = np.zeros((2, 64), np.float32)
    ir[:, ::2] = 0.1
    engine, clip = renderer(), np.ones(40_000, np.float32)
    play(engine, clip, ir, loop=False)
    heard = hear(engine, 160)
    short = energy_db(heard) - passive_energy_db(clip, ir)
    measured("energy beyond what the response allows", short, 0.0, "dB")
    measured("energy short of it", -short, 0.1, "dB")


@given(st.lists(st.tuples(st.integers(0, 4), st.integers(1, 5)), min_size=1, max_size=20))
def test_exchanges_at_any_rate_stay_within_the_loudest_of_their_responses(measured, script):
    """Fades are convex: each sample of a response is never heard louder than the loudest response has it."""
    irs = [room(seed, decay_samples=10.0**seed) for seed in range(4)]
    irs.append(-irs[2])
    engine, clip = renderer(), np.sign(noise(1, 5_000)).astype(np.float32)
    play(engine, clip, irs[0])
    used, heard = {0}, []
    for number, blocks in script:
        engine.set_ir("a", irs[number])
        used.add(number)
        heard.append(hear(engine, blocks))
    bound = np.abs([irs[number] for number in used]).max(axis=0).sum(axis=-1).max()
    wet = np.concatenate(heard, axis=1)
    assert not_finite(wet) == 0
    measured("peak beside the bound", np.abs(wet).max() / bound, 1.0 + 1e-5)
    hear(engine, 3 * (4096 // SIZE) + ENDURANCE // SIZE)
    last = irs[script[-1][0]]
    clock = engine.sample_clock
    expected = convolved(played(clip, clock + 4 * SIZE), last, clock + 4 * SIZE)[:, clock:]
    measured("error once the last has faded in", error_db(hear(engine, 4), expected), -110, "dB")


def test_a_response_turned_upside_down_in_every_block(measured):
    engine, clip, ir = renderer(), np.ones(SIZE, np.float32), room(6)
    play(engine, clip, ir)
    heard = []
    for number in range(60):
        engine.set_ir("a", ir if number % 2 else -ir)
        heard.append(hear(engine, 1))
    measured("peak beside the bound", np.abs(heard).max() / np.abs(ir).sum(axis=-1).max(), 1.0 + 1e-5)


def test_exchanging_a_response_for_itself_changes_nothing(measured):
    engine, clip, ir = renderer(), noise(1, 5_000), room(7)
    play(engine, clip, ir)
    for _ in range(10):
        engine.set_ir("a", ir.copy())
        hear(engine, 1)
    undisturbed(measured, engine, clip, ir, 20, started=10)


def test_a_short_response_takes_over_from_a_long_one_and_the_tail_leaves(measured):
    engine, clip = renderer(), noise(1, 5_000)
    play(engine, clip, room(8, decay_samples=3_000))
    hear(engine, 40)
    short = room(9)[:, :5]
    engine.set_ir("a", short)
    hear(engine, 3 * (4096 // SIZE) + ENDURANCE // SIZE)
    clock = engine.sample_clock
    expected = convolved(played(clip, clock + 8 * SIZE), short, clock + 8 * SIZE)[:, clock:]
    measured("error once it has", error_db(hear(engine, 8), expected), -110, "dB")


def test_a_shared_tail_of_silent_responses_is_silent(measured):
    engine = renderer(ir_samples=20_000, shared_tail=True)
    for name in ("a", "b"):
        play(engine, noise(1, 5_000), np.zeros((2, 20_000), np.float32), name=name)
    measured("largest sample", np.abs(hear(engine, 100)).max(), 0.0)


@pytest.mark.parametrize("amplitude", [1e-30, 1e-6, 1.0, 1e6])
def test_compiled_and_plain_convolution_agree_at_any_level(measured, amplitude):
    clip, ir = amplitude * noise(1, 1, 40 * SIZE), room(2)
    outputs = []
    for any_size in (False, True):
        convolver = Convolver(sources=1, channels=2, block_size=SIZE, ir_samples=IR_SAMPLES, any_size=any_size)
        convolver.set_ir(0, ir)
        blocks = [convolver.process(clip[:, at : at + SIZE].copy()) for at in range(0, clip.shape[1], SIZE)]
        outputs.append(np.concatenate(blocks, axis=1).astype(np.float64))
    expected = convolved(clip[0], ir, clip.shape[1])
    measured("error of the compiled one", error_db(outputs[0], expected), -120, "dB")
    measured("error of the plain one", error_db(outputs[1], expected), -120, "dB")
