"""What a mesh looks like from above."""

import numpy as np
import pytest

from server.acoustics.mesh import TriangleMesh
from server.acoustics.mesh_plan import section
from tests.two_rooms import HEIGHT_M, box, rooms


def length_m(lines) -> float:
    return float(np.sum(np.linalg.norm(lines[:, 1] - lines[:, 0], axis=-1)))


@pytest.mark.parametrize("height_m", [0.01, 0.7, 1.0, 1.9])
def test_a_box_is_cut_in_its_outline(height_m):
    lines = section(box((1.0, 2.0, 0.0), (4.0, 3.0, 2.0), "wood"), height_m)
    assert length_m(lines) == pytest.approx(8.0)
    assert lines.min(axis=(0, 1)).tolist() == [1.0, 2.0]
    assert lines.max(axis=(0, 1)).tolist() == [4.0, 3.0]


@pytest.mark.parametrize("height_m", [-0.5, 2.5])
def test_beyond_a_mesh_there_is_nothing(height_m):
    assert section(box((1.0, 2.0, 0.0), (4.0, 3.0, 2.0), "wood"), height_m).shape == (0, 2, 2)


def test_a_slope_is_cut_where_it_is_so_high():
    corners = np.array([(0.0, 0.0, 0.0), (4.0, 0.0, 2.0), (0.0, 3.0, 0.0)])
    sheet = TriangleMesh(corners, np.array([[0, 1, 2]]), np.zeros(1, np.int32), ("sheet",))
    ((one, other),) = section(sheet, 0.5)
    assert sorted([tuple(np.round(one, 9)), tuple(np.round(other, 9))]) == [(1.0, 0.0), (1.0, 2.25)]


def test_rooms_of_a_plan_are_cut_in_their_plan_also_at_the_height_of_vertices():
    around = 2 * (8.0 + 5.0) + 2 * (2.0 + 2.1) + 2 * 0.15 - 2 * 0.15  # the outline, and both sides of the wall
    for height_m in (0.0, 1.3):
        assert length_m(section(rooms().mesh, height_m)) == pytest.approx(around, abs=0.2)
    assert not len(section(rooms().mesh, HEIGHT_M))
