"""Directions and distances where formulas have poles, and motion that nobody makes."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.acoustics.bands import FILTER_BANDS_HZ
from server.acoustics.geometry import Pose, Quaternion
from server.acoustics.minimum_phase import band_cepstra
from server.protocol.client_messages import ListenerPose, MoveEmitter
from server.rendering.direct_path import NEAR_LIMIT_M, PathTarget
from server.rendering.hrtf import KEMAR, HeadFilters, Hrtf, filter_taps
from server.rendering.still_paths import StillPaths
from tests.hard_cases.listening import (
    FLAT,
    HERE,
    RATE,
    SECOND,
    SIZE,
    THERE,
    Listening,
    ahead,
    decibels,
    hear,
    not_finite,
    play,
    renderer,
    splatter_db,
    tone,
)
from tests.signals import noise

LEVEL = (0.0, 0.0, 0.0, 1.0)
AXES = {
    "ahead": (1.0, 0.0, 0.0),
    "behind": (-1.0, 0.0, 0.0),
    "left": (0.0, 1.0, 0.0),
    "right": (0.0, -1.0, 0.0),
    "above": (0.0, 0.0, 1.0),
    "below": (0.0, 0.0, -1.0),
}


@pytest.fixture(scope="module")
def still(filters):
    return StillPaths(filters, speed_of_sound=343.0, air_db_per_m=FLAT)


def response(still, direction, length_m=2.0, orientation=LEVEL):
    """(2, sample) of one path."""
    out = np.zeros((2, 1_000), np.float32)
    direction = np.asarray(direction) / np.linalg.norm(direction)
    still.add(np.array([length_m]), direction[None], FLAT[None], orientation, out)
    return out.astype(np.float64)


def difference_db(one, other):
    return decibels(np.linalg.norm(one - other) / np.linalg.norm(one))


def test_across_the_median_plane_the_ears_change_places(measured, still):
    """Ahead, behind, above and below are as loud on both sides, as near as a measured head is symmetrical."""
    for name in ("ahead", "behind", "above", "below"):
        left, right = response(still, AXES[name])
        measured("between the ears", abs(decibels(np.linalg.norm(left) / np.linalg.norm(right))), 0.1, "dB")


@pytest.mark.parametrize("side", ["left", "right"])
def test_exactly_to_one_side_that_ear_is_the_louder_one(measured, still, side):
    left, right = response(still, AXES[side])
    near, far = (left, right) if side == "left" else (right, left)
    measured("near ear above the far one", decibels(np.linalg.norm(near) / np.linalg.norm(far)), 6, "dB", at_least=True)


@pytest.mark.parametrize("name", AXES)
@pytest.mark.parametrize("epsilon", [1e-12, 1e-9, 1e-6, 1e-4])
def test_a_hair_off_an_axis_it_sounds_the_same(measured, still, name, epsilon):
    exact = response(still, AXES[name])
    for turn in range(8):
        off = np.array(AXES[name]) + epsilon * np.array(
            [math.sin(turn), math.cos(turn * 1.3), math.sin(turn * 0.7 + 1)]
        )
        bound = max(-100.0, decibels(30 * epsilon))
        measured("difference", difference_db(exact, response(still, off)), bound, "dB")


@pytest.mark.parametrize("elevation", [90, -90])
def test_straight_above_and_below_there_is_no_azimuth(measured, still, elevation):
    up = math.radians(elevation)
    responses = [
        response(still, (math.cos(up) * math.cos(turn), math.cos(up) * math.sin(turn), math.sin(up)))
        for turn in np.linspace(-math.pi, math.pi, 13)
    ]
    measured("difference", max(difference_db(responses[0], one) for one in responses), -100, "dB")


def test_azimuth_is_continuous_across_the_back(measured, still):
    back = [(-1.0, side * 1e-9, 0.0) for side in (1, -1)]
    measured("difference", difference_db(*(response(still, one) for one in back)), -100, "dB")


def test_ten_thousand_directions_are_finite_and_of_one_loudness(measured, still):
    """Fibonacci's sphere, ahead included: no direction falls between the triangles of the head."""
    count = 10_000
    z = 1 - 2 * (np.arange(count) + 0.5) / count
    turn = np.arange(count) * math.pi * (3 - math.sqrt(5))
    flat = np.sqrt(1 - z * z)
    directions = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=-1)
    directions[0] = AXES["ahead"]
    levels_db = []
    for direction in directions:
        heard = np.zeros((2, 400), np.float32)
        still.add(np.ones(1), direction[None], FLAT[None], LEVEL, heard)
        assert not_finite(heard) == 0
        levels_db.append(decibels(np.linalg.norm(heard)))
    measured("loudest to softest", max(levels_db) - min(levels_db), 20.0, "dB")


