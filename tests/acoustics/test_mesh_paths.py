"""Shortest paths in meshes: against the same floor plans, against screens and openings whose paths are known, and
against paths over points strewn along the edges."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.diffraction import diffraction_gain_db
from server.acoustics.mesh import TriangleMesh
from server.acoustics.mesh_edges import MOST_POINTS, _edges, bends_of
from server.acoustics.mesh_paths import MeshPathFinder
from server.acoustics.mesh_tree import MeshTree
from server.acoustics.sound_path import PlanPathFinder
from server.scene.mesh_geometry import MeshGeometry
from training.data.scene_file import SceneFile

SCENES = Path(__file__).resolve().parents[2] / "training" / "scenes"
SPEED = 343.0
QUADS = ((0, 2, 6, 4), (1, 5, 7, 3), (0, 4, 5, 1), (2, 3, 7, 6), (0, 1, 3, 2), (4, 6, 7, 5))
CUBE = np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=float)
OF_AIR = np.array([(q[0], q[a], q[a + 1]) for q in QUADS for a in (1, 2)])
OF_SOLID = OF_AIR[:, ::-1]
ROOM = (CUBE * (10, 8, 3), OF_AIR)
TURN, _ = np.linalg.qr(np.random.default_rng(3).standard_normal((3, 3)))


def mesh_of(*parts):
    """Parts are (vertices, triangles)."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    triangles = np.concatenate([np.asarray(faces) + at for (_, faces), at in zip(parts, starts, strict=False)])
    return TriangleMesh(np.concatenate([part for part, _ in parts]), triangles, np.zeros(len(triangles), int), ("all",))


def finder_of(*parts):
    return MeshPathFinder(MeshTree(mesh_of(*parts)), SPEED)


def sheet(*corners):
    return np.array(corners, dtype=float), np.array([(0, 1, 2), (0, 2, 3)])


def block(low, high):
    return CUBE * np.subtract(high, low) + low, OF_SOLID


def points_inside(plan, count, seed):
    corners = np.array(plan.corners)
    low, high = (*corners.min(axis=0), 0.1), (*corners.max(axis=0), plan.height_m - 0.1)
    points = np.random.default_rng(seed).uniform(low, high, (60 * count, 3))
    return points[plan.contains(points) & (plan.wall_distance_m(points) >= 0.02)][:count]


@pytest.mark.parametrize("name", ["apartment", "medium1", "medium2", "small1"])
def test_a_plan_as_a_mesh_leads_sound_as_the_plan(name):
    geometry = SceneFile.read(SCENES / f"{name}.toml").geometry
    plan = geometry.floor_plan
    mesh, expected = MeshPathFinder(MeshTree(MeshGeometry.of_plan(geometry).mesh), SPEED), PlanPathFinder(plan, SPEED)
    emitters = points_inside(plan, 100, 1)
    off_m, hidden = [], 0
    for listener in points_inside(plan, 30, 2):
        found, wanted = mesh.find(listener, emitters), expected.find(listener, emitters)
        np.testing.assert_array_equal(found.in_sight, wanted.in_sight)
        same = np.abs(found.length_m - wanted.length_m) < 1e-4
        np.testing.assert_allclose(found.screen_db[same], wanted.screen_db[same], atol=0.03)
        np.testing.assert_allclose(found.arrival[same], wanted.arrival[same], atol=0.02)
        np.testing.assert_allclose(found.departure[same], wanted.departure[same], atol=0.02)
        off_m.append(np.abs(found.length_m - wanted.length_m))
        hidden += np.count_nonzero(~wanted.in_sight)
    # Where two ways are nearly as long, that over the points may be the longer one by the points' distances.
    assert np.mean(np.concatenate(off_m) > 1e-4) < 0.005
    assert np.max(off_m) < 0.05
    assert (hidden > 100) == (name != "small1")


