import numpy as np
import pytest
import trimesh

from tests.training.data.levels.conftest import box
from training.data.levels.decimation import merge_flat


def divided(vertices, triangles, times=4):
    for _ in range(times):
        vertices, triangles = trimesh.remesh.subdivide(vertices, triangles)
    return np.asarray(vertices), np.asarray(triangles)


def farthest_m(points, vertices, triangles):
    """How far points are from a mesh at most, by brute force over planes, sides and corners."""
    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    nearest = np.full(len(points), np.inf)
    for corners in mesh.triangles:
        closest = trimesh.triangles.closest_point(np.broadcast_to(corners, (len(points), 3, 3)), points)
        nearest = np.minimum(nearest, np.linalg.norm(points - closest, axis=1))
    return nearest.max()


def test_a_divided_box_becomes_twelve_triangles_again():
    vertices, triangles = divided(*box())
    merged = merge_flat(vertices, triangles, np.zeros(len(triangles), int), 1e-6)
    assert len(triangles) == 12 * 4**4
    assert len(merged.triangles) == 12
    mesh = trimesh.Trimesh(vertices, merged.triangles, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(-5 * 2.6 * 4)


def test_borders_between_materials_stay():
    vertices, triangles = divided(*box())
    materials = (vertices[triangles].mean(axis=1)[:, 0] > 2.5).astype(int)
    merged = merge_flat(vertices, triangles, materials, 1e-6)
    areas = trimesh.Trimesh(vertices, triangles, process=False).area_faces
    after = trimesh.Trimesh(vertices, merged.triangles, process=False).area_faces
    assert len(merged.triangles) < len(triangles) / 3
    for material in (0, 1):
        assert after[materials[merged.kept] == material].sum() == pytest.approx(areas[materials == material].sum())


@pytest.mark.parametrize("within_m", [0.004, 0.02])
def test_no_point_of_a_curved_surface_moves_farther_than_the_bound(within_m):
    x, y = np.meshgrid(np.linspace(0, 4, 24), np.linspace(0, 3, 24), indexing="ij")
    vertices = np.stack([x, y, 0.1 * np.sin(x) * np.cos(y)], axis=-1).reshape(-1, 3)
    cell = np.arange(24 * 24).reshape(24, 24)
    a, b, c, d = (part.ravel() for part in (cell[:-1, :-1], cell[1:, :-1], cell[1:, 1:], cell[:-1, 1:]))
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    merged = merge_flat(vertices, triangles, np.zeros(len(triangles), int), within_m)
    assert len(merged.triangles) < 0.8 * len(triangles)
    assert 0 < merged.bound_m <= within_m
    assert farthest_m(vertices, vertices, merged.triangles) <= merged.bound_m + 1e-9
    some = vertices[merged.triangles].mean(axis=1)
    assert farthest_m(some, vertices, triangles) <= merged.bound_m + 1e-9


def test_nothing_is_merged_within_zero():
    vertices, triangles = divided(*box(), times=1)
    merged = merge_flat(vertices, triangles, np.zeros(len(triangles), int), 0.0)
    np.testing.assert_array_equal(merged.triangles, triangles)
    assert merged.bound_m == 0
