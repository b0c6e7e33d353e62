"""Openings part a plan into rooms, which together are the plan."""

from pathlib import Path

import pytest

from server.scene.geometry import Geometry, Opening
from server.scene.rooms import rooms_of
from training.scene_file import SceneFile

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


def test_two_rooms_are_the_two_sides_of_their_door():
    apartment = SceneFile.read(SCENES / "apartment.toml").geometry
    square = Geometry(
        height_m=2.5,
        corners=((0, 0), (4, 0), (4, 3), (0, 3)),
        openings=(Opening(name="door", start=(1.0, 0.0), end=(1.0, 3.0)),),
        materials=apartment.materials,
    )
    one, other = sorted(room.plan.area_m2 for room in rooms_of(square))
    assert (one, other) == pytest.approx((3.0, 9.0))


@pytest.mark.parametrize("end", [(1.0, 1.0), (2.0, 0.0), (9.0, 9.0)], ids=["in the room", "along the wall", "outside"])
def test_an_opening_that_leads_to_no_wall_parts_nothing(end):
    materials = SceneFile.read(SCENES / "apartment.toml").geometry.materials
    square = Geometry(
        height_m=2.5,
        corners=((0, 0), (4, 0), (4, 3), (0, 3)),
        openings=(Opening(name="door", start=(1.0, 0.0), end=end),),
        materials=materials,
    )
    (room,) = rooms_of(square)
    assert room.passage_m == 0
    assert room.plan.area_m2 == pytest.approx(12)