def test_over_a_screen_sound_is_screened_by_its_detour():
    """A wall across the room, 1.5 m high: the shortest path crosses its upper edge by the law of the unfolded plane."""
    finder = finder_of(ROOM, sheet((5, 0, 0), (5, 8, 0), (5, 8, 1.5), (5, 0, 1.5)))
    listener, emitter = np.array([3.0, 2.0, 1.0]), np.array([8.0, 5.0, 0.5])
    paths = finder.find(listener, emitter[None])
    across = np.hypot(2.0, 0.5) + np.hypot(3.0, 1.0)
    length = np.hypot(across, 3.0)
    assert not paths.in_sight[0]
    assert paths.length_m[0] == pytest.approx(length, abs=1e-6)
    straight = np.linalg.norm(emitter - listener)
    assert paths.excess_m[0] == pytest.approx(length - straight, abs=1e-6)
    expected = [diffraction_gain_db(2 * (length - straight) * hz / SPEED) for hz in OCTAVE_BANDS_HZ]
    np.testing.assert_allclose(paths.screen_db[0], expected, atol=1e-3)
    spot = np.array([5.0, 2.0 + 3.0 * np.hypot(2.0, 0.5) / across, 1.5])
    np.testing.assert_allclose(paths.arrival[0], (spot - listener) / np.linalg.norm(spot - listener), atol=1e-5)
    np.testing.assert_allclose(paths.departure[0], (spot - emitter) / np.linalg.norm(spot - emitter), atol=1e-5)


def test_through_a_window_the_shortest_of_all_ways_is_taken():
    """A wall across the room with a window, against points strewn all along the window's edges."""
    low, high = np.array([3.0, 1.0]), np.array([4.5, 2.0])
    wall = [
        sheet((5, 0, 0), (5, low[0], 0), (5, low[0], 3), (5, 0, 3)),
        sheet((5, high[0], 0), (5, 8, 0), (5, 8, 3), (5, high[0], 3)),
        sheet((5, low[0], 0), (5, high[0], 0), (5, high[0], low[1]), (5, low[0], low[1])),
        sheet((5, low[0], high[1]), (5, high[0], high[1]), (5, high[0], 3), (5, low[0], 3)),
    ]
    finder = finder_of(ROOM, *wall)
    share = np.linspace(0, 1, 4001)[:, None]
    frame = [(low, (low[0], high[1])), ((low[0], high[1]), high), (high, (high[0], low[1])), ((high[0], low[1]), low)]
    spots = np.concatenate([np.array(a) + share * np.subtract(b, a) for a, b in frame])
    spots = np.column_stack([np.full(len(spots), 5.0), spots])
    rng, hidden = np.random.default_rng(1), 0
    for listener, emitter in zip(
        rng.uniform((0.2, 0.2, 0.2), (4.8, 7.8, 2.8), (60, 3)),
        rng.uniform((5.2, 0.2, 0.2), (9.8, 7.8, 2.8), (60, 3)),
        strict=True,
    ):
        paths = finder.find(listener, emitter[None])
        at = (listener + (emitter - listener) * (5 - listener[0]) / (emitter[0] - listener[0]))[1:]
        assert paths.in_sight[0] == bool(np.all((at > low) & (at < high)))
        if not paths.in_sight[0]:
            ways = np.linalg.norm(spots - listener, axis=-1) + np.linalg.norm(spots - emitter, axis=-1)
            assert paths.length_m[0] == pytest.approx(ways.min(), abs=6e-3)
            hidden += 1
    assert hidden > 40


def house():
    """Two floors with a hole between them, a wall with a door, a table and a cupboard, with seams whose pieces have no
    vertices in common."""
    return (
        (CUBE * (8, 6, 5.4), OF_AIR),
        block((0, 0, 2.5), (8, 4, 2.7)),
        block((0, 4, 2.5), (5, 6, 2.7)),
        block((4, 0, 0), (4.2, 2.5, 2.5)),
        block((4, 3.4, 0), (4.2, 6, 2.5)),
        block((4, 2.5, 2.05), (4.2, 3.4, 2.5)),
        block((1.0, 1.0, 0.7), (2.4, 2.0, 0.75)),
        block((6.5, 0.0, 0.0), (7.5, 0.6, 2.0)),
    )


