import dataclasses
import math

import numpy as np
import pytest

from server.scene.geometry import Geometry, Material, Materials
from training.data.scene_file import HISTOGRAM_BIN_S
from training.trials.reverberation import Comparison, is_diffuse, reverberation_time_s


def decay(t60_s, duration_s=2.0):
    return 10 ** (-6 * np.arange(0, duration_s, HISTOGRAM_BIN_S) / t60_s)


def test_an_exponential_has_its_own_reverberation_time():
    times_s = [0.3, 0.8, 1.2]
    np.testing.assert_allclose(reverberation_time_s([decay(each) for each in times_s]), times_s, rtol=0.02)


def test_what_does_not_fall_far_enough_has_none():
    short = decay(2.0, duration_s=0.3)
    assert math.isnan(reverberation_time_s([np.append(short, 1.0)])[0])


def test_of_two_slopes_it_is_the_one_between_5_and_35_db():
    time_s = np.arange(0, 4, HISTOGRAM_BIN_S)
    both = 10 ** (-6 * time_s / 0.5) + 1e-6 * 10 ** (-6 * time_s / 3)
    assert reverberation_time_s([both])[0] == pytest.approx(0.5, rel=0.02)


def room(sides=(5, 4, 3), walls=0.1, ceiling=0.1, scattering=0.5):
    x, y, height = sides
    wall, above = (Material(absorption=(a,) * 7, scattering=(scattering,) * 7) for a in (walls, ceiling))
    corners = ((0, 0), (x, 0), (x, y), (0, y))
    return Geometry(height_m=height, corners=corners, materials=Materials(walls=wall, floor=wall, ceiling=above))


@pytest.mark.parametrize(
    ("geometry", "expected"),
    [
        (room(), True),
        (room(sides=(20, 2, 2.6)), False),
        (room(ceiling=0.9), False),
        (room(walls=0.6, ceiling=0.6), False),
        (room(scattering=0.1), False),
    ],
    ids=["plain", "corridor", "open to the sky", "booth", "smooth"],
)
def test_eyring_is_judged_where_a_field_is_diffuse(geometry, expected):
    assert is_diffuse(geometry) is expected


def test_only_what_is_judged_can_be_beyond_a_limit():
    good = (0.01,) * 7
    bad = (*good[:6], -0.2)
    fine = Comparison((1.0,) * 7, bad, good, bad, judges_others=False, is_diffuse=False)
    assert fine.beyond() == []
    judged = dataclasses.replace(fine, judges_others=True, is_diffuse=True)
    assert judged.beyond() == ["pyroomacoustics: 20.0 %", "Eyring: 20.0 %"]
    assert dataclasses.replace(fine, from_mirrors=(math.nan,) * 7).beyond() != []
