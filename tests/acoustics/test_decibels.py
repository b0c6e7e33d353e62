import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from server.acoustics.decibels import amplitude_to_db, db_to_amplitude, db_to_power, power_to_db


@given(st.floats(-200.0, 200.0))
def test_levels_survive_a_round_trip(level_db: float) -> None:
    assert_allclose(power_to_db(db_to_power(level_db)), level_db, atol=1e-9)
    assert_allclose(amplitude_to_db(db_to_amplitude(level_db)), level_db, atol=1e-9)


def test_known_levels() -> None:
    assert_allclose(power_to_db([1.0, 10.0, 0.5]), [0.0, 10.0, -3.0103], atol=1e-4)
    assert_allclose(amplitude_to_db([-1.0, 10.0, 0.5]), [0.0, 20.0, -6.0206], atol=1e-4)


def test_silence_has_no_level_and_no_warning() -> None:
    assert power_to_db(0.0) == amplitude_to_db(0.0) == -np.inf
    assert db_to_power(-np.inf) == 0.0


@pytest.mark.parametrize("convert", [power_to_db, amplitude_to_db, db_to_power, db_to_amplitude])
def test_shapes_are_kept(convert) -> None:
    assert convert(np.ones((2, 3))).shape == (2, 3)