@pytest.fixture(scope="module")
def in_house():
    tree = MeshTree(mesh_of(*house()))
    points = np.random.default_rng(5).uniform((0.1, 0.1, 0.1), (7.9, 5.9, 5.3), (600, 3))
    free = tree.contains(points) & (tree.distance_m(points) > 0.05)
    return MeshPathFinder(tree, SPEED), tree, points[free][:120]


def test_every_place_of_a_house_is_reached_the_same_way_back(in_house):
    finder, _, points = in_house
    lengths = np.array([finder.find(point, points).length_m for point in points])
    np.testing.assert_allclose(lengths, lengths.T, atol=0.05)
    levels = np.array([finder.find(point, points).screen_db for point in points])
    in_sight = np.array([finder.find(point, points).in_sight for point in points])
    np.testing.assert_array_equal(in_sight, in_sight.T)
    back = levels.transpose(1, 0, 2)
    np.testing.assert_allclose(levels[in_sight], back[in_sight], atol=1e-6)
    assert np.count_nonzero(levels[in_sight].max(axis=-1) < -0.5) > 10
    np.testing.assert_allclose(levels, back, atol=0.1)
    assert np.all(levels[..., 0] > -60)
    # No way is longer than one by way of a third place, but for the points at which ways bend.
    through = np.min(lengths[:, :, None] + lengths[None], axis=1)
    assert np.mean(lengths > through + 0.01) < 1e-3
    assert np.all(lengths < through + 0.15)


def test_paths_of_a_house_are_not_blocked(in_house):
    finder, tree, points = in_house
    for listener in points[:40]:
        paths = finder.find(listener, points)
        clear_m = np.minimum(0.3, paths.length_m)[:, None]
        ends = listener + clear_m * paths.arrival
        hits = tree.closest(np.broadcast_to(listener, ends.shape), ends - listener, most=0.99)
        near = np.linalg.norm(ends - listener, axis=-1) * np.where(hits.triangle < 0, 0.0, hits.distance)
        # The first leg may end at an edge before that.
        assert np.all((hits.triangle < 0) | (tree.distance_m(listener + near[:, None] * paths.arrival) < 1e-2))
        assert np.all(paths.length_m >= np.linalg.norm(points - listener, axis=-1) - 1e-9)


def test_turned_freely_and_in_single_precision_a_house_leads_sound_as_before(in_house):
    finder, tree, points = in_house
    mesh = tree.mesh
    turned = (mesh.vertices_m @ TURN.T + (3, -2, 1)).astype(np.float32)
    other = MeshPathFinder(MeshTree(TriangleMesh(turned, mesh.triangles, mesh.surfaces, mesh.materials)), SPEED)
    off_m = []
    for listener in points[:30]:
        found, wanted = (
            other.find(TURN @ listener + (3, -2, 1), points @ TURN.T + (3, -2, 1)),
            finder.find(listener, points),
        )
        assert np.count_nonzero(found.in_sight != wanted.in_sight) == 0
        off_m.append(np.abs(found.length_m - wanted.length_m))
    # Points lie elsewhere along the edges, so that of ways nearly as long another one may be taken.
    assert np.mean(np.concatenate(off_m) > 0.01) < 0.05
    assert np.max(off_m) < 0.3


def test_no_sound_creeps_under_what_stands_on_the_floor_or_out_of_a_cupboard():
    room, cupboard = ROOM, block((2, 2, 0), (3, 3, 2))
    inside = block((2.1, 2.1, 0.1), (2.9, 2.9, 1.9))
    finder = finder_of(room, cupboard, (inside[0], OF_AIR))
    paths = finder.find((5, 5, 1.5), np.array([(2.5, 2.5, 1.0), (1.0, 1.0, 0.3)]))
    assert not paths.in_sight.any()
    np.testing.assert_array_equal(paths.screen_db[0], -100)
    assert paths.excess_m[0] == 0
    assert np.all(paths.screen_db[1] > -40)
    # Round the cupboard, at the height of the straight line, and not under it.
    assert paths.excess_m[1] > 0.1


