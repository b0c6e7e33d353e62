"""A floor plan and the mesh of its surfaces, asked the same questions."""

from pathlib import Path

import numpy as np
import pytest

from server.acoustics.surroundings import MeshSurroundings, PlanSurroundings, compile_meshes
from server.kernels.compiled import functions_compiled
from server.scene.mesh_geometry import MeshGeometry
from training.data.scene_file import SceneFile

APARTMENT = SceneFile.read(Path(__file__).resolve().parents[2] / "training" / "scenes" / "apartment.toml").geometry
GAINS_DB = -np.arange(1.0, 22.0).reshape(3, 7)
LOSSES_DB = np.vstack([np.arange(10.0, 17.0), np.full((2, 7), np.inf)])


@pytest.fixture(scope="module")
def plan():
    return PlanSurroundings(APARTMENT.floor_plan)


@pytest.fixture(scope="module")
def mesh():
    return MeshSurroundings(MeshGeometry.of_plan(APARTMENT).mesh)


@pytest.fixture(scope="module")
def points(plan):
    low, high = plan.bounds_m
    return np.random.default_rng(1).uniform(low - 0.5, high + 0.5, (400, 3))


def test_both_say_what_is_inside_and_in_sight(plan, mesh, points):
    np.testing.assert_allclose(mesh.bounds_m, plan.bounds_m)
    inside = plan.contains(points)
    np.testing.assert_array_equal(mesh.contains(points), inside)
    assert [mesh.holds(tuple(point)) for point in points[:50]] == [plan.holds(tuple(point)) for point in points[:50]]
    within = points[inside]
    assert 0 < len(within) < len(points)
    np.testing.assert_array_equal(
        mesh.is_visible(within[:, None], within[None, :30]), plan.is_visible(within[:, None], within[None, :30])
    )
    assert plan.has_obstacles
    assert mesh.has_obstacles


@pytest.mark.parametrize(
    "losses_db", [None, LOSSES_DB, np.full((3, 7), np.inf)], ids=["solid", "light", "without mass"]
)
def test_both_mirror_sound_and_let_it_through_walls(plan, mesh, points, losses_db):
    within = points[plan.contains(points)]
    one, other = (each.first_reflections(GAINS_DB, losses_db) for each in (plan, mesh))
    for listener in within[:15]:
        found, expected = one.find(listener, within), other.find(listener, within)
        rows = [
            sorted(np.column_stack([each.emitter, each.length_m, each.arrival, each.gain_db]).round(6).tolist())
            for each in (found, expected)
        ]
        np.testing.assert_allclose(rows[0], rows[1], atol=2e-6)
        through = found.gain_db[:, 0] % 10 == 0
        assert through.any() == (losses_db is LOSSES_DB)


def test_no_reflection_is_shorter_than_the_first_echo_of_either(plan, mesh, points):
    within = points[plan.contains(points)]
    reflections = plan.first_reflections(GAINS_DB)
    for listener in within[:15]:
        found = reflections.find(listener, within)
        shortest = np.full(len(within), np.inf)
        np.minimum.at(shortest, found.emitter, found.length_m)
        for each in (plan, mesh):
            assert np.all(
                each.first_echo().length_m(np.broadcast_to(listener, within.shape), within) <= shortest + 1e-9
            )


def test_under_the_open_sky_what_no_back_shows_is_air():
    mesh = MeshGeometry.of_plan(APARTMENT).mesh
    floor = mesh.only(mesh.surfaces == 1)
    above, below = np.array([[2.0, 2.0, 1.0]]), np.array([[2.0, 2.0, -1.0]])
    assert MeshSurroundings(floor, open_sky=True).contains(above)
    assert not MeshSurroundings(floor, open_sky=True).contains(below)
    assert not MeshSurroundings(floor).contains(above)


def test_once_compiled_a_mesh_is_asked_without_compiling(mesh, points):
    compile_meshes()
    before = functions_compiled()
    inside = points[mesh.contains(points)]
    place = MeshSurroundings(mesh.mesh)
    assert place.holds(tuple(inside[0]))
    place.is_visible(inside[0], inside)
    place.sound_paths(343.0).find(inside[0], inside)
    place.first_reflections(GAINS_DB, LOSSES_DB).find(inside[0], inside)
    place.first_echo().length_m(inside[:1], inside[1:2])
    assert functions_compiled() == before
