"""Poses and floor plans, against hand-drawn answers and laws of distance."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse.csgraph import shortest_path

from server.acoustics.geometry import FloorPlan, Pose, Quaternion, axes_of, yaws_of

APARTMENT = FloorPlan(
    ((0, 0), (4, 0), (4, 2), (4.2, 2), (4.2, 0), (8, 0), (8, 5), (4.2, 5), (4.2, 3), (4, 3), (4, 5), (0, 5)), 2.8
)
point = st.tuples(st.floats(0.1, 7.9), st.floats(0.1, 4.9), st.floats(0.1, 2.7)).filter(
    lambda p: bool(APARTMENT.contains(np.array(p)))
)


@given(
    st.one_of(st.floats(-1, 9), st.sampled_from([0, 4, 4.2, 8])),
    st.one_of(st.floats(-1, 6), st.sampled_from([0, 2, 3, 5])),
    st.one_of(st.floats(-1, 4), st.sampled_from([0, 2.8, math.nan])),
)
def test_one_point_is_held_where_many_are_contained(x: float, y: float, z: float) -> None:
    assert APARTMENT.holds((x, y, z)) == APARTMENT.contains(np.array((x, y, z)))


@given(st.floats(-3.1, 3.1))
def test_yaw_survives_the_quaternion(yaw: float) -> None:
    assert math.isclose(Pose.from_yaw((0, 0, 0), yaw).yaw, yaw, abs_tol=1e-9)


@pytest.mark.parametrize("orientation", [(0, 0, 0, 0), (math.nan, 0, 0, 1), (1e-9, 0, 0, 0)])
def test_orientation_without_a_direction_is_rejected(orientation: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="orientation"):
        Pose((0, 0, 0), orientation)  # type: ignore[arg-type]


def test_non_finite_position_is_rejected() -> None:
    with pytest.raises(ValueError, match="position"):
        Pose((math.inf, 0, 0))


def ahead_left_up(orientation: Quaternion) -> np.ndarray:
    """(3, 3) the axes of a head as rows in world axes."""
    return axes_of(orientation)


def test_yaw_pitch_and_roll_turn_each_about_the_heads_own_axes() -> None:
    quarter = math.pi / 2
    x, y, z = np.eye(3)
    # Nose up: what was ahead is now below the look direction, and the top of the head points back.
    np.testing.assert_allclose(ahead_left_up(Quaternion.from_angles(0, quarter, 0)), [z, y, -x], atol=1e-12)
    # Rolled to the right: the left ear points up.
    np.testing.assert_allclose(ahead_left_up(Quaternion.from_angles(0, 0, quarter)), [x, z, -y], atol=1e-12)
    np.testing.assert_allclose(ahead_left_up(Quaternion.from_angles(quarter, 0, 0)), [y, -x, z], atol=1e-12)
    # To the north, then up, then rolled: the left ear, which pointed west, points south after the roll.
    np.testing.assert_allclose(ahead_left_up(Quaternion.from_angles(quarter, quarter, 0)), [z, -x, -y], atol=1e-12)
    np.testing.assert_allclose(ahead_left_up(Quaternion.from_angles(quarter, quarter, quarter)), [z, -y, x], atol=1e-12)


@given(*[st.floats(-math.pi, math.pi)] * 3)
def test_angles_are_three_turns_one_after_another(yaw: float, pitch: float, roll: float) -> None:
    def about(axis: int, angle: float) -> np.ndarray:
        first, second = (axis + 1) % 3, (axis + 2) % 3
        matrix = np.eye(3)
        matrix[first, first] = matrix[second, second] = math.cos(angle)
        matrix[second, first], matrix[first, second] = math.sin(angle), -math.sin(angle)
        return matrix

    expected = about(2, yaw) @ about(1, -pitch) @ about(0, roll)
    np.testing.assert_allclose(ahead_left_up(Quaternion.from_angles(yaw, pitch, roll)).T, expected, atol=1e-12)


def test_a_level_head_by_angles_is_one_by_its_yaw() -> None:
    for yaw in (0.0, 1.0, -2.5, math.pi):
        assert Quaternion.from_angles(yaw, 0.0, 0.0) == Quaternion.from_yaw(yaw)
    for angles in ((math.nan, 0, 0), (0, math.inf, 0), (0, 0, -math.inf)):
        with pytest.raises(ValueError, match="finite"):
            Quaternion.from_angles(*angles)


def test_long_quaternion_is_normalised() -> None:
    assert math.isclose(Pose((0, 0, 0), (0, 0, 5, 5)).yaw, math.pi / 2)


def test_rooms_and_doorway_are_inside_walls_are_not() -> None:
    z = 1.5
    inside = np.array([(1, 1, z), (7, 4, z), (4.1, 2.5, z), (0, 0, z), (4.0, 2.5, z)])
    outside = np.array([(4.1, 1, z), (4.1, 4, z), (-0.01, 1, z), (9, 2, z), (1, 1, 2.9), (1, 1, -0.1)])
    assert APARTMENT.contains(inside).all()
    assert not APARTMENT.contains(outside).any()


def test_area_is_the_rectangle_less_the_wall() -> None:
    assert math.isclose(APARTMENT.area_m2, 8 * 5 - 0.2 * 4)


def test_sight_passes_the_doorway_and_not_the_wall() -> None:
    a = np.array((2, 2.5, 1.5))
    assert APARTMENT.is_visible(a, np.array((6, 2.5, 1.5)))
    assert not APARTMENT.is_visible(np.array((2, 1, 1.5)), np.array((6, 1, 1.5)))


def test_path_round_one_corner_is_two_straight_legs() -> None:
    a, b = np.array((3.0, 1.0, 1.5)), np.array((4.1, 2.05, 1.5))
    expected = math.hypot(1, 1) + math.hypot(0.1, 0.05)
    assert not APARTMENT.is_visible(a, b)
    assert math.isclose(APARTMENT.path_length_m(a, b), expected)


def test_path_round_two_corners_goes_through_the_doorway() -> None:
    a, b = np.array((3.0, 1.0, 1.5)), np.array((5.2, 1.0, 1.5))
    assert math.isclose(APARTMENT.path_length_m(a, b), math.sqrt(2) + 0.2 + math.sqrt(2))


@given(point, point)
def test_path_is_symmetric_and_no_shorter_than_the_straight_line(a: tuple[float, ...], b: tuple[float, ...]) -> None:
    there, back = APARTMENT.path_length_m(np.array(a), np.array(b)), APARTMENT.path_length_m(np.array(b), np.array(a))
    assert math.isclose(there, back, rel_tol=1e-12)
    assert there >= math.dist(a, b) - 1e-9
    assert math.isfinite(there)


@given(point, point, point)
def test_path_obeys_the_triangle_inequality_in_plan(
    a: tuple[float, ...], b: tuple[float, ...], c: tuple[float, ...]
) -> None:
    level = [np.array((p[0], p[1], 1.5)) for p in (a, b, c)]
    length = APARTMENT.path_length_m
    assert length(level[0], level[2]) <= length(level[0], level[1]) + length(level[1], level[2]) + 1e-6


@pytest.mark.parametrize("corners", range(3, 12))
def test_lengths_round_corners_are_scipys_to_the_bit(corners: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a plan whose corners see each other by chance."""
    rng = np.random.default_rng(corners)
    bends = rng.uniform(0, 10, (corners, 2))
    sees = rng.uniform(size=(corners, corners)) < 0.4
    monkeypatch.setattr(FloorPlan, "bend_corners", bends)
    monkeypatch.setattr(FloorPlan, "is_visible", lambda *_: sees | np.eye(corners, dtype=bool))
    direct = np.where(sees, np.linalg.norm(bends[:, None] - bends[None], axis=-1), np.inf)
    plan = FloorPlan(((0, 0), (1, 0), (0, 1)), 2.5)
    np.testing.assert_array_equal(plan.bend_lengths_m, shortest_path(direct, method="D", directed=False))


@given(st.floats(-3.1, 3.1), st.floats(-3.1, 3.1), st.floats(-3.1, 3.1))
def test_a_heading_is_that_of_the_nose_in_plan(yaw, pitch, roll):
    """Beyond the zenith the nose points backwards, and so does the heading. Only straight up and down there is none."""
    head = Quaternion.from_angles(yaw, pitch, roll)
    x, y, _ = axes_of(head)[0]
    if math.hypot(x, y) > 1e-3:
        away = yaws_of([head])[0] - math.atan2(y, x)
        assert abs(math.remainder(away, 2 * math.pi)) < 1e-6
        backwards = math.pi if math.cos(pitch) < 0 else 0.0
        assert abs(math.remainder(yaws_of([head])[0] - yaw - backwards, 2 * math.pi)) < 1e-6