def test_turning_a_hundredth_of_a_degree_changes_as_little(measured):
    """A Lipschitz figure over random headings: the relative change per degree, largest over the sphere. Of a head made
    from its measurements, in which loudspeakers stood a few centimetres out of place."""
    made = HeadFilters.from_hrtf(Hrtf.read(KEMAR, RATE))
    still = StillPaths(made, speed_of_sound=343.0, air_db_per_m=FLAT)
    rng = np.random.default_rng(0)
    step = math.radians(0.01)
    worst = 0.0
    for _ in range(2_000):
        direction = rng.standard_normal(3)
        across = np.cross(direction, rng.standard_normal(3))
        turned = direction / np.linalg.norm(direction) + step * across / np.linalg.norm(across)
        one, other = response(still, direction), response(still, turned)
        worst = max(worst, np.linalg.norm(one - other) / np.linalg.norm(one) / 0.01)
    measured("change per degree", worst, 0.5)


def test_an_emitter_at_the_head_is_as_loud_as_one_at_the_near_limit(measured, still):
    at_limit = response(still, AXES["ahead"], NEAR_LIMIT_M)
    for length_m in (0.0, -0.0, 1e-300, 1e-9, 0.1):
        heard = response(still, AXES["ahead"], length_m)
        assert not_finite(heard) == 0
        off_db = decibels(np.linalg.norm(heard) / np.linalg.norm(at_limit))
        # The ear is nearer than the centre of the head: what would be heard before emission is left out.
        measured("level beside the near limit", off_db, 0.5, "dB")


def test_a_step_into_the_head_and_out_again_does_not_click(measured, filters):
    engine = renderer(filters)
    play(engine, tone(), path=ahead(0.5))
    hear(engine, SECOND)
    heard = []
    for step in range(2 * SECOND):
        engine.set_path("a", ahead(0.5 * abs(math.cos(math.pi * step / SECOND))))
        heard.append(hear(engine, 1))
    wet = np.concatenate(heard, axis=1)
    measured("peak", np.abs(wet).max(), 0.2 / NEAR_LIMIT_M)
    measured("splatter above 4 kHz", splatter_db(wet), -60, "dB")


def test_a_head_that_turns_past_half_a_turn_does_not_click(measured, filters):
    engine = renderer(filters)
    play(engine, tone(), path=ahead())
    hear(engine, SECOND)
    heard = []
    for step in range(2 * SECOND):
        yaw = math.pi - 0.2 + 0.4 * step / (2 * SECOND)  # over pi in the middle
        engine.set_orientation(Quaternion.from_yaw(math.remainder(yaw, 2 * math.pi)))
        heard.append(hear(engine, 1))
    measured("splatter above 4 kHz", splatter_db(np.concatenate(heard, axis=1)), -80, "dB")


def test_quaternions_of_opposite_sign_are_one_orientation(measured, filters):
    engine = renderer(filters)
    play(engine, tone(), path=ahead())
    hear(engine, SECOND)
    turned = Quaternion.from_yaw(0.7)
    heard = []
    for step in range(SECOND):
        engine.set_orientation(turned if step % 2 else Quaternion(*(-part for part in turned)))
        heard.append(hear(engine, 1))
    measured("splatter above 4 kHz", splatter_db(np.concatenate(heard[20:], axis=1)), -90, "dB")


