"""Other convolvers, called as usual in Python: pedalboard (JUCE) block by block, and SciPy over a whole signal.

pedalboard's `Convolution` has one input per channel, so a mono source is fed to both channels. There is one
`Convolution` per source, and their outputs are not mixed.
"""

from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.signal

from server.acoustics.decibels import amplitude_to_db
from server.bench.rooms import FloatArray


class Pedalboard:
    """One `Convolution` per IR (2, n). `process` takes one block for each source, (sources, 2, b)."""

    def __init__(self, module: ModuleType, irs: FloatArray, sample_rate: int) -> None:
        self._convolutions: list[Any] = [module.Convolution(ir, 1.0, sample_rate) for ir in irs]
        self._sample_rate = sample_rate

    def process(self, blocks: FloatArray) -> list[FloatArray]:
        sample_rate = self._sample_rate
        return [
            convolution.process(block, sample_rate, reset=False)
            for convolution, block in zip(self._convolutions, blocks, strict=True)
        ]


def find_pedalboard() -> ModuleType | None:
    """The module pedalboard; None if it is not installed."""
    try:
        import pedalboard
    except ImportError:
        return None
    return pedalboard


def convolve_at_once(dry: FloatArray, ir: FloatArray) -> FloatArray:
    """Convolve (n,) with (channels, m) by SciPy's fastest method for long signals, overlap-add."""
    return np.asarray(scipy.signal.oaconvolve(dry[np.newaxis], ir, axes=1))


def reference(dry: npt.NDArray[np.floating], ir: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """The exact convolution of (n,) with (channels, m) in float64; the first n samples."""
    wet = scipy.signal.fftconvolve(dry[np.newaxis].astype(np.float64), ir.astype(np.float64), axes=1)
    return np.asarray(wet[:, : dry.size])


def error_db(wet: FloatArray, expected: npt.NDArray[np.float64]) -> float:
    """Largest error in dB, relative to the largest sample."""
    return float(amplitude_to_db(np.abs(wet - expected).max() / np.abs(expected).max()))
