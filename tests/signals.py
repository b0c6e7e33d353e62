"""Signals that tests render, and how far two renderings are apart."""

import numpy as np
import numpy.typing as npt


def noise(seed: int, *shape: int) -> npt.NDArray[np.float32]:
    """White, of unit variance."""
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


def decaying_noise(
    seed: int, samples: int, channels: int = 2, *, decay_samples: float, gain: float = 1.0
) -> npt.NDArray[np.float32]:
    """(channels, samples), like the impulse response of a room; its amplitude falls by a factor of e in
    `decay_samples`."""
    decay = np.exp(-np.arange(samples) / decay_samples)
    return (gain * noise(seed, channels, samples) * decay).astype(np.float32)


def error_db(actual: npt.ArrayLike, expected: npt.ArrayLike) -> float:
    """The largest error, relative to the largest sample expected; -600 where there is none."""
    difference = np.abs(np.asarray(actual) - np.asarray(expected)).max()
    return float(20 * np.log10(difference / np.abs(expected).max() + 1e-30))
