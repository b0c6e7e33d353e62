"""Laws of the nodes, in a room that is no rectangle, against the floor plan's own answers."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from server.acoustics.geometry import Pose
from server.acoustics.sound_path import PlanPathFinder
from server.field.lattice import Lattice, delay_response
from server.scene.bundle import Bundle, find_bundle
from server.scene.manifest import Manifest, Reuse

MANIFEST = Manifest.model_validate_json((find_bundle("apartment") / "scene.json").read_text())
BUNDLE = Bundle(Path(), MANIFEST, "", {}, np.zeros((2, 1), np.float32))
PLAN, LOW, HIGH = BUNDLE.floor_plan, np.array(MANIFEST.bounds.minimum), np.array(MANIFEST.bounds.maximum)
PATHS = PlanPathFinder(PLAN, MANIFEST.speed_of_sound)
SPACINGS_M = (0.1, 0.35, 1.0, 2.5, 20.0)

places = st.tuples(*(st.floats(low, high, allow_subnormal=False) for low, high in zip(LOW, HIGH, strict=True)))
shares = st.tuples(*[st.floats(-0.49, 0.49)] * 3)


def lattice(spacing_m, turn_deg=30.0, **changes):
    return Lattice(BUNDLE, Reuse(spacing_m=spacing_m, turn_deg=turn_deg), PATHS, **changes)


def inside(*poses):
    return bool(np.all(PLAN.contains(np.array(poses))))


@given(places, places, st.sampled_from(SPACINGS_M), shares)
def test_a_node_is_in_the_room_and_in_the_sight_of_the_poses_and_as_hidden_as_they(listener, emitter, spacing_m, at):
    assume(inside(listener, emitter))
    offset = tuple(spacing_m * share for share in at) if spacing_m <= 0.35 else (0.0, 0.0, 0.0)
    node, _ = lattice(spacing_m, offset=offset).snap(listener, emitter, 0.0)
    assert inside(node.listener, node.emitter)
    ends = np.array([listener, emitter]), np.array([node.listener, node.emitter])
    assert PLAN.is_visible(*ends).all()
    assert PLAN.is_visible(np.array(node.listener), np.array(node.emitter)) == PLAN.is_visible(*ends[0])
    assert np.all((ends[1] >= LOW) & (ends[1] <= HIGH))


@given(places, places, st.sampled_from(SPACINGS_M))
def test_a_node_is_within_half_a_spacing_along_each_axis(listener, emitter, spacing_m):
    assume(inside(listener, emitter))
    node, _ = lattice(spacing_m).snap(listener, emitter, 0.0)
    assert np.abs(np.array([listener, emitter]) - [node.listener, node.emitter]).max() <= spacing_m / 2 + 1e-9


@given(places, places, st.sampled_from(SPACINGS_M))
def test_reflected_sound_follows_the_direct_sound_as_it_does_at_the_node(listener, emitter, spacing_m):
    """To half a step of a quarter of a metre, or of a quarter of the spacing, and half a sample."""
    assume(inside(listener, emitter))
    node, later = lattice(spacing_m).snap(listener, emitter, 0.0)
    lengths_m = PLAN.path_length_m(np.array([listener, node.listener]), np.array([emitter, node.emitter]))
    metres_per_sample = MANIFEST.speed_of_sound / MANIFEST.codec.sample_rate
    error_m = abs(lengths_m[0] - lengths_m[1] - later * metres_per_sample)
    assert error_m <= max(0.25, spacing_m / 4) / 2 + metres_per_sample / 2 + 1e-9


@given(st.floats(-20, 20), st.sampled_from([5.0, 40.0, 120.0, 360.0]))
def test_a_heading_is_within_half_a_turn_of_its_nodes_and_whole_turns_are_no_other(yaw, turn_deg):
    nodes = lattice(1.0, turn_deg)
    heading = nodes.snap((1.0, 1.0, 1.5), (2.0, 2.0, 1.5), yaw).node.yaw
    off = math.remainder(yaw - heading, math.tau)
    assert abs(math.degrees(off)) <= turn_deg / 2 + 1e-6
    if abs(abs(math.degrees(off)) - turn_deg / 2) > 1e-3:  # half-way between two, rounding decides
        assert nodes.snap((1.0, 1.0, 1.5), (2.0, 2.0, 1.5), yaw + math.tau).node.yaw == heading
    assert 0 <= heading < math.tau


def test_poses_of_a_cell_have_one_node_and_of_many_there_are_as_many_as_cells():
    rng = np.random.default_rng(0)
    listeners = rng.uniform((0.0, 0.0, 1.2), (3.9, 4.9, 1.9), (4_000, 3))
    found = {lattice(1.0).snap(tuple(place), (1.0, 1.0, 1.5), 0.0).node.listener for place in listeners}
    assert len(found) == 4 * 5


@pytest.mark.parametrize("later", [0, 3, -3, 9, -9, 50, -50])
def test_a_response_moves_by_whole_samples(later):
    response = np.arange(1, 19, dtype=np.float32).reshape(2, 9)
    expected = [[ear[at - later] if 0 <= at - later < 9 else 0 for at in range(9)] for ear in response.tolist()]
    assert delay_response(response, later).tolist() == expected


headings = st.floats(-7, 7)
turns = st.sampled_from([15.0, 120.0, 360.0])
SIXTEEN_WAYS = np.vstack([np.random.default_rng(1).standard_normal((10, 3)), np.eye(3), -np.eye(3)])
SIXTEEN_WAYS /= np.linalg.norm(SIXTEEN_WAYS, axis=1, keepdims=True)


@settings(max_examples=200)
@given(places, places, headings, st.sampled_from(SPACINGS_M), turns, shares, st.floats(-1, 1))
def test_all_listeners_of_a_neighbourhood_are_given_what_its_middle_was(
    listener, emitter, yaw, spacing_m, turn_deg, at, turned
):
    """To its very edge, all round, on lattices that lie anywhere."""
    assume(inside(listener, emitter))
    offset = tuple(min(spacing_m, 2.5) * share for share in at)
    nodes = lattice(spacing_m, turn_deg, offset=offset, turned=0.4 * turned)
    snapped, around = nodes.find(listener, emitter, yaw)
    assert nodes.snap(listener, emitter, yaw) == snapped
    arc_rad = min(around.arc_rad, math.pi)
    for share in (0.5, 0.999_999):
        for way, turn in zip(SIXTEEN_WAYS, np.linspace(-1, 1, 16), strict=True):
            place = tuple((np.array(listener) + max(0.0, around.radius_m) * share * way).tolist())
            heading = yaw + float(turn) * share * arc_rad
            if around.holds(Pose.from_yaw(place, heading)):
                assert nodes.snap(place, emitter, heading) == snapped


def test_neighbourhoods_are_wide_enough_to_be_of_use():
    """Of a listener who walks: of most poses, one found before is known to be as good."""
    nodes, around, known = lattice(5.0, 360.0), None, 0
    poses = [Pose((0.4 + 0.07 * step, 1.7, 1.5)) for step in range(40)]
    for pose in poses:
        if around is not None and around.holds(pose):
            known += 1
        else:
            around = nodes.find(pose.position, (2.0, 2.6, 1.5), 0.0)[1]
    assert known > len(poses) / 2


def test_a_neighbourhood_of_some_headings_ends_with_them():
    around = lattice(1.0, 120.0).find((1.2, 1.3, 1.5), (2.0, 2.0, 1.5), math.radians(50))[1]
    assert around.arc_rad == pytest.approx(math.radians(10), abs=1e-6)
    assert around.holds(Pose.from_yaw((1.2, 1.3, 1.5), math.radians(59) - math.tau))
    assert not around.holds(Pose.from_yaw((1.2, 1.3, 1.5), math.radians(61)))
