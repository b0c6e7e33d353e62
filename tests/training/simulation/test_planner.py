"""Plans follow from the scene alone; each effect is called for where theory says that it is heard."""

import json
from dataclasses import replace

import numpy as np
import pytest

from server.scene.geometry import Opening
from training.data.scene_file import SceneFile, SceneFileError
from training.data.simulation_plan import SimulatedEffect, SimulationPlan, overrides_among
from training.simulation import planner
from training.simulation.plan_predictions import PlanPredictions
from training.simulation.planner import THRESHOLD, SimulationPlanner, planner_of

TWO_ROOMS = ((0, 0), (3, 0), (3, 4), (3.2, 4), (3.2, 0), (7, 0), (7, 5), (0, 5))


@pytest.fixture(scope="module")
def box(tiny_scene):
    return SceneFile.read(tiny_scene).model_copy(update={"effects": {}})


def with_materials(scene, walls=None, **shares):
    """Shares alike on all surfaces, and what only walls have."""
    of_all = {name: (value,) * 7 for name, value in shares.items()}
    materials = scene.geometry.materials
    changed = {name: getattr(materials, name).model_copy(update=of_all) for name in ("walls", "floor", "ceiling")}
    changed["walls"] = changed["walls"].model_copy(update=walls or {})
    return with_geometry(scene, materials=materials.model_copy(update=changed))


def with_geometry(scene, **changes):
    return scene.model_copy(update={"geometry": scene.geometry.model_copy(update=changes)})


def two_rooms(scene, **walls):
    passage = Opening(name="passage", start=(3.1, 4), end=(3.1, 5))
    return with_materials(with_geometry(scene, corners=TWO_ROOMS, openings=(passage,)), walls=walls)


def predicted(scene):
    """Kept by `conftest.py` for the tests that ask again."""
    return planner.PlanPredictions(scene, scene.probe_positions(0))


@pytest.fixture(scope="module")
def planned():
    """The plan of a scene, made once for all tests."""
    plans = {}

    def plan(scene):
        text = scene.model_dump_json()
        if text not in plans:
            plans[text] = planner_of(scene, 0).plan({})
        return plans[text]

    return plan


@pytest.fixture(scope="module")
def decided(planned):
    """The plan of a scene, and what it says of an effect."""

    def decide(scene, name):
        plan = planned(scene)
        (decision,) = (each for each in plan.decisions if each.name == name)
        return plan, decision

    return decide


@pytest.mark.usefixtures("brief_trials")
def test_the_same_scene_has_the_same_plan(box):
    probes = box.probe_positions(3)
    one, other = (SimulationPlanner(PlanPredictions(box, probes)).plan({}) for _ in range(2))
    assert one == other


def test_an_effect_is_on_where_its_change_reaches_the_threshold(planned, apartment, box):
    for scene in (box, apartment):
        for each in planned(scene).decisions:
            assert np.isfinite(each.change_jnd)
            assert each.called_for == (each.change_jnd >= THRESHOLD.enter_jnd)
            assert each.reason


def test_everything_has_all_that_the_scene_file_allows(apartment):
    plan = planner_of(apartment, 0).everything
    assert plan.settings == SimulationPlan.everything(3, 20_000).settings


def test_an_anechoic_room_has_no_rays_and_no_images(box, decided):
    plan, late = decided(with_materials(box, absorption=1.0), SimulatedEffect.LATE_REVERBERATION)
    assert (plan.rays, plan.tail_rays, plan.image_order, plan.tail_start_s) == (0, 0, 1, None)
    assert late.change_jnd < 0.01


def test_one_room_shares_its_tail_and_two_do_not(box, decided):
    alone, _ = decided(box, SimulatedEffect.PER_SOURCE_TAIL)
    parted, decision = decided(two_rooms(box), SimulatedEffect.PER_SOURCE_TAIL)
    assert alone.tail_start_s is not None
    assert parted.tail_start_s is None
    assert decision.change_jnd > 1


def test_the_tail_is_shared_only_after_everything_has_mixed_everywhere(box, decided):
    plan, _ = decided(box, SimulatedEffect.PER_SOURCE_TAIL)
    probes = box.probe_positions(0)
    farthest_m = np.linalg.norm(probes[:, None] - probes[None], axis=-1).max()
    assert plan.tail_start_s == pytest.approx(farthest_m / 343 + 50.1e-3 + 0.0117e-3 * 30)


