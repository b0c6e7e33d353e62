"""Orientations that are none: at every door they are refused by name, or made to have unit length."""

import math
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.acoustics.geometry import LEVEL, Pose, Quaternion, axes_of
from server.core.errors import RequestError
from server.offline.render import PathError, read_path
from server.protocol.client_messages import ListenerPose, parse_client_message
from tests.hard_cases.listening import Listening

HERE = (2.0, 2.0, 1.5)
NO_ORIENTATION = {
    "zero": (0.0, 0.0, 0.0, 0.0),
    "negative zero": (-0.0, 0.0, -0.0, 0.0),
    "denormal": (5e-324, 0.0, 0.0, 0.0),
    "denormal float32": (1e-40, 1e-41, 0.0, 0.0),
    "tiny": (0.0, 1e-7, 0.0, 0.0),
    "not a number": (0.0, 0.0, 0.0, math.nan),
    "infinite": (math.inf, 0.0, 0.0, 0.0),
    "both infinities": (math.inf, -math.inf, 0.0, 1.0),
    "overflowing": (1e308, 1e308, 1e308, 1e308),
    "huge": (0.0, 0.0, 0.0, 1e13),
}
bad = pytest.mark.parametrize("numbers", NO_ORIENTATION.values(), ids=NO_ORIENTATION)


@bad
def test_an_orientation_that_is_none_cannot_exist(numbers):
    for make in (lambda: Quaternion(*numbers), lambda: Pose(HERE, numbers)):
        with pytest.raises(ValueError, match="orientation must be"):
            make()


@bad
def test_a_text_message_with_it_is_refused_and_names_the_pose(numbers):
    text = ", ".join("1e999" if math.isinf(n) else "NaN" if math.isnan(n) else repr(n) for n in numbers)
    message = f'{{"type": "listener", "pose_id": 1, "position": [2, 2, 1.5], "orientation": [{text}]}}'
    with pytest.raises(RequestError) as caught:
        parse_client_message(message)
    assert caught.value.code == "malformed_pose"


@bad
def test_a_binary_message_with_it_is_refused_and_names_the_pose(numbers):
    with np.errstate(over="ignore"):
        floats = np.asarray([*HERE, *numbers]).astype("<f4").tobytes()
    with pytest.raises(RequestError) as caught:
        parse_client_message(struct.pack("<BBHI", 2, 0, 0, 1) + floats)
    assert caught.value.code == "malformed_pose"


@bad
def test_a_path_file_with_it_is_refused_and_names_line_and_column(numbers, tmp_path):
    path = tmp_path / "path.csv"
    path.write_text("sample,x,y,z,qx,qy,qz,qw\n0,2,2,1.5,0,0,0,1\n9,2,2,1.5," + ",".join(map(repr, numbers)) + "\n")
    with pytest.raises(PathError, match=r"line 3, column.*q"):
        read_path(path, 24_000)


@bad
def test_a_stream_goes_on_as_before_after_it(measured, field, filters, numbers):
    outputs = []
    for is_disturbed in (False, True):
        listening = Listening(field, filters)
        listening.add()
        listening.hear(3)
        if is_disturbed:
            with np.errstate(over="ignore"):
                floats = np.asarray([*HERE, *numbers]).astype("<f4").tobytes()
            with pytest.raises(RequestError):
                listening.say(parse_client_message(struct.pack("<BBHI", 2, 0, 0, 1) + floats))
        outputs.append(listening.hear(20))
    measured("largest difference", np.abs(outputs[0] - outputs[1]).max(), 0.0)


@given(
    st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 1e-2),
    st.floats(1e-3, 1e9),
)
def test_an_orientation_of_any_length_is_that_of_unit_length(measured, numbers, scale):
    unit, scaled = Quaternion(*numbers), Quaternion(*(scale * n for n in numbers))
    measured("length off", abs(math.hypot(*scaled) - 1), 4e-16)
    measured("largest difference", np.abs(np.subtract(unit, scaled)).max(), 4e-16)


@given(st.tuples(*[st.floats(-1e6, 1e6)] * 4).filter(lambda q: math.hypot(*q) > 1e-5))
def test_the_axes_of_any_head_are_at_right_angles_and_of_unit_length(measured, numbers):
    axes = axes_of(Quaternion(*numbers))
    measured("off a rotation", np.abs(axes @ axes.T - np.eye(3)).max(), 2e-15)
    measured("off one handedness", abs(np.linalg.det(axes) - 1), 2e-15)


@given(st.floats(-1e300, 1e300))
def test_any_finite_yaw_is_a_heading(measured, yaw):
    turned = Quaternion.from_yaw(yaw)
    measured("length off", abs(math.hypot(*turned) - 1), 4e-16)
    heading = Pose(HERE, turned).yaw
    # Of half the angle sine and cosine are taken, so their heading is that of the float halved and doubled again.
    apart = math.remainder(heading - math.atan2(math.sin(yaw), math.cos(yaw)), 2 * math.pi)
    measured("heading off", abs(apart), 4e-15)


@pytest.mark.parametrize("yaw", [math.nan, math.inf, -math.inf])
def test_a_yaw_that_is_no_number_is_refused_by_name(yaw):
    with pytest.raises(ValueError, match="yaw must be a finite number"):
        Pose.from_yaw(HERE, yaw)


@pytest.mark.parametrize("text", ["NaN", "Infinity", "-Infinity", "1e999"])
def test_a_message_whose_yaw_is_no_number_is_refused(text):
    with pytest.raises(RequestError) as caught:
        parse_client_message(f'{{"type": "listener", "pose_id": 1, "position": [2, 2, 1.5], "yaw": {text}}}')
    assert caught.value.code == "malformed_pose"


def test_half_a_turn_from_either_side_is_one_heading(measured):
    one, other = Pose.from_yaw(HERE, math.pi), Pose.from_yaw(HERE, -math.pi)
    measured("off half a turn", abs(abs(one.yaw) - math.pi), 4e-16)
    measured("axes apart", np.abs(axes_of(one.orientation) - axes_of(other.orientation)).max(), 4e-16)


def test_a_pose_keeps_the_orientation_of_another_to_the_bit(measured):
    """A hundred emitters moved a hundred times turn by nothing."""
    turned = Quaternion(-0.83, 0.67, 0.57, -0.52)  # made to have unit length twice, it would be another
    moved = Pose(HERE, turned)
    for step in range(100):
        moved = Pose((2.0 + step / 100, 2.0, 1.5), moved.orientation)
    measured("largest change", np.abs(np.subtract(moved.orientation, turned)).max(), 0.0)


def test_what_is_not_said_is_level():
    assert ListenerPose(pose_id=1, position=HERE).pose.orientation == LEVEL
