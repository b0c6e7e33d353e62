"""Signals of the benchmarks: noise and noise-like impulse responses, reproducible by seed."""

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float32]


def noise(seed: int, *shape: int) -> FloatArray:
    """White noise of unit variance."""
    return np.random.default_rng(seed).standard_normal(shape, dtype=np.float32)


def room(seed: int, samples: int, channels: int = 2) -> FloatArray:
    """An impulse response (channels, samples): noise that decays by 60 dB over its length."""
    decay = 10 ** (-3 * np.arange(samples) / samples)
    return noise(seed, channels, samples) * decay.astype(np.float32)


def tone(frequency_hz: float, samples: int, sample_rate: int) -> FloatArray:
    """(samples,) sine of unit amplitude."""
    phase = 2 * np.pi * frequency_hz / sample_rate * np.arange(samples, dtype=np.float64)
    return np.sin(phase).astype(np.float32)
