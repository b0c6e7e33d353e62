"""First reflections in meshes against those of the same floor plans, and against mirrors tried triangle by triangle."""

from pathlib import Path

import numpy as np
import pytest

from server.acoustics.mesh import TriangleMesh
from server.acoustics.mesh_reflections import MOST_REFLECTIONS, MeshReflectionFinder, MeshWallLosses
from server.acoustics.mesh_tree import MeshTree, patches_of
from server.acoustics.reflections import ReflectionFinder
from server.acoustics.transmission import walls_between
from server.scene.geometry import Geometry, Material, Materials
from server.scene.mesh_geometry import MeshGeometry
from training.data.scene_file import SceneFile
from training.simulation.rays import sphere_directions

SCENES = Path(__file__).resolve().parents[2] / "training" / "scenes"
OF_ALL = Material(absorption=(0.2,) * 7, scattering=(0.1,) * 7)
GAINS_DB = -np.arange(1.0, 22.0).reshape(3, 7)  # of walls, floor and ceiling
APARTMENT = SceneFile.read(SCENES / "apartment.toml").geometry
LARGE = SceneFile.read(SCENES / "large2.toml").geometry


def points_inside(plan, count, seed):
    corners = np.array(plan.corners)
    low, high = (*corners.min(axis=0), 0.1), (*corners.max(axis=0), plan.height_m - 0.1)
    points = np.random.default_rng(seed).uniform(low, high, (60 * count, 3))
    return points[plan.contains(points) & (plan.wall_distance_m(points) >= 0.05)][:count]


def rows_of(found):
    rows = np.column_stack([found.emitter, found.length_m, found.arrival, found.departure, found.gain_db]).round(6)
    return sorted(map(tuple, (rows + 0.0).tolist()))


@pytest.mark.parametrize("geometry", [APARTMENT, LARGE], ids=["apartment", "large2"])
def test_a_plan_as_a_mesh_mirrors_as_the_plan(geometry):
    plan = geometry.floor_plan
    tree = MeshTree(MeshGeometry.of_plan(geometry).mesh)
    mesh, expected = MeshReflectionFinder(tree, GAINS_DB), ReflectionFinder(plan, GAINS_DB)
    emitters, number = points_inside(plan, 25, 1), 0
    for listener in points_inside(plan, 25, 2):
        found = mesh.find(listener, emitters)
        assert rows_of(found) == rows_of(expected.find(listener, emitters))
        assert (np.diff(found.emitter) >= 0).all()
        number += len(found.emitter)
    assert number > 500


