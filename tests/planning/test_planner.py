import json
import time
from dataclasses import replace

import numpy as np
import pytest

from server.acoustics.air import absorption_db_per_m
from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.directivity import CARDIOID
from server.acoustics.geometry import FloorPlan, Pose
from server.acoustics.surroundings import PlanSurroundings
from server.core.errors import RequestError
from server.planning.catalogue import CATALOGUE
from server.planning.cost import Cost
from server.planning.planner import THRESHOLD, make_plan
from server.planning.scene_acoustics import Emitter, Listener, Reverberation, SceneAcoustics, Situation
from server.scene.effects import EffectName, read_overrides
from server.scene.geometry import Material

BANDS = len(OCTAVE_BANDS_HZ)
AIR = absorption_db_per_m(OCTAVE_BANDS_HZ)
PLASTER = Material(absorption=(0.2,) * BANDS, scattering=(0.1,) * BANDS)
BOX = FloorPlan(((0, 0), (6, 0), (6, 5), (0, 5)), 2.8)
ELL = FloorPlan(((0, 0), (8, 0), (8, 3), (3, 3), (3, 8), (0, 8)), 2.8)
LIVELY = Reverberation(np.full(BANDS, 0.2), early=0.6, t60_s=np.full(BANDS, 0.6), late_iacc=0.15, turn_db=1.5)

OPEN = SceneAcoustics(
    minimum=(-500.0, -500.0, 0.0),
    maximum=(500.0, 500.0, 50.0),
    sample_rate=48_000,
    speed_of_sound=343.0,
    air_db_per_m=AIR,
    nearest_m=0.25,
)
ROOM = replace(
    OPEN,
    minimum=(0.2, 0.2, 0.5),
    maximum=(5.8, 4.8, 2.0),
    surroundings=PlanSurroundings(BOX),
    surfaces=(PLASTER, PLASTER, PLASTER),
    reverberation=LIVELY,
)
DRY = replace(LIVELY, energy=np.full(BANDS, 0.01))
CORNER = replace(ROOM, surroundings=PlanSurroundings(ELL), maximum=(7.8, 7.8, 2.0), reverberation=DRY)


def at(x: float, y: float = 1.0, **more) -> Emitter:
    return Emitter(Pose((x, y, 1.5)), **more)


def situation(place: SceneAcoustics, *emitters: Emitter, **listener) -> Situation:
    return Situation(
        place,
        Listener(Pose(listener.pop("stands", (1.0, 1.0, 1.5))), **listener),
        {str(number): emitter for number, emitter in enumerate(emitters)},
    )


def on(plan, emitter: str = "0") -> set[EffectName]:
    return {name for name in EffectName if plan.is_on(name, emitter)}


def test_the_open_field_calls_for_the_direct_sound_at_its_distance_through_a_head():
    plan = make_plan(situation(OPEN, at(4)))
    assert on(plan) == {EffectName.DIRECT_PATH, EffectName.DISTANCE_ATTENUATION, EffectName.HRTF}


def test_one_loudspeaker_needs_no_head():
    plan = make_plan(situation(ROOM, at(4), output="mono", turns=True))
    assert not on(plan) & {EffectName.HRTF, EffectName.HEAD_ROTATION}


def test_a_reverberant_room_calls_for_reflections_and_reverberation():
    assert {EffectName.EARLY_REFLECTIONS, EffectName.LATE_REVERBERATION} <= on(make_plan(situation(ROOM, at(4))))


def test_bands_above_half_the_sample_rate_call_for_nothing():
    """Air that takes a decibel a metre at 8 kHz, and at lower frequencies nothing."""
    thick = replace(OPEN, air_db_per_m=np.array([0.0] * 6 + [1.0]))
    plans = [make_plan(situation(replace(thick, sample_rate=rate), at(4))) for rate in (48_000, 11_025, 8_000)]
    assert [plan.is_on(EffectName.AIR_ABSORPTION) for plan in plans] == [True, False, False]


def test_air_is_called_for_from_the_distance_where_it_takes_a_decibel_at_8_khz():
    limit_m = 1.0 / AIR[-1]
    for share, is_on in ((0.9, False), (1.1, True)):
        plan = make_plan(situation(OPEN, at(1 + share * limit_m)))
        assert plan.is_on(EffectName.AIR_ABSORPTION, "0") is is_on
        assert plan.about(EffectName.AIR_ABSORPTION, "0")[0].change_jnd == pytest.approx(share, rel=1e-6)


