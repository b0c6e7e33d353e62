import numpy as np
import pytest
from shapely import Polygon

from tests.training.data.levels.conftest import box
from training.data.levels.contacts import cells_of, find_contacts, lies_on_others


def contacts_of(corners):
    own = np.arange(3 * len(corners)).reshape(-1, 3)  # no vertices in common
    return find_contacts(corners, own, cells_of(corners))


def crosses(one, two):
    """An oracle: a side of either meets the inside of the other, by solving for where."""
    for a, b in ((one, two), (two, one)):
        for i in range(3):
            start, along = a[i], a[(i + 1) % 3] - a[i]
            matrix = np.column_stack([b[1] - b[0], b[2] - b[0], -along])
            if abs(np.linalg.det(matrix)) < 1e-12:
                continue
            u, v, t = np.linalg.solve(matrix, start - b[0])
            if u > 0 and v > 0 and u + v < 1 and 0 < t < 1:
                return True
    return False


def test_crossings_are_those_of_every_pair_solved():
    corners = np.random.default_rng(0).uniform(0, 4, (60, 1, 3)) + np.random.default_rng(1).normal(0, 0.7, (60, 3, 3))
    found = set(map(tuple, contacts_of(corners).crossing.tolist()))
    expected = {(i, j) for i in range(60) for j in range(i + 1, 60) if crosses(corners[i], corners[j])}
    assert len(expected) > 15
    assert len(found ^ expected) <= 1  # one may touch within a millimetre


def test_triangles_of_one_plane_lie_on_each_other_where_their_outlines_overlap():
    flat = np.random.default_rng(2).uniform(0, 4, (40, 3, 2))
    corners = np.concatenate([flat, np.full((40, 3, 1), 1.0)], axis=-1)
    found = set(map(tuple, contacts_of(corners).lying.tolist()))
    polygons = [Polygon(each) for each in flat]
    expected = {
        (i, j) for i in range(40) for j in range(i + 1, 40) if polygons[i].intersection(polygons[j]).area > 0.01
    }
    assert expected <= found
    assert all(polygons[i].intersects(polygons[j]) for i, j in found)


def test_a_closed_box_meets_itself_nowhere():
    vertices, triangles = box()
    contacts = find_contacts(vertices[triangles], triangles, cells_of(vertices[triangles]))
    assert not len(contacts.crossing)
    assert not len(contacts.lying)
    assert contacts.is_whole


def test_the_work_is_bounded(monkeypatch):
    monkeypatch.setattr("training.data.levels.contacts.MOST_PAIRS", 10)
    assert not contacts_of(np.random.default_rng(0).uniform(0, 1, (50, 3, 3))).is_whole


@pytest.mark.parametrize(("height", "lies"), [(0.0, True), (0.0009, True), (0.0011, False), (0.5, False)])
def test_places_lie_on_triangles_within_a_millimetre(height, lies):
    corners = np.array([[(0, 0, 0), (2, 0, 0), (0, 2, 0)], [(5, 5, 5), (6, 5, 5), (5, 6, 5)]], float)
    assert lies_on_others(np.array([(0.5, 0.5, height)]), np.array([1]), corners, cells_of(corners)) == [lies]
    assert not lies_on_others(np.array([(0.5, 0.5, height)]), np.array([0]), corners, cells_of(corners))[0]
