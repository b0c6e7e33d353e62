"""Paths round corners against a brute-force visibility graph, optimisation, and laws of continuity."""

import math
import tomllib
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar
from scipy.sparse.csgraph import dijkstra

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.geometry import FloorPlan
from server.acoustics.sound_path import DescribedPaths, PlanPathFinder, SoundPathFinder, SoundPaths
from server.acoustics.sound_path_kernel import describe_paths, find_sound_paths
from tests.oracles.sound_path import NumpySoundPathFinder, diffraction_gain_db

Floats = npt.NDArray[np.float64]

SPEED_OF_SOUND = 343.0
WAVELENGTHS_M = SPEED_OF_SOUND / np.array(OCTAVE_BANDS_HZ)
SCENES = Path(__file__).resolve().parents[2] / "training" / "scenes"


def load_plan(name: str) -> FloorPlan:
    geometry = tomllib.loads((SCENES / name).read_text())["geometry"]
    return FloorPlan(tuple((x, y) for x, y in geometry["corners"]), geometry["height_m"])


def star(seed: int) -> FloorPlan:
    """A simple polygon with slanted walls and about half of its corners reflex."""
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * (np.arange(12) + rng.uniform(-0.3, 0.3, 12)) / 12
    radius = rng.uniform(0.8, 6, 12)
    return FloorPlan(tuple(zip(radius * np.cos(angle), radius * np.sin(angle), strict=True)), 3.0)


APARTMENT = load_plan("apartment.toml")
# Three corridors end to end: paths with up to four bends.
SERPENTINE = FloorPlan(
    ((0, 0), (6, 0), (6, 4), (1, 4), (1, 4.2), (6, 4.2), (6, 6), (0, 6), (0, 2.2), (5, 2.2), (5, 2), (0, 2)), 3.0
)
BOX = FloorPlan(((0, 0), (5, 0), (5, 4), (0, 4)), 2.5)
PLANS = {"apartment": APARTMENT, "serpentine": SERPENTINE, "star": star(33), "box": BOX}
FINDERS = {name: PlanPathFinder(plan, SPEED_OF_SOUND) for name, plan in PLANS.items()}
FINDER = FINDERS["apartment"]
ORACLES = {name: NumpySoundPathFinder(plan, SPEED_OF_SOUND) for name, plan in PLANS.items()}


def test_places_that_are_read_only_or_lie_apart_compile_nothing_more():
    """That would take seconds, on whichever thread asks first."""
    kernels = (find_sound_paths, describe_paths)
    before = [kernel.signatures for kernel in kernels]
    places = np.array([[3.0, 0.0, 3.0, 0.0, 1.5, 0.0], [5.0, 0.0, 3.0, 0.0, 1.5, 0.0]])
    expected = FINDER.find(places[0, ::2].copy(), places[:, ::2].copy())
    places.flags.writeable = False
    for each in (places[:, ::2], np.ascontiguousarray(places[:, ::2])):
        each.flags.writeable = False
        np.testing.assert_array_equal(FINDER.find(each[0], each).length_m, expected.length_m)
        FINDER.describe(each, each)
    assert [kernel.signatures for kernel in kernels] == before


def points_inside(plan: FloorPlan, count: int, seed: int, *, clearance_m: float = 0.0) -> Floats:
    corners = np.array(plan.corners)
    low, high = (*corners.min(axis=0), 0.1), (*corners.max(axis=0), plan.height_m - 0.1)
    points = np.random.default_rng(seed).uniform(low, high, (40 * count, 3))
    kept = points[plan.contains(points) & (plan.wall_distance_m(points) >= clearance_m)]
    assert len(kept) >= count
    return kept[:count]


def edges(plan: FloorPlan, a: Floats, b: Floats) -> Floats:
    """(len(a), len(b)) distances in plan, 0 where a sample of the line between is outside."""
    share = np.linspace(0, 1, 1001)[:, None, None, None]
    along = (1 - share) * a[:, None] + share * b[None]
    inside = plan.contains(np.concatenate([along, np.ones((*along.shape[:-1], 1))], axis=-1)).all(axis=0)
    return np.where(inside, np.linalg.norm(a[:, None] - b[None], axis=-1), 0)


