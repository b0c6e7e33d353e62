import numpy as np
import pytest

from tests.training.data.levels.conftest import box
from training.data.levels.leaks import escaping


def test_no_ray_leaves_a_closed_box():
    vertices, triangles = box()
    escape = escaping(vertices[triangles], np.array([(1, 1, 1), (4, 2, 3)], float), [], np.random.default_rng(0))
    assert escape.rays == 1_000
    assert escape.left == 0


def test_the_share_that_leaves_is_the_solid_angle_of_the_hole():
    vertices, triangles = box((-1, -1, -1), (1, 1, 1), without=(0, 6))
    origins = np.zeros((20, 3))
    escape = escaping(vertices[triangles], origins, [], np.random.default_rng(0))
    assert escape.share == pytest.approx(1 / 6, abs=0.005)
    assert (escape.ends[:, 0] < -0.9).all()  # the side at -x is missing


def test_a_door_in_the_hole_stops_them():
    vertices, triangles = box((-1, -1, -1), (1, 1, 1), without=(0, 6))
    leaf = vertices[np.array([(0, 1, 3), (0, 3, 2)])]
    assert escaping(vertices[triangles], np.zeros((3, 3)), [leaf], np.random.default_rng(0)).left == 0
