"""From spectrograms to responses: silence, the longest response, decays of no time and of minutes."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from server.field.gate import MOST_GIVEN
from tests.hard_cases.predictions import (
    AT,
    COLD,
    COMPILED,
    FROZEN,
    INTEGRATED,
    PHASES,
    SAMPLES,
    WARM,
    decoder_of,
    difference_db,
    energy,
    exact_of,
    flat,
    gate_of,
    parameters,
    predicted,
    predicted_energy,
)

# Silence.


@COMPILED
@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("level", [np.log(1e-5), -12.0, -90.0, -1e30, -np.inf])
def test_the_logarithm_of_silence_is_silence(phase, level, is_compiled):
    """At the floor, beneath it, and without any."""
    some = parameters()
    response = decoder_of(some, phase, is_compiled=is_compiled).decode(flat(some, np.float32(level)), AT)
    assert np.abs(response).max() < 1e-10


def test_silence_is_encoded_at_the_floor_and_decoded_to_silence(measured):
    codec = parameters().codec
    log_magnitude, frequency = codec.encode(np.zeros((2, SAMPLES)))
    np.testing.assert_allclose(log_magnitude, np.log(codec.log_floor))
    assert np.isfinite(frequency).all()
    measured("largest sample", np.abs(codec.decode(log_magnitude, frequency)).max(), 1e-15)


@COMPILED
def test_one_bin_in_silence_sounds_alone(is_compiled, measured):
    some = parameters(known=0)
    codec = some.codec
    quiet = flat(some, np.float32(-np.inf))
    quiet.log_magnitude[0, :, 40, 10:30] = 0.0
    response = decoder_of(some, is_compiled=is_compiled).decode(quiet, AT)
    spectrum = np.abs(np.fft.rfft(response[0])) ** 2
    frequency = np.fft.rfftfreq(SAMPLES) * codec.n_fft
    share = spectrum[:, np.abs(frequency - 40) > 4].sum() / spectrum.sum()
    measured("energy elsewhere", 10 * np.log10(share), -30.0, "dB")


@pytest.mark.parametrize("bin_", [0, -1])
@COMPILED
def test_dc_and_nyquist_alone_have_the_energy_that_was_asked_for(bin_, is_compiled, measured):
    some = parameters(known=0)
    alone = flat(some, np.float32(-np.inf))
    alone.log_magnitude[0, :, bin_] = -2.0
    response = decoder_of(some, is_compiled=is_compiled).decode(alone, np.array([-64.0]))
    assert np.isfinite(response).all()
    measured("energy above the prediction", 10 * np.log10(energy(response) / predicted_energy(some, alone)), 3.0, "dB")


# Double precision.


@COMPILED
def test_the_longest_response_is_decoded_as_in_double_precision(is_compiled, measured):
    """Of five seconds, with the phase of every frame known."""
    codec = parameters(120_000, known=0).codec
    some = parameters(120_000, known=codec.frames)
    spectrograms = predicted(some, decay=5.0)
    found = decoder_of(some, INTEGRATED, is_compiled=is_compiled).decode(spectrograms, AT)
    measured("difference", difference_db(found, exact_of(some, INTEGRATED).decode(spectrograms, AT)), -90.0, "dB")


@COMPILED
@pytest.mark.parametrize(("phase", "bound"), [(FROZEN, -110), (INTEGRATED, -110), (WARM, -100), (COLD, -50)])
def test_single_precision_is_near_double(phase, bound, is_compiled, measured):
    """From zero phase, bins where all cancels decide by rounding which way to turn."""
    some = parameters()
    spectrograms = predicted(some, 3)
    starts = np.array([350.3, -20.7, 2_000.0])
    found = decoder_of(some, phase, is_compiled=is_compiled).decode(spectrograms, starts)
    expected = exact_of(some, phase).decode(spectrograms, starts)
    for one, exact in zip(found, expected, strict=True):
        measured(f"difference, {phase.kind}{' warm' * phase.warm}", difference_db(one, exact), bound, "dB")


# Decays.


@COMPILED
@pytest.mark.parametrize("phase", PHASES)
def test_a_decay_of_no_time_is_over_when_its_frame_is(phase, is_compiled, measured):
    """T60 of zero: one frame sounds, and what follows is silent."""
    some = parameters(known=1)
    click = flat(some, np.float32(-np.inf))
    click.log_magnitude[..., 6] = 0.0
    response = decoder_of(some, phase, is_compiled=is_compiled).decode(click, np.array([300.0]))
    assert np.isfinite(response).all()
    end = 300 + 9 * some.codec.hop + some.codec.n_fft
    after, whole = energy(response[..., end:]), energy(response)
    assert whole > 0
    measured("energy after it", 10 * np.log10(after / whole + 1e-30), -60.0, "dB")


@COMPILED
def test_a_decay_of_minutes_lasts_to_the_end_at_its_level(is_compiled, measured):
    """A T60 of three minutes falls by 0.7 dB in two seconds."""
    some = parameters(48_000, known=1)
    spectrograms = flat(some, 0.0)
    fall = np.log(10) * 3 * (some.codec.frame_times_s / 180.0)
    spectrograms.log_magnitude[:] = (-1.0 - fall).astype(np.float32)
    spectrograms.interaural[:] = 0
    response = decoder_of(some, is_compiled=is_compiled).decode(spectrograms, np.array([0.0]))
    early, late = energy(response[..., 4_000:12_000]), energy(response[..., 38_000:46_000])
    expected_db = -60 * (34_000 / 24_000) / 180
    measured("difference from the decay", abs(10 * np.log10(late / early) - expected_db), 0.5, "dB")


@COMPILED
@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("level", [0.0, 10.0, 40.0])
def test_what_is_decoded_has_the_energy_that_was_predicted_however_loud(phase, level, is_compiled, measured):
    """Passive: no more, but for what the noise is uneven by and what one frame's window lends the next."""
    some = parameters()
    loud = predicted(some, seed=6)
    loud.log_magnitude[:] += np.float32(level)
    response = decoder_of(some, phase, is_compiled=is_compiled).decode(loud, np.array([100.0]))
    assert np.isfinite(response).all()
    measured("energy above it", 10 * np.log10(energy(response) / predicted_energy(some, loud)), 1.5, "dB")