@lru_cache
def corner_edges(plan: FloorPlan) -> Floats:
    return edges(plan, np.array(plan.corners), np.array(plan.corners))


def brute_force(plan: FloorPlan, listener: Floats, emitter: Floats) -> tuple[float, Floats, Floats]:
    """Length in plan and the first points of the path from either end: Dijkstra over all corners."""
    nodes = np.concatenate([[listener[:2], emitter[:2]], np.array(plan.corners)])
    lengths = np.block([[np.zeros((2, 2)), edges(plan, nodes[:2], nodes[2:])], [np.zeros((12, 2)), corner_edges(plan)]])
    lengths[0, 1] = edges(plan, nodes[:1], nodes[1:2])[0, 0]
    distance, before = dijkstra(lengths, indices=[0, 1], directed=False, return_predecessors=True)
    return float(distance[0, 1]), nodes[before[1, 0]], nodes[before[0, 1]]


def one(finder: SoundPathFinder, listener: npt.ArrayLike, emitter: npt.ArrayLike) -> SoundPaths:
    return finder.find(listener, np.asarray(emitter, dtype=np.float64)[None])


@pytest.mark.parametrize("name", ["apartment", "serpentine", "star"])
def test_lengths_and_directions_agree_with_brute_force(name: str) -> None:
    plan, finder = PLANS[name], FINDERS[name]
    bent = 0
    for listener, emitter in zip(points_inside(plan, 24, 1), points_inside(plan, 24, 2), strict=True):
        level, first, last = brute_force(plan, listener, emitter)
        paths = one(finder, listener, emitter)
        assert math.isclose(paths.length_m[0], math.hypot(level, emitter[2] - listener[2]), abs_tol=1e-4)
        bent += not paths.in_sight[0]
        for direction, start, bend in ((paths.arrival[0], listener, first), (paths.departure[0], emitter, last)):
            expected = (bend - start[:2]) / np.linalg.norm(bend - start[:2])
            np.testing.assert_allclose(direction[:2] / np.linalg.norm(direction[:2]), expected, atol=0.01)
    assert 5 < bent < 24


@pytest.mark.parametrize("name", PLANS)
def test_lengths_are_those_of_the_floor_plan(name: str) -> None:
    plan, finder = PLANS[name], FINDERS[name]
    emitters = points_inside(plan, 50, 3)
    for listener in points_inside(plan, 50, 4):
        paths = finder.find(listener, emitters)
        np.testing.assert_allclose(paths.length_m, plan.path_length_m(listener, emitters), rtol=1e-12)
        np.testing.assert_array_equal(paths.in_sight, plan.is_visible(listener, emitters))
        straight = np.linalg.norm(emitters - listener, axis=-1)
        np.testing.assert_allclose(paths.excess_m, paths.length_m - straight, atol=1e-12)
        assert np.all(paths.excess_m[paths.in_sight] == 0)
        assert np.all(paths.excess_m[~paths.in_sight] > 0)


def test_path_over_a_corner_rises_to_the_height_that_makes_it_shortest() -> None:
    listener, emitter, corner = np.array((3.0, 1.0, 0.3)), np.array((4.1, 2.05, 2.6)), np.array((4.0, 2.0))

    def length(height_m: float) -> float:
        bend = np.array((*corner, height_m))
        return float(np.linalg.norm(bend - listener) + np.linalg.norm(bend - emitter))

    best = minimize_scalar(length, bounds=(0, 2.8), method="bounded", options={"xatol": 1e-9})
    bend = np.array((*corner, best.x))
    paths = one(FINDER, listener, emitter)
    assert math.isclose(paths.length_m[0], best.fun, rel_tol=1e-9)
    np.testing.assert_allclose(paths.arrival[0], (bend - listener) / np.linalg.norm(bend - listener), atol=1e-6)
    np.testing.assert_allclose(paths.departure[0], (bend - emitter) / np.linalg.norm(bend - emitter), atol=1e-6)


def test_in_sight_sound_comes_straight() -> None:
    listener, emitter = np.array((1.0, 2.2, 1.2)), np.array((6.5, 2.8, 2.0))
    paths = one(FINDER, listener, emitter)
    straight = (emitter - listener) / np.linalg.norm(emitter - listener)
    np.testing.assert_allclose(paths.arrival[0], straight)
    np.testing.assert_allclose(paths.departure[0], -straight)
    assert paths.in_sight[0]


