"""Directivity against textbook microphone patterns and against Monte Carlo."""

import math

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.acoustics.decibels import db_to_power, power_to_db
from server.acoustics.directivity import (
    CARDIOID,
    FIGURE_OF_EIGHT,
    GAIN_FLOOR_DB,
    HYPERCARDIOID,
    OMNIDIRECTIONAL,
    SUBCARDIOID,
    SUPERCARDIOID,
    Cardioid,
    Directivity,
    PolarPattern,
)

COSINES, WEIGHTS = np.polynomial.legendre.leggauss(200)

# A voice, roughly: it beams more the higher the band.
ANGLES_DEG = (0.0, 20.0, 45.0, 90.0, 135.0, 180.0)
VOICE = PolarPattern(
    ANGLES_DEG,
    tuple(tuple(-depth * (angle / 180) ** 1.5 for angle in ANGLES_DEG) for depth in (2, 4, 7, 10, 14, 18, 24)),
)


def directions(count: int, seed: int = 1) -> npt.NDArray[np.float64]:
    """(count, 3) evenly over the sphere."""
    vectors = np.random.default_rng(seed).standard_normal((count, 3))
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def at_angle(angle_deg: float) -> npt.NDArray[np.float64]:
    """(3,) a direction away from the axis, up and to the side."""
    angle = math.radians(angle_deg)
    return np.array([math.cos(angle), 0.6 * math.sin(angle), 0.8 * math.sin(angle)])


# Gain at 90 and at 180 degrees and the random energy efficiency, as textbooks on microphones print them; for
# the supercardioid at its exact share of 0.366.
@pytest.mark.parametrize(
    ("pattern", "aside_db", "behind_db", "diffuse_db"),
    [
        (OMNIDIRECTIONAL, 0.0, 0.0, 0.0),
        (CARDIOID, -6.0, GAIN_FLOOR_DB, -4.8),
        (SUPERCARDIOID, -8.7, -11.4, -5.7),
        (HYPERCARDIOID, -12.0, -6.0, -6.0),
        (FIGURE_OF_EIGHT, GAIN_FLOOR_DB, 0.0, -4.8),
    ],
)
def test_family_agrees_with_data_sheets(
    pattern: Cardioid, aside_db: float, behind_db: float, diffuse_db: float
) -> None:
    gains = pattern.gain_db([at_angle(0), at_angle(90), at_angle(180)])
    np.testing.assert_allclose(gains, np.repeat([[0.0], [aside_db], [behind_db]], 7, axis=1), atol=0.1)
    np.testing.assert_allclose(pattern.diffuse_gain_db, np.full(7, diffuse_db), atol=0.1)


def test_supercardioid_hears_the_front_most_and_hypercardioid_the_reverberation_least() -> None:
    shares = np.linspace(0, 1, 101)
    points = directions(20_000)
    points = np.concatenate([points, -points])
    ahead = points[:, 0] > 0
    power = np.array([db_to_power(Cardioid(float(share)).gain_db(points)[:, 0]) for share in shares])
    front_to_back = power[:, ahead].mean(axis=1) / power[:, ~ahead].mean(axis=1)
    assert abs(shares[np.argmax(front_to_back)] - SUPERCARDIOID.omni_share) < 0.02
    assert abs(shares[np.argmin(power.mean(axis=1))] - HYPERCARDIOID.omni_share) < 0.02


@pytest.mark.parametrize(
    "pattern",
    [
        OMNIDIRECTIONAL,
        SUBCARDIOID,
        CARDIOID,
        HYPERCARDIOID,
        FIGURE_OF_EIGHT,
        Cardioid(0.4, 3.5),
        Cardioid(0.6, 8),
        VOICE,
    ],
)
def test_diffuse_gain_is_the_mean_power_over_the_sphere(pattern: Directivity) -> None:
    mean = power_to_db(np.mean(db_to_power(pattern.gain_db(directions(200_000))), axis=0))
    np.testing.assert_allclose(pattern.diffuse_gain_db, mean, atol=0.1)


