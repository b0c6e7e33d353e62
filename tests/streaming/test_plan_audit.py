"""Plans of effects that are checked: what they leave out is heard or not, and what is heard comes back."""

import dataclasses

import pytest

from server.acoustics.geometry import Pose
from server.responses.direct_sound import DirectSound
from server.responses.effect_flags import ALL_ON, EmitterEffects
from server.responses.emitter_state import EmitterState
from server.scene.effects import EffectName
from server.streaming.plan_audit import LIMIT_JND, PERIOD_S, SHARE_OF_ALL, PlanAudit, RegretRecord, interval_s

HERE, THERE = Pose((2.0, 2.0, 1.5)), Pose((3.0, 2.5, 1.5))


@pytest.fixture
def check(mirrored_field, filters):
    direct = DirectSound.of(mirrored_field.bundle, filters)

    def run(effects, *, whole=ALL_ON, channels=2, whole_channels=2):
        emitter = EmitterState(THERE, effects=effects)
        asked = PlanAudit("standard", HERE, emitter, whole, channels, whole_channels, direct)
        return asked, asked.run(mirrored_field)

    return run


def test_a_plan_with_everything_on_regrets_nothing(check):
    asked, regret = check(dataclasses.replace(ALL_ON, propagation_delay=False))
    assert not asked.finds_anything
    assert max(regret.by_parameter.values()) < 1e-6
    assert not regret.is_heard
    assert not regret.corrections


@pytest.mark.parametrize(
    ("part", "name"),
    [
        ("direct_path", EffectName.DIRECT_PATH),
        ("late", EffectName.LATE_REVERBERATION),
    ],
)
def test_what_is_missed_is_found_and_named(check, part, name):
    asked, regret = check(dataclasses.replace(ALL_ON, **{part: False}))
    assert asked.finds_anything
    assert regret.is_heard
    (correction,) = regret.corrections
    assert correction == name
    assert "JND" in regret.corrections[name]


def test_a_head_that_is_missed_is_found(check):
    _, regret = check(ALL_ON, channels=1)
    assert regret.is_heard
    assert list(regret.corrections) == [EffectName.HRTF]


def test_what_was_switched_off_by_hand_is_no_regret(check):
    without = dataclasses.replace(ALL_ON, late=False)
    asked, regret = check(without, whole=without)
    assert not asked.finds_anything
    assert not regret.is_heard


def test_air_over_a_metre_is_not_missed(check):
    asked, regret = check(EmitterEffects(air_absorption=False))
    assert asked.finds_anything
    assert 0 < max(regret.by_parameter.values()) < LIMIT_JND
    assert not regret.corrections


def test_a_record_keeps_the_worst(check):
    record, other = RegretRecord(), RegretRecord()
    _, heard = check(dataclasses.replace(ALL_ON, late=False))
    _, unheard = check(EmitterEffects(air_absorption=False))
    record.add(unheard)
    other.add(heard)
    record.merge(other)
    assert (record.checks, record.failures) == (2, 1)
    for parameter, jnd in heard.by_parameter.items():
        assert record.worst_jnd[parameter] == max(jnd, unheard.by_parameter.get(parameter, 0.0))


@pytest.mark.parametrize("streams", [1, 4, 20, 500])
@pytest.mark.parametrize("cost_s", [0.0, 0.02, 0.2])
def test_checks_of_all_streams_together_take_no_more_than_their_share(streams, cost_s):
    apart_s = interval_s(cost_s, streams=streams)
    assert apart_s >= PERIOD_S
    assert streams * cost_s / apart_s <= SHARE_OF_ALL + 1e-12
    assert cost_s / apart_s <= 0.01 + 1e-12