@pytest.mark.usefixtures("brief_trials")
def test_a_tail_that_would_start_after_the_response_is_not_shared(box, decided):
    short = box.simulation.model_copy(update={"duration_s": 0.25})
    hall = with_geometry(box, corners=((0, 0), (78, 0), (78, 3), (0, 3)))
    wide = box.probes.model_copy(update={"spacing_m": 12.0})
    plan, decision = decided(
        hall.model_copy(update={"simulation": short, "probes": wide}), SimulatedEffect.PER_SOURCE_TAIL
    )
    assert not decision.called_for
    assert plan.tail_start_s is None
    assert plan.rays == short.rays


def test_smooth_walls_need_no_scattering(box):
    """By a trial of sixteen times as many rays the changes are 0.06, 0.40 and 2.05 JND: 0.02 of scattering shorten
    reverberation by 2 %, which is above the threshold of 0.25, as many reflections follow."""
    smooth, smoother_than_most, rough = (
        predicted(with_materials(box, scattering=share)).scattering(has_rays=True) for share in (0.002, 0.02, 0.2)
    )
    assert smooth.change_jnd < THRESHOLD.enter_jnd
    assert smoother_than_most.change_jnd == pytest.approx(0.40, abs=0.1)
    assert rough.change_jnd == pytest.approx(2.05, abs=0.2)


@pytest.mark.long
def test_little_scattering_is_heard_where_many_reflections_follow(box):
    """Of tiles all round, 0.05 of scattering shorten reverberation by 7 to 9 %: 1.4 to 1.8 JND."""
    tiled = with_materials(with_geometry(box, corners=((0, 0), (2, 0), (2, 2.5), (0, 2.5)), height_m=2.4))
    tiled = with_materials(tiled, absorption=0.02, scattering=0.05)
    grid = box.probes.model_copy(update={"spacing_m": 0.5, "jitter_m": 0.08, "wall_clearance_m": 0.3})
    longer = box.simulation.model_copy(update={"duration_s": 3.0})
    change = predicted(tiled.model_copy(update={"probes": grid, "simulation": longer})).scattering(has_rays=True)
    assert change.parameter == "t60"
    assert 1.2 < change.change_jnd < 2.2


def test_without_rays_nothing_is_decided_about_what_only_rays_do(box):
    plan = planner_of(with_materials(box, absorption=1.0, scattering=0.9), 0).plan({})
    told = {each.name: each for each in plan.decisions}
    assert plan.rays == 0
    for name in (SimulatedEffect.SCATTERING, SimulatedEffect.PER_SOURCE_TAIL):
        assert not told[name].called_for
        assert told[name].change_jnd == 0
        assert "no rays" in told[name].reason
    assert not plan.scattering


def test_rays_are_traced_where_what_is_scattered_is_heard(box):
    """What scatters at the first surface is sound too, and images do not bring it."""
    plan = planner_of(with_materials(box, absorption=0.8, scattering=0.9), 0).plan({})
    assert plan.rays > 0
    assert plan.scattering


@pytest.mark.usefixtures("brief_trials")
def test_responses_shorter_than_reverberation_are_told(box):
    hard = with_materials(box, absorption=0.02)
    (note,) = planner_of(hard, 0).plan({}).notes
    assert "simulation.duration_s" in note
    assert "T60" in note
    needed_s = float(note.split(" s would hold")[0].rpartition(" ")[2])
    assert needed_s == pytest.approx(predicted(hard).room.reverberation_time_s.max(), rel=0.1)
    long = hard.simulation.model_copy(update={"duration_s": 1.05 * needed_s})
    assert predicted(hard.model_copy(update={"simulation": long})).notes(has_rays=True) == ()


def test_responses_that_end_before_sound_arrives_are_refused(box):
    corridor = with_geometry(box, corners=((0, 0), (300, 0), (300, 2), (0, 2)))
    start = box.start.model_copy(update={"listener": (1.0, 1.0, 1.5), "emitter": (299.0, 1.0, 1.5)})
    grid = box.probes.model_copy(update={"spacing_m": 30.0})
    with pytest.raises(SceneFileError, match=r"simulation.duration_s: sound needs up to 0.87 s .* after 0.25 s"):
        planner_of(corridor.model_copy(update={"start": start, "probes": grid}), 0)


@pytest.mark.usefixtures("brief_trials")
def test_bands_above_half_the_sample_rate_are_told_and_decide_nothing(box):
    """Materials of the 8 kHz band differ; at 8 kHz nobody hears it."""
    slow = box.model_copy(update={"simulation": box.simulation.model_copy(update={"sample_rate": 8000})})
    rough_on_top = {"scattering": (0.0,) * 6 + (0.9,)}
    materials = {
        name: getattr(box.geometry.materials, name).model_copy(update=rough_on_top)
        for name in ("walls", "floor", "ceiling")
    }
    of_both = [
        with_geometry(scene, materials=box.geometry.materials.model_copy(update=materials)) for scene in (box, slow)
    ]
    fast_plan, slow_plan = (planner_of(scene, 0).plan({}) for scene in of_both)
    assert (fast_plan.scattering, slow_plan.scattering) == (True, False)
    assert any("8000 Hz" in note for note in slow_plan.notes)


