"""Decays whose parameters are known in closed form, and responses measured in rooms."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import soundfile

RATE = 24_000
MEASURED = Path(__file__).parents[1] / "data" / "measured"


def decaying_noise(
    t60_s: float, *, seed: int = 0, duration_s: float = 0.7, shape: tuple[int, ...] = (2,)
) -> npt.NDArray[np.float64]:
    time_s = np.arange(round(duration_s * RATE)) / RATE
    noise = np.random.default_rng(seed).standard_normal((*shape, len(time_s)))
    return noise * 10.0 ** (-3.0 * time_s / t60_s)


def envelope(t60_s: float, duration_s: float = 0.7) -> npt.NDArray[np.float64]:
    return 10.0 ** (-3.0 * np.arange(round(duration_s * RATE)) / RATE / t60_s)


def measured(name: str) -> tuple[npt.NDArray[np.float64], int]:
    samples, rate = soundfile.read(MEASURED / name)
    return samples.T, rate
