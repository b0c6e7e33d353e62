"""Atmospheric absorption against the tables that ISO 9613 prints."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.acoustics.air import absorption_db_per_m
from server.acoustics.bands import OCTAVE_BANDS_HZ

# ISO 9613-1:1993 table 1 at 101.325 kPa, printed to three figures: (temperature in C, relative humidity in %, tenths of
# a decade above 1 kHz, dB per km). The table is computed at exact midband frequencies, 1000 * 10^(k / 10) Hz (note 5).
TABLE_1 = [
    (-20, 10, -13, 0.589),
    (-20, 70, 0, 11.5),
    (-20, 100, 9, 41.1),
    (-10, 50, 0, 12.9),
    (0, 10, -9, 1.30),
    (0, 15, 0, 18.3),
    (0, 100, 0, 3.37),
    (10, 70, 6, 32.8),
    (15, 70, 6, 26.4),
    (20, 10, 0, 14.1),
    (20, 10, 6, 109),
    (20, 15, 8, 175),
    (20, 10, -13, 0.270),
    (20, 50, -10, 0.294),
    (20, 50, -9, 0.445),
    (20, 70, -9, 0.339),
    (20, 70, -7, 0.776),
    (20, 70, 0, 4.98),
    (20, 80, -13, 0.0501),
    (20, 80, 0, 5.15),
    (20, 100, 6, 19.4),
    (30, 50, 0, 7.03),
    (30, 70, 6, 23.1),
    (50, 70, 9, 80.3),
]

# ISO 9613-2:1996 table 2, dB per km in the octave bands from 125 Hz, to one decimal.
TABLE_2 = [
    (10, 70, (0.4, 1.0, 1.9, 3.7, 9.7, 32.8, 117)),
    (20, 70, (0.3, 1.1, 2.8, 5.0, 9.0, 22.9, 76.6)),
    (30, 70, (0.3, 1.0, 3.1, 7.4, 12.7, 23.1, 59.3)),
    (15, 20, (0.6, 1.2, 2.7, 8.2, 28.2, 88.8, 202)),
    (15, 50, (0.5, 1.2, 2.2, 4.2, 10.8, 36.2, 129)),
    (15, 80, (0.3, 1.1, 2.4, 4.1, 8.3, 23.7, 82.8)),
]


@pytest.mark.parametrize(("temperature_c", "humidity_percent", "tenths", "db_per_km"), TABLE_1)
def test_agrees_with_table_1(temperature_c: float, humidity_percent: float, tenths: int, db_per_km: float) -> None:
    loss = absorption_db_per_m(
        1000 * 10 ** (tenths / 10), temperature_c=temperature_c, relative_humidity=humidity_percent / 100
    )
    assert math.isclose(1000 * loss, db_per_km, rel_tol=0.01)


@pytest.mark.parametrize(("temperature_c", "humidity_percent", "db_per_km"), TABLE_2)
def test_agrees_with_the_octave_bands_of_part_2(
    temperature_c: float, humidity_percent: float, db_per_km: tuple[float, ...]
) -> None:
    midband_hz = 1000 * 10 ** (0.3 * np.arange(-3, 4))
    loss = absorption_db_per_m(midband_hz, temperature_c=temperature_c, relative_humidity=humidity_percent / 100)
    np.testing.assert_allclose(1000 * loss, db_per_km, atol=0.06, rtol=0.01)


@given(st.floats(-60, 90), st.floats(0, 1), st.floats(10, 500))
def test_high_notes_are_lost_first_and_nothing_grows(
    temperature_c: float, humidity: float, pressure_kpa: float
) -> None:
    loss = absorption_db_per_m(
        OCTAVE_BANDS_HZ, temperature_c=temperature_c, relative_humidity=humidity, pressure_kpa=pressure_kpa
    )
    assert loss.shape == (len(OCTAVE_BANDS_HZ),)
    assert loss[0] > 0
    assert np.all(np.diff(loss) > 0)


@given(st.floats(0, 1e6), st.floats(-273, 1000), st.floats(0, 1), st.floats(1e-3, 1e5))
def test_is_finite_in_any_air(frequency_hz: float, temperature_c: float, humidity: float, pressure_kpa: float) -> None:
    loss = absorption_db_per_m(
        frequency_hz, temperature_c=temperature_c, relative_humidity=humidity, pressure_kpa=pressure_kpa
    )
    assert np.isfinite(loss)
    assert loss >= 0


@pytest.mark.parametrize(
    "air",
    [
        {"relative_humidity": 1.01},
        {"relative_humidity": math.nan},
        {"temperature_c": -273.15},
        {"temperature_c": math.inf},
        {"pressure_kpa": 0.0},
        {"pressure_kpa": math.nan},
    ],
)
def test_air_that_cannot_be_is_refused(air: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="must be"):
        absorption_db_per_m(1000.0, **air)
