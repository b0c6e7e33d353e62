"""The mass law against the impedance of a limp panel, an integral over angles of incidence, and measured walls."""

import numpy as np
import pytest
from scipy.integrate import quad

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.geometry import FloorPlan
from server.acoustics.reflections import ReflectionFinder
from server.acoustics.transmission import (
    AIR_IMPEDANCE,
    PlanWallLosses,
    TransmittedPaths,
    normal_incidence_loss_db,
    transmission_loss_db,
    walls_between,
)

# Two rooms and the wall between them, which ends at a passage in the north.
PLAN = FloorPlan(((0, 0), (3, 0), (3, 4), (3.2, 4), (3.2, 0), (7, 0), (7, 5), (0, 5)), 2.5)


def transmitted(mass, frequency, angle):
    """Energy share through a panel of impedance i omega m between two half spaces of air."""
    return 1 / abs(1 + 1j * 2 * np.pi * frequency * mass * np.cos(angle) / (2 * AIR_IMPEDANCE)) ** 2


@pytest.mark.parametrize("mass", [0.0, 0.3, 10.0, 60.0, 400.0])
@pytest.mark.parametrize("frequency", [125.0, 1000.0, 8000.0])
def test_straight_on_it_is_what_a_limp_panel_lets_through(mass, frequency):
    expected = -10 * np.log10(transmitted(mass, frequency, 0.0))
    assert normal_incidence_loss_db(mass, frequency) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("mass", [20.0, 60.0, 200.0])
@pytest.mark.parametrize("frequency", [250.0, 1000.0, 4000.0])
def test_field_incidence_is_the_mean_over_angles_up_to_78_degrees(mass, frequency):
    limit = np.radians(78)
    share, _ = quad(lambda angle: transmitted(mass, frequency, angle) * np.sin(2 * angle), 0, limit)
    expected = -10 * np.log10(share / np.sin(limit) ** 2)
    # The rule's 5.5 dB are rounded: the integral loses 4.6 to 5.6 dB.
    assert transmission_loss_db(mass, frequency) == pytest.approx(expected, abs=1.0)


def test_six_db_with_every_octave_and_with_every_doubling_of_the_mass():
    loss = transmission_loss_db(100.0, OCTAVE_BANDS_HZ)
    np.testing.assert_allclose(np.diff(loss), 20 * np.log10(2), atol=0.01)
    np.testing.assert_allclose(transmission_loss_db(200.0, OCTAVE_BANDS_HZ) - loss, 20 * np.log10(2), atol=0.01)


def test_nothing_is_gained_from_a_wall_of_no_mass():
    np.testing.assert_array_equal(transmission_loss_db(0.0, OCTAVE_BANDS_HZ), 0.0)


@pytest.mark.parametrize("mass", [-1.0, np.nan, np.inf])
def test_a_mass_that_cannot_be_is_refused(mass):
    with pytest.raises(ValueError, match="surface mass"):
        transmission_loss_db(mass, 500.0)


def test_a_line_goes_through_as_many_walls_as_stand_on_it():
    here = np.array([[1.0, 1.0, 1.2], [1.0, 4.5, 1.2], [1.0, 1.0, 1.2], [1.0, 3.5, 1.2]])
    there = np.array([[6.0, 2.0, 1.8], [6.0, 4.6, 1.2], [2.0, 4.0, 1.2], [6.0, 4.9, 1.2]])
    np.testing.assert_array_equal(walls_between(PLAN, here, there), [1, 0, 0, 0])
    np.testing.assert_array_equal(walls_between(PLAN, there, here), [1, 0, 0, 0])


def test_points_in_sight_have_no_wall_between_them():
    rng = np.random.default_rng(0)
    a, b = (rng.uniform((0, 0, 0.1), (7, 5, 2.4), (4000, 3)) for _ in range(2))
    inside = PLAN.contains(a) & PLAN.contains(b)
    np.testing.assert_array_equal((walls_between(PLAN, a, b) == 0)[inside], PLAN.is_visible(a, b)[inside])


def test_paths_through_walls_join_those_of_a_finder_emitter_by_emitter():
    listener, loss_db = np.array([1.0, 1.0, 1.2]), transmission_loss_db(20.0, OCTAVE_BANDS_HZ)
    emitters = np.array([[2.0, 3.0, 1.5], [6.0, 2.0, 1.8], [1.5, 4.5, 1.0], [6.5, 1.0, 1.2]])
    finder = ReflectionFinder(PLAN, np.full((3, len(OCTAVE_BANDS_HZ)), -3.0))
    mirrored = finder.find(listener, emitters)
    found = TransmittedPaths(finder, PlanWallLosses(PLAN, loss_db)).find(listener, emitters)
    np.testing.assert_array_equal(found.emitter, np.sort(found.emitter))
    for number, emitter in enumerate(emitters):
        before, after = np.flatnonzero(mirrored.emitter == number), np.flatnonzero(found.emitter == number)
        is_hidden = not PLAN.is_visible(listener, emitter)
        assert len(after) == len(before) + is_hidden
        if is_hidden:
            through = after[-1]
            distance = np.linalg.norm(emitter - listener)
            assert found.length_m[through] == pytest.approx(distance)
            np.testing.assert_allclose(found.arrival[through] * distance, emitter - listener, atol=1e-12)
            np.testing.assert_array_equal(found.departure[through], -found.arrival[through])
            np.testing.assert_allclose(found.gain_db[through], -loss_db)
            after = after[:-1]
        for name in ("length_m", "arrival", "departure", "gain_db"):
            np.testing.assert_array_equal(getattr(found, name)[after], getattr(mirrored, name)[before])
