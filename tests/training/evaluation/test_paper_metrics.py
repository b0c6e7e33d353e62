import numpy as np
import pytest
from numpy.testing import assert_allclose

from training.evaluation.paper_metrics import (
    HOP,
    INTERAURAL_LAG,
    LOG_FLOOR,
    N_FFT,
    SPECTRAL_LOSS_OF_PAPER,
    PaperErrors,
    interaural_lag_s,
)

RATE = 24_000


def late_by(samples: int, count: int = 2_000) -> np.ndarray:
    """Ears that hear the same noise, the right one later by so many samples (earlier if negative)."""
    noise = np.random.default_rng(1).standard_normal(count)
    ears = np.zeros((2, count + abs(samples)))
    ears[0, max(-samples, 0) :][:count] = noise
    ears[1, max(samples, 0) :][:count] = noise
    return ears


@pytest.mark.parametrize("samples", [0, 7, -13, 300])
def test_the_lag_is_that_between_the_ears_however_long(samples):
    assert interaural_lag_s(late_by(samples), RATE) == samples / RATE


def test_the_lag_is_that_of_the_whole_cross_correlation():
    ears = np.random.default_rng(2).standard_normal((5, 2, 400))
    expected = [np.argmax(np.correlate(right, left, "full")) - 399 for left, right in ears]
    assert_allclose(interaural_lag_s(ears, RATE) * RATE, expected)


def test_one_ear_or_silence_has_no_lag():
    assert np.isnan(interaural_lag_s(np.ones((3, 1, 50)), RATE)).all()
    assert np.isnan(interaural_lag_s(late_by(3) * [[1.0], [0.0]], RATE))


def test_the_error_is_the_difference_of_lags_in_microseconds():
    reference, estimate = late_by(12)[None], late_by(-12)[None]
    assert_allclose(PaperErrors(reference, RATE).of(estimate)[INTERAURAL_LAG.name], 24 / RATE * 1e6)


def test_what_lies_below_the_papers_floor_is_not_an_error():
    """Two tails that differ by 20 dB, 60 dB and more below the floor, are the same to it."""
    tail = 1e-7 * np.random.default_rng(3).standard_normal((1, 2, 4_000))
    assert PaperErrors(tail, RATE).of(10 * tail)[SPECTRAL_LOSS_OF_PAPER.name].max() < 0.03


def test_the_spectral_loss_is_that_of_windows_written_out():
    reference, estimate = np.random.default_rng(4).standard_normal((2, 1, 2, 2_048))
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(N_FFT) / N_FFT)
    losses = []
    for start in range(-N_FFT + HOP, 2_048, HOP):
        spectra = []
        for signal in (reference, estimate):
            padded = np.pad(signal, ((0, 0), (0, 0), (N_FFT, N_FFT)))[..., start + N_FFT :][..., :N_FFT]
            spectra.append(np.log(np.abs(np.fft.rfft(padded * window))[..., :-1] + LOG_FLOOR))
        losses.append(np.abs(spectra[1] - spectra[0]).mean())
    found = PaperErrors(reference, RATE).of(estimate)[SPECTRAL_LOSS_OF_PAPER.name]
    assert_allclose(found, np.mean(losses), rtol=1e-9)
