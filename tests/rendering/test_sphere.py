import numpy as np
import pytest
from numpy.testing import assert_array_equal

from server.rendering.sphere import (
    CUBE_CELLS,
    CoverageError,
    cube_cell,
    fill_gaps,
    find_triangle,
    solid_angles,
    triangles_by_cell,
    triangulate,
)


def random_directions(count, seed=0):
    xyz = np.random.default_rng(seed).standard_normal((count, 3))
    return xyz / np.linalg.norm(xyz, axis=-1, keepdims=True)


@pytest.fixture(params=["few", "random", "kemar"])
def directions(request, kemar):
    if request.param == "few":
        return np.concatenate([np.eye(3), -np.eye(3)])
    return random_directions(200) if request.param == "random" else kemar.directions


@pytest.mark.parametrize("start", [0, 3])
def test_weights_lead_back_to_the_direction(directions, start):
    """From any triangle, over any way: the weighted corners point where was asked, and are the nearest around."""
    mesh = triangulate(fill_gaps(directions)[0])
    corners = fill_gaps(directions)[0][mesh.triangles]
    weights = np.zeros(3)
    for direction in random_directions(500, seed=1):
        found = find_triangle(mesh.across, mesh.inverses, direction, start, weights)
        assert weights.min() >= 0
        assert weights.sum() == pytest.approx(1)
        back = weights @ corners[found]
        np.testing.assert_allclose(back / np.linalg.norm(back), direction, atol=1e-7)


def test_directions_leave_a_cube_through_the_cell_whose_middle_is_nearest():
    steps = (2 * np.arange(CUBE_CELLS) + 1) / CUBE_CELLS - 1
    one, other = (each.ravel() for each in np.meshgrid(steps, steps, indexing="ij"))
    faces = [
        np.roll(np.stack([np.full_like(one, sign), one, other]), axis, axis=0).T
        for axis in range(3)
        for sign in (1, -1)
    ]
    middles = np.concatenate(faces)
    for middle in middles:
        assert_array_equal(middles[cube_cell(middle)], middle)
    for direction in random_directions(500, seed=2):
        on_cube = direction / np.abs(direction).max()
        assert np.abs(middles[cube_cell(direction)] - on_cube).max() <= 1 / CUBE_CELLS + 1e-9


@pytest.mark.parametrize("direction", [(0.0, 0.0, 0.0), (1.0, 1.0, -1.0), (0.0, -1.0, 1.0), (0.0, np.nan, 1.0)])
def test_every_direction_leaves_a_cube_somewhere(direction):
    assert 0 <= cube_cell(np.array(direction)) < 6 * CUBE_CELLS**2


def test_from_the_triangle_of_its_cell_a_direction_is_near(kemar):
    """Of the triangles that a search tries, all but the last do not hold the direction."""
    directions = fill_gaps(kemar.directions)[0]
    mesh = triangulate(directions)
    by_cell = triangles_by_cell(directions, mesh.triangles)
    weights = np.zeros(3)
    tried = []
    for direction in random_directions(300, seed=3):
        triangle, steps = by_cell[cube_cell(direction)], 0
        while (mesh.inverses[triangle] @ direction).min() < -1e-9:
            triangle, steps = mesh.across[triangle, np.argmin(mesh.inverses[triangle] @ direction)], steps + 1
        assert find_triangle(mesh.across, mesh.inverses, direction, by_cell[cube_cell(direction)], weights) == triangle
        tried.append(steps)
    assert np.mean(tried) < 3


def test_at_a_measured_direction_nothing_else_counts(directions):
    mesh = triangulate(fill_gaps(directions)[0])
    weights = np.zeros(3)
    for index, direction in enumerate(directions):
        found = find_triangle(mesh.across, mesh.inverses, direction, 0, weights)
        counts = mesh.triangles[found][weights > 1e-9]
        assert counts.tolist() == [index]


@pytest.mark.parametrize("direction", [(0.0, 0.0, 0.0), (np.nan, 0.0, 1.0)])
def test_no_direction_is_a_trap(kemar, direction):
    mesh = triangulate(fill_gaps(kemar.directions)[0])
    weights = np.zeros(3)
    find_triangle(mesh.across, mesh.inverses, np.array(direction), 5, weights)
    assert weights.sum() == pytest.approx(1)


def test_gaps_are_filled_from_the_same_cone_of_confusion():
    """Of a ring around the head: above sounds like what is ahead and behind, above left like what is to the left."""
    azimuth = np.radians(np.arange(0, 360, 5))
    ring = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], axis=-1)
    directions, shares = fill_gaps(ring)
    np.testing.assert_allclose(shares.sum(axis=-1), 1)
    for added, share in zip(directions[len(ring) :], shares, strict=True):
        side = share @ np.arcsin(ring[:, 1])
        assert side == pytest.approx(np.arcsin(added[1]), abs=np.radians(6))


def test_a_measured_sphere_has_no_gap_to_fill():
    directions, shares = fill_gaps(random_directions(500))
    assert len(directions) == 500
    assert shares.shape == (0, 500)


def test_one_side_of_the_head_cannot_be_triangulated():
    directions = random_directions(100)
    with pytest.raises(CoverageError):
        triangulate(directions[directions[:, 0] > 0.1])
    with pytest.raises(CoverageError):
        triangulate(np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]]))


def test_solid_angles_are_the_areas_nearest():
    """Of a band around the equator up to 30 degrees and the poles: Archimedes."""
    caps = np.array([[0, 0, 1.0], [0, 0, -1.0]])
    azimuth = np.radians(np.arange(0, 360, 1))
    ring = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], axis=-1)
    shares = solid_angles(np.concatenate([caps, ring]))
    np.testing.assert_allclose(shares[:2], (1 - np.sin(np.radians(45))) / 2, rtol=0.01)
    assert shares.sum() == pytest.approx(1)
