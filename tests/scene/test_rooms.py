"""Openings part a plan into rooms, which together are the plan."""

from pathlib import Path

import pytest

from server.scene.geometry import Geometry, Opening
from server.scene.rooms import rooms_of
from training.data.scene_file import SceneFile

SCENES = Path(__file__).parents[2] / "training" / "scenes"


@pytest.mark.parametrize(("name", "count"), [("small1", 1), ("apartment", 2), ("large1", 3), ("large2", 5)])
def test_the_rooms_of_a_scene_are_its_plan(name, count):
    geometry = SceneFile.read(SCENES / f"{name}.toml").geometry
    rooms = rooms_of(geometry)
    assert len(rooms) == count
    assert all(room.plan.area_m2 > 0 for room in rooms)
    assert sum(room.plan.area_m2 for room in rooms) == pytest.approx(geometry.floor_plan.area_m2)
    widths = sum(
        ((opening.end[0] - opening.start[0]) ** 2 + (opening.end[1] - opening.start[1]) ** 2) ** 0.5
        for opening in geometry.openings
    )
    assert sum(room.passage_m for room in rooms) == pytest.approx(2 * widths)


@pytest.fixture
def with_opening():
    """A plan of 4 x 3 m, or of other corners, with one opening."""
    materials = SceneFile.read(SCENES / "apartment.toml").geometry.materials

    def made(start, end, corners=((0, 0), (4, 0), (4, 3), (0, 3))):
        opening = Opening(name="door", start=start, end=end)
        return Geometry(height_m=2.5, corners=corners, openings=(opening,), materials=materials)

    return made


@pytest.mark.parametrize("ends", [((1.0, 0.0), (1.0, 3.0)), ((1.0, 3.0), (1.0, 0.0))])
def test_two_rooms_are_the_two_sides_of_their_door(with_opening, ends):
    rooms = rooms_of(with_opening(*ends))
    assert sorted(room.plan.area_m2 for room in rooms) == pytest.approx([3.0, 9.0])
    assert [room.passage_m for room in rooms] == pytest.approx([3.0, 3.0])


def test_a_door_from_corner_to_corner_parts_a_room(with_opening):
    rooms = rooms_of(with_opening((0.0, 0.0), (4.0, 3.0)))
    assert [room.plan.area_m2 for room in rooms] == pytest.approx([6.0, 6.0])


def test_a_door_ends_at_the_face_of_the_wall_that_it_touches(with_opening):
    """Of a partition 5 cm thick and 6 m long."""
    corners = ((0, 0), (8, 0), (8, 3), (0, 3), (0, 1.55), (6, 1.55), (6, 1.5), (0, 1.5))
    rooms = rooms_of(with_opening((3.0, 1.55), (3.0, 3.0), corners))
    assert sorted(room.plan.area_m2 for room in rooms) == pytest.approx([3 * 1.45, 24 - 6 * 0.05 - 3 * 1.45])


@pytest.mark.parametrize(
    "ends",
    [
        ((1.0, 0.0), (1.0, 1.0)),
        ((1.0, 0.0), (2.0, 0.0)),
        ((4.0, 0.0), (4.0, 1.0)),
        ((4.0, 0.0), (4.0, 3.0)),
        ((0.0, 3.0), (0.0, 0.0)),
        ((1.0, 0.0), (9.0, 9.0)),
    ],
    ids=["in the room", "along a wall", "from a corner", "a whole wall", "the last wall", "outside"],
)
def test_an_opening_that_leads_to_no_other_wall_parts_nothing(with_opening, ends):
    (room,) = rooms_of(with_opening(*ends))
    assert room.passage_m == 0
    assert room.plan.area_m2 == pytest.approx(12)