# What a network should not say.


@COMPILED
@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("size", [1.0, 1.5, 100.0])
def test_certainties_and_coherences_beyond_one_make_nothing_louder(phase, size, is_compiled, measured):
    some = parameters()
    wild = predicted(some, seed=7)
    wild.interaural[:] *= size / 0.6
    wild.certainty[:] = np.minimum(wild.certainty * size, 1.0)
    response = decoder_of(some, phase, is_compiled=is_compiled).decode(wild, np.array([100.0]))
    measured("energy above it", 10 * np.log10(energy(response) / predicted_energy(some, wild)), 1.5, "dB")


@COMPILED
@pytest.mark.parametrize("phase", [FROZEN, INTEGRATED], ids=["frozen", "integrated"])
@pytest.mark.parametrize("field", ["log_magnitude", "instantaneous_frequency", "certainty", "interaural"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_no_number_does_not_outlive_its_response(phase, field, value, is_compiled):
    """Workspaces are used again."""
    some = parameters()
    sane = predicted(some)
    decoder = decoder_of(some, phase, is_compiled=is_compiled)
    expected = decoder.decode(sane, AT)
    wrong = replace(sane, **{field: np.full_like(getattr(sane, field), value)})
    with np.errstate(all="ignore"):
        decoder.decode(wrong, AT)
    np.testing.assert_array_equal(decoder.decode(sane, AT), expected)


# Where a response begins.


@COMPILED
@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("at", [-1e9, -6_001.0, -64.0, -0.0, 0.0, 5_999.5, 6_000.0, 1e9])
def test_a_response_that_begins_anywhere_is_finite_and_silent_before(phase, at, is_compiled):
    some = parameters()
    response = decoder_of(some, phase, is_compiled=is_compiled).decode(predicted(some), np.array([at]))
    onset = np.array([np.floor(at)], dtype=np.int64)
    gate_of(some, gives_back=True, is_compiled=is_compiled).open(response, onset)
    assert np.isfinite(response).all()
    silent = int(np.clip(np.floor(at), 0, SAMPLES))
    assert not np.any(response[..., :silent])
    if at <= -SAMPLES - some.n_fft:
        assert np.abs(response).max() < 1e-6  # all of it was before emission


@COMPILED
@pytest.mark.parametrize("before", [0.0, 1e-42, 1e-20, 1.0, 1e18])
@pytest.mark.parametrize("after", [0.0, 1e-42, 1e-20, 1.0, 1e18])
def test_what_a_gate_gives_back_makes_nothing_much_louder(before, after, is_compiled):
    some, onset = parameters(), 1_000
    response = np.full((1, 2, SAMPLES), after, np.float32)
    response[..., :onset] = before
    expected = response.copy()
    gate_of(some, gives_back=True, is_compiled=is_compiled).open(response, np.array([onset]))
    assert not response[..., :onset].any()
    assert np.isfinite(response).all()
    assert np.all(response[..., onset:] <= 1.0001 * np.sqrt(1 + MOST_GIVEN) * expected[..., onset:])


@settings(settings.get_profile("hard_cases"), max_examples=40)
@given(at=st.floats(0, 2_000), step=st.floats(1e-4, 0.05), seed=st.integers(0, 50))
def test_a_response_moves_smoothly_with_its_beginning(measured, at, step, seed):
    """Across whole samples and whole frames too; per hundredth of a sample, 4 micrometres."""
    some = parameters()
    spectrograms = predicted(some, seed=seed)
    decoder = decoder_of(some)
    one, other = (decoder.decode(spectrograms, np.array([place])) for place in (at, at + step))
    change = np.sqrt(energy(one - other) / energy(one)) / step
    measured("change per sample of delay", change, 4.0)


@settings(settings.get_profile("hard_cases"), max_examples=30)
@given(
    levels=st.floats(-30, 30),
    certainty=st.floats(0, 1),
    coherence=st.floats(-2, 2),
    at=st.floats(-500, 7_000),
    compiled=st.booleans(),
    number=st.integers(0, 3),
)
def test_whatever_a_network_says_within_reason_is_finite_and_no_louder_than_said(
    measured, levels, certainty, coherence, at, compiled, number
):
    some = parameters()
    phase = [FROZEN, INTEGRATED, COLD, WARM][number]
    said = flat(some, np.float32(levels))
    said.certainty[:], said.interaural[:] = certainty, coherence
    response = decoder_of(some, phase, is_compiled=compiled).decode(said, np.array([at]))
    assert np.isfinite(response).all()
    allowed = predicted_energy(some, said)
    measured("energy above it", 10 * np.log10((energy(response) + 1e-30) / (allowed + 1e-20)), 6.0, "dB")


@pytest.mark.parametrize("frames", [1, 2, 7])
@COMPILED
def test_a_level_of_a_few_frames_agrees_with_double_precision(frames, is_compiled, measured):
    some = parameters()
    spectrograms = predicted(some)
    found = decoder_of(some, is_compiled=is_compiled, frames=frames).decode(spectrograms, AT)
    expected = exact_of(some, frames=frames).decode(spectrograms, AT)
    measured("difference", difference_db(found, expected), -100.0, "dB")


@pytest.mark.parametrize("phase", PHASES)
def test_the_same_prediction_is_the_same_response_to_the_last_bit(phase):
    some = parameters()
    once, again = (decoder_of(some, phase).decode(predicted(some, 3), np.array([0.3, 99.9, -7.0])) for _ in range(2))
    np.testing.assert_array_equal(once, again)


@pytest.mark.parametrize("phase", PHASES)
def test_predictions_decoded_together_do_not_meet(phase, measured):
    some = parameters()
    spectrograms, starts = predicted(some, 5), np.array([0.3, 99.9, -7.0, 1e3, 4e3])
    decoder = decoder_of(some, phase)
    together = decoder.decode(spectrograms, starts)
    for row in range(5):
        alone = decoder.decode(spectrograms[row : row + 1], starts[row : row + 1])[0]
        measured("difference", difference_db(together[row], alone), -140.0, "dB")