@pytest.mark.parametrize("name", PLANS)
def test_there_and_back_are_the_same_path(name: str) -> None:
    for a, b in zip(points_inside(PLANS[name], 100, 5), points_inside(PLANS[name], 100, 6), strict=True):
        there, back = one(FINDERS[name], a, b), one(FINDERS[name], b, a)
        np.testing.assert_allclose(there.length_m, back.length_m, rtol=1e-12)
        np.testing.assert_allclose(there.arrival, back.departure, atol=1e-9)
        np.testing.assert_allclose(there.departure, back.arrival, atol=1e-9)
        np.testing.assert_allclose(there.screen_db, back.screen_db, atol=1e-6)


def test_in_the_shadow_the_whole_detour_screens() -> None:
    paths = one(FINDER, (3.0, 1.0, 1.5), (5.2, 1.0, 1.5))
    detour = 2 * math.sqrt(2) + 0.2 - 2.2
    np.testing.assert_allclose(paths.screen_db[0], diffraction_gain_db(2 * detour / WAVELENGTHS_M))
    assert np.all(np.diff(paths.screen_db[0]) < 0)


def test_a_grazed_corner_takes_five_db_in_every_band() -> None:
    corner, along = np.array((4.0, 2.0)), np.array((math.cos(0.7), math.sin(0.7)))
    paths = one(FINDER, (*(corner - 1.3 * along), 1.5), (*(corner + 0.6 * along), 1.1))
    np.testing.assert_allclose(paths.screen_db[0], -5, atol=1e-4)


def test_just_in_the_light_high_bands_are_clear_first() -> None:
    corner, along = np.array((4.0, 2.0)), np.array((math.cos(0.7), math.sin(0.7)))
    past = corner + 0.1 * np.array((-along[1], along[0]))
    paths = one(FINDER, (*(past - 1.5 * along), 1.5), (*(past + 0.7 * along), 1.5))
    assert paths.in_sight[0]
    assert -5 < paths.screen_db[0, 0] < -3
    assert np.all(np.diff(paths.screen_db[0]) >= 0)
    assert paths.screen_db[0, -1] == 0


def test_where_no_corner_is_near_the_line_nothing_is_lost() -> None:
    assert np.all(one(FINDER, (1.0, 1.0, 1.5), (2.5, 3.5, 1.5)).screen_db == 0)
    # Beside a corner, and not past it.
    assert np.all(one(FINDER, (3.9, 2.5, 1.5), (2.0, 2.5, 1.5)).screen_db == 0)
    for listener in points_inside(BOX, 20, 7):
        assert np.all(FINDERS["box"].find(listener, points_inside(BOX, 20, 8)).screen_db == 0)


def numbers(paths: SoundPaths) -> dict[str, Floats]:
    return {
        "length_m": paths.length_m[:, None],
        "arrival": paths.arrival,
        "departure": paths.departure,
        "excess_m": paths.excess_m[:, None],
        "screen_db": paths.screen_db,
    }


def largest_steps(finder: SoundPathFinder, way: Floats, emitters: Floats) -> dict[str, float]:
    """By how much each number changes at most from one point of the way (n, 3) to the next."""
    before, largest = numbers(finder.find(way[0], emitters)), {}
    for listener in way[1:]:
        now = numbers(finder.find(listener, emitters))
        for name, values in now.items():
            largest[name] = max(largest.get(name, 0.0), float(np.max(np.abs(values - before[name]))))
        before = now
    return largest


def arc(centre: tuple[float, float], radius_m: float, start_deg: float, end_deg: float, step_m: float) -> Floats:
    start, end = math.radians(start_deg), math.radians(end_deg)
    angle = np.linspace(start, end, math.ceil(abs(end - start) * radius_m / step_m) + 1)
    return np.stack(
        [centre[0] + radius_m * np.cos(angle), centre[1] + radius_m * np.sin(angle), np.full(len(angle), 1.6)], axis=-1
    )