def test_whoever_may_walk_away_hears_air_from_nearer_by():
    near = at(1 + 0.9 / AIR[-1])
    assert not make_plan(situation(OPEN, near)).is_on(EffectName.AIR_ABSORPTION)
    assert make_plan(situation(OPEN, near, speed_m_s=1.4)).is_on(EffectName.AIR_ABSORPTION)


def test_distance_at_one_metre_takes_nothing():
    assert not make_plan(situation(OPEN, at(2))).is_on(EffectName.DISTANCE_ATTENUATION)
    assert make_plan(situation(OPEN, at(2.2))).is_on(EffectName.DISTANCE_ATTENUATION)


def test_a_delay_follows_what_moves_or_turns():
    still = make_plan(situation(OPEN, at(4)))
    assert not still.is_on(EffectName.PROPAGATION_DELAY)
    walking = make_plan(situation(OPEN, at(4, speed_m_s=1.4), at(5)))
    assert walking.is_on(EffectName.PROPAGATION_DELAY, "0")
    assert not walking.is_on(EffectName.PROPAGATION_DELAY, "1")
    assert make_plan(situation(OPEN, at(4), turns=True)).is_on(EffectName.PROPAGATION_DELAY)
    assert not make_plan(situation(OPEN, at(4), turns=True, output="mono")).is_on(EffectName.PROPAGATION_DELAY)


def test_doppler_is_the_speed_over_that_of_sound():
    plan = make_plan(situation(replace(OPEN, maximum=(4.0, 1.0, 2.0), minimum=(4.0, 1.0, 0.0)), at(4, speed_m_s=0.5)))
    (decision,) = plan.about(EffectName.PROPAGATION_DELAY, "0")
    assert (decision.parameter, decision.change_jnd) == ("pitch", pytest.approx(100 * 0.5 / 343 / 0.2))


def test_nothing_stands_in_the_way_in_a_convex_room():
    plan = make_plan(situation(ROOM, at(5, 4), speed_m_s=1.4))
    assert not on(plan) & {EffectName.OCCLUSION, EffectName.DIFFRACTION}
    assert "convex" in plan.about(EffectName.OCCLUSION, "0")[0].reason


def test_a_wall_between_is_called_for_and_so_is_one_within_reach():
    hidden, seen = at(2.8, 4.5), at(2, 2)
    behind = make_plan(situation(CORNER, hidden, stands=(4, 2.8, 1.5)))
    assert {EffectName.OCCLUSION, EffectName.DIFFRACTION} <= on(behind)
    assert not make_plan(situation(CORNER, seen, stands=(1.5, 1, 1.5))).is_on(EffectName.OCCLUSION)
    assert make_plan(situation(CORNER, at(1.5, 4), stands=(2, 2, 1.5), speed_m_s=1.4)).is_on(EffectName.OCCLUSION)


def test_through_a_light_wall_sound_is_heard_with_the_first_reflections():
    """Out of sight, where no wall mirrors from one to the other."""
    dead = Material(absorption=(0.999,) * BANDS, scattering=(0.9,) * BANDS)
    hidden = {"emitter": at(1.0, 7.0), "stands": (7.0, 1.0, 1.5)}

    def change(mass: float, *, transmits: bool) -> float:
        walls = dead.model_copy(update={"surface_mass_kg_m2": mass})
        place = replace(CORNER, surfaces=(walls, dead, dead), transmits=transmits, reverberation=DRY)
        plan = make_plan(situation(place, hidden["emitter"], stands=hidden["stands"]))
        return plan.about(EffectName.EARLY_REFLECTIONS, "0")[0].change_jnd

    assert change(0.5, transmits=True) > 1
    assert change(0.5, transmits=False) < 0.1
    assert change(500.0, transmits=True) < change(0.5, transmits=True) / 3


def test_deep_in_the_shadow_there_is_no_direct_sound_to_compute():
    lively = replace(CORNER, reverberation=replace(LIVELY, energy=np.full(BANDS, 2.0)))
    assert EffectName.DIRECT_PATH not in on(make_plan(situation(lively, at(1.5, 7.5), stands=(7.5, 1.5, 1.5))))


def test_what_beams_is_called_for_where_it_is_not_heard_from_ahead():
    aside = at(4, pattern=CARDIOID)
    assert not make_plan(situation(OPEN, at(4))).is_on(EffectName.DIRECTIVITY)
    assert make_plan(situation(OPEN, aside)).is_on(EffectName.DIRECTIVITY)
    towards = replace(aside, pose=Pose.from_yaw((4.0, 1.0, 1.5), np.pi))
    assert not make_plan(situation(OPEN, towards)).is_on(EffectName.DIRECTIVITY)
    assert make_plan(situation(OPEN, replace(towards, turns=True))).is_on(EffectName.DIRECTIVITY)


