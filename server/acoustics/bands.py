"""Octave bands, in which materials, directivities and diffraction are described."""

import math

import numpy as np
import numpy.typing as npt

OCTAVE_BANDS_HZ = (125.0, 250.0, 500.0, 1000.0, 2000.0, 4000.0, 8000.0)


def bands_within(sample_rate: float) -> int:
    """Number of OCTAVE_BANDS_HZ that begin below half the sample rate. Higher bands hold no sound."""
    return sum(centre_hz / math.sqrt(2) < sample_rate / 2 for centre_hz in OCTAVE_BANDS_HZ)


def band_positions(frequencies_hz: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """(frequency,) where frequencies lie among the octave bands, over the logarithm of frequency: 1.5 is midway between
    the second band and the third. Frequencies beyond the outermost bands belong to these."""
    octave = np.log2(np.maximum(frequencies_hz, 1.0) / OCTAVE_BANDS_HZ[0])
    return np.asarray(np.clip(octave, 0, len(OCTAVE_BANDS_HZ) - 1))


def band_weights(frequencies_hz: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """(band, frequency) weights that interpolate between octave bands linearly over the logarithm of frequency, and
    continue the outermost bands; columns add up to one."""
    apart = band_positions(frequencies_hz) - np.arange(len(OCTAVE_BANDS_HZ))[:, None]
    return np.asarray(np.maximum(0.0, 1 - np.abs(apart)))
