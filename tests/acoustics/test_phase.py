"""What is known and what is noise, put together again: power, phase and interaural coherence are those asked for."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from server.acoustics.codec import Codec
from server.acoustics.phase import FrozenNoise, correlated_noise, delayed, separate

CODEC = Codec(24_000, 256, 64, 60_000, 1e-5)
SHAPE = (CODEC.bins, CODEC.frames)


@pytest.fixture(scope="module")
def noise() -> FrozenNoise:
    return FrozenNoise.from_signal(CODEC, np.random.default_rng(0).standard_normal((2, CODEC.samples)))


def _flat(value: complex) -> np.ndarray:
    return np.full(SHAPE, value, dtype=np.complex64)


def _composed(magnitude, phase, certainty, coherence, noise):
    known, noise_magnitude, noise_coherence = separate(magnitude, phase, certainty, coherence)
    spectrogram = correlated_noise(noise_magnitude, noise_coherence, noise)
    spectrogram[..., : known.shape[-1]] += known
    return spectrogram


def test_certain_phase_is_kept_exactly(noise: FrozenNoise) -> None:
    rng = np.random.default_rng(1)
    phase = rng.uniform(-3, 3, (2, CODEC.bins, 8)).astype(np.float32)
    magnitude = rng.uniform(0, 2, (2, *SHAPE)).astype(np.float32)
    spectrogram = _composed(magnitude, phase, np.ones_like(phase), _flat(0.2), noise)
    assert_allclose(spectrogram[..., :8], magnitude[..., :8] * np.exp(1j * phase), atol=1e-5)


@pytest.mark.parametrize("certainty", [0.0, 0.5, 0.9])
def test_power_is_that_of_the_magnitude_whatever_the_certainty(noise: FrozenNoise, certainty: float) -> None:
    magnitude = np.full((2, *SHAPE), 0.3, dtype=np.float32)
    phase = np.zeros((2, *SHAPE), dtype=np.float32)
    # A known part that leaves room for noise of any correlation.
    coherence = _flat(certainty**2 + 0.1)
    spectrogram = _composed(magnitude, phase, np.full_like(phase, certainty), coherence, noise)
    assert_allclose(np.mean(np.abs(spectrogram) ** 2, axis=(-2, -1)), 0.09, rtol=0.05)


# Beside a known part of certainty R, noise can bring coherences no farther than 1 - R**2 from R**2.
@pytest.mark.parametrize(
    ("coherence", "certainty"),
    [(0.0, 0.0), (0.6, 0.0), (-0.2 + 0.4j, 0.0), (0.95, 0.0), (0.0, 0.6), (0.6, 0.6), (0.1 + 0.4j, 0.6), (0.95, 0.6)],
)
def test_ears_have_the_coherence_asked_for(noise: FrozenNoise, coherence: complex, certainty: float) -> None:
    phase = np.zeros((2, *SHAPE), dtype=np.float32)
    magnitude = np.ones((2, *SHAPE), np.float32)
    left, right = _composed(magnitude, phase, np.full_like(phase, certainty), _flat(coherence), noise)[..., 2:-2]
    measured = np.mean(left * np.conj(right)) / np.sqrt(np.mean(np.abs(left) ** 2) * np.mean(np.abs(right) ** 2))
    assert abs(measured - coherence) < 0.03


def test_impossible_coherence_is_limited(noise: FrozenNoise) -> None:
    nothing = np.zeros((2, CODEC.bins, 0), dtype=np.float32)
    left, right = _composed(np.ones((2, *SHAPE), np.float32), nothing, nothing, _flat(3.0), noise)
    assert_allclose(left, right, atol=3e-2)


def test_smooth_magnitudes_survive_the_time_domain(noise: FrozenNoise) -> None:
    """Shaped frozen noise is nearly a consistent spectrogram: its energy is still there after synthesis."""
    decay = np.exp(-CODEC.frame_times_s / 0.3)
    magnitude = np.broadcast_to(decay, (2, *SHAPE)).astype(np.float32)
    signal = CODEC.synthesise(correlated_noise(magnitude, _flat(0), noise))
    expected = np.sum(decay**2) * CODEC.hop / CODEC.window_energy
    assert_allclose(np.sum(signal**2, axis=-1), expected, rtol=0.05)


@pytest.mark.parametrize("frames", [-2.0, -0.3, 0.0, 0.25, 3.0, 17.75, 100.0])
def test_a_straight_line_delayed_is_the_line_at_an_earlier_time(frames: float) -> None:
    line = np.broadcast_to(np.arange(40, dtype=np.float32), (1, 3, 40))
    later = delayed(line, np.array([frames]))[0]
    at = np.arange(40) - frames
    defined = (at >= 0) & (at <= 39)
    assert_allclose(later[:, defined], np.broadcast_to(at[defined], (3, defined.sum())), atol=1e-4)
    assert not later[:, at <= -1].any()


def test_each_row_is_delayed_by_its_own_frames() -> None:
    rng = np.random.default_rng(4)
    values = (rng.standard_normal((3, 2, 30)) + 1j * rng.standard_normal((3, 2, 30))).astype(np.complex64)
    together = delayed(values, np.array([0.5, 4.0, -1.25]))
    alone = [delayed(values[row : row + 1], np.array([frames]))[0] for row, frames in enumerate((0.5, 4.0, -1.25))]
    assert_allclose(together, np.stack(alone))
