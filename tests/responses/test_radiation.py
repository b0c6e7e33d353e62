import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from server.acoustics.directivity import CARDIOID, FIGURE_OF_EIGHT, OMNIDIRECTIONAL, SUPERCARDIOID, PolarPattern
from server.acoustics.geometry import Pose
from server.responses.radiation import reverberation_gain, seen_from

coordinates = st.floats(-1, 1)


@given(st.tuples(*[coordinates] * 4).filter(lambda q: math.hypot(*q) > 0.1), st.tuples(*[coordinates] * 3))
def test_a_direction_is_seen_as_the_inverse_rotation_says(quaternion, direction):
    orientation = Pose((0.0, 0.0, 0.0), quaternion).orientation
    assert_allclose(seen_from(orientation, direction), Rotation(orientation).inv().apply(direction), atol=1e-12)


def test_what_lies_north_is_ahead_of_who_looks_north():
    north = Pose.from_yaw((0.0, 0.0, 0.0), math.pi / 2).orientation
    assert_allclose(seen_from(north, (0.0, 1.0, 0.0)), (1.0, 0.0, 0.0), atol=1e-15)


@pytest.mark.parametrize("directivity", [OMNIDIRECTIONAL, CARDIOID, SUPERCARDIOID, FIGURE_OF_EIGHT])
def test_a_room_gets_the_power_that_goes_in_all_directions(directivity):
    share = directivity.omni_share
    power, _ = quad(lambda c: (share + (1 - share) * c) ** 2 / 2, -1, 1)
    assert reverberation_gain(directivity) == pytest.approx(math.sqrt(power), rel=1e-6)


def test_a_room_gets_the_mean_power_of_all_bands():
    silent = tuple((-60.0, -60.0) if band else (0.0, 0.0) for band in range(7))
    assert reverberation_gain(PolarPattern((0.0, 180.0), silent)) == pytest.approx(math.sqrt(1 / 7), rel=1e-3)
