"""Rays through meshes against each triangle tried by itself, in floats and in fractions; and where other tests leak."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of

from server.acoustics.mesh import TriangleMesh
from server.acoustics.mesh_tree import MeshTree, planes_of
from server.acoustics.mesh_tree_kernel import STACK
from tests.oracles import mesh_tree as oracle

QUADS = ((0, 2, 6, 4), (1, 5, 7, 3), (0, 4, 5, 1), (2, 3, 7, 6), (0, 1, 3, 2), (4, 6, 7, 5))
CUBE = np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=float)
INWARDS = np.array([(q[0], q[a], q[a + 1]) for q in QUADS for a in (1, 2)])
OUTWARDS = INWARDS[:, ::-1]


def mesh_of(*parts):
    """Parts are (vertices, triangles)."""
    vertices, triangles = [], []
    for corners, faces in parts:
        triangles.append(np.asarray(faces) + sum(map(len, vertices)))
        vertices.append(np.asarray(corners, dtype=float))
    faces = np.concatenate(triangles)
    return TriangleMesh(np.concatenate(vertices), faces, np.zeros(len(faces), int), ("wall",))


def room(low, high):
    return CUBE * (np.array(high) - low) + low, INWARDS


def block(low, high):
    return CUBE * (np.array(high) - low) + low, OUTWARDS


def sheet(x, *, faces=((0, 1, 2), (0, 2, 3))):
    """A square across the x axis that shows its face to smaller x."""
    return [(x, 0, 0), (x, 0, 2), (x, 2, 2), (x, 2, 0)], faces


def soup(count, seed, size=1.0):
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-5, 5, (count, 1, 3)) + rng.normal(0, size, (count, 3, 3))
    return mesh_of((corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)))


def bumpy_ball(seed):
    """A closed mesh of 1,280 triangles, some of them slivers, around the origin, with its normals inwards."""
    golden = (1 + 5**0.5) / 2
    points = [p for a in (-1, 1) for b in (-golden, golden) for p in ((0, a, b), (a, b, 0), (b, 0, a))]
    points = np.array(points, dtype=float)
    near = np.linalg.norm(points[:, None] - points, axis=-1) < 2.1
    faces = [
        (a, b, c)
        for a in range(12)
        for b in range(a + 1, 12)
        for c in range(b + 1, 12)
        if near[a, b] and near[b, c] and near[a, c]
    ]
    faces = [f if np.linalg.det(points[list(f)]) < 0 else f[::-1] for f in faces]
    vertices, middles = list(points), {}

    def middle(a, b):
        if frozenset((a, b)) not in middles:
            middles[frozenset((a, b))] = len(vertices)
            vertices.append((vertices[a] + vertices[b]) / 2)
        return middles[frozenset((a, b))]

    for _ in range(3):
        split = []
        for a, b, c in faces:
            ab, bc, ca = middle(a, b), middle(b, c), middle(c, a)
            split += [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        faces = split
    rng = np.random.default_rng(seed)
    directions = np.array(vertices) / np.linalg.norm(vertices, axis=-1, keepdims=True)
    return mesh_of((directions * rng.choice([0.9, 1.0, 7.7], (len(vertices), 1)) + 1 / 3, faces))


@pytest.mark.parametrize("count", [1, 3, 40, 700])
def test_closest_hits_sight_and_walls_are_those_of_every_triangle_tried(count):
    mesh, rng = soup(count, seed=count), np.random.default_rng(2)
    tree = MeshTree(mesh)
    a, b = rng.uniform(-6, 6, (2, 400, 3))
    expected = oracle.distances(mesh, a, b - a)
    hits = tree.closest(a, b - a)
    np.testing.assert_allclose(hits.distance, expected.min(axis=1), rtol=1e-9)
    hit = np.isfinite(hits.distance)
    np.testing.assert_array_equal(hits.triangle[hit], expected.argmin(axis=1)[hit])
    assert (hits.triangle[~hit] == -1).all()
    facing = np.sum(mesh.normals[hits.triangle] * (b - a), axis=-1) < 0
    np.testing.assert_array_equal(hits.faces[hit], facing[hit])
    np.testing.assert_array_equal(tree.is_visible(a, b), expected.min(axis=1) > 1)
    limited = tree.closest(a, b - a, 0.5)
    np.testing.assert_array_equal(np.isfinite(limited.distance), expected.min(axis=1) < 0.5)
    met, walls = np.sum(expected < 1, axis=1), np.array([len(each) for each in tree.walls_between(a, b)])
    assert np.all(walls <= met)
    assert np.all(2 * walls >= met)


integers = arrays_of.arrays(np.int8, st.tuples(st.integers(1, 12), st.just(3), st.just(3)), elements=st.integers(-3, 3))
places = arrays_of.arrays(np.int8, 3, elements=st.integers(-4, 4))


@given(integers, places, places)
@settings(max_examples=120, deadline=None)
def test_hits_are_exact_on_a_grid_with_slivers_doubles_edges_and_vertices(corners, origin, direction):
    """Rays in planes, along edges, through vertices, from surfaces: all are common on a grid of nine places a side."""
    corners = np.concatenate([corners, corners[:2, ::-1]])  # coplanar double faces
    mesh = mesh_of((corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)))
    hits = MeshTree(mesh).closest(origin, direction)
    if not direction.any():
        assert hits.triangle[0] == -1
        return
    inside, touching = oracle.exact(mesh, origin.astype(float), direction.astype(float))
    if np.isfinite(hits.distance[0]) and hits.distance[0] > 1e-9:
        assert min(abs(hits.distance[0] - float(each)) for each in touching) < 1e-9
    assert hits.distance[0] <= min(map(float, inside), default=np.inf) + 1e-9


@given(places, places, st.tuples(*[st.sampled_from([-1.0, 1.0])] * 6))
@settings(max_examples=60, deadline=None)
def test_negative_zeros_are_zeros(origin, direction, signs):
    mesh = mesh_of(room((-3, -3, -3), (3, 3, 3)), block((-1, -1, -1), (1, 1, 1)))
    tree = MeshTree(mesh)
    plain = tree.closest(origin.astype(float), direction.astype(float))
    signed = [np.where(v == 0, np.copysign(0.0, s), v) for v, s in ((origin, signs[:3]), (direction, signs[3:]))]
    found = tree.closest(*signed)
    assert found.distance[0] == plain.distance[0]
    assert found.faces[0] == plain.faces[0]


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_no_ray_leaks_at_vertices_or_edges(scale):
    ball = bumpy_ball(3)
    mesh = mesh_of((ball.vertices_m * scale, ball.triangles))
    tree, middle = MeshTree(mesh), np.full(3, scale / 3)
    corners = mesh.corners_m
    shares = np.random.default_rng(1).uniform(0, 1, (3, 1, 1, 1))
    along = (corners + shares * (np.roll(corners, 1, axis=1) - corners)).reshape(-1, 3)
    for targets in (mesh.vertices_m, along, corners.mean(axis=1)):
        hits = tree.closest(middle, targets - middle)
        assert hits.faces.all()
        # It is a star as seen from its middle: every ray meets one place only.
        np.testing.assert_allclose(hits.distance, 1, rtol=1e-6)
        assert not tree.is_visible(middle, middle + 1.5 * (targets - middle)).any()
        assert tree.is_visible(middle, targets).all()
        through = tree.walls_between(np.broadcast_to(middle, targets.shape), middle + 20 * (targets - middle))
        assert {len(walls) for walls in through} == {1}


def test_rays_along_edges_and_in_planes_end_at_what_stands_across():
    tree = MeshTree(mesh_of(room((0, 0, 0), (4, 3, 2))))
    corner_to_corner = tree.closest([(0, 0, 0), (1, 0, 0), (1, 1, 0), (2, 0, 1)], [(1, 0, 0)] * 4)
    np.testing.assert_allclose(corner_to_corner.distance, [4, 3, 3, 2])
    assert not np.isfinite(MeshTree(mesh_of(sheet(1))).closest((1, 1, -1), (0, 0, 1)).distance[0])


def test_a_ray_that_starts_on_a_surface_meets_it_only_if_it_goes_into_it():
    tree = MeshTree(mesh_of(room((0, 0, 0), (4, 3, 2))))
    hits = tree.closest([(0, 1, 1), (0, 1, 1), (-1e-12, 1, 1)], [(1, 0, 0), (-1, 0, 0), (-1, 0, 0)])
    np.testing.assert_allclose(hits.distance, [4, 0, 0], atol=1e-9)


def test_of_double_faces_the_one_that_faces_the_ray_is_hit():
    both = mesh_of(sheet(1), sheet(1, faces=((2, 1, 0), (3, 2, 0))), sheet(1, faces=((1, 0, 3), (1, 3, 2))))
    tree, rng = MeshTree(both), np.random.default_rng(0)
    targets = np.concatenate([np.ones((200, 1)), rng.uniform(0, 2, (200, 2))], axis=1)
    for start in ((0.1, 1, 1), (3, 0.2, 1.9)):
        hits = tree.closest(start, targets - start)
        assert hits.faces.all()
        np.testing.assert_allclose(hits.distance, 1)


@pytest.mark.parametrize(
    ("parts", "walls"),
    [
        ([block((1, 0, 0), (1.2, 2, 2))], 1),
        ([block((1, 0, 0), (1.2, 2, 2)), block((2, 0, 0), (2.2, 2, 2))], 2),
        ([sheet(1)], 1),
        ([sheet(1, faces=((2, 1, 0), (3, 2, 0)))], 1),
        ([sheet(1), sheet(1, faces=((2, 1, 0), (3, 2, 0)))], 1),
        ([sheet(1), sheet(1, faces=((2, 1, 0), (3, 2, 0))), sheet(2), sheet(2, faces=((2, 1, 0), (3, 2, 0)))], 2),
        ([sheet(1), sheet(1)], 1),
        ([sheet(4)], 0),
    ],
)
def test_walls_are_counted_once_whatever_faces_they_have(parts, walls):
    tree = MeshTree(mesh_of(*parts))
    # Through the middle, which is an edge of two triangles, and beside it.
    a, b = np.array([(0, 1, 1), (0, 0.3, 1.1)]), np.array([(3, 1, 1), (3, 0.4, 1.3)])
    assert [len(each) for each in tree.walls_between(a, b)] == [walls, walls]
    assert [len(each) for each in tree.walls_between(b, a)] == [walls, walls]


def test_a_wall_is_given_by_the_faces_through_which_it_is_entered_and_left():
    mesh = mesh_of(block((1, 0, 0), (1.2, 2, 2)), sheet(2))
    tree = MeshTree(mesh)
    for start, end, expected in (
        ((0, 1, 0.7), (3, 1, 0.9), [(1, 1.2), (2, 2)]),
        ((3, 1, 0.9), (0, 1, 0.7), [(2, 2), (1.2, 1)]),
    ):
        (walls,) = tree.walls_between([start], [end])
        np.testing.assert_allclose(mesh.corners_m[walls][..., 0], np.array(expected)[..., None].repeat(3, axis=-1))


@pytest.mark.parametrize(
    "mesh", [soup(60, 1, 4.0), mesh_of(sheet(1), sheet(2), sheet(2, faces=((2, 1, 0), (3, 2, 0))))]
)
def test_from_the_other_end_there_are_the_same_walls(mesh):
    tree = MeshTree(mesh)
    a, b = np.random.default_rng(2).uniform(-6, 6, (2, 500, 3))
    there, back = tree.walls_between(a, b), tree.walls_between(b, a)
    assert max(map(len, there)) > 1
    for one, other in zip(there, back, strict=True):
        np.testing.assert_array_equal(one, other[::-1, ::-1])


def test_inside_is_the_air_that_is_enclosed():
    mesh = mesh_of(room((0, 0, 0), (6, 5, 3)), block((2, 2, 0), (3, 3, 1)))
    tree = MeshTree(mesh)
    points = [(1, 1, 1), (2.5, 2.5, 0.5), (2.5, 2.5, 2), (7, 1, 1), (-1, 2, 2), (0, 2, 1), (6, 5, 3), (2, 2.5, 0.5)]
    assert tree.contains(points).tolist() == [True, False, True, False, False, True, True, True]
    grid = np.random.default_rng(4).uniform(-1, 7, (500, 3))
    in_room = np.all((grid > 0) & (grid < (6, 5, 3)), axis=-1)
    in_block = np.all((grid > (2, 2, 0)) & (grid < (3, 3, 1)), axis=-1)
    np.testing.assert_array_equal(tree.contains(grid), in_room & ~in_block)
    assert tree.contains(grid.reshape(50, 10, 3)).shape == (50, 10)


def test_a_hole_or_a_flipped_triangle_does_not_change_what_is_inside():
    corners, faces = room((0, 0, 0), (6, 5, 3))
    for changed in (faces[1:], np.concatenate([faces[1:], faces[:1, ::-1]])):
        tree = MeshTree(mesh_of((corners, changed)))
        inside = np.random.default_rng(1).uniform((0.5, 0.5, 0.5), (5.5, 4.5, 2.5), (200, 3))
        assert tree.contains(inside).mean() > 0.99
        assert not tree.contains(inside + np.array((0, 0, 3))).any()


def test_many_triangles_in_one_place_make_a_shallow_tree():
    corners = np.tile([(1.0, 0, 0), (1, 2, 0), (1, 0, 2)], (5000, 1))
    tree = MeshTree(mesh_of((corners, np.arange(len(corners)).reshape(-1, 3)))).tree
    depth, deepest = {0: 1}, 1
    for node, (second, count, _) in enumerate(tree.links):
        deepest = max(deepest, depth[node])
        if not count:
            depth[node + 1] = depth[int(second)] = depth[node] + 1
    assert deepest < STACK / 2
    assert sorted(tree.numbers) == list(range(5000))


def test_planes_are_shared_by_what_is_coplanar_whichever_way_it_faces():
    mesh = mesh_of(room((0, 0, 0), (4, 3, 2)), block((4, 5, 0), (6, 7, 2)), ([(0, 0, 0)] * 3, [(0, 1, 2)]))
    planes = planes_of(mesh)
    assert len(set(planes[:12])) == 6
    assert planes[2] == planes[12]  # at x = 4, inwards and outwards
    assert planes[8] == planes[20]  # both floors
    assert np.count_nonzero(planes == planes[-1]) == 1


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_rays_that_are_not_finite_are_refused(bad):
    tree = MeshTree(mesh_of(room((0, 0, 0), (4, 3, 2))))
    with pytest.raises(ValueError, match="origins: must be finite"):
        tree.closest((bad, 0, 0), (1, 0, 0))
    with pytest.raises(ValueError, match="directions: must be finite"):
        tree.closest((0, 0, 0), (1, bad, 0))


def test_distance_is_that_of_the_nearest_point_of_any_triangle():
    mesh, rng = soup(60, seed=5), np.random.default_rng(6)
    points = rng.uniform(-7, 7, (80, 3))
    found = MeshTree(mesh).distance_m(points)
    steps = np.linspace(0, 1, 61)
    u, v = np.meshgrid(steps, steps)
    shares = np.stack([u, v, 1 - u - v], axis=-1)[u + v <= 1 + 1e-12]
    spots = np.einsum("sk,tkx->tsx", shares, mesh.corners_m).reshape(-1, 3)
    nearest = np.array([np.linalg.norm(spots - point, axis=-1).min() for point in points])
    assert np.all(found <= nearest + 1e-12)
    assert np.all(nearest - found < 0.06)
    assert MeshTree(mesh).distance_m(mesh.corners_m).max() < 1e-12


def test_nothing_above_a_ceiling_is_in_the_air_under_an_open_sky():
    """In the corner above a room, no direction but straight down meets anything."""
    tree = MeshTree(mesh_of(room((0, 0, 0), (10, 8, 2.6))))
    rng = np.random.default_rng(4)
    above = rng.uniform((0.01, 0.01, 2.7), (9.99, 7.99, 8.0), (2_000, 3))
    assert not tree.contains(above, is_open=True).any()
    assert tree.contains(rng.uniform((0.1, 0.1, 0.1), (9.9, 7.9, 2.5), (200, 3)), is_open=True).all()


def test_what_is_above_the_ground_or_beside_it_is_in_the_air_under_an_open_sky():
    ground = mesh_of(([(0, 0, 0), (10, 0, 0), (10, 8, 0), (0, 8, 0)], [(0, 1, 2), (0, 2, 3)]))
    rng = np.random.default_rng(5)
    low, high = (0.01, 0.01), (9.99, 7.99)
    above = rng.uniform((*low, 0.01), (*high, 60.0), (2_000, 3))
    tree = MeshTree(ground)
    assert tree.contains(above, is_open=True).all()
    assert tree.contains((30.0, 4.0, 1.0), is_open=True)
