"""Places that are none: in walls and on them, outside, on top of each other, and a million metres away."""

import heapq
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.acoustics import diffraction
from server.acoustics.air import absorption_db_per_m
from server.acoustics.directivity import CARDIOID, FIGURE_OF_EIGHT, HYPERCARDIOID, OMNIDIRECTIONAL, Cardioid
from server.acoustics.geometry import FARTHEST_M, FloorPlan, Pose
from server.acoustics.reflections import ReflectionFinder
from server.acoustics.sound_path import PlanPathFinder
from server.core.errors import RequestError
from server.protocol.client_messages import ListenerPose, MoveEmitter
from server.rendering.direct_path import PathTarget
from server.rendering.still_paths import StillPaths
from server.responses.radiation import reverberation_gain
from server.scene.bundle import BUNDLED, Bundle
from tests.hard_cases.listening import AHEAD, FLAT, Listening, hear, not_finite, play, renderer
from tests.oracles.reflections import NumpyReflectionFinder
from tests.oracles.sound_path import NumpySoundPathFinder
from tests.signals import noise

# A room with one reflex corner, and a flat of two rooms with a doorway.
CORNER = FloorPlan(((0, 0), (8, 0), (8, 3), (4, 3), (4, 6), (0, 6)), 2.7)
FLAT_OF_TWO = Bundle.load(BUNDLED / "apartment").floor_plan
PLANS = {"corner": CORNER, "two rooms": FLAT_OF_TWO}
every_plan = pytest.mark.parametrize("plan", PLANS.values(), ids=PLANS)

SPECIAL = {
    "in a wall": (5.0, 5.0, 1.5),
    "on a wall": (8.0, 1.5, 1.5),
    "a hair behind a wall": (8.0 + 1e-12, 1.5, 1.5),
    "on a corner": (8.0, 0.0, 1.5),
    "on a corner that sound bends round": (4.0, 3.0, 1.5),
    "on the floor": (2.0, 2.0, 0.0),
    "on the ceiling": (2.0, 2.0, 2.7),
    "outside": (20.0, 1.0, 1.0),
    "a million metres away": (1e6, -1e6, 1e6),
}
diffraction_gain_db = np.vectorize(diffraction.diffraction_gain_db, otypes=[float])
LISTENER = (1.0, 5.0, 1.5)


def paths(plan, listener, emitter):
    """By compiled code and by NumPy."""
    listener, emitters = np.asarray(listener, float), np.asarray([emitter], float)
    return tuple(kind(plan, 343.0).find(listener, emitters) for kind in (PlanPathFinder, NumpySoundPathFinder))


@pytest.mark.parametrize("place", SPECIAL.values(), ids=SPECIAL)
def test_a_path_to_any_place_is_finite_and_no_shorter_than_the_straight_line(measured, place):
    straight = math.dist(place, LISTENER)
    for found in paths(CORNER, LISTENER, place):
        for values in (found.length_m, found.arrival, found.departure, found.screen_db):
            assert not_finite(values) == 0
        measured("shorter than the straight line", straight - found.length_m[0], 1e-9 * max(1, straight), "m")
        measured("arrival off unit length", abs(np.linalg.norm(found.arrival) - 1), 1e-12)
        measured("screen gain", found.screen_db.max(), 0.0, "dB")


@pytest.mark.parametrize("place", SPECIAL.values(), ids=SPECIAL)
def test_compiled_and_plain_paths_agree_on_any_place(measured, place):
    compiled, plain = paths(CORNER, LISTENER, place)
    for name in ("length_m", "arrival", "departure", "screen_db"):
        one, other = getattr(compiled, name), getattr(plain, name)
        measured("largest difference", np.abs(one - other).max() / max(1, np.abs(other).max()), 1e-9)


@pytest.mark.parametrize("place", SPECIAL.values(), ids=SPECIAL)
def test_the_length_of_a_path_to_any_place_is_finite(measured, place):
    length_m = float(CORNER.path_length_m(np.array(place), np.array(LISTENER)))
    measured("shorter than the straight line", math.dist(place, LISTENER) - length_m, 1e-9 * length_m, "m")
    assert math.isfinite(length_m)