def test_a_path_changes_without_a_jump_as_the_emitter_moves(in_house):
    finder = in_house[0]
    way = np.linspace((0.4, 0.5, 1.2), (7.6, 5.6, 1.6), 4000)
    listener = np.array([6.0, 5.0, 4.0])
    free = in_house[1].contains(way)
    paths = finder.find(listener, way)
    step = np.linalg.norm(way[1] - way[0])
    moves = np.abs(np.diff(paths.length_m))[free[1:] & free[:-1]]
    assert np.all(moves < step + 0.15)
    assert np.mean(moves > step + 1e-3) < 0.01
    gains = np.abs(np.diff(paths.screen_db[:, 2]))[free[1:] & free[:-1]]
    assert np.max(gains) < 2.0


@pytest.mark.parametrize("offset", [0.0, -0.0, 1e-12])
def test_ends_on_an_edge_at_a_vertex_and_on_each_other_give_finite_paths(in_house, offset):
    finder = in_house[0]
    ends = np.array([(4 + offset, 2.5, 1.0), (4 + offset, 2.5, 2.05), (4.1, 2.5, offset), (4.1, 3.0, 2.05), (0, 0, 0)])
    for listener in ends:
        paths = finder.find(listener, ends)
        for value in vars(paths).values():
            assert np.isfinite(value).all()
        np.testing.assert_allclose(np.linalg.norm(paths.arrival, axis=-1), 1)
        assert np.isfinite(finder.describe(np.broadcast_to(listener, ends.shape), ends).described).all()


def test_what_describes_a_path_is_what_the_path_says(in_house):
    finder, _, points = in_house
    listeners, emitters = points[:40], points[40:80]
    described = finder.describe(listeners, emitters)
    for row, (listener, emitter) in enumerate(zip(listeners, emitters, strict=True)):
        paths = finder.find(listener, emitter[None])
        assert described.length_m[row] == paths.length_m[0]
        sight = 1.0 if paths.in_sight[0] else np.exp(-paths.excess_m[0] / 0.05)
        in_plan = [each[0, :2] / np.linalg.norm(each[0, :2]) for each in (paths.arrival, paths.departure)]
        np.testing.assert_allclose(
            described.described[row], (paths.length_m[0], sight, *in_plan[0], *in_plan[1]), atol=1e-3
        )


