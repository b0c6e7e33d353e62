import numpy as np
import pytest
from scipy.signal import stft
from scipy.stats import kurtosis

from server.acoustics.codec import Codec
from training.models.frozen_noise import even_noise

CODEC = Codec(24_000, 256, 64, 14_400, 1e-5)
# Of the log magnitude of Gaussian noise: pi / sqrt(24).
RAYLEIGH = np.pi / np.sqrt(24)


@pytest.fixture(scope="module")
def noise():
    return even_noise(CODEC, np.random.default_rng(0))


def log_magnitude_spread(signal, n_fft):
    _, _, spectrogram = stft(signal, nperseg=n_fft)
    return np.std(np.log(np.abs(spectrogram[..., 2:-2, 2:-2])))


def test_it_has_unit_power(noise):
    spectrogram = CODEC.transform(noise.astype(np.float64))
    assert np.mean(np.abs(spectrogram) ** 2) / CODEC.window_energy == pytest.approx(1, rel=1e-3)
    assert np.mean(noise**2) == pytest.approx(1, abs=0.05)


def test_its_spectrogram_is_more_even_than_that_of_white_noise(noise):
    white = np.random.default_rng(1).standard_normal(noise.shape)
    assert log_magnitude_spread(white, CODEC.n_fft) == pytest.approx(RAYLEIGH, rel=0.05)
    assert log_magnitude_spread(noise, CODEC.n_fft) < 0.5 * RAYLEIGH


def test_its_ears_are_independent(noise):
    lags = np.fft.irfft(np.fft.rfft(noise[0]) * np.conj(np.fft.rfft(noise[1])))
    assert np.abs(lags).max() / CODEC.samples < 6 / np.sqrt(CODEC.samples)


def test_it_still_sounds_like_noise(noise):
    """Even at the codec's resolution, and random at any other: no tones, no clicks, no echo."""
    assert log_magnitude_spread(noise, 2048) == pytest.approx(RAYLEIGH, rel=0.15)
    assert (np.abs(kurtosis(noise, axis=-1)) < 2).all()
    power = np.abs(np.fft.rfft(noise)) ** 2
    correlation = np.fft.irfft(power)[:, : CODEC.samples // 2]
    assert np.abs(correlation[:, 1:] / correlation[:, :1]).max() < 0.1


def test_it_is_white(noise):
    _, _, spectrogram = stft(noise, nperseg=64)
    band_power = np.mean(np.abs(spectrogram[:, 2:-2]) ** 2, axis=-1)
    np.testing.assert_allclose(band_power / band_power.mean(axis=-1, keepdims=True), 1, atol=0.15)


def test_the_generator_decides_it():
    codec = Codec(8_000, 256, 64, 2_000, 1e-5)
    first, again, other = (even_noise(codec, np.random.default_rng(seed)) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert abs(np.corrcoef(first[0], other[0])[0, 1]) < 0.2