@every_plan
@given(st.tuples(*[st.floats(0, 1)] * 6))
def test_a_path_is_as_long_there_as_back(measured, plan, shares):
    low, high = np.min(plan.corners, axis=0), np.max(plan.corners, axis=0)
    a, b = (np.array([*(low + np.array(part[:2]) * (high - low)), 2.5 * part[2]]) for part in (shares[:3], shares[3:]))
    there, back = plan.path_length_m(a, b), plan.path_length_m(b, a)
    measured("difference", abs(float(there - back)), 1e-12 * float(there) + 1e-15, "m")


@every_plan
@given(st.tuples(*[st.floats(0.02, 0.98)] * 4), st.floats(0, 2 * math.pi))
def test_a_millimetre_changes_a_path_by_a_millimetre_at_most(measured, plan, shares, turn):
    """Geodesic distances are 1-Lipschitz, corners or not; it is what keeps the direct sound from popping."""
    low, high = np.min(plan.corners, axis=0), np.max(plan.corners, axis=0)
    a, b = (np.array([*(low + np.array(part) * (high - low)), 1.5]) for part in (shares[:2], shares[2:]))
    near = a + 1e-3 * np.array([math.cos(turn), math.sin(turn), 0.0])
    if not (plan.contains(a) and plan.contains(b) and plan.contains(near) and plan.is_visible(a, near)):
        return
    change = float(abs(plan.path_length_m(a, b) - plan.path_length_m(near, b)))
    measured("change", change / 1e-3, 1.0 + 1e-6, "m per m")


def shortest_by_search(plan, a, b):
    """Dijkstra's algorithm over both points and all corners, one edge at a time: slow and with nothing in common."""
    nodes = [np.asarray(a), np.asarray(b), *(np.array([*corner, 0.0]) for corner in plan.bend_corners)]
    best, queue = {}, [(0.0, 0)]
    while queue:
        length, at = heapq.heappop(queue)
        if at in best:
            continue
        best[at] = length
        for to, node in enumerate(nodes):
            if to not in best and bool(plan.is_visible(nodes[at], node)):
                heapq.heappush(queue, (length + math.hypot(*(node - nodes[at])[:2]), to))
    return math.hypot(best[1], b[2] - a[2])


def test_paths_round_many_corners_are_the_shortest_there_are(measured):
    """A comb of twelve teeth: 24 reflex corners between one end and the other."""
    corners = [(0.0, 0.0), (25.0, 0.0), (25.0, 6.0)]
    for tooth in range(12, 0, -1):
        depth = 1.0 if tooth % 2 else 3.0
        corners += [(2 * tooth + 0.4, 6.0), (2 * tooth + 0.4, depth), (2 * tooth - 0.4, depth), (2 * tooth - 0.4, 6.0)]
    plan = FloorPlan((*corners, (0.0, 6.0)), 3.0)
    assert len(plan.bend_corners) == 24
    rng = np.random.default_rng(0)
    points = rng.uniform((0.2, 0.2, 0.5), (24.8, 5.8, 2.5), (400, 3))
    inside = points[plan.contains(points)][:7]
    found = plan.path_length_m(inside[:, None], inside[None])
    expected = np.array([[shortest_by_search(plan, a, b) for b in inside] for a in inside])
    measured("largest error", np.abs(found - expected).max(), 1e-9, "m")


@pytest.mark.parametrize(
    "position", [(0.29, 2.0, 1.5), (2.0, 2.0, 2.3 + 1e-9), (9e3, 2.0, 1.5), (1e6, 1e6, 1e6), (-1e6, 0.0, 0.0)]
)
@pytest.mark.parametrize("message", [ListenerPose, MoveEmitter])
def test_a_place_outside_is_refused_and_the_sound_is_as_if_nothing_had_been_said(
    measured, field, filters, position, message
):
    outputs = []
    for is_disturbed in (False, True):
        listening = Listening(field, filters)
        listening.add()
        listening.hear(3)
        if is_disturbed:
            name = {"id": "talker"} if message is MoveEmitter else {}
            assert listening.say(message(pose_id=7, position=position, **name)) == ["position_out_of_bounds"]
        outputs.append(listening.hear(12))
    measured("largest difference", np.abs(outputs[0] - outputs[1]).max(), 0.0)