def rooms_with_beams(beams):
    """Two rooms of 30 m with a door between them, and thin beams all along their ceilings."""
    return (
        (CUBE * (60.2, 30, 4), OF_AIR),
        block((30, 0, 0), (30.2, 14, 4)),
        block((30, 15, 0), (30.2, 30, 4)),
        block((30, 14, 2.1), (30.2, 15, 4)),
        *[
            block((low, y, 3.5), (low + 29.8, y + 0.02, 3.6))
            for low in (0.1, 30.3)
            for y in np.linspace(0.1, 29.8, beams // 2)
        ],
    )


@pytest.mark.parametrize("beams", [50, 200])
def test_beams_without_number_do_not_close_a_door(beams, caplog):
    rng = np.random.default_rng(2)
    listener, emitters = (20, 8, 1.5), rng.uniform((31, 1, 0.3), (59, 29, 2.0), (40, 3))
    expected = finder_of(*rooms_with_beams(0)).find(listener, emitters)
    bends = bends_of(tree := MeshTree(mesh_of(*rooms_with_beams(beams))))
    found = MeshPathFinder(tree, SPEED, bends).find(listener, emitters)
    assert len(bends.places) <= MOST_POINTS
    assert np.count_nonzero(~expected.in_sight) > 30
    np.testing.assert_array_equal(found.in_sight, expected.in_sight)
    np.testing.assert_allclose(found.length_m, expected.length_m, atol=0.05)
    np.testing.assert_allclose(found.screen_db, expected.screen_db, atol=1)
    # Each of 200 beams has eight edges.
    assert ("left out" in caplog.text) == (beams == 200)


def small_house(at=(0, 0, 0)):
    """10 m wide, with a wall of which a door is open, on a ground of 20 m."""
    parts = (
        sheet((-5, -7, 0), (15, -7, 0), (15, 13, 0), (-5, 13, 0)),
        block((0, 0, 2.6), (10, 6, 2.8)),
        *(block((x, 0, 0), (x + 0.2, 6, 2.6)) for x in (0, 9.8)),
        *(block((0, y, 0), (10, y + 0.2, 2.6)) for y in (0, 5.8)),
        block((5, 0.2, 0), (5.2, 4, 2.6)),
        block((5, 4.9, 0), (5.2, 5.8, 2.6)),
        block((5, 4, 2.0), (5.2, 4.9, 2.6)),
    )
    return tuple((vertices + np.asarray(at), faces) for vertices, faces in parts)


@pytest.mark.parametrize("half_m", [200, 490])
def test_a_sky_far_away_takes_no_sound_from_a_house(half_m):
    points = np.random.default_rng(4).uniform((0.3, 0.3, 0.2), (9.7, 5.7, 2.5), (60, 3))
    tree = MeshTree(mesh_of(*small_house()))
    points = points[(tree.distance_m(points) > 0.05) & ((points[:, 0] < 5) | (points[:, 0] > 5.2))]
    sky = (CUBE * 2 * half_m - (half_m, half_m, 1), OF_AIR)
    alone, under_sky = MeshPathFinder(tree, SPEED), finder_of(sky, *small_house())
    for listener in points:
        expected, found = alone.find(listener, points), under_sky.find(listener, points)
        assert expected.screen_db.min() > -60
        np.testing.assert_allclose(found.length_m, expected.length_m, atol=0.05)
        np.testing.assert_allclose(found.screen_db, expected.screen_db, atol=1)


def hills(cells, spacing_m, depth_m):
    """Uneven ground below the origin."""
    at = (np.arange(cells + 1) - cells / 2) * spacing_m
    x, y = np.meshgrid(at, at, indexing="ij")
    corners = np.stack([x, y, -np.random.default_rng(7).uniform(0, depth_m, x.shape)], axis=-1).reshape(-1, 3)
    number = np.arange((cells + 1) ** 2).reshape(cells + 1, -1)
    a, b, c, d = (each.reshape(-1) for each in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]))
    return corners, np.concatenate([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)])


def test_a_house_in_wide_hills_keeps_its_doors(caplog):
    """The ground has more edges than are looked at, all of them longer than those of a door."""
    points = np.random.default_rng(6).uniform((0.3, 0.3, 0.2), (9.7, 5.7, 2.5), (50, 3))
    points = points[(points[:, 0] < 4.95) | (points[:, 0] > 5.25)]
    alone, in_hills = finder_of(*small_house()), finder_of(hills(100, 3.0, 0.3), *small_house())
    assert "8192 of" in caplog.text
    assert "768 of" in caplog.text
    expected, found = (np.array([each.find(at, points).screen_db for at in points]) for each in (alone, in_hills))
    assert np.count_nonzero(expected[..., 0] < -6) > 300
    assert found.min() > -60
    assert np.mean(np.abs(found - expected).max(axis=-1) > 1) < 0.03


def test_a_house_far_from_the_origin_leads_sound_as_before():
    far = np.array([7000.0, -4000.0, 300.0])
    near, moved = finder_of(*small_house()), finder_of(*small_house(far))
    points = np.random.default_rng(4).uniform((-3, -5, 0.2), (13, 11, 4), (60, 3))
    hidden = 0
    for listener in points[:20]:
        expected, found = near.find(listener, points), moved.find(listener + far, points + far)
        np.testing.assert_array_equal(found.in_sight, expected.in_sight)
        np.testing.assert_allclose(found.length_m, expected.length_m, atol=0.02)
        hidden += np.count_nonzero(~expected.in_sight)
    assert hidden > 100


