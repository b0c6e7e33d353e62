"""First reflections against pyroomacoustics' images, sampled paths, and laws of mirrors."""

import tomllib
from pathlib import Path

import numpy as np
import pyroomacoustics as pra
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.geometry import FloorPlan
from server.acoustics.reflections import FirstEcho, ReflectionFinder, mirror_gain_db
from tests.oracles.reflections import NumpyReflectionFinder

SCENE = Path(__file__).resolve().parents[2] / "training" / "scenes" / "apartment.toml"
GEOMETRY = tomllib.loads(SCENE.read_text())["geometry"]
SURFACES = ("walls", "floor", "ceiling")
MATERIALS = [GEOMETRY["materials"][surface] for surface in SURFACES]
GAINS_DB = np.array([mirror_gain_db(material["absorption"], material["scattering"]) for material in MATERIALS])


def star(seed):
    """A simple polygon with slanted walls and about half of its corners reflex."""
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * (np.arange(12) + rng.uniform(-0.3, 0.3, 12)) / 12
    radius = rng.uniform(0.8, 6, 12)
    return FloorPlan(tuple(zip(radius * np.cos(angle), radius * np.sin(angle), strict=True)), 3.0)


BOX = FloorPlan(((0, 0), (5, 0), (5, 4), (0, 4)), 2.5)
APARTMENT = FloorPlan(tuple(map(tuple, GEOMETRY["corners"])), GEOMETRY["height_m"])
SLANTED = FloorPlan(((0, 0), (6, -1), (5, 3), (2.5, 2), (1, 4.5)), 2.7)
PLANS = {"box": BOX, "apartment": APARTMENT, "slanted": SLANTED, "star": star(33)}
FINDERS = {name: ReflectionFinder(plan, GAINS_DB) for name, plan in PLANS.items()}


def points_inside(plan, count, seed):
    corners = np.array(plan.corners)
    low, high = (*corners.min(axis=0), 0.1), (*corners.max(axis=0), plan.height_m - 0.1)
    points = np.random.default_rng(seed).uniform(low, high, (60 * count, 3))
    kept = points[plan.contains(points) & (plan.wall_distance_m(points) >= 0.05)]
    assert len(kept) >= count
    return kept[:count]


def pairs(plan, count, seed):
    return zip(points_inside(plan, count, seed), points_inside(plan, count, seed + 1), strict=True)


def one(finder, listener, emitter):
    return finder.find(listener, np.asarray(emitter, dtype=np.float64)[None])


def images(listener, found):
    return listener + found.length_m[:, None] * found.arrival


def in_order(positions, *others):
    order = np.lexsort(np.round(positions, 2).T)
    return positions[order], *(other[order] for other in others)


def engine_of(plan, listeners):
    def material(of):
        shares = (of["absorption"], of["scattering"])
        return pra.Material(*({"coeffs": list(share), "center_freqs": list(OCTAVE_BANDS_HZ)} for share in shares))

    walls, floor, ceiling = map(material, MATERIALS)
    # At this rate its octave bands are exactly ours; where rays bring what is scattered, images are of the rest.
    room = pra.Room.from_corners(np.array(plan.corners).T, fs=24_000, max_order=1, materials=walls, ray_tracing=True)
    room.extrude(plan.height_m, materials={"floor": floor, "ceiling": ceiling})
    room.add_microphone_array(listeners.T)
    return room.room_engine


@pytest.mark.parametrize("name", ["box", "apartment", "slanted"])
def test_paths_are_those_of_pyroomacoustics(name):
    plan, finder = PLANS[name], FINDERS[name]
    listeners = points_inside(plan, 30, 1)
    engine = engine_of(plan, listeners)
    blocked = 0
    for emitter in points_inside(plan, 10, 2):
        engine.image_source_model(emitter.astype(np.float32))
        mirrored = np.array(engine.orders) == 1
        positions, damping = (np.array(a.T)[mirrored] for a in (engine.sources, engine.attenuations))
        for listener, heard in zip(listeners, np.array(engine.visible_mics, dtype=bool)[:, mirrored], strict=True):
            blocked += np.sum(~heard)
            found = one(finder, listener, emitter)
            expected = in_order(positions[heard], damping[heard])
            mine = in_order(images(listener, found), 10 ** (found.gain_db / 20))
            for theirs, ours in zip(expected, mine, strict=True):
                np.testing.assert_allclose(ours, theirs, atol=2e-4)
    assert (blocked > 0) == (name != "box")