def test_tails_are_shared_where_their_decays_are_alike():
    place = replace(ROOM, tail_start_s=0.1)
    alike = [at(2, reverberation=LIVELY), at(4, reverberation=replace(LIVELY, t60_s=1.02 * LIVELY.t60_s))]
    assert not make_plan(situation(place, *alike)).is_on(EffectName.PER_SOURCE_TAIL)
    other = at(4, reverberation=replace(LIVELY, t60_s=1.5 * LIVELY.t60_s))
    assert make_plan(situation(place, alike[0], other)).is_on(EffectName.PER_SOURCE_TAIL)
    # A tail from 35 dB down on is no part of the reverberation time.
    late = replace(place, tail_start_s=0.6 * 1.5 * 35 / 60)
    assert not make_plan(situation(late, alike[0], other)).is_on(EffectName.PER_SOURCE_TAIL)
    assert make_plan(situation(place, at(2), at(4))).is_on(EffectName.PER_SOURCE_TAIL)
    known = replace(place, reverberations=(LIVELY, alike[1].reverberation))
    assert not make_plan(situation(known, at(2), at(4))).is_on(EffectName.PER_SOURCE_TAIL)
    known = replace(place, reverberations=(LIVELY, other.reverberation))
    assert make_plan(situation(known, at(2), at(4))).is_on(EffectName.PER_SOURCE_TAIL)


def test_responses_turn_with_the_head_only_where_it_turns():
    assert not make_plan(situation(ROOM, at(4))).is_on(EffectName.HEAD_ROTATION)
    assert make_plan(situation(ROOM, at(4), turns=True)).is_on(EffectName.HEAD_ROTATION)
    assert not make_plan(situation(OPEN, at(4), turns=True)).is_on(EffectName.HEAD_ROTATION)


def test_a_bus_turns_reflected_sound_by_itself_and_direct_sound_follows():
    ears, bus = (make_plan(situation(ROOM, at(4), turns=True, bus=order)) for order in (None, 1))
    assert on(ears) - on(bus) == {EffectName.HEAD_ROTATION}
    (decision,) = bus.about(EffectName.HEAD_ROTATION)
    assert "without new responses" in decision.reason
    assert decision.change_jnd == 0


@pytest.mark.parametrize("output", ["mono", "ambisonics"])
def test_where_no_head_is_rendered_turns_change_no_decision_and_cost_nothing(output):
    costs = {name: Cost(1.0, turning_us=1000.0, turning_first_us=1000.0) for name in EffectName}
    turned, still = (
        make_plan(situation(ROOM, at(4), output=output, turns=turns), costs=costs) for turns in (True, False)
    )
    switched, cost_us = [
        [[getattr(each, name) for each in plan.decisions] for plan in (turned, still)]
        for name in ("called_for", "cost_us")
    ]
    assert switched[0] == switched[1]
    assert cost_us[0] == cost_us[1]


def test_a_direct_sound_buried_in_reverberation_is_not_called_for_nor_anything_about_it():
    drowned = replace(ROOM, reverberation=replace(LIVELY, energy=np.full(BANDS, 1000.0)))
    plan = make_plan(situation(drowned, at(5, 4, speed_m_s=1.0)))
    effects = on(plan)
    assert EffectName.DIRECT_PATH not in effects
    assert not effects & {EffectName.DISTANCE_ATTENUATION, EffectName.PROPAGATION_DELAY}
    assert plan.about(EffectName.PROPAGATION_DELAY, "0")[0].reason == "there is no direct sound"


def test_where_the_field_holds_the_direct_sound_nothing_is_computed_of_it():
    measured = replace(ROOM, surroundings=None, surfaces=None, holds_direct_sound=True)
    assert on(make_plan(situation(measured, at(4, speed_m_s=1), turns=True))) == {
        EffectName.LATE_REVERBERATION,
        EffectName.HRTF,
        EffectName.HEAD_ROTATION,
    }