def test_a_large_cell_that_lacks_the_only_way_out_closes_no_room():
    """A closet with a slit under its ceiling, in a place with one cell that lacks all points."""
    closet = (
        block((0.3, 0.3, 0.0), (0.7, 0.35, 3.0)),
        block((0.3, 0.65, 0.0), (0.7, 0.7, 3.0)),
        block((0.3, 0.35, 0.0), (0.35, 0.65, 3.0)),
        block((0.65, 0.35, 0.0), (0.7, 0.65, 2.9)),
    )
    tree = MeshTree(mesh_of(ROOM, *closet))
    bends = bends_of(tree)
    count = len(bends.places)
    blind = bends._replace(
        cell_m=np.array([10.0, 8.0, 3.0]),
        counts=np.ones(3, np.int64),
        begins=np.array([0, 0, count]),
        seen=np.arange(count, dtype=np.int32),
        origin=np.zeros(3),
    )
    emitters = np.array([(8, 6, 1), (0.5, 0.5, 2.0), (0.2, 0.2, 1.0), (3, 1, 2)])
    for listener in ((0.5, 0.5, 0.5), (9, 1, 1)):
        expected, found = (MeshPathFinder(tree, SPEED, each).find(listener, emitters) for each in (bends, blind))
        assert expected.screen_db.min() > -80
        np.testing.assert_allclose(found.length_m, expected.length_m, atol=0.1)


@pytest.mark.parametrize("beside_m", [0, 300])
def test_houses_far_apart_are_walked_through_as_one_house_is(beside_m):
    """Cells are as large as a house then."""
    alone = finder_of(*small_house())
    both = finder_of(*small_house(), *small_house((300, beside_m, 0)))
    points = np.random.default_rng(6).uniform((0.3, 0.3, 0.2), (9.7, 5.7, 2.5), (50, 3))
    points = points[(points[:, 0] < 4.95) | (points[:, 0] > 5.25)]
    for listener in points:
        expected, found = alone.find(listener, points), both.find(listener, points)
        assert expected.screen_db.min() > -60
        np.testing.assert_allclose(found.length_m, expected.length_m, atol=0.1)


def test_vast_meshes_take_bounded_work():
    """A box without edges to bend round, and sheets, one of which is as long as a country."""
    assert len(bends_of(MeshTree(mesh_of((CUBE * (1000, 1000, 300), OF_AIR)))).places) == 0
    for size_m in (1e3, 2e6):
        vast = bends_of(MeshTree(mesh_of(sheet((0, 0, 0), (size_m, 0, 0), (size_m, size_m, 0), (0, size_m, 0)))))
        assert 0 < len(vast.places) <= MOST_POINTS
        np.testing.assert_allclose(vast.extents, size_m, rtol=1e-3)
        assert vast.begins[-1] < 2_000_000


def test_thousands_of_edges_that_meet_in_a_place_take_little_memory():
    ways = np.random.default_rng(1).standard_normal((4000, 2, 3))
    corners = np.concatenate([np.zeros((4000, 1, 3)), ways], axis=1).reshape(-1, 3)
    mesh = TriangleMesh(corners, np.arange(12000).reshape(-1, 3), np.zeros(4000, int), ("all",))
    tracemalloc.start()
    try:
        assert 4000 < len(_edges(mesh).extents) <= 8192
        assert tracemalloc.get_traced_memory()[1] < 60e6
    finally:
        tracemalloc.stop()


def test_a_mesh_without_edges_to_bend_round_has_straight_paths():
    paths = finder_of(ROOM).find((1, 1, 1), np.array([(9, 7, 2), (1, 1, 1)]))
    assert paths.in_sight.all()
    np.testing.assert_array_equal(paths.screen_db, 0)
    degenerate = TriangleMesh(np.zeros((3, 3)), [(0, 1, 2)], [0], ("all",))
    assert MeshPathFinder(MeshTree(degenerate), SPEED).find((1, 1, 1), np.ones((1, 3))).in_sight.all()
