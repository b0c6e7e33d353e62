"""Octave bands, in which materials, directivities and diffraction are described."""

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

OCTAVE_BANDS_HZ = (125.0, 250.0, 500.0, 1000.0, 2000.0, 4000.0, 8000.0)
FILTER_BANDS_HZ = (*OCTAVE_BANDS_HZ, 16000.0)
"""The bands of filters for paths. The last is known of the air alone: surfaces and directivities are there as in the
one below."""


def in_filter_bands(air_db_per_m: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """(filter band,) absorption of air that is given in OCTAVE_BANDS_HZ or FILTER_BANDS_HZ. The former goes on as in
    the last band. Raises ValueError for another number of bands."""
    given = np.array(air_db_per_m, np.float64)
    if given.shape not in ((len(OCTAVE_BANDS_HZ),), (len(FILTER_BANDS_HZ),)):
        raise ValueError(f"air_db_per_m must have a value for each octave band, and has the shape {given.shape}")
    return given if len(given) == len(FILTER_BANDS_HZ) else in_octave_above(given)


def in_octave_above(values: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """(..., filter band) values given in OCTAVE_BANDS_HZ (..., band), with that of the last band again for the octave
    above."""
    given = np.asarray(values, np.float64)
    return np.concatenate([given, given[..., -1:]], axis=-1)


def bands_within(sample_rate: float, centres_hz: Sequence[float] = OCTAVE_BANDS_HZ) -> int:
    """Number of octave bands that begin below half the sample rate. Higher bands hold no sound."""
    return sum(centre_hz / math.sqrt(2) < sample_rate / 2 for centre_hz in centres_hz)


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
