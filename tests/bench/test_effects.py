"""Plans prove themselves in six situations, in both directions: what is off is not missed, and what is on would be."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from server.acoustics.geometry import Pose
from server.bench.effects import SCENARIOS, change_without, errors_of, everything, heard, plan_of, situation_of, without
from server.bench.effects_table import markdown_table, terminal_rows
from server.bench.statistical_field import SAMPLE_RATE, Room, StatisticalField, box
from server.planning.places import reverberation_of
from server.scene.effects import EffectName

*FEW, HALL = SCENARIOS
FOUR = replace(HALL, name="four emitters in a hall", emitters=HALL.emitters[::5])
SITUATIONS = pytest.mark.parametrize(
    "scenario", [*FEW, FOUR, pytest.param(HALL, marks=pytest.mark.long)], ids=lambda scenario: scenario.name
)


@cache
def measured(scenario):
    return errors_of(scenario, plan_of(scenario))


@SITUATIONS
def test_nobody_hears_what_the_plan_leaves_out(scenario):
    errors = measured(scenario)
    assert max(errors["errors_jnd"].values()) < 1
    assert {"level", "spectrum", "drr", "c50", "ild"} <= set(errors["errors_jnd"])


@SITUATIONS
def test_whatever_is_on_would_be_missed(scenario):
    """Even of all effects that are on the one that matters least."""
    assert measured(scenario)["least_jnd"] > 1, measured(scenario)["least_of"]
    assert len(measured(scenario)["on"]) > 0


@SITUATIONS
def test_whatever_is_off_would_not_be_missed_alone(scenario):
    whole = plan_of(scenario, everything())
    plan, reference = plan_of(scenario), heard(scenario, whole)
    for name in EffectName:
        if not plan.is_on(name):
            assert change_without(scenario, whole, name, reference) < 1, name


def test_predictions_are_near_what_is_rendered():
    """Air and distance to a tenth of a JND in the open, where nothing else sounds."""
    scenario = SCENARIOS[0]
    whole = plan_of(scenario, everything())
    reference = heard(scenario, whole)
    for name in (EffectName.AIR_ABSORPTION, EffectName.DISTANCE_ATTENUATION):
        predicted = plan_of(scenario).about(name)[0].change_jnd
        assert change_without(scenario, whole, name, reference) == pytest.approx(predicted, abs=0.1)


def test_what_is_left_out_is_not_in_the_response():
    scenario = SCENARIOS[2]
    whole = plan_of(scenario, everything())
    full = heard(scenario, whole)
    rest = heard(scenario, without(whole, EffectName.DIRECT_PATH))
    arrival = round(scenario.field().onset_s([scenario.listener], scenario.emitters)[0] * SAMPLE_RATE)
    assert np.abs(full[..., : arrival + 24]).max() > 0.1
    assert np.abs(rest[..., : arrival - 2]).max() < 1e-3


def test_the_hall_shares_one_tail_and_the_room_has_no_direct_paths_to_follow():
    hall, room = plan_of(SCENARIOS[5]), plan_of(SCENARIOS[2])
    assert not hall.is_on(EffectName.PER_SOURCE_TAIL)
    assert not room.is_on(EffectName.PROPAGATION_DELAY)


def test_a_statistical_field_has_the_energy_and_the_decay_that_theory_expects():
    size_m = (8.0, 6.0, 3.0)
    room = Room((0.0, 0.0), size_m, 0.25)
    field = StatisticalField("theory", (room,), box((0.0, 0.0), size_m))
    (found,) = reverberation_of(field, Pose((2.0, 2.0, 1.5)), [(5.0, 4.0, 1.5)])
    surface_m2 = 2 * (48 + 24 + 18)
    # All reflected sound is 16 pi (1 - a) / (a S); mirrored once is a of it, and nine tenths of that are computed.
    expected = 16 * np.pi * 0.75 / (0.25 * surface_m2) * (1 - 0.9 * 0.25)
    assert np.mean(found.energy) == pytest.approx(expected, rel=0.1)
    eyring_s = 0.161 * np.prod(size_m) / (-surface_m2 * np.log(0.75))
    assert np.median(found.t60_s) == pytest.approx(eyring_s, rel=0.1)
    assert found.late_iacc < 0.3


def test_next_door_it_is_as_quiet_as_the_doorway_has_it():
    two = SCENARIOS[3].field()
    here, there = (2.0, 1.5, 1.5), (6.0, 1.5, 1.5)
    (same,) = reverberation_of(two, Pose(here), [(3.0, 2.5, 1.5)])
    (other,) = reverberation_of(two, Pose(here), [there])
    absorption_m2, doorway_m2 = 0.3 * 2 * (16 + 10.4 + 10.4), 0.9 * 2.6
    expected = doorway_m2 / (absorption_m2 + doorway_m2)
    assert np.mean(other.energy) / np.mean(same.energy) == pytest.approx(expected, rel=0.05)


def test_situations_are_those_that_sessions_would_tell():
    situation = situation_of(SCENARIOS[4])
    assert situation.emitters["0"].speed_m_s == 10
    assert not situation.listener.turns


def test_the_table_tells_what_was_measured():
    row = {
        "situation": "a place",
        "on": ["head", "air absorption"],
        "plan_us": 12.4,
        "all_us": 30.0,
        "none_us": 3.0,
        "ratio": 1.04,
        "error_jnd": 0.5,
        "error_in": "drr",
        "least_jnd": 2.25,
        "least_of": "head",
    }
    *_, line = markdown_table([row]).splitlines()
    assert line == "| a place | head, air absorption | 12 | 30 | 3 | 1.04 | 0.50 (drr) | 2.2 (head) |"
    assert terminal_rows([row])[0]["on"] == "2/12"