# Round every edge of the doorway, from where its room ends to where the other begins; and along the wall past it.
WALKS = {
    "lower left": ((4.0, 2.0), 0.3, 270, 0),
    "lower right": ((4.2, 2.0), 0.3, -90, 180),
    "upper left": ((4.0, 3.0), 0.3, 90, 360),
    "upper right": ((4.2, 3.0), 0.3, 90, -180),
    "wide": ((4.1, 2.5), 0.45, 0, 360),
    "far away": ((-30.0, 2.5), 33.7, -3.5, 3.5),
}
EMITTERS = np.concatenate(
    [
        points_inside(APARTMENT, 24, 9, clearance_m=0.15),
        # In the doorway, and next to the wall on either side.
        [(4.1, 2.5, 1.0), (4.1, 2.15, 2.0), (3.85, 1.2, 1.5), (4.35, 4.0, 1.5), (4.35, 0.5, 0.4)],
    ]
)


@pytest.mark.parametrize("walk", WALKS)
def test_walking_round_a_corner_nothing_jumps(walk: str) -> None:
    """Steps of a millimetre move the numbers a little, and steps ten times shorter far less."""
    centre, radius_m, start_deg, end_deg = WALKS[walk]
    way = arc(centre, radius_m, start_deg, end_deg, 0.001)
    # An emitter that one walks through passes from one side to the other; it jumps as it should.
    emitters = EMITTERS[np.min(np.linalg.norm(EMITTERS[:, None, :2] - way[:, :2], axis=-1), axis=-1) > 0.1]
    assert len(emitters) > 20
    coarse = largest_steps(FINDER, way, emitters)
    fine = largest_steps(FINDER, arc(centre, radius_m, start_deg, end_deg, 0.0001), emitters)
    assert coarse["length_m"] < 0.001001
    assert coarse["excess_m"] < 0.002001
    assert coarse["arrival"] < 0.02
    assert coarse["departure"] < 0.02
    assert coarse["screen_db"] < 1.2
    for name, step in fine.items():
        assert step < 0.2 * coarse[name] + 1e-9, name


@pytest.mark.parametrize("name", ["serpentine", "star"])
def test_any_straight_walk_in_the_open_is_without_jumps(name: str) -> None:
    """Between points in sight of each other and clear of the walls, in steps of 0.1 and of 0.01 mm."""
    plan = PLANS[name]
    points = points_inside(plan, 60, 10, clearance_m=0.2)
    emitters = points_inside(plan, 16, 11, clearance_m=0.2)
    walks = 0
    for start, end in zip(points[::2], points[1::2], strict=True):
        share = np.linspace(0, 1, 400)[:, None]
        way = (1 - share) * start + share * end
        heard = emitters[np.min(np.linalg.norm(emitters[:, None, :2] - way[:, :2], axis=-1), axis=-1) > 0.1]
        if np.any(plan.wall_distance_m(way) < 0.1) or not np.all(plan.contains(way)):
            continue
        walks += 1
        finer = np.linspace(0, 1, 3991)[:, None]
        coarse = largest_steps(FINDERS[name], way, heard)
        fine = largest_steps(FINDERS[name], (1 - finer) * start + finer * end, heard)
        for quantity, step in fine.items():
            assert step < 0.2 * coarse[quantity] + 1e-7, quantity
    assert walks >= 5


@pytest.mark.parametrize(
    ("listener", "emitter"),
    [
        ((2.0, 2.5, 1.5), (2.0, 2.5, 1.5)),
        ((2.0, 2.5, 1.5), (2.0, 2.5, 2.5)),
        ((2.0, 2.5, 1.5), (2.0, 2.5 + 1e-300, 1.5)),
        ((4.0, 2.0, 1.5), (4.0, 2.0, 1.5)),
        ((4.0, 2.0, 1.5), (4.0, 2.0, 2.0)),
        ((4.0, 2.0, 1.5), (6.0, 1.0, 1.5)),
        ((2.0, 1.0, 1.5), (4.2, 2.0, 1.5)),
        ((4.0, 1.0, 1.5), (4.2, 1.0, 1.5)),
        ((0.0, 0.0, 0.0), (8.0, 5.0, 2.8)),
        ((4.1, 1.0, 1.5), (6.0, 1.0, 1.5)),
        ((-1.0, -1.0, 1.5), (4.1, 4.5, 1.5)),
        ((1e6, 0.0, 1.5), (-1e6, 0.0, 1.5)),
    ],
)
def test_every_number_is_finite_wherever_the_points_are(
    listener: tuple[float, ...], emitter: tuple[float, ...]
) -> None:
    for find in (FINDER.find, ORACLES["apartment"].find):
        paths = find(np.array(listener), np.array([emitter]))
        assert all(np.isfinite(values).all() for values in numbers(paths).values())
        np.testing.assert_allclose(np.linalg.norm(paths.arrival, axis=-1), 1, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(paths.departure, axis=-1), 1, atol=1e-12)
        assert paths.length_m[0] >= math.dist(listener, emitter) - 1e-12
        assert np.all(paths.screen_db <= 0)