def attic(seed):
    """Slanted triangles at random around a room of 6 x 6 x 6 m, of three materials."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-3, 3, (60, 1, 3)) + rng.normal(0, 1.2, (60, 3, 3))
    return TriangleMesh(
        corners.reshape(-1, 3), np.arange(180).reshape(-1, 3), rng.integers(0, 3, 60), ("walls", "floor", "ceiling")
    )


def mirrors(tree, listener, emitter):
    """Numbers of triangles, and images of the emitter in them, each found by a line to the image."""
    mesh, found = tree.mesh, []
    for number, (normal, corner) in enumerate(zip(mesh.normals, mesh.corners_m[:, 0], strict=True)):
        from_listener, from_emitter = normal @ (listener - corner), normal @ (emitter - corner)
        if from_listener * from_emitter <= 0:
            continue
        image = emitter - 2 * from_emitter * normal
        spot = listener + (image - listener) * from_listener / (from_listener + from_emitter)
        a, b, c = mesh.corners_m[number]
        sides = [normal @ np.cross(q - p, spot - p) for p, q in ((a, b), (b, c), (c, a))]
        if min(sides) > 0 and tree.is_visible(listener, spot) and tree.is_visible(emitter, spot):
            found.append((number, image))
    return found


def test_slanted_triangles_mirror_on_both_sides_where_both_ends_see_the_spot():
    tree, rng = MeshTree(attic(4)), np.random.default_rng(5)
    finder, number = MeshReflectionFinder(tree, GAINS_DB), 0
    for listener, emitter in rng.uniform(-3, 3, (150, 2, 3)):
        expected = mirrors(tree, listener, emitter)
        found = finder.find(listener, emitter[None])
        images = sorted((listener + found.length_m[:, None] * found.arrival).tolist())
        wanted = sorted(image.tolist() for _, image in expected)
        np.testing.assert_allclose(np.reshape(images, (-1, 3)), np.reshape(wanted, (-1, 3)), atol=1e-9)
        gains = sorted(found.gain_db[:, 0].tolist())
        assert gains == sorted(GAINS_DB[tree.mesh.surfaces[number], 0] for number, _ in expected)
        number += len(expected)
    assert number > 50


def test_exchanging_listener_and_emitter_reverses_each_path():
    tree = MeshTree(attic(4))
    finder = MeshReflectionFinder(tree, GAINS_DB)
    for here, there in np.random.default_rng(6).uniform(-3, 3, (80, 2, 3)):
        one, other = finder.find(here, there[None]), finder.find(there, here[None])
        assert sorted(one.length_m.round(9)) == sorted(other.length_m.round(9))
        assert sorted(one.arrival.round(6).tolist()) == sorted(other.departure.round(6).tolist())


@pytest.mark.parametrize("offset", [0.0, -0.0, 1e-12])
def test_ends_on_a_patch_an_edge_or_a_vertex_give_finite_paths(offset):
    corners = ((0.0, 0.0), (4.0, 0.0), (4.0, 3.0), (0.0, 3.0))
    geometry = Geometry(height_m=2.5, corners=corners, materials=Materials(walls=OF_ALL, floor=OF_ALL, ceiling=OF_ALL))
    finder = MeshReflectionFinder(MeshTree(MeshGeometry.of_plan(geometry).mesh), GAINS_DB)
    ends = [(offset, 1, 1), (1, offset, offset), (offset, offset, offset), (1.3, 1.1, 0.9)]
    for listener in ends:
        found = finder.find(listener, np.array(ends, dtype=float))
        for value in (found.length_m, found.arrival, found.departure):
            assert np.isfinite(value).all()
        np.testing.assert_allclose(np.linalg.norm(found.arrival, axis=-1), 1)
    # A source on the floor coincides with its image: only the floor gives the path of the direct sound.
    whole = finder.find((1.3, 1.1, 0.9), np.array([(2.7, 1.9, 1.0)]))
    assert len(whole.emitter) == 6


def test_coplanar_triangles_are_one_patch_if_edges_join_them():
    plan = MeshGeometry.of_plan(APARTMENT).mesh
    patches = patches_of(plan)
    assert len(set(patches)) == len(APARTMENT.corners) + 2
    for patch in set(patches):
        assert len(set(plan.surfaces[patches == patch])) == 1
    apart = TriangleMesh(
        [(0, 0, 0), (1, 0, 0), (0, 1, 0), (5, 0, 0), (6, 0, 0), (5, 1, 0), (1, 1, 0)],
        [(0, 1, 2), (3, 4, 5), (2, 1, 6)],
        [0, 0, 0],
        ("floor",),
    )
    first, second, third = patches_of(apart)
    assert first == third != second


def test_of_too_many_mirrors_the_largest_are_found():
    """Two hundred facets of a ball, each of which shows an ear to itself."""
    directions = sphere_directions(200)
    sizes_m = np.random.default_rng(1).permutation(np.linspace(0.05, 0.2, 200))
    beside = np.cross(directions, (0.3, 0.5, 0.81))
    beside /= np.linalg.norm(beside, axis=-1, keepdims=True)
    turns = np.stack([np.cos(a) * beside + np.sin(a) * np.cross(directions, beside) for a in (0, 2.1, 4.2)], axis=1)
    corners = 3 * directions[:, None] + sizes_m[:, None, None] * turns
    mesh = TriangleMesh(corners.reshape(-1, 3), np.arange(600).reshape(-1, 3), np.zeros(200, int), ("floor",))
    found = MeshReflectionFinder(MeshTree(mesh), GAINS_DB[:1]).find((0, 0, 0), np.zeros((1, 3)))
    np.testing.assert_allclose(found.length_m, 6)
    facets = np.argmax(found.arrival @ directions.T, axis=-1)
    assert sorted(facets) == sorted(np.argsort(-sizes_m)[:MOST_REFLECTIONS])


def test_transmission_takes_what_the_walls_of_a_plan_take():
    plan = APARTMENT.floor_plan
    tree = MeshTree(MeshGeometry.of_plan(APARTMENT).mesh)
    listener, emitters = points_inside(plan, 1, 3)[0], points_inside(plan, 200, 4)
    through, losses_db = MeshWallLosses(tree, GAINS_DB * -1).between(listener, emitters)
    walls = walls_between(plan, listener, emitters)
    np.testing.assert_array_equal(through, walls > 0)
    np.testing.assert_allclose(losses_db, walls[:, None] * -GAINS_DB[0])
    assert 0 < np.count_nonzero(through) < 200
    solid = np.where(np.arange(3)[:, None] == 0, np.inf, -GAINS_DB)
    assert not MeshWallLosses(tree, solid).between(listener, emitters)[0].any()


def test_through_a_wall_with_two_materials_the_heavier_counts_from_both_sides():
    square = np.array([(0, y, z) for y, z in ((-1, -1), (1, -1), (1, 1), (-1, 1))], dtype=float)
    corners = np.concatenate([square, square + np.array([0.2, 0, 0])])
    faces = np.array([(0, 2, 1), (0, 3, 2), (4, 5, 6), (4, 6, 7)])
    tree = MeshTree(TriangleMesh(corners, faces, [0, 0, 1, 1], ("plaster", "brick")))
    light, heavy = np.linspace(5, 20, 7), np.linspace(30, 60, 7)
    here, there = np.array([-2.0, 0.1, 0.2]), np.array([2.0, -0.3, 0.1])
    for losses_db in ([light, heavy], [heavy, light]):
        for one, other in ((here, there), (there, here)):
            through, found = MeshWallLosses(tree, np.array(losses_db)).between(one, other[None])
            assert through.all()
            np.testing.assert_allclose(found, heavy[None])
    solid = np.array([np.full(7, np.inf), light])
    for one, other in ((here, there), (there, here)):
        assert not MeshWallLosses(tree, solid).between(one, other[None])[0].any()


def test_turned_freely_and_in_single_precision_a_mesh_loses_no_reflection():
    """Walls of several triangles each, which rounding puts into planes that are not quite the same."""
    fine = MeshGeometry.of_plan(LARGE).mesh
    for _ in range(3):
        corners = fine.corners_m
        halves = (corners + np.roll(corners, -1, axis=1)) / 2
        inner = [np.stack([corners[:, k], halves[:, k], halves[:, k - 1]], axis=1) for k in range(3)]
        parts = np.concatenate([*inner, halves])
        numbers = np.arange(3 * len(parts)).reshape(-1, 3)
        fine = TriangleMesh(parts.reshape(-1, 3), numbers, np.tile(fine.surfaces, 4), fine.materials)
    turn, _ = np.linalg.qr(np.random.default_rng(2).standard_normal((3, 3)))
    moved = (fine.vertices_m @ turn.T + (13, -7, 5)).astype(np.float32)
    turned = MeshReflectionFinder(
        MeshTree(TriangleMesh(moved, fine.triangles, fine.surfaces, fine.materials)), GAINS_DB
    )
    expected, lost, number = MeshReflectionFinder(MeshTree(fine), GAINS_DB), 0, 0
    emitters = points_inside(LARGE.floor_plan, 40, 1)
    for listener in points_inside(LARGE.floor_plan, 40, 2):
        wanted = expected.find(listener, emitters)
        found = turned.find(turn @ listener + (13, -7, 5), emitters @ turn.T + (13, -7, 5))
        counts = [np.bincount(each.emitter, minlength=len(emitters)) for each in (wanted, found)]
        lost += np.abs(counts[0] - counts[1]).sum()
        number += len(wanted.emitter)
    assert number > 2000
    assert lost < 0.002 * number