def test_a_rougher_room_needs_images_of_fewer_orders(box):
    room = box.model_copy(update={"simulation": box.simulation.model_copy(update={"image_order": 4})})
    orders = [
        planner_of(with_materials(room, absorption=0.5, scattering=share), 0).plan({}).image_order
        for share in (0.02, 0.3, 0.9)
    ]
    assert orders == sorted(orders, reverse=True)
    assert orders[0] > orders[-1]


def test_air_matters_less_where_walls_take_most(box):
    """But not less than the threshold: at 8 kHz air takes 0.1 dB a metre, and the first reflections that are all that
    decays go some metres further than the direct sound."""
    live, dead = (
        planner.PlanPredictions(with_materials(box, absorption=share), box.probe_positions(0)).air_absorption(
            has_rays=has_rays, scatters=has_rays
        )
        for share, has_rays in ((0.05, True), (0.99, False))
    )
    assert live.change_jnd > THRESHOLD.enter_jnd
    assert live.change_jnd > 10 * dead.change_jnd
    assert THRESHOLD.enter_jnd < dead.change_jnd < 1


def test_sound_bends_where_there_are_corners(box, decided):
    alone, none = decided(box, SimulatedEffect.DIFFRACTION)
    parted, round_corners = decided(two_rooms(box), SimulatedEffect.DIFFRACTION)
    assert (alone.diffraction, none.change_jnd) == (False, 0.0)
    assert parted.diffraction
    assert round_corners.change_jnd > THRESHOLD.enter_jnd


def test_only_thin_walls_let_anything_heard_through(box, decided):
    changes = [
        predicted(two_rooms(box, surface_mass_kg_m2=mass)).transmission().change_jnd for mass in (0.5, 5.0, 50.0, 500.0)
    ]
    assert changes == sorted(changes, reverse=True)
    assert changes[0] > THRESHOLD.enter_jnd > changes[-1]
    assert decided(two_rooms(box, surface_mass_kg_m2=0.5), SimulatedEffect.TRANSMISSION)[1].called_for
    assert predicted(two_rooms(box)).transmission().change_jnd == 0.0
    assert predicted(with_materials(box, walls={"surface_mass_kg_m2": 0.5})).transmission().change_jnd == 0


def test_fewer_rays_do_in_a_smaller_room(box):
    many = box.model_copy(update={"simulation": box.simulation.model_copy(update={"rays": 10**9})})
    larger = with_geometry(many, corners=((0, 0), (8, 0), (8, 6), (0, 6)))
    rays = [planner.PlanPredictions(scene, box.probe_positions(0)).rays() for scene in (many, larger)]
    assert rays[0] < rays[1] < 10**9
    assert predicted(box).rays() == box.simulation.rays  # never more than the file allows


@pytest.mark.parametrize("is_on", [True, False])
def test_overrides_are_followed_and_told(box, is_on):
    names = set(SimulatedEffect) - {SimulatedEffect.DIRECTIVITY, SimulatedEffect.TRANSMISSION}
    plan = planner_of(box, 0).plan(dict.fromkeys(names, is_on))
    told = {each.name: each for each in plan.decisions}
    assert all(told[name].called_for == is_on and told[name].overridden for name in names)
    assert plan.image_order == (box.simulation.image_order if is_on else 1)
    assert plan.rays == (box.simulation.rays if is_on else 0)
    assert (plan.scattering, plan.air_absorption, plan.diffraction) == (is_on,) * 3


@pytest.mark.parametrize("name", ["directivity", "transmission"])
def test_what_cannot_be_simulated_is_refused_by_name(box, name):
    with pytest.raises(SceneFileError, match=f"effects.{name}"):
        planner_of(box, 0).plan({SimulatedEffect(name): True})


def test_overrides_of_rendering_alone_are_not_simulations():
    assert overrides_among({"hrtf": False, "air_absorption": True}) == {SimulatedEffect.AIR_ABSORPTION: True}


def test_a_scene_file_names_effects_that_exist(tiny_scene, tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(tiny_scene.read_text() + "echo = true\n")
    with pytest.raises(SceneFileError, match=r"effects: .*no effect 'echo', only direct_path"):
        SceneFile.read(path)


def test_a_plan_survives_json(planned, apartment):
    plan = replace(planned(apartment), cost_s=12.5)
    assert SimulationPlan.from_json(json.loads(json.dumps(plan.to_json()))) == plan