def test_standing_on_a_corner_one_hears_round_the_next() -> None:
    listener, emitter = np.array((4.0, 2.0, 1.5)), np.array((4.5, 1.0, 1.5))
    paths = one(FINDER, listener, emitter)
    assert math.isclose(paths.length_m[0], 0.2 + math.hypot(0.3, 1.0))
    np.testing.assert_allclose(paths.arrival[0], (1, 0, 0), atol=1e-12)


def test_no_emitters_no_paths() -> None:
    for find in (FINDER.find, ORACLES["apartment"].find, ORACLES["box"].find):
        paths = find(np.array((1.0, 1.0, 1.5)), np.zeros((0, 3)))
        assert paths.length_m.shape == (0,)
        assert paths.screen_db.shape == (0, len(OCTAVE_BANDS_HZ))


def test_results_belong_to_the_caller() -> None:
    first = one(FINDER, (1.0, 1.0, 1.5), (6.0, 1.0, 1.5))
    length = float(first.length_m[0])
    one(FINDER, (2.0, 2.0, 1.5), (2.0, 1.0, 1.5))
    assert first.length_m[0] == length


def assert_same(ours: SoundPaths, theirs: SoundPaths) -> None:
    np.testing.assert_array_equal(ours.in_sight, theirs.in_sight)
    for name, values in numbers(ours).items():
        np.testing.assert_allclose(values, numbers(theirs)[name], rtol=0, atol=1e-7, err_msg=name)


@pytest.mark.parametrize("name", PLANS)
def test_compiled_and_numpy_paths_are_the_same(name: str) -> None:
    emitters = points_inside(PLANS[name], 16, 12)
    for listener in points_inside(PLANS[name], 60, 13):
        assert_same(FINDERS[name].find(listener, emitters), ORACLES[name].find(listener, emitters))


@given(st.integers(0, 10_000))
@settings(max_examples=30)
def test_in_any_room_the_shortest_path_is_found_whichever_way_it_is_computed(seed: int) -> None:
    plan = star(seed)
    finder = PlanPathFinder(plan, SPEED_OF_SOUND)
    listener, *emitters = points_inside(plan, 9, seed)
    paths = finder.find(listener, np.array(emitters))
    np.testing.assert_allclose(paths.length_m, plan.path_length_m(listener, np.array(emitters)), rtol=1e-12)
    assert_same(paths, NumpySoundPathFinder(plan, SPEED_OF_SOUND).find(listener, np.array(emitters)))


# Paths as a field is told of them.


@pytest.fixture(params=PLANS)
def told(request: pytest.FixtureRequest) -> tuple[FloorPlan, Floats, Floats, DescribedPaths]:
    """A plan, listeners and emitters in it, and their described paths."""
    plan = PLANS[request.param]
    points = points_inside(plan, 1200, 21, clearance_m=0.01)
    listeners, emitters = points[:600], points[600:]
    return plan, listeners, emitters, FINDERS[request.param].describe(listeners, emitters)


def test_told_lengths_are_those_of_the_paths(told: tuple[FloorPlan, Floats, Floats, DescribedPaths]) -> None:
    plan, listeners, emitters, paths = told
    np.testing.assert_allclose(paths.length_m, plan.path_length_m(emitters, listeners), rtol=1e-9)
    np.testing.assert_array_equal(paths.described[:, 0], paths.length_m.astype(np.float32))


