"""Energies of samples in compiled code, and by them whether samples are finite."""

from typing import Any, Final

import numpy as np
import numpy.typing as npt

from server.kernels.compiled import compiled, compiled_loosely

Float32 = npt.NDArray[np.float32]

_MOST: Final = float(np.finfo(np.float32).max)


@compiled_loosely
def energy_of(samples: Any) -> float:
    """The sum of squares of samples (n,) in double precision."""
    energy = np.float64(0.0)
    for n in range(len(samples)):
        energy += np.float64(samples[n]) * np.float64(samples[n])
    return energy


@compiled_loosely
def _single_energy_of(samples: Any) -> np.float32:
    """As `energy_of`, in single precision, in half the time."""
    energy = np.float32(0.0)
    for n in range(len(samples)):
        energy += samples[n] * samples[n]
    return energy


@compiled
def first_not_finite(signals: Float32) -> int:
    """The number of the first of some signals (B, channel, sample) with a sample that is not finite, or whose energy in
    a channel is no float32; -1 if there is none."""
    for row in range(signals.shape[0]):
        for channel in range(signals.shape[1]):
            if not _single_energy_of(signals[row, channel]) <= _MOST:
                return row
    return -1
