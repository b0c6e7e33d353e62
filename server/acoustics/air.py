"""Absorption of sound by air: pure tones by ISO 9613-1:1993."""

import numpy as np
import numpy.typing as npt

_REFERENCE_PRESSURE_KPA = 101.325
_REFERENCE_KELVIN = 293.15
_TRIPLE_POINT_KELVIN = 273.16
_ZERO_CELSIUS_KELVIN = 273.15


def absorption_db_per_m(
    frequencies_hz: npt.ArrayLike,
    *,
    temperature_c: float = 20.0,
    relative_humidity: float = 0.5,
    pressure_kpa: float = _REFERENCE_PRESSURE_KPA,
) -> npt.NDArray[np.float64]:
    """(...) dB that a pure tone loses per metre; ISO 9613-1 equations (3) to (5), humidity by (B.1) to (B.3).

    `relative_humidity` is a share from 0 to 1. The standard states an accuracy of 10 % from 50 Hz to 10 kHz and from
    -20 to 50 C; beyond that the result is still finite. Raises ValueError for impossible air.
    """
    if not 0 <= relative_humidity <= 1:
        raise ValueError("relative humidity must be a share from 0 to 1")
    kelvin = temperature_c + _ZERO_CELSIUS_KELVIN
    if not (0 < kelvin < np.inf and 0 < pressure_kpa < np.inf):
        raise ValueError("temperature must be above absolute zero, pressure above none")
    frequency = np.asarray(frequencies_hz, dtype=np.float64)
    pressure = pressure_kpa / _REFERENCE_PRESSURE_KPA
    warmth = kelvin / _REFERENCE_KELVIN
    saturation = 10 ** (4.6151 - 6.8346 * (_TRIPLE_POINT_KELVIN / kelvin) ** 1.261)
    # Molar concentration of water vapour, per cent; above the boiling point the formula would exceed 100.
    vapour = min(100.0, 100 * relative_humidity * saturation / pressure)
    oxygen_hz = pressure * (24 + 4.04e4 * vapour * (0.02 + vapour) / (0.391 + vapour))
    nitrogen_hz = pressure / warmth**0.5 * (9 + 280 * vapour * np.exp(-4.170 * (warmth ** (-1 / 3) - 1)))
    classical = 1.84e-11 / pressure * warmth**0.5
    oxygen = 0.01275 * np.exp(-2239.1 / kelvin) / (oxygen_hz + frequency**2 / oxygen_hz)
    nitrogen = 0.1068 * np.exp(-3352.0 / kelvin) / (nitrogen_hz + frequency**2 / nitrogen_hz)
    return np.asarray(8.686 * frequency**2 * (classical + warmth**-2.5 * (oxygen + nitrogen)))
