"""Phase where there is none, on the branch cut, and summed over the longest response."""

from dataclasses import replace

import numpy as np
import pytest

from server.acoustics.codec import Codec
from server.acoustics.phase import griffin_lim
from server.field.phase_cache import PhaseCache
from server.health.laws import branch_cut_share
from tests.hard_cases.predictions import (
    AT,
    COLD,
    COMPILED,
    INTEGRATED,
    SAMPLES,
    WARM,
    decoder_of,
    difference_db,
    flat,
    parameters,
    predicted,
)


@COMPILED
@pytest.mark.parametrize("phase", [COLD, WARM], ids=["from zero phase", "warm"])
def test_griffin_lim_on_an_all_zero_magnitude_stays_at_zero(phase, is_compiled):
    some = parameters()
    silent = flat(some, np.float32(-np.inf))
    response = decoder_of(some, phase, is_compiled=is_compiled).decode(silent, AT)
    assert not np.any(response)
    near = np.random.default_rng(3).standard_normal((2, SAMPLES)).astype(np.float32)
    assert not np.any(decoder_of(some, WARM, is_compiled=is_compiled).decode(silent, AT, [near]))


@pytest.mark.parametrize("size", [0.0, 1e-38, 1e-30])
def test_griffin_lim_from_next_to_nothing_does_not_divide_by_it(size, measured):
    codec = parameters().codec
    magnitude = np.full((2, codec.bins, codec.frames), 0.1, np.float32)
    start = size * np.random.default_rng(1).standard_normal((2, SAMPLES))
    found = griffin_lim(codec, magnitude, start.astype(np.float32), 3)
    assert np.isfinite(found).all()
    measured("largest sample", np.abs(found).max(), codec.bins * 0.1)


def test_a_silent_response_is_nothing_to_take_a_phase_from():
    """Iterations from it would find that silence has no phase, and stay there."""
    phases = PhaseCache()
    place = np.zeros(3), np.ones(3), np.array([0.0, 0.0, 0.0, 1.0])
    phases.keep(*place, np.zeros((2, 100), np.float32))
    assert phases.nearest(*place) is None
    sound = np.ones((2, 100), np.float32)
    phases.keep(*place, sound)
    np.testing.assert_array_equal(phases.nearest(*place), sound)
    phases.keep(*place, np.zeros((2, 100), np.float32))
    np.testing.assert_array_equal(phases.nearest(*place), sound)


@pytest.mark.parametrize("offset", [0.0, 1e-7, -1e-7, 1e-3, -1e-3])
def test_a_tone_on_the_branch_cut_comes_back(offset, measured):
    """Every bin with k = 2 (mod 4) advances by pi per frame: half the time the wrong way, were it not demodulated."""
    codec = parameters().codec
    for bin_ in (6, 62, 122):
        tone = np.cos(2 * np.pi * (bin_ + offset) / codec.n_fft * np.arange(SAMPLES) + 0.3)
        log_magnitude, frequency = codec.encode(tone)
        inner = slice(8, codec.frames - 8)
        measured("largest advance", np.abs(frequency[bin_, inner]).max(), 0.1, "rad")
        found = codec.decode(log_magnitude, frequency)
        measured("difference", difference_db(found, tone), -60.0, "dB")


@pytest.mark.parametrize("advance", [np.pi, -np.pi, np.nextafter(np.pi, 0), np.nextafter(-np.pi, 0), 3.1415927])
@COMPILED
def test_an_advance_of_exactly_pi_is_taken_either_way_and_means_the_same(advance, is_compiled, measured):
    some = parameters()
    exact = predicted(some)
    exact.instantaneous_frequency[..., 1:] = advance
    turned = replace(exact, instantaneous_frequency=exact.instantaneous_frequency.copy())
    turned.instantaneous_frequency[..., 1:] = -advance
    decoder = decoder_of(some, INTEGRATED, is_compiled=is_compiled)
    measured("difference", difference_db(decoder.decode(turned, AT), decoder.decode(exact, AT)), -80.0, "dB")


def test_advances_are_wrapped_to_one_turn_and_hold_nothing_at_the_cut():
    codec = parameters().codec
    decaying = np.random.default_rng(4).standard_normal((40, SAMPLES)) * np.exp(-np.arange(SAMPLES) / 800)
    _, frequency = codec.encode(decaying)
    advances = frequency[..., 1:]
    assert advances.min() >= -np.pi
    assert advances.max() < np.pi
    # Windows overlap by three quarters, so that noise turns little about the centre of its bin.
    assert branch_cut_share(frequency) < 3


@pytest.mark.parametrize(("rate", "seconds"), [(24_000, 5), (48_000, 12)])
def test_phase_summed_over_the_longest_response_is_as_exact_as_at_its_beginning(rate, seconds, measured):
    codec = Codec(rate, 256, 64, rate * seconds, 1e-5)
    rng = np.random.default_rng(5)
    frames = codec.frames
    steps = rng.uniform(-np.pi, np.pi, (2, codec.bins, frames))
    exact = np.cumsum(steps.astype(np.float32).astype(np.longdouble), axis=-1) + codec.nominal_advance.astype(
        np.longdouble
    ) * np.arange(frames)
    found = codec.integrate(steps.astype(np.float32))
    error = np.angle(np.exp(1j * (found - exact % (2 * np.pi)).astype(float)))
    measured("error of the last frame", np.abs(error[..., -1]).max(), 1e-5, "rad")
    naive = np.cumsum(steps.astype(np.float32), axis=-1, dtype=np.float32)
    naive = naive + (codec.nominal_advance * np.arange(frames)).astype(np.float32)
    lost = np.angle(np.exp(1j * (naive - exact).astype(float)))
    assert np.abs(lost[..., -1]).max() > 100 * np.abs(error[..., -1]).max()  # in single precision it is lost


@COMPILED
def test_ears_that_are_all_certain_leave_no_noise_whatever_their_coherence(is_compiled, measured):
    some = parameters()
    certain = predicted(some, seed=8)
    certain.certainty[:] = 1.0
    certain.log_magnitude[..., some.known_frames :] = -np.inf
    other = replace(certain, interaural=-certain.interaural)
    decoder = decoder_of(some, is_compiled=is_compiled)
    measured("difference", difference_db(decoder.decode(other, AT), decoder.decode(certain, AT)), -60.0, "dB")


@pytest.mark.parametrize("phase", [COLD, WARM], ids=["from zero phase", "warm"])
def test_what_is_no_number_does_not_outlive_its_iterations(phase):
    some = parameters()
    sane = predicted(some)
    decoder = decoder_of(some, phase)
    expected = decoder.decode(sane, AT)
    wrong = replace(sane, log_magnitude=np.full_like(sane.log_magnitude, np.nan))
    decoder.decode(wrong, AT)
    np.testing.assert_array_equal(decoder.decode(sane, AT), expected)


@pytest.mark.parametrize("known", [0, 1])
@COMPILED
def test_a_field_that_knows_no_phase_is_decoded(known, is_compiled):
    some = parameters(known=known)
    response = decoder_of(some, is_compiled=is_compiled).decode(predicted(some), AT)
    assert np.isfinite(response).all()
    assert np.any(response)
