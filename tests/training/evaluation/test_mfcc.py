import numpy as np
import pytest

from training.evaluation.mfcc import COEFFICIENTS, FILTERS, STEP_S, WINDOW_S, hertz, mel, mel_filters, mfcc

RATE = 16_000


def test_mels_and_hertz_are_inverse():
    frequency = np.array([0.0, 100.0, 1000.0, 7000.0])
    np.testing.assert_allclose(hertz(mel(frequency)), frequency, atol=1e-9)
    assert mel(1000.0) == pytest.approx(1000.0, rel=1e-3)  # by the scale's definition


def test_filters_share_every_frequency_out_between_neighbours():
    filters = mel_filters(RATE, 4096)
    frequency = np.fft.rfftfreq(4096, 1 / RATE)
    centres = hertz(np.linspace(0, mel(RATE / 2), FILTERS + 2))
    between = (frequency >= centres[1]) & (frequency <= centres[-2])
    np.testing.assert_allclose(filters.sum(axis=0)[between], 1)
    assert np.all((filters > 0).sum(axis=0) <= 2)


def test_shape_is_a_column_per_frame():
    samples = 8_000
    frames = 1 + (samples - round(WINDOW_S * RATE)) // round(STEP_S * RATE)
    signal = np.random.default_rng(0).standard_normal((3, 2, samples))
    assert mfcc(signal, RATE).shape == (3, 2, COEFFICIENTS, frames)
    with pytest.raises(ValueError, match="shorter"):
        mfcc(signal[..., :300], RATE)


def test_gain_is_in_the_first_coefficient_alone():
    signal = np.random.default_rng(0).standard_normal(8_000)
    difference = mfcc(10 * signal, RATE) - mfcc(signal, RATE)
    np.testing.assert_allclose(difference[0], np.log(100) * np.sqrt(FILTERS))
    np.testing.assert_allclose(difference[1:], 0, atol=1e-9)


def test_a_tone_is_where_its_filter_is():
    """The log energies behind the coefficients, as far as so few of them tell, are largest around the tone."""
    for frequency in (500.0, 2000.0):
        tone = np.sin(2 * np.pi * frequency * np.arange(8_000) / RATE)
        basis = np.cos(np.pi * np.outer(np.arange(COEFFICIENTS), np.arange(FILTERS) + 0.5) / FILTERS)
        scale = np.sqrt(np.r_[1, np.full(COEFFICIENTS - 1, 2)] / FILTERS)
        smooth = (scale * mfcc(tone, RATE).mean(axis=-1)) @ basis
        centres = hertz(np.linspace(0, mel(RATE / 2), FILTERS + 2))[1:-1]
        assert abs(np.argmax(smooth) - np.argmin(np.abs(centres - frequency))) <= 1


def test_later_sound_moves_to_later_frames():
    signal = np.random.default_rng(1).standard_normal(8_000)
    late = np.concatenate([np.zeros(3 * round(STEP_S * RATE)), signal])
    np.testing.assert_allclose(mfcc(late, RATE)[:, 3:], mfcc(signal, RATE), atol=1e-9)