@pytest.mark.parametrize("coordinate", [math.nan, math.inf, -math.inf, 1.1 * FARTHEST_M, -1e300])
@pytest.mark.parametrize("axis", range(3))
def test_a_pose_nowhere_cannot_exist(coordinate, axis):
    position = [1.0, 2.0, 1.5]
    position[axis] = coordinate
    with pytest.raises(ValueError, match="position must"):
        Pose(tuple(position))


@pytest.mark.parametrize("place", [place for name, place in SPECIAL.items() if "million" not in name])
def test_whether_a_place_is_inside_is_one_answer(place):
    assert FLAT_OF_TWO.holds(place) == bool(FLAT_OF_TWO.contains(np.array(place)))
    assert CORNER.holds(place) == bool(CORNER.contains(np.array(place)))


@pytest.mark.parametrize("length_m", [1e3, 1e6, 1e7])
def test_sound_from_far_away_is_faint_and_finite(measured, filters, length_m):
    engine = renderer(filters, air_db_per_m=np.full(7, 0.01))
    play(engine, noise(1, 3_000), path=PathTarget(length_m, AHEAD, FLAT))
    heard = hear(engine, 200)
    assert not_finite(heard) == 0
    measured("peak beside one over the distance", np.abs(heard).max() * length_m, 4.0)


def test_from_far_away_to_near_and_back_leaves_nothing_behind(measured, filters):
    outputs = []
    for is_disturbed in (False, True):
        engine = renderer(filters)
        play(engine, noise(1, 256), path=PathTarget(2.0, AHEAD, FLAT))
        hear(engine, 8)
        engine.set_path("a", PathTarget(1e6 if is_disturbed else 2.0, AHEAD, FLAT))
        hear(engine, 8)
        engine.set_path("a", PathTarget(2.0, AHEAD, FLAT))
        hear(engine, 40)
        outputs.append(hear(engine, 8))
    measured("largest difference", np.abs(outputs[0] - outputs[1]).max(), 1e-6)


@pytest.fixture(scope="module")
def mirrors():
    return ReflectionFinder(CORNER, np.full((3, 7), -1.0))


@given(st.floats(0, 8), st.floats(0, 8), st.floats(0, 2.7), st.floats(0, 2.7))
def test_reflections_along_a_wall_are_finite(measured, mirrors, a, b, low, high):
    """Listener and emitter both on the wall: the image path is parallel to it, and there is nothing to mirror."""
    found = mirrors.find(np.array([a, 0.0, low]), np.array([[b, 0.0, high]]))
    for values in (found.length_m, found.arrival, found.departure, found.gain_db):
        assert not_finite(values) == 0
    straight = math.hypot(a - b, high - low)
    shorter = float(np.max(straight - found.length_m, initial=-math.inf)) if len(found.length_m) else 0.0
    measured("shorter than the straight line", shorter, 1e-9, "m")


@pytest.mark.parametrize("height", [0.0, 1.35, 2.7])
def test_reflections_of_an_emitter_at_the_listener_are_finite(measured, mirrors, height):
    place = np.array([2.0, 2.0, height])
    found = mirrors.find(place, place[None])
    assert not_finite(found.arrival) + not_finite(found.length_m) == 0
    measured("shortest", float(found.length_m.min()), 1e-9, "m", at_least=True)
    off = np.abs(np.linalg.norm(found.arrival, axis=-1) - 1).max()
    measured("arrival off unit length", float(off), 1e-12)


@every_plan
@given(st.tuples(*[st.floats(0, 1)] * 6))
def test_compiled_and_plain_reflections_agree_anywhere(measured, plan, shares):
    low, high = np.min(plan.corners, axis=0), np.max(plan.corners, axis=0)
    a, b = (np.array([*(low + np.array(part[:2]) * (high - low)), 2.5 * part[2]]) for part in (shares[:3], shares[3:]))
    if not (plan.contains(a) and plan.contains(b)):
        return
    one, other = _mirrors_of(plan).find(a, b[None]), NumpyReflectionFinder(plan, _MIRRORS_DB).find(a, b[None])
    lengths = [np.sort(found.length_m) for found in (one, other)]
    # At the very end of a wall one may see a path that the other does not; every other is there twice.
    if len(lengths[0]) == len(lengths[1]):
        measured("largest difference", float(np.max(np.abs(lengths[0] - lengths[1]), initial=0.0)), 1e-9, "m")
    measured("paths apart", abs(len(lengths[0]) - len(lengths[1])), 1)