def test_a_millimetre_of_jitter_ninety_times_a_second_is_not_heard(measured, filters):
    engine = renderer(filters)
    play(engine, tone(), path=ahead())
    hear(engine, SECOND)
    rng = np.random.default_rng(1)
    heard = []
    for _ in range(3 * SECOND):
        engine.set_path("a", ahead(2.0 + rng.uniform(-1e-3, 1e-3)))
        heard.append(hear(engine, 1))
    measured("splatter above 4 kHz", splatter_db(np.concatenate(heard, axis=1)), -80, "dB")


def test_a_teleport_in_every_block_stays_within_the_nearest_of_its_places(measured, filters, still):
    engine = renderer(filters)
    play(engine, np.sign(noise(8, RATE)), path=ahead())
    rng = np.random.default_rng(2)
    heard = []
    for _ in range(4 * SECOND):
        arrival = rng.standard_normal(3)
        arrival /= np.linalg.norm(arrival)
        engine.set_path("a", PathTarget(float(rng.uniform(0, 60)), arrival, FLAT))
        heard.append(hear(engine, 1))
    wet = np.concatenate(heard, axis=1)
    assert not_finite(wet) == 0
    # The sum of magnitudes of a filter bounds what it makes of anything; a tenth more for what lies between directions.
    loudest = max(
        np.abs(response(still, direction, 0.25)).sum(axis=-1).max() for direction in rng.standard_normal((500, 3))
    )
    measured("peak beside the bound", np.abs(wet).max() / (1.1 * loudest), 1.0)


def test_after_a_teleport_all_is_as_if_one_had_always_been_there(measured, filters):
    there = PathTarget(9.0, (0.0, 1.0, 0.0), FLAT)
    outputs = []
    for start in (ahead(0.3), there):
        engine = renderer(filters)
        play(engine, noise(3, SIZE), path=start)
        hear(engine, 20)
        engine.set_path("a", there)
        hear(engine, 30)
        outputs.append(hear(engine, 10))
    measured("difference", difference_db(*outputs), -60, "dB")


def test_faster_than_sound_is_a_jump_and_not_a_boom(measured, filters):
    engine = renderer(filters)
    play(engine, tone(), path=ahead(150.0))
    hear(engine, 2 * SECOND)
    heard = []
    for step in range(20):
        engine.set_path("a", ahead(150.0 - 7.4 * step))  # 700 m/s
        heard.append(hear(engine, 1))
    nearest_m = 150.0 - 7.4 * 19
    measured("peak", np.abs(np.concatenate(heard, axis=1)).max(), 0.2 / nearest_m * 1.5)


@given(
    st.lists(
        st.tuples(*[st.floats(-60, 60)] * 3, *[st.floats(-1, 1)] * 4).filter(lambda pose: math.hypot(*pose[3:]) > 1e-6),
        min_size=1,
        max_size=6,
    )
)
def test_any_walk_of_any_head_is_finite_and_the_same_twice(measured, filters, poses):
    def walk():
        engine = renderer(filters)
        play(engine, noise(4, 2_000), path=ahead())
        heard = []
        for pose in poses:
            place = np.array(pose[:3])
            length_m = float(np.linalg.norm(place))
            arrival = place / length_m if length_m > 1e-9 else np.array([1.0, 0.0, 0.0])
            engine.set_path("a", PathTarget(length_m, arrival, FLAT))
            engine.set_orientation(Quaternion(*pose[3:]))
            heard.append(hear(engine, 2))
        return np.concatenate(heard, axis=1)

    first, again = walk(), walk()
    assert not_finite(first) == 0
    measured("largest difference of a rerun", np.abs(first - again).max(), 0.0)


