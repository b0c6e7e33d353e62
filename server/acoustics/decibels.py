"""Conversion to and from decibels.

Powers and energies convert with 10 log10, amplitudes with 20 log10. Zero becomes -inf, and -inf becomes zero. A
negative power is an error of the caller and becomes NaN.
"""

import numpy as np
import numpy.typing as npt

_Floats = npt.NDArray[np.float64]


def power_to_db(power: npt.ArrayLike) -> _Floats:
    with np.errstate(divide="ignore"):
        return np.asarray(10.0 * np.log10(np.asarray(power, dtype=np.float64)))


def db_to_power(level_db: npt.ArrayLike) -> _Floats:
    return np.asarray(10.0 ** (np.asarray(level_db, dtype=np.float64) / 10.0))


def amplitude_to_db(amplitude: npt.ArrayLike) -> _Floats:
    """Level of |amplitude|."""
    return power_to_db(np.square(np.abs(np.asarray(amplitude, dtype=np.float64))))


def db_to_amplitude(level_db: npt.ArrayLike) -> _Floats:
    return db_to_power(np.asarray(level_db, dtype=np.float64) / 2.0)