_FINDERS = {}
_MIRRORS_DB = np.full((3, 7), -1.0)


def _mirrors_of(plan):
    if plan.corners not in _FINDERS:
        _FINDERS[plan.corners] = ReflectionFinder(plan, _MIRRORS_DB)
    return _FINDERS[plan.corners]


@pytest.mark.parametrize("number", [0.0, -0.0, 5e-324, -5e-324, 1e-300, -0.1915871349, -1e300, 1e300, 1e-8, -1e-8])
def test_a_screen_never_amplifies_and_is_always_finite(measured, number):
    gain = float(diffraction_gain_db(number))
    assert math.isfinite(gain)
    measured("gain", gain, 0.0, "dB")


@pytest.mark.parametrize("number", [0.0, -0.0, 5e-324, -5e-324, 1e-300, -1e-300, 1e-9, -1e-9])
def test_a_screen_that_the_line_grazes_takes_five_decibels(measured, number):
    measured("difference", abs(float(diffraction_gain_db(number)) + 5), 1e-6, "dB")


@pytest.mark.parametrize("number", [-0.1915871349, -0.25, -1.0, -2.0, -7.3, -1e6, -1e300])
def test_a_screen_far_from_the_line_takes_nothing(measured, number):
    measured("taken", abs(float(diffraction_gain_db(number))), 0.0, "dB")


def test_a_screen_grows_without_steps_as_one_walks_behind_it(measured):
    numbers = np.linspace(-0.4, 4.0, 200_001)
    gains = diffraction_gain_db(numbers)
    measured("largest rise", float(np.max(np.diff(gains))), 1e-12, "dB")
    measured("largest step", float(np.max(-np.diff(gains))), 0.01, "dB")


@pytest.mark.parametrize("humidity", [0.0, 0.05, 1.0])
@pytest.mark.parametrize("temperature", [-273.0, -20.0, 50.0, 500.0])
def test_air_of_any_weather_absorbs_and_never_amplifies(measured, humidity, temperature):
    absorbed = absorption_db_per_m([0.0, 125.0, 8_000.0, 1e6], temperature_c=temperature, relative_humidity=humidity)
    assert not_finite(absorbed) == 0
    measured("least absorption", float(absorbed.min()), 0.0, "dB/m", at_least=True)


@pytest.mark.parametrize(
    "pattern", [CARDIOID, FIGURE_OF_EIGHT, HYPERCARDIOID, Cardioid(0.5, 32.0), Cardioid(0.0, 1e-9)]
)
@given(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda d: math.hypot(*d) > 1e-6))
def test_no_pattern_amplifies_and_its_null_is_finite(measured, pattern, direction):
    unit = np.array(direction) / math.hypot(*direction)
    for seen in (unit, np.array([0.0, 1.0, 0.0]), np.array([-1.0, 0.0, 0.0])):
        gain = pattern.gain_db(seen)
        measured("largest gain", float(gain.max()), 1e-9, "dB")
        measured("deepest null", float(gain.min()), -60.0 - 1e-9, "dB", at_least=True)
    filled = reverberation_gain(pattern)
    measured("what fills the room beside all round", filled - reverberation_gain(OMNIDIRECTIONAL), 1e-9)


def test_paths_at_rest_from_a_million_metres_add_nothing_that_is_heard(measured, filters):
    still = StillPaths(filters, speed_of_sound=343.0, air_db_per_m=np.full(7, 0.1))
    out = np.zeros((2, 4_000), np.float32)
    still.add(np.array([1e6, 0.0]), np.array([AHEAD, AHEAD]), np.zeros((2, 7)), (0.0, 0.0, 0.0, 1.0), out)
    alone = np.zeros_like(out)
    still.add(np.array([0.0]), np.array([AHEAD]), np.zeros((1, 7)), (0.0, 0.0, 0.0, 1.0), alone)
    measured("largest difference", float(np.abs(out - alone).max()), 0.0)


def test_who_asks_at_a_place_that_is_none_hears_why(bundle):
    with pytest.raises(RequestError, match=r"listener \(1e\+06, 0, 0\) is outside \[0\.3, 0\.3, 0\.5\] to"):
        bundle.require_inside((1e6, 0.0, 0.0), "listener")
