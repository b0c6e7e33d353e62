"""Responses by pose: the nearest within reach, the newest of those in one place, and no more than there is room for."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from server.acoustics.geometry import Quaternion
from server.field.phase_cache import RADIUS_M, PhaseCache

HERE, THERE = np.array([1.0, 2.0, 1.5]), np.array([5.0, 3.0, 1.5])
STEP = np.array([0.1, 0.0, 0.0])


def _response(value):
    return np.full((2, 10), value, np.float32)


def _head(*angles):
    return np.array(Quaternion.from_angles(*angles))


AHEAD = _head(0.0, 0.0, 0.0)


def _found(cache, listener, emitter, head=AHEAD):
    response = cache.nearest(listener, emitter, head)
    return None if response is None else response[0, 0]


def test_nothing_is_near_where_nothing_was():
    assert PhaseCache().nearest(HERE, THERE, AHEAD) is None


@pytest.mark.parametrize("end", ["listener", "emitter"])
def test_the_nearest_within_the_radius_is_found(end):
    cache = PhaseCache()
    for number in range(4):
        moved = number * STEP
        cache.keep(HERE + moved * (end == "listener"), THERE + moved * (end == "emitter"), AHEAD, _response(number))
    at = 2.3 * STEP
    assert _found(cache, HERE + at * (end == "listener"), THERE + at * (end == "emitter")) == 2
    beyond = 3 * STEP + np.array([RADIUS_M * 1.01, 0, 0])
    assert _found(cache, HERE + beyond * (end == "listener"), THERE + beyond * (end == "emitter")) is None


def test_headings_count_round_the_circle():
    cache = PhaseCache()
    for yaw in (-3.1, 0.0, 1.5):
        cache.keep(HERE, THERE, _head(yaw, 0.0, 0.0), _response(yaw))
    assert _found(cache, HERE, THERE, _head(3.1, 0.0, 0.0)) == np.float32(-3.1)
    assert _found(cache, HERE, THERE, _head(1.1, 0.0, 0.0)) == 1.5


def test_a_head_tilted_to_its_side_has_its_ears_elsewhere():
    """Its heading is the same; its ears have another place."""
    cache = PhaseCache()
    for roll in (0.0, 1.2, -1.2):
        cache.keep(HERE, THERE, _head(0.0, 0.0, roll), _response(roll))
    assert _found(cache, HERE, THERE, _head(0.0, 0.0, 0.9)) == np.float32(1.2)
    assert _found(cache, HERE, THERE, _head(0.0, 0.6, -1.1)) == np.float32(-1.2)


def test_exchanged_ends_are_another_pose():
    cache = PhaseCache()
    cache.keep(HERE, THERE, AHEAD, _response(1))
    assert _found(cache, THERE, HERE) is None


def test_of_one_place_the_newest_is_kept_as_it_was():
    cache = PhaseCache(capacity=2)
    for number in range(5):
        response = _response(number)
        cache.keep(HERE, THERE, _head(0.001 * number, 0.0, 0.0), response)
        response[:] = -1
    assert _found(cache, HERE, THERE) == 4
    cache.keep(THERE, HERE, AHEAD, _response(9))
    assert _found(cache, HERE, THERE) == 4


def test_the_one_unused_for_longest_makes_room():
    cache = PhaseCache(capacity=3)
    places = [HERE + np.array([number, 0, 0]) for number in range(4)]
    for number in range(3):
        cache.keep(places[number], THERE, AHEAD, _response(10 + number))
    assert _found(cache, places[0], THERE) == 10
    cache.keep(places[3], THERE, AHEAD, _response(13))
    assert [_found(cache, place, THERE) for place in places] == [10, None, 12, 13]


def test_what_is_found_is_the_response_itself():
    cache = PhaseCache()
    response = np.random.default_rng(0).standard_normal((2, 50)).astype(np.float32)
    cache.keep(HERE, THERE, _head(0.2, 0.0, 0.0), response)
    assert_array_equal(cache.nearest(HERE, THERE, _head(0.2, 0.0, 0.0)), response)
