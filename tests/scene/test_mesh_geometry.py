"""Floor plans as meshes: closed, of the same area and volume, with the same inside."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from server.acoustics.mesh import MeshError
from server.acoustics.mesh_tree import MeshTree
from server.scene.geometry import Geometry, Material, Materials
from server.scene.mesh_geometry import MeshGeometry, triangulated
from training.data.scene_file import SceneFile

SCENES = sorted(Path("training/scenes").rglob("*.toml"))
OF_ALL = Material(absorption=(0.2,) * 7, scattering=(0.1,) * 7)


def star(seed, corners):
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * (np.arange(corners) + rng.uniform(-0.4, 0.4, corners)) / corners
    radius = rng.uniform(0.3, 6, corners)
    return tuple(zip((radius * np.cos(angle)).tolist(), (radius * np.sin(angle)).tolist(), strict=True))


def is_closed(mesh):
    """Each edge is run along as often in one direction as in the other."""
    edges = Counter()
    for a, b, c in mesh.triangles.tolist():
        edges.update([(a, b), (b, c), (c, a)])
    return all(edges[end, start] == number == 1 for (start, end), number in edges.items())


@pytest.mark.parametrize("scene", SCENES, ids=lambda path: path.stem)
def test_a_scene_is_a_closed_mesh_of_its_area_volume_and_materials(scene):
    geometry = SceneFile.read(scene).geometry
    plan, place = geometry.floor_plan, MeshGeometry.of_plan(geometry)
    mesh = place.mesh
    assert is_closed(mesh)
    assert mesh.volume_m3 == pytest.approx(plan.area_m2 * plan.height_m)
    around_m = np.linalg.norm(plan.walls[:, 1] - plan.walls[:, 0], axis=-1).sum()
    areas = [mesh.areas_m2[mesh.surfaces == surface].sum() for surface in range(3)]
    assert areas == pytest.approx([around_m * plan.height_m, plan.area_m2, plan.area_m2])
    normals = [mesh.normals[mesh.surfaces == surface, 2] for surface in range(3)]
    for found, expected in zip(normals, (0, 1, -1), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-12)
    np.testing.assert_array_equal(place.of_surfaces("absorption")[1], geometry.materials.floor.absorption)
    corners = np.array(plan.corners)
    points = np.random.default_rng(0).uniform(
        (*corners.min(axis=0) - 1, -1), (*corners.max(axis=0) + 1, plan.height_m + 1), (300, 3)
    )
    np.testing.assert_array_equal(MeshTree(mesh).contains(points), plan.contains(points))


def test_sight_in_a_mesh_is_sight_in_its_plan():
    geometry = SceneFile.read(Path("training/scenes/apartment.toml")).geometry
    plan, rng = geometry.floor_plan, np.random.default_rng(1)
    corners = np.array(plan.corners)
    points = rng.uniform((*corners.min(axis=0), 0.1), (*corners.max(axis=0), 2.3), (2000, 3))
    points = points[plan.contains(points)]
    a, b = points[: len(points) // 2], points[len(points) // 2 :][: len(points) // 2]
    tree = MeshTree(MeshGeometry.of_plan(geometry).mesh)
    np.testing.assert_array_equal(tree.is_visible(a, b), plan.is_visible(a, b))
    assert 0.1 < plan.is_visible(a, b).mean() < 0.9


@given(st.integers(0, 10**6), st.integers(3, 24))
@settings(max_examples=40, deadline=None)
def test_triangles_fill_a_polygon(seed, count):
    corners = star(seed, count)
    materials = Materials(walls=OF_ALL, floor=OF_ALL, ceiling=OF_ALL)
    geometry = Geometry(height_m=2.0, corners=corners, materials=materials)
    points, triangles = np.array(corners), triangulated(corners)
    (ax, ay), (bx, by), (cx, cy) = points[triangles].transpose(1, 2, 0)
    areas = ((bx - ax) * (cy - ay) - (by - ay) * (cx - ax)) / 2
    assert len(triangles) == count - 2
    assert (areas > -1e-9).all()
    assert areas.sum() == pytest.approx(geometry.floor_plan.area_m2)


def test_corners_in_a_line_are_part_of_the_mesh():
    triangles = triangulated(((0, 0), (1, 0), (2, 0), (2, 1), (2, 2), (0, 2)))
    assert set(triangles.ravel().tolist()) == set(range(6))
    assert len(triangles) == 4


def test_a_material_without_properties_is_named():
    mesh = MeshGeometry.of_plan(SceneFile.read(SCENES[0]).geometry).mesh
    with pytest.raises(MeshError, match="materials: floor, ceiling: give absorption"):
        MeshGeometry(mesh, {"walls": OF_ALL})