def test_a_session_follows_ten_thousand_poses_and_breaks_at_none(measured, field, filters):
    """All over the volume and the sphere, one in every block, the emitter's and the listener's in turn."""
    listening = Listening(field, filters, clip=0.5 * noise(5, 4_000))
    listening.add()
    rng = np.random.default_rng(6)
    bounds = field.bundle.manifest.bounds
    refused, bad, peak = 0, 0, 0.0
    for number in range(1, 10_001):
        position = tuple(rng.uniform(bounds.minimum, bounds.maximum))
        turn = tuple(rng.standard_normal(4))
        message = (
            ListenerPose(pose_id=number, position=position, orientation=turn)
            if number % 2
            else MoveEmitter(id="talker", pose_id=number, position=position, orientation=turn)
        )
        refused += len(listening.say(message))
        if number % 50 == 0:
            listening.answer()
        block = listening.session.render_block().samples
        bad += not_finite(block)
        peak = max(peak, float(np.abs(block).max()))
    measured("poses refused", refused, 0)
    measured("samples not finite", bad, 0)
    measured("peak", peak, 10 ** (-1 / 20) * (1 + 1e-6))


def test_a_centimetre_in_a_session_changes_a_block_by_little(measured, field, filters):
    """A Lipschitz figure of what is heard: two listeners a centimetre apart, everything else the same."""
    worst = -math.inf
    rng = np.random.default_rng(7)
    for _ in range(6):
        position = rng.uniform((0.5, 0.5, 1.0), (7.0, 4.5, 2.0))
        heard = []
        for apart in (0.0, 0.01):
            listening = Listening(field, filters, clip=0.05 * tone(400))
            listening.say(ListenerPose(pose_id=1, position=(position[0] + apart, position[1], position[2])))
            listening.add()
            heard.append(listening.hear(40))
        worst = max(worst, difference_db(*heard))
    measured("change per centimetre", worst, -15, "dB")


@pytest.mark.parametrize("place", [HERE, THERE])
def test_listener_and_emitter_in_one_place(measured, field, filters, place):
    listening = Listening(field, filters)
    listening.say(ListenerPose(pose_id=1, position=place))
    assert listening.add(position=place) == []
    heard = listening.hear(60)
    assert not_finite(heard) == 0
    measured("level", decibels(np.abs(heard).max()), 0.0, "dB")
    measured("heard at all", decibels(np.abs(heard).max()), -60.0, "dB", at_least=True)


@pytest.mark.parametrize(
    "orientation",
    [LEVEL, (0, 0.7071, 0, 0.7071), (0.5, 0.5, 0.5, 0.5), (1, 0, 0, 0), (-0.17, 0.47, 0.42, 0.86)],
)
def test_a_pose_is_given_back_as_it_was_taken(measured, orientation):
    pose = Pose((1.0, 2.0, 3.0), orientation)
    again = Pose(pose.position, pose.orientation)
    measured("largest change", np.abs(np.subtract(again.orientation, pose.orientation)).max(), 0.0)
    measured("length off", abs(math.hypot(*pose.orientation) - 1), 1e-15)


def test_bands_at_and_above_nyquists_frequency_leave_the_others_as_they_are(measured):
    """At 8 kHz three bands have their middle where there is no sound."""
    for rate in (8_000, 11_025, 16_000, 96_000):
        cepstra = band_cepstra(rate, filter_taps(rate))
        assert not_finite(cepstra) == 0
        gains_db = 20 / math.log(10) * np.fft.rfft(cepstra, 8192).real  # of one decibel in each band
        measured("largest gain of one decibel in one band", np.abs(gains_db).max(), 1.5, "dB")
        measured("off a decibel in all", np.abs(gains_db.sum(axis=0) - 1).max(), 0.02, "dB")
        for band, centre_hz in enumerate(FILTER_BANDS_HZ):
            if centre_hz < rate / 2:
                at = gains_db[band, round(centre_hz / rate * 8192)]
                measured("off a decibel in the middle of a band", abs(at - 1), 0.05, "dB")