def test_a_box_mirrors_everything_in_each_of_its_six_surfaces():
    for listener, emitter in pairs(BOX, 20, 3):
        expected = []
        for axis, size in enumerate((5.0, 4.0, 2.5)):
            for wall in (0.0, size):
                image = emitter.copy()
                image[axis] = 2 * wall - image[axis]
                expected.append(image)
        found = one(FINDERS["box"], listener, emitter)
        np.testing.assert_allclose(in_order(images(listener, found))[0], in_order(np.array(expected))[0], atol=1e-12)


@pytest.mark.parametrize("name", PLANS)
def test_a_path_is_the_same_both_ways(name):
    for listener, emitter in pairs(PLANS[name], 40, 5):
        there, back = one(FINDERS[name], listener, emitter), one(FINDERS[name], emitter, listener)
        np.testing.assert_allclose(there.length_m, back.length_m)
        np.testing.assert_allclose(there.arrival, back.departure, atol=1e-12)
        np.testing.assert_allclose(there.departure, back.arrival, atol=1e-12)
        np.testing.assert_array_equal(there.gain_db, back.gain_db)


@pytest.mark.parametrize("name", PLANS)
def test_both_legs_meet_on_a_surface_at_equal_angles_and_nothing_stands_between(name):
    """Where the ray from one end, and that from the other, are nearest: one point, from both ends, and on a surface."""
    plan, count = PLANS[name], 0
    for listener, emitter in pairs(plan, 40, 7):
        found = one(FINDERS[name], listener, emitter)
        for length, arrival, departure in zip(found.length_m, found.arrival, found.departure, strict=True):
            count += 1
            between = emitter - listener
            # |between + s departure| = length - s, as the two legs are as long as the path.
            s = (length**2 - between @ between) / (2 * (length + between @ departure))
            touched = emitter + s * departure
            np.testing.assert_allclose(touched, listener + (length - s) * arrival, atol=1e-9)
            bisector = (arrival + departure) / np.linalg.norm(arrival + departure)
            on_wall = plan.wall_distance_m(touched) < 1e-9
            on_cap = min(abs(touched[2]), abs(touched[2] - plan.height_m)) < 1e-9
            assert on_wall != on_cap
            if on_cap:
                np.testing.assert_allclose(np.abs(bisector), (0, 0, 1), atol=1e-9)
            else:
                detours = np.linalg.norm(plan.walls - touched[:2], axis=-1).sum(axis=-1)
                extents = np.linalg.norm(plan.walls[:, 1] - plan.walls[:, 0], axis=-1)
                start, end = plan.walls[np.argmin(detours - extents)]
                assert abs(bisector[2]) < 1e-9
                assert abs(bisector[:2] @ (end - start)) < 1e-9
            for point in (listener, emitter):
                along = point + np.linspace(0, 1, 400)[:, None] * (touched - point)
                inside = plan.contains(along * (1, 1, 1 - 1e-9) + (0, 0, 1e-10))
                assert inside[:-1].all()
    assert count > 80


def test_behind_a_wall_there_is_only_what_comes_through_the_doorway():
    """From room to room, out of sight: neither floor nor ceiling, nor the walls of either room."""
    listener, emitter = np.array((4.5, 0.5, 1.5)), np.array((1.0, 0.5, 1.6))
    assert not APARTMENT.is_visible(listener, emitter)
    assert not len(one(FINDERS["apartment"], listener, emitter).length_m)
    # Over the wall at y = 5, and in line with the doorway: the wall behind the emitter.
    (length,) = one(FINDERS["apartment"], np.array((5.0, 0.8, 1.5)), np.array((1.0, 1.0, 1.6))).length_m
    assert length == pytest.approx(np.sqrt(4.0**2 + (4.2 + 4.0) ** 2 + 0.1**2))
    found = one(FINDERS["apartment"], np.array((5.0, 2.5, 1.5)), np.array((1.0, 2.5, 1.6)))
    assert np.isclose(found.length_m, np.hypot(1.0 + 5.0, 0.1)).any()


