"""Where a listener can walk: up stairs and through doors, and on no roof, table or wardrobe."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from server.acoustics.mesh import TriangleMesh
from server.acoustics.surroundings import MeshSurroundings
from tests.two_rooms import EAST, HARD, WEST, box, rooms
from training.data.levels.level_scene import LevelFile, LevelGeometry, LevelScene
from training.data.levels.walkable import STEP_M, reached_ground
from training.data.scene_file import Probes, SceneFileError, Simulation

START = (1.0, 2.0, 1.6)
SHED = ((0.0, 3.0, 0.0), (2.0, 5.0, 2.5))
PLATFORM = ((5.0, 0.0, 0.0), (8.0, 5.0, 3.0))
FLIGHT_M = 1.2
PROBES = Probes(spacing_m=1.0, jitter_m=0.2, wall_clearance_m=0.4, heights_m=(1.2, 1.9))


def flight(steps):
    """From the floor, where x is 2 m, to the platform."""
    ends = np.linspace(2.0, 5.0, steps + 1)
    return [
        ((low, 0.0, 0.0), (high, FLIGHT_M, 3.0 * (number + 1) / steps))
        for number, (low, high) in enumerate(pairwise(ends))
    ]


def hall(*blocks):
    """A hall of 8 x 5 x 6 m in which these blocks stand."""
    around = box((0.0, 0.0, 0.0), (8.0, 5.0, 6.0), "stone")
    inwards = TriangleMesh(around.vertices_m, around.triangles[:, ::-1], around.surfaces, around.materials)
    return TriangleMesh.joined([inwards, *(box(*ends, "stone") for ends in blocks)])


def reached(mesh, *starts, emitters=()):
    return reached_ground(MeshSurroundings(mesh), starts, emitters, ear_m=1.2, head_room_m=1.6).spots


def is_within(points, low, high):
    return np.all((points[:, :2] > low[:2]) & (points[:, :2] < high[:2]), axis=-1)


def test_stairs_are_climbed_step_by_step_and_a_roof_without_stairs_is_not_reached():
    spots = reached(hall(SHED, PLATFORM, *flight(10)), START)
    assert set(np.unique(spots[:, 2].round(6))) == {*(np.arange(11) * 0.3).round(6)}
    assert not is_within(spots, *SHED).any()
    assert is_within(spots, *PLATFORM).sum() * 0.04 == pytest.approx(15, rel=0.1)


def test_steps_that_are_too_high_are_not_taken():
    assert STEP_M < 3.0 / 5
    assert not is_within(reached(hall(PLATFORM, *flight(5)), START), *PLATFORM).any()


def test_each_start_reaches_what_is_below_it():
    on_the_roof = reached(hall(SHED, PLATFORM), (1.0, 4.0, 4.1))
    np.testing.assert_allclose(on_the_roof[:, 2], 2.5)
    assert is_within(on_the_roof, *SHED).all()
    both = reached(hall(SHED, PLATFORM), (1.0, 4.0, 4.1), START)
    assert set(np.unique(both[:, 2].round(6))) == {0.0, 2.5}
    assert not len(reached(hall(SHED)))


def test_an_emitter_reaches_the_floor_of_its_room_and_not_the_table_below_it():
    table = (0.5, 1.0, 0.0), (2.0, 2.0, 0.74)
    assert set(reached(hall(table), (1.2, 1.5, 2.0))[:, 2].round(6)) == {0.74}
    assert set(reached(hall(table), emitters=[(1.2, 1.5, 1.0)])[:, 2].round(6)) == {0.0}
    closed = ((4.0, 0.0, 0.0), (4.1, 5.0, 6.0))
    assert reached(hall(closed), emitters=[(1.0, 1.0, 1.5)])[:, 0].max() < 4.0
    assert {*(reached(hall(closed), START, emitters=[(6.0, 1.0, 1.5)])[:, 0] > 4.0)} == {False, True}


@pytest.mark.parametrize("height_m", [1.0, 6.0])
def test_nobody_walks_through_a_thin_wall_or_over_a_balustrade(height_m):
    spots = reached(hall(((4.0, 0.0, 0.0), (4.02, 5.0, height_m))), START)
    assert spots[:, 0].max() < 4.0


def test_nobody_walks_where_there_is_no_room_for_a_head():
    low = ((2.0, 0.0, 1.5), (4.0, 5.0, 2.5))
    spots = reached(hall(low), START)
    assert spots[:, 0].max() < 2.0
    spots = reached(hall(((2.0, 0.0, 1.7), (4.0, 5.0, 2.5))), START)
    assert spots[:, 0].max() > 7.5


def test_slopes_are_walked_on_unless_they_are_steep():
    def ramp(rise_m):
        wedge = box((2.0, 0.0, 0.0), (6.0, 5.0, rise_m), "stone")
        vertices = wedge.vertices_m.copy()
        vertices[(vertices[:, 0] < 3) & (vertices[:, 2] > 0), 2] = 1e-3
        return TriangleMesh.joined([hall(), replace(wedge, vertices_m=vertices)])

    assert reached(ramp(2.0), START)[:, 2].max() > 1.9
    steep = reached(ramp(5.5), START)
    assert steep[:, 2].max() < 0.2


def level(mesh, **changes):
    settings = {"rays": 200, "duration_s": 0.25, "arrival_directions": 6, "yaws": 1, "sample_rate": 16_000}
    given = {
        "id": "hall", "name": "Hall", "description": "",
        "geometry": LevelGeometry(mesh="geometry.npz", materials=dict.fromkeys(mesh.materials, HARD)),
        "start": {"listener": START, "emitter": (3.0, 3.0, 1.5)}, "probes": PROBES,
        "simulation": Simulation(image_order=1, held_out_share=0.1, **settings), **changes,
    }  # fmt: skip
    return LevelScene(LevelFile(**given), mesh, ())


def test_probes_stand_on_stairs_and_not_above_what_nobody_reaches():
    scene = level(hall(SHED, PLATFORM, *flight(10)))
    probes = scene.probe_positions(1)
    np.testing.assert_array_equal(probes, scene.probe_positions(1))
    assert not is_within(probes, *SHED).any()
    ground_m = np.select(
        [is_within(probes, *PLATFORM), probes[:, 1] > FLIGHT_M, probes[:, 0] < 2.0],
        [3.0, 0.0, 0.0],
        0.3 * np.ceil((probes[:, 0] - 2.0) / 0.3),
    )
    above_m = probes[:, 2] - ground_m
    assert np.all((above_m > 1.2 - 1e-9) & (above_m < 1.9 + 1e-9))
    on_the_flight = probes[is_within(probes, (2.0, 0.0), (5.0, FLIGHT_M))]
    assert len(on_the_flight) == 3
    assert np.ptp(on_the_flight[:, 2]) > 1.0
    assert scene.surroundings.tree.distance_m(probes).min() >= PROBES.wall_clearance_m


def test_narrow_ground_beside_the_middle_of_its_cells_has_probes_where_none_is_near():
    """A gallery 0.9 m wide, between the cells of a grid of two metres."""
    gallery = ((0.0, 0.0, 0.0), (8.0, 3.5, 3.0)), ((0.0, 4.4, 0.0), (8.0, 5.0, 3.0))
    coarse = PROBES.model_copy(update={"spacing_m": 2.0})
    scene = level(hall(*gallery), probes=coarse, start={"listener": (1.0, 4.0, 1.6), "emitter": (7.0, 4.0, 1.6)})
    probes = scene.probe_positions(1)
    assert 3 <= len(probes) <= 5
    assert np.all((probes[:, 1] > 3.9 - 0.1) & (probes[:, 1] < 4.0 + 0.1))
    assert np.diff(np.sort(probes[:, 0])).max() < 4.0


def test_doors_do_not_bar_the_way():
    spots = reached(rooms().mesh, WEST)
    assert {*(spots[:, 0] > 4.0)} == {False, True}
    assert reached(rooms().mesh, WEST).shape == reached(rooms().mesh, EAST).shape


def test_a_level_without_ground_is_refused_with_what_to_do():
    pit = level(hall(((0.0, 0.0, 0.0), (8.0, 5.0, 5.0))), start={"listener": (1, 2, 5.6), "emitter": (3, 3, 5.6)})
    with pytest.raises(SceneFileError, match=r"fewer than 3 probes .* listener can walk"):
        pit.probe_positions(1)