@given(st.floats(0, 1), st.floats(0.01, 32))
def test_diffuse_gain_of_the_family_agrees_with_quadrature(omni_share: float, order: float) -> None:
    power = np.abs(omni_share + (1 - omni_share) * COSINES) ** (2 * order)
    expected = power_to_db(np.sum(WEIGHTS * power) / 2)
    np.testing.assert_allclose(Cardioid(omni_share, order).diffuse_gain_db, expected, atol=0.02)


@given(st.floats(0, 1), st.floats(0.01, 32), st.floats(0, 180))
def test_family_is_loudest_ahead_and_never_below_the_floor(omni_share: float, order: float, angle_deg: float) -> None:
    gain = Cardioid(omni_share, order).gain_db(at_angle(angle_deg))
    assert gain.shape == (7,)
    assert np.all((gain <= 1e-9) & (gain >= GAIN_FLOOR_DB - 1e-9))


def test_higher_orders_multiply_the_pattern() -> None:
    points = directions(50)
    np.testing.assert_allclose(
        Cardioid(0.7, 3).gain_db(points), np.maximum(3 * Cardioid(0.7).gain_db(points), GAIN_FLOOR_DB), atol=1e-9
    )


def test_measured_pattern_goes_through_its_points_and_straight_between_them() -> None:
    measured = np.asarray(VOICE.gains_db)
    on_points = VOICE.gain_db([at_angle(angle) for angle in ANGLES_DEG])
    np.testing.assert_allclose(on_points, measured.T, atol=1e-6)
    angles = np.linspace(0, 180, 91)
    between = VOICE.gain_db([at_angle(angle) for angle in angles])
    np.testing.assert_allclose(
        between, np.stack([np.interp(angles, ANGLES_DEG, row) for row in measured], 1), atol=1e-6
    )


def test_measured_pattern_turns_about_its_axis() -> None:
    point, turned = np.array([0.5, math.sqrt(0.75), 0.0]), np.array([0.5, 0.0, -math.sqrt(0.75)])
    np.testing.assert_allclose(VOICE.gain_db(point), VOICE.gain_db(turned), atol=1e-12)


def test_silence_in_a_measured_pattern_stops_at_the_floor() -> None:
    deep = PolarPattern((0.0, 90.0, 180.0), ((0.0, -500.0, -1e9),) * 7)
    np.testing.assert_allclose(deep.gain_db([at_angle(90), at_angle(180)]), np.full((2, 7), GAIN_FLOOR_DB))


@pytest.mark.parametrize("share", [-0.01, 1.01, math.nan])
def test_share_outside_the_family_is_refused(share: float) -> None:
    with pytest.raises(ValueError, match="omni_share"):
        Cardioid(share)


@pytest.mark.parametrize("order", [0.0, -1.0, 33.0, math.nan])
def test_order_outside_the_family_is_refused(order: float) -> None:
    with pytest.raises(ValueError, match="order"):
        Cardioid(0.5, order)


@pytest.mark.parametrize(
    ("angles_deg", "gains_db"),
    [
        ((0.0,), ((0.0,),) * 7),
        ((0.0, 90.0), ((0.0, 0.0),) * 7),
        ((10.0, 180.0), ((0.0, 0.0),) * 7),
        ((0.0, 90.0, 90.0, 180.0), ((0.0,) * 4,) * 7),
        ((0.0, math.nan, 180.0), ((0.0,) * 3,) * 7),
        ((0.0, 180.0), ((0.0, 0.0),) * 6),
        ((0.0, 180.0), ((0.0, 0.0, 0.0),) * 7),
        ((0.0, 180.0), ((0.0, -math.inf),) * 7),
        ((0.0, 180.0), ((0.0, math.nan),) * 7),
        ((0.0, 180.0), ((0.0, 41.0),) * 7),
    ],
)
def test_tables_that_say_nothing_are_refused(
    angles_deg: tuple[float, ...], gains_db: tuple[tuple[float, ...], ...]
) -> None:
    with pytest.raises(ValueError, match=r"angles|gains"):
        PolarPattern(angles_deg, gains_db)