def test_a_wall_in_two_pieces_mirrors_once():
    """Exactly at the corner where the pieces meet, too."""
    pieces = ReflectionFinder(FloorPlan(((0, 0), (2, 0), (5, 0), (5, 4), (0, 4)), 2.5), GAINS_DB)
    for x in (1.0, 2.0, 3.0):
        listener, emitter = np.array((x - 0.5, 1.0, 1.2)), np.array((x + 0.5, 1.0, 1.2))
        assert len(one(pieces, listener, emitter).length_m) == 6


@pytest.mark.parametrize("place", [(2.0, 2.0, 1.0), (0.0, 2.0, 1.0), (2.0, 2.0, 0.0), (5.0, 2.0, 2.5)])
def test_in_one_place_and_on_surfaces_every_number_is_finite(place):
    found = one(FINDERS["box"], np.array(place), np.array(place))
    assert len(found.length_m) >= 3
    assert (found.length_m > 0).all()
    for directions in (found.arrival, found.departure):
        np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1)


def test_what_absorbs_everything_or_scatters_it_mirrors_nothing():
    np.testing.assert_allclose(mirror_gain_db([0.36, 0.0, 0.1], [0.0, 0.19, 0.1]), 20 * np.log10([0.8, 0.9, 0.9]))
    np.testing.assert_array_equal(mirror_gain_db([1.0, 0.0], [0.0, 1.0]), -100)


def assert_same(a, b):
    for name in ("emitter", "length_m", "arrival", "departure", "gain_db"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=1e-12)


@given(st.integers(0, 10_000))
@settings(max_examples=30)
def test_in_any_room_the_same_is_found_by_compiled_code_and_numpy(seed):
    plan = star(seed)
    finder = ReflectionFinder(plan, GAINS_DB)
    listener, *emitters = points_inside(plan, 9, seed)
    together = finder.find(listener, np.array(emitters))
    assert_same(together, NumpyReflectionFinder(plan, GAINS_DB).find(listener, np.array(emitters)))
    alone = [one(finder, listener, emitter).length_m for emitter in emitters]
    np.testing.assert_array_equal(together.length_m, np.concatenate(alone))


@pytest.mark.parametrize("name", PLANS)
def test_compiled_and_numpy_reflections_are_the_same(name):
    emitters, oracle = points_inside(PLANS[name], 16, 14), NumpyReflectionFinder(PLANS[name], GAINS_DB)
    for listener in points_inside(PLANS[name], 20, 15):
        assert_same(FINDERS[name].find(listener, emitters), oracle.find(listener, emitters))


@pytest.mark.parametrize("name", PLANS)
def test_no_reflection_comes_before_the_first_echo(name):
    plan, finder = PLANS[name], FINDERS[name]
    echo = FirstEcho.of_plan(plan)
    margins = []
    for listener, emitter in pairs(plan, 200, 11):
        earliest = float(echo.length_m(listener[None], emitter[None])[0])
        assert earliest >= np.linalg.norm(listener - emitter)
        found = one(finder, listener, emitter)
        margins += [float(found.length_m.min()) - earliest] if len(found.length_m) else []
    assert min(margins) >= -1e-9
    # A bound, and hardly less than what it bounds where a surface in front of both is there to mirror.
    assert np.median(margins) < 1e-9


def test_the_first_echo_of_a_box_is_its_nearest_image():
    listeners, emitters = points_inside(BOX, 50, 3), points_inside(BOX, 50, 4)
    nearest = [one(FINDERS["box"], *pair).length_m.min() for pair in zip(listeners, emitters, strict=True)]
    np.testing.assert_allclose(FirstEcho.of_plan(BOX).length_m(listeners, emitters), nearest)


def test_on_a_surface_the_echo_is_there_at_once():
    ends = np.array([[1.0, 2.0, 0.0]]), np.array([[4.0, 1.0, 1.2]])
    np.testing.assert_allclose(FirstEcho.of_plan(BOX).length_m(*ends), np.linalg.norm(ends[0] - ends[1], axis=-1))
