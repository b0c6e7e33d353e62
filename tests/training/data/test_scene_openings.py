"""An opening leads from one wall of its room to another, or what keeps it from that is said with its place."""

import pytest

from server.scene.geometry import Geometry, Material, Materials, Opening
from training.data.scene_openings import faults_of

TWO_ROOMS = ((0, 0), (3, 0), (3, 4), (3.2, 4), (3.2, 0), (7, 0), (7, 5), (0, 5))
PASSAGE = ((3.1, 4), (3.1, 5))


def faults(*lines, corners=TWO_ROOMS):
    material = Material(absorption=(0.3,) * 7, scattering=(0.3,) * 7)
    openings = tuple(Opening(name="door", start=start, end=end) for start, end in lines)
    materials = Materials(walls=material, floor=material, ceiling=material)
    return faults_of(Geometry(height_m=2.5, corners=corners, openings=openings, materials=materials))


@pytest.mark.parametrize(
    "lines",
    [
        (),
        (PASSAGE,),
        (PASSAGE[::-1],),
        (PASSAGE, ((0, 2), (3, 2))),
        (((1, 0), (1, 5)), ((1, 0), (0, 5))),  # of two that share a post
        (((3.1, 4), (3.1, 5.0004)),),  # as near to a wall as what parts rooms takes for being on it
    ],
)
def test_passages_have_no_fault(lines):
    assert faults(*lines) == []


@pytest.mark.parametrize(
    ("lines", "first"),
    [
        ([((1, 1), (2, 1))], "openings.0: start (1, 1) touches no wall: the nearest is 1 m away, at"),
        ([((0, 2), (2.5, 2))], "openings.0: end (2.5, 2) touches no wall: the nearest is 0.5 m away, at (3, 2)"),
        ([((9, 1), (9, 2))], "openings.0: start (9, 1) touches no wall: the nearest is 2 m away, at (7, 1)"),
        ([((1, 0), (2, 0))], "openings.0: runs along a wall, from (1, 0) to (2, 0)"),
        ([((3, 1), (3.2, 1))], "openings.0: is outside of the room, from (3, 1) to (3.2, 1)"),
        ([((0, 1), (7, 1))], "openings.0: goes through a wall on its way from (0, 1) to (7, 1)"),
        ([((3.1, 4), (3.1, 4))], "openings.0: is 0 m wide, from (3.1, 4) to (3.1, 4)"),
        ([((0, 0.05), (0.05, 0))], "openings.0: is 0.0707 m wide"),
        ([PASSAGE, PASSAGE], "openings.1: lies on openings.0 from (3.1, 4) to (3.1, 5)"),
        ([((0, 1), (3, 2)), ((0, 2), (3, 1))], "openings.1: crosses openings.0 at (1.5, 1.5)"),
        ([((1, 0), (1, 5)), ((0, 2), (3, 2))], "openings.1: crosses openings.0 at (1, 2)"),
    ],
)
def test_what_is_no_passage_is_told_with_its_place(lines, first):
    assert faults(*lines)[0].startswith(first)
