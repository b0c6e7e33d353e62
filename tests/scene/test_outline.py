"""A floor plan is one simple polygon, or what keeps it from being one is said with its place."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.acoustics.geometry import FloorPlan
from server.scene.outline import faults_of

BOX = [(0.0, 0.0), (4.0, 0.0), (4.0, 3.0), (0.0, 3.0)]
COORDINATES = st.integers(-6, 6).map(float)


@pytest.mark.parametrize(
    "corners",
    [
        BOX,
        BOX[:3],
        [(0, 0), (2, 0), (4, 0), (4, 3)],  # a corner that does not turn
        [(0, 0), (4, 0), (4, 2), (4.2, 2), (4.2, 0), (8, 0), (8, 5), (0, 5)],
        [(0, 0), (1000, 0), (1000, 0.002), (0, 0.002)],
    ],
)
def test_simple_polygons_have_no_fault(corners):
    assert faults_of(corners) == []


@pytest.mark.parametrize(
    ("corners", "first"),
    [
        ([(0, 0), (4, 0), (4, 3), (2, 3), (2, -3), (1, -3), (1, 3), (0, 3)], "edges 0 and 3 cross at (2, 0)"),
        ([(0, 0), (4, 3), (4, 0), (0, 3)], "edges 0 and 2 cross at (2, 1.5)"),
        ([(0, 0), (6, 0), (6, 4), (2, -2), (0, 4)], "edges 0 and 2 cross at (3.33333, 0)"),
        ([(0, 0), (4, 0), (4, 3), (2, 0), (0, 3)], "edges 0 and 2 touch at (2, 0)"),
        ([(0, 0), (4, 0), (4, 4), (2, 4), (2, 0.0005), (1, 4), (0, 4)], "edges 0 and 3 touch at (2, 0)"),
        ([(0, 0), (4, 0), (6, 0), (4, 0.0001), (4, 3)], "edges 0 and 2 touch at (4, 0)"),
        ([(0, 0), (6, 0), (4, 0), (4, 3)], "edges 0 and 1 run over each other from (6, 0) to (4, 0)"),
        ([(0, 0), (4, 0), (2, 0)], "edges 0 and 1 run over each other from (4, 0) to (2, 0)"),
        ([(0, 0), (4, 0), (4, 0.0005), (4, 3)], "corner 2 is where corner 1 is, at (4, 0.0005)"),
        ([*BOX, (0, 0)], "corner 0 is where corner 4 is, at (0, 0): leave the last one out"),
        (BOX[::-1], "corners must run counter-clockwise: these run clockwise"),
    ],
)
def test_what_is_no_simple_polygon_is_told_with_its_place(corners, first):
    assert faults_of(corners)[0].startswith(first)


def test_no_more_than_a_few_of_many_crossings_are_told():
    star = [(math.cos(4 * math.pi * point / 9), math.sin(4 * math.pi * point / 9)) for point in range(9)]
    *crossings, numbering = faults_of(star)
    assert len(crossings) == 3
    assert numbering == "edge 0 runs from corner 0 to corner 1"


def _turn(a, b, c):
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _cross(a, b, c, d):
    """Whether two lines meet in the middle of both, by the side of each that the other's ends are on."""
    return _turn(a, b, c) * _turn(a, b, d) < 0 and _turn(c, d, a) * _turn(c, d, b) < 0


@given(st.lists(st.tuples(COORDINATES, COORDINATES), min_size=3, max_size=8))
def test_crossings_are_found_as_by_signs_of_areas(corners):
    """On a grid of whole metres, where signs are exact."""
    count = len(corners)
    edges = [(corners[number], corners[(number + 1) % count]) for number in range(count)]
    crosses = any(_cross(*edges[a], *edges[b]) for a in range(count) for b in range(a))
    faults = faults_of(corners)
    if crosses:
        assert faults
    if not faults:
        assert FloorPlan(tuple(corners), 1.0).area_m2 > 0
        shoelace = sum(a[0] * b[1] - b[0] * a[1] for a, b in edges) / 2
        assert shoelace > 0
