"""Composed spectrograms have the power, the phase and the interaural coherence they were asked for."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from server.acoustics.codec import Codec
from server.acoustics.phase import FrozenNoise, compose

CODEC = Codec(24_000, 256, 64, 60_000, 1e-5)
SHAPE = (CODEC.bins, CODEC.frames)


@pytest.fixture(scope="module")
def noise() -> FrozenNoise:
    return FrozenNoise.from_signal(CODEC, np.random.default_rng(0).standard_normal((2, CODEC.samples)))


def _flat(value: complex) -> np.ndarray:
    return np.full(SHAPE, value, dtype=np.complex64)


def test_certain_phase_is_kept_exactly(noise: FrozenNoise) -> None:
    rng = np.random.default_rng(1)
    phase = rng.uniform(-3, 3, (2, CODEC.bins, 8)).astype(np.float32)
    magnitude = rng.uniform(0, 2, (2, *SHAPE)).astype(np.float32)
    spectrogram = compose(magnitude, phase, np.ones_like(phase), _flat(0.2), noise)
    assert_allclose(spectrogram[..., :8], magnitude[..., :8] * np.exp(1j * phase), atol=1e-5)


@pytest.mark.parametrize("certainty", [0.0, 0.5, 0.9])
def test_power_is_that_of_the_magnitude_whatever_the_certainty(noise: FrozenNoise, certainty: float) -> None:
    magnitude = np.full((2, *SHAPE), 0.3, dtype=np.float32)
    phase = np.zeros((2, *SHAPE), dtype=np.float32)
    # A known part that leaves room for noise of any correlation.
    coherence = _flat(certainty**2 + 0.1)
    power = np.mean(
        np.abs(compose(magnitude, phase, np.full_like(phase, certainty), coherence, noise)) ** 2, axis=(-2, -1)
    )
    assert_allclose(power, 0.09, rtol=0.05)


@pytest.mark.parametrize("coherence", [0.0, 0.6, -0.3 + 0.5j, 1.0])
def test_ears_have_the_coherence_asked_for(noise: FrozenNoise, coherence: complex) -> None:
    certainty = np.zeros((2, CODEC.bins, 0), dtype=np.float32)
    left, right = compose(np.ones((2, *SHAPE), np.float32), certainty, certainty, _flat(coherence), noise)[..., 2:-2]
    measured = np.mean(left * np.conj(right)) / np.sqrt(np.mean(np.abs(left) ** 2) * np.mean(np.abs(right) ** 2))
    assert abs(measured - coherence) < 0.03


def test_impossible_coherence_is_limited(noise: FrozenNoise) -> None:
    certainty = np.zeros((2, CODEC.bins, 0), dtype=np.float32)
    spectrogram = compose(np.ones((2, *SHAPE), np.float32), certainty, certainty, _flat(3.0), noise)
    assert_allclose(spectrogram[0], spectrogram[1], atol=1e-6)


def test_smooth_magnitudes_survive_the_time_domain(noise: FrozenNoise) -> None:
    """Shaped frozen noise is nearly a consistent spectrogram: its energy is still there after synthesis."""
    decay = np.exp(-CODEC.frame_times_s / 0.3)
    magnitude = np.broadcast_to(decay, (2, *SHAPE)).astype(np.float32)
    certainty = np.zeros((2, CODEC.bins, 0), dtype=np.float32)
    signal = CODEC.synthesise(compose(magnitude, certainty, certainty, _flat(0), noise))
    expected = np.sum(decay**2) * CODEC.hop / CODEC.window_energy
    assert_allclose(np.sum(signal**2, axis=-1), expected, rtol=0.05)