def test_inaudible_alone_but_audible_together_is_on():
    """Air and a pattern that each take 0.8 dB at 8 kHz take 1.6 dB together."""
    narrow = at(1 + 0.8 / AIR[-1], pattern=replace(CARDIOID, omni_share=1 - (1 - 10 ** (-0.8 / 20)) / 2))
    plan = make_plan(situation(OPEN, replace(narrow, pose=Pose(narrow.pose.position))))
    effects = {EffectName.AIR_ABSORPTION, EffectName.DIRECTIVITY}
    alone = [make_plan(situation(OPEN, replace(narrow, pattern=at(0).pattern)))]
    assert not alone[0].is_on(EffectName.AIR_ABSORPTION)
    assert len(on(plan) & effects) == 1
    (decision,) = [each for each in plan.decisions if each.name in effects and each.called_for]
    assert "air absorption" in decision.reason
    assert decision.change_jnd > THRESHOLD.enter_jnd


def test_decisions_do_not_flutter_about_a_threshold():
    def plan(share: float, previous=None):
        return make_plan(situation(OPEN, at(1 + share / AIR[-1])), previous=previous)

    on_before, off_before = plan(1.1), plan(0.5)
    assert plan(0.8, on_before).is_on(EffectName.AIR_ABSORPTION)
    assert not plan(0.8, off_before).is_on(EffectName.AIR_ABSORPTION)
    assert not plan(0.6, on_before).is_on(EffectName.AIR_ABSORPTION)


def test_overrides_win_and_say_what_was_predicted():
    overrides = read_overrides({"air_absorption": True, "late_reverberation": False})
    plan = make_plan(situation(ROOM, at(4)), overrides=overrides)
    assert plan.is_on(EffectName.AIR_ABSORPTION)
    assert not plan.is_on(EffectName.LATE_REVERBERATION)
    (decision,) = plan.about(EffectName.LATE_REVERBERATION, "0")
    assert decision.overridden
    assert decision.change_jnd > 1
    assert decision.reason.startswith("switched off on demand; without it")


def test_an_effect_nobody_knows_is_named():
    with pytest.raises(RequestError, match=r"no effect 'echo'.*late_reverberation"):
        read_overrides({"echo": True})


def test_costs_are_counted_where_they_fall():
    costs = {
        EffectName.HRTF: Cost(2.0, 10),
        EffectName.DIRECT_PATH: Cost(3.0, 20),
        EffectName.AIR_ABSORPTION: Cost(1.0, 5),
    }
    plan = make_plan(situation(OPEN, at(3), at(4)), costs=costs)
    assert plan.cost_us == 2 * 2.0 + 2 * 3.0
    assert plan.saved_us == 2 * 1.0
    assert plan.about(EffectName.HRTF)[0].memory_bytes == 20


def test_what_it_costs_that_there_is_any_is_shared_by_all():
    costs = {EffectName.HRTF: Cost(2.0, 0, first_us=10.0, moving_us=5.0, moving_first_us=1.0, turning_us=3.0)}

    def cost_us(count: int, **listener) -> float | None:
        (decision,) = make_plan(situation(OPEN, *[at(3)] * count, **listener), costs=costs).about(EffectName.HRTF)
        return decision.cost_us

    assert cost_us(1) == 12
    assert cost_us(4) == pytest.approx(4 * 2 + 10)
    assert cost_us(4, turns=True) == pytest.approx(4 * (2 + 3) + 10)
    assert cost_us(4, speed_m_s=1.0, turns=True) == pytest.approx(4 * (2 + 5) + 11)


def test_the_same_situation_has_the_same_plan_and_json_holds_it():
    asked = situation(CORNER, at(1.5, 7, pattern=CARDIOID), stands=(7, 1.5, 1.5), speed_m_s=1.4, turns=True)
    assert make_plan(asked) == make_plan(asked)
    document = json.loads(json.dumps(make_plan(asked).to_json(), allow_nan=False))
    assert len(document["decisions"]) == len(CATALOGUE)
    assert all(np.isfinite(decision["change_jnd"]) and decision["reason"] for decision in document["decisions"])


def test_without_emitters_there_is_nothing_to_plan():
    assert not list(make_plan(situation(ROOM)).decisions)


def test_a_listener_inside_an_emitter_is_planned_for():
    plan = make_plan(situation(CORNER, at(1.0, 1.0, pattern=CARDIOID), turns=True, speed_m_s=1.4))
    assert all(np.isfinite(decision.change_jnd) for decision in plan.decisions)


def test_a_plan_takes_little_time():
    asked = situation(CORNER, at(1.5, 7), stands=(7, 1.5, 1.5))
    times_s = []
    for _ in range(30):
        started_s = time.thread_time()
        make_plan(asked)
        times_s.append(time.thread_time() - started_s)
    assert min(times_s) < 0.005