def test_told_sight_fades_with_what_a_corner_adds_to_the_way(
    told: tuple[FloorPlan, Floats, Floats, DescribedPaths],
) -> None:
    plan, listeners, emitters, paths = told
    level = (1, 1, 0)
    excess_m = plan.path_length_m(emitters * level, listeners * level)
    excess_m = excess_m - np.linalg.norm((emitters - listeners)[:, :2], axis=-1)
    np.testing.assert_allclose(paths.described[:, 1], np.exp(-excess_m / 0.05), atol=1e-5)
    assert (paths.described[:, 1] == 1).all() == (plan is BOX)


def test_no_step_of_a_millimetre_changes_told_sight_by_much() -> None:
    """Past the corner of an L."""
    plan = FloorPlan(((0, 0), (6, 0), (6, 2), (2, 2), (2, 5), (0, 5)), 3.0)
    across = np.linspace(2.1, 4.5, 2401)
    listeners = np.column_stack([np.full_like(across, 1.0), across, np.full_like(across, 1.5)])
    emitters = np.tile([5.0, 1.0, 1.5], (len(across), 1))
    sight = PlanPathFinder(plan, SPEED_OF_SOUND).describe(listeners, emitters).described[:, 1]
    assert sight.min() < 0.1
    assert sight.max() == 1
    assert np.abs(np.diff(sight)).max() < 0.02


def test_told_directions_are_those_in_which_the_paths_leave_both_ends(
    told: tuple[FloorPlan, Floats, Floats, DescribedPaths],
) -> None:
    plan, listeners, emitters, paths = told
    finder = PlanPathFinder(plan, SPEED_OF_SOUND)
    for row, (listener, emitter) in enumerate(zip(listeners, emitters, strict=True)):
        found = one(finder, listener, emitter)
        for direction, told_so in ((found.arrival[0], 2), (found.departure[0], 4)):
            expected = direction[:2] / np.linalg.norm(direction[:2])
            np.testing.assert_allclose(paths.described[row, told_so : told_so + 2], expected, atol=0.01)


def test_compiled_and_numpy_paths_are_told_the_same(told: tuple[FloorPlan, Floats, Floats, DescribedPaths]) -> None:
    plan, listeners, emitters, paths = told
    expected = NumpySoundPathFinder(plan, SPEED_OF_SOUND).describe(listeners, emitters)
    np.testing.assert_allclose(paths.length_m, expected.length_m, rtol=1e-12)
    np.testing.assert_allclose(paths.described, expected.described, atol=1e-6)


def test_told_paths_there_and_back_are_one(told: tuple[FloorPlan, Floats, Floats, DescribedPaths]) -> None:
    plan, listeners, emitters, paths = told
    back = PlanPathFinder(plan, SPEED_OF_SOUND).describe(emitters, listeners)
    np.testing.assert_allclose(back.described[:, [0, 1, 4, 5, 2, 3]], paths.described, atol=1e-5)


def test_each_pair_is_told_as_if_it_were_alone(told: tuple[FloorPlan, Floats, Floats, DescribedPaths]) -> None:
    """Pairs with one listener share work."""
    plan, listeners, emitters, _ = told
    finder = PlanPathFinder(plan, SPEED_OF_SOUND)
    listeners = np.repeat(listeners[:30], 4, axis=0)
    together = finder.describe(listeners, emitters[:120])
    alone = [finder.describe(listeners[row : row + 1], emitters[row : row + 1]).described for row in range(120)]
    np.testing.assert_array_equal(together.described, np.concatenate(alone))


@pytest.mark.parametrize("far", [1e3, 1e5, 1e6])
def test_told_sight_of_places_far_outside_is_a_share(far: float) -> None:
    """A network that is asked there multiplies by it."""
    turns = np.linspace(0, 2 * np.pi, 40)
    listeners = np.stack([far * np.cos(turns), far * np.sin(turns), np.full(40, 1.5)], axis=-1)
    paths = FINDER.describe(listeners, np.tile([1.0, 1.0, 1.5], (40, 1)))
    assert ((paths.described[:, 1] >= 0) & (paths.described[:, 1] <= 1)).all()
    assert np.isfinite(paths.described).all()
