"""Levels are planned by the laws of floor plans; what a plan leaves out is not simulated."""

from dataclasses import replace

import numpy as np
import pytest

from server.acoustics.decibels import db_to_power, power_to_db
from server.acoustics.mesh import TriangleMesh
from server.scene.mesh_geometry import MeshGeometry
from training.data.dataset import GEOMETRIC_ORDER, SPEED_OF_SOUND
from training.data.levels.level_scene import LevelFile, LevelGeometry, LevelScene, SceneDoor, read_scene
from training.data.scene_file import HISTOGRAM_BIN_S, SceneFile, SceneFileError
from training.data.simulation_plan import SimulatedEffect, SimulationPlan
from training.simulation.check import check_plan
from training.simulation.direct_paths import DirectPaths
from training.simulation.level_predictions import LevelPredictions
from training.simulation.planner import THRESHOLD, SimulationPlanner, planner_of
from training.simulation.run import prepared
from training.simulation.tracing import RoomTracer
from training.simulation.walked_room import WalkedRoom

TWO_ROOMS = ((0, 0), (3, 0), (3, 4), (3.2, 4), (3.2, 0), (7, 0), (7, 5), (0, 5))
CHANGED_BY_RAYS = (SimulatedEffect.LATE_REVERBERATION, SimulatedEffect.SCATTERING, SimulatedEffect.AIR_ABSORPTION)


@pytest.fixture(scope="module")
def box(tiny_scene):
    return SceneFile.read(tiny_scene).model_copy(update={"effects": {}})


def two_rooms(scene):
    return scene.model_copy(update={"geometry": scene.geometry.model_copy(update={"corners": TWO_ROOMS})})


def level_of(scene, *, door=None, **material):
    """The surfaces of a floor plan, all of one material but for what the plan says, and a door in the passage."""
    place = MeshGeometry.of_plan(scene.geometry)
    of_bands = {name: each if name == "surface_mass_kg_m2" else (each,) * 7 for name, each in material.items()}
    materials = {name: each.model_copy(update=of_bands) for name, each in place.materials.items()}
    doors = () if door is None else (door,)
    corners = [(3.1, 4, 0), (3.1, 5, 0), (3.1, 5, 2.5), (3.1, 4, 2.5)]
    leaf = TriangleMesh(np.array(corners, dtype=float), [(0, 1, 2), (0, 2, 3)], [0, 0], ("walls",))
    file = LevelFile(
        id="level",
        name="",
        description="",
        geometry=LevelGeometry(mesh="geometry.npz", materials=materials, doors=doors),
        start=scene.start,
        probes=scene.probes,
        simulation=scene.simulation,
    )
    return LevelScene(file, place.mesh, tuple(leaf for _ in doors))


def sliding(**changes):
    shut = {"name": "middle", "mesh": "door0.npz", "kind": "slide", "pivot": (3.1, 4, 0), "angle_deg": 0.0}
    return SceneDoor(**{**shut, "slide_m": (0.0, -1.0, 0.0), "openness": 0.0, **changes})


def decided(level, overrides=None):
    plan = planner_of(level, 0).plan(overrides or {})
    return plan, {each.name: each for each in plan.decisions}


def everything_in(level):
    return SimulationPlan.everything(GEOMETRIC_ORDER, level.simulation.rays, transmission=level.has_mass)


def test_a_level_is_planned_as_its_floor_plan(box):
    """By trials of rays in another geometry, and fewer of them; of what bends, by a trial in place of a formula."""
    for scene in (box, two_rooms(box)):
        here, there = (planner_of(each, 0).plan({}).decisions for each in (scene, level_of(scene)))
        of_plan, of_level = ({each.name: each for each in decisions} for decisions in (here, there))
        for name in (*CHANGED_BY_RAYS, SimulatedEffect.DIFFRACTION, SimulatedEffect.TRANSMISSION):
            assert of_plan[name].called_for == of_level[name].called_for, name
        for name in CHANGED_BY_RAYS[1:]:
            assert of_level[name].change_jnd == pytest.approx(of_plan[name].change_jnd, rel=0.5, abs=0.3), name


@pytest.mark.usefixtures("brief_trials")
def test_the_same_level_and_seed_have_the_same_plan_and_an_effect_is_on_where_its_change_reaches_the_threshold(box):
    level = level_of(two_rooms(box), door=sliding(surface_mass_kg_m2=5.0))
    predicted = [LevelPredictions(level, level.probe_positions(3)) for _ in range(2)]
    assert set(predicted[0].states) == {"all doors open", "all doors shut"}
    plan, again = (SimulationPlanner(each).plan({}) for each in predicted)
    assert plan == again
    for each in plan.decisions:
        assert np.isfinite(each.change_jnd)
        assert each.reason
        if each.name != SimulatedEffect.PER_SOURCE_TAIL:
            assert each.called_for == (each.change_jnd >= THRESHOLD.enter_jnd), each


def test_an_anechoic_level_has_no_rays(box):
    plan, told = decided(level_of(box, absorption=1.0, scattering=0.9))
    assert (plan.rays, plan.scattering, plan.tail_start_s) == (0, False, None)
    for name in (SimulatedEffect.SCATTERING, SimulatedEffect.PER_SOURCE_TAIL):
        assert not told[name].called_for
        assert "no rays" in told[name].reason
    simulation = prepared(level_of(box), seed=1, plan=plan)
    assert not simulation.energies(0, np.array([1, 2]), 0).any()


def test_smooth_walls_need_no_scattering_and_rough_ones_do(box):
    smooth, told = decided(level_of(box, scattering=0.0))
    assert (smooth.scattering, told[SimulatedEffect.SCATTERING].change_jnd) == (False, 0.0)
    rough, told = decided(level_of(box, scattering=0.5))
    assert rough.scattering
    assert told[SimulatedEffect.SCATTERING].change_jnd > 1


def test_one_convex_room_needs_no_diffraction_and_two_rooms_do(box):
    plan, told = decided(level_of(box))
    assert not plan.diffraction
    assert told[SimulatedEffect.DIFFRACTION].reason == "nothing stands between any two places"
    plan, told = decided(level_of(two_rooms(box)))
    assert plan.diffraction
    assert told[SimulatedEffect.DIFFRACTION].change_jnd > THRESHOLD.enter_jnd


def test_only_what_is_light_lets_anything_heard_through(box):
    rooms = two_rooms(box)
    plan, told = decided(level_of(rooms))
    assert not plan.transmission
    assert told[SimulatedEffect.TRANSMISSION].reason == "no material and no door has a mass"
    changes_jnd = []
    for mass in (1.0, 30.0, 1000.0):
        level = level_of(rooms, surface_mass_kg_m2=mass)
        told = LevelPredictions(level, level.probe_positions(0)).transmission()
        assert f"walls and doors of {mass:g} kg/m2" in told.reason
        changes_jnd.append(told.change_jnd)
    assert changes_jnd == sorted(changes_jnd, reverse=True)
    assert changes_jnd[0] > 4 * THRESHOLD.enter_jnd
    assert changes_jnd[-1] < THRESHOLD.enter_jnd


def test_a_light_door_is_heard_through_when_it_is_shut_however_it_stands_at_the_beginning(box):
    for openness in (0.5, 1.0):
        level = level_of(two_rooms(box), door=sliding(surface_mass_kg_m2=5.0, openness=openness))
        predicted = LevelPredictions(level, level.probe_positions(0))
        told = predicted.transmission()
        assert told.change_jnd > 1
        assert told.reason.endswith("all doors shut")
        assert ("doors as at the beginning" in predicted.states) == (openness == 0.5)


def test_the_ways_of_a_state_are_those_of_the_level_in_that_state(box):
    level = level_of(two_rooms(box), door=sliding(openness=0.5))
    probes = level.probe_positions(0)
    for state in LevelPredictions(level, probes).states.values():
        alone = replace(state, known=None)
        np.testing.assert_array_equal(state.place.mesh.vertices_m, state.surroundings.mesh.vertices_m)
        lengths_m = [each.path_length_m(probes[:, None], probes[None]) for each in (state, alone)]
        np.testing.assert_allclose(*lengths_m, atol=0.05)


def test_walks_find_the_mean_free_path_and_the_absorption_that_is_met(box):
    level = level_of(box)
    room = WalkedRoom.of(level, level.probe_positions(0))
    volume_m3, surface_m2 = 4 * 3 * 2.5, 2 * (4 * 3 + 4 * 2.5 + 3 * 2.5)
    assert room.mean_free_path_m == pytest.approx(4 * volume_m3 / surface_m2, rel=0.03)
    np.testing.assert_allclose(room.absorption, 0.3)
    opened = replace(level, mesh=level.mesh.only(np.flatnonzero(level.mesh.surfaces != 2)))
    assert 0.3 < WalkedRoom.of(opened, level.probe_positions(0)).absorption[0] < 0.7


def test_what_goes_through_walls_and_the_rest_are_all_that_rays_bring(box):
    level = level_of(two_rooms(box), surface_mass_kg_m2=1.0)
    receivers, emitter = np.array([(1.0, 1.0, 1.5), (6.0, 1.0, 1.5)]), np.array((2.0, 2.0, 1.2))
    plan = everything_in(level)

    def energy(plan, seed, **options):
        tracer = RoomTracer.of(level, plan, receivers, few_rays=True, **options)
        return tracer.energy(emitter, rays=4000, rng=np.random.default_rng(seed)).sum(axis=(1, 3))

    whole, parted = energy(plan, 1), energy(replace(plan, transmission=False), 2)
    through = energy(plan, 3, only_through=True)
    np.testing.assert_allclose(power_to_db(whole / (parted + through)), 0, atol=0.5)
    assert np.all(through > 0)
    assert not energy(replace(plan, transmission=False), 3, only_through=True).any()


def test_a_level_without_scattering_or_air_is_simulated_without(box):
    level, smooth = level_of(box), level_of(box, scattering=0.0)
    plan, receivers, emitter = everything_in(level), level.probe_positions(0)[1:], level.probe_positions(0)[0]

    def energy(scene, **effects):
        tracer = RoomTracer.of(scene, replace(plan, **effects), receivers)
        return tracer.energy(emitter, rays=200, rng=np.random.default_rng(1))

    few = RoomTracer.of(level, plan, receivers, few_rays=True)
    np.testing.assert_array_equal(few.energy(emitter, rays=200, rng=np.random.default_rng(1)), energy(level))
    np.testing.assert_array_equal(energy(level, scattering=False), energy(smooth))
    assert not np.array_equal(energy(level), energy(smooth))
    dry, damped = energy(level, air_absorption=False).astype(float), energy(level).astype(float)
    bins_m = (np.arange(dry.shape[-1]) + 0.5) * HISTOGRAM_BIN_S * SPEED_OF_SOUND
    np.testing.assert_allclose(damped, dry * db_to_power(-level.air.absorption_db_per_m[:, None] * bins_m), rtol=1e-4)
    assert damped[..., -1, :].sum() < 0.9 * dry[..., -1, :].sum()


def test_a_level_without_diffraction_or_transmission_is_silent_where_only_these_are_heard(box):
    level = level_of(two_rooms(box), door=sliding(surface_mass_kg_m2=5.0))
    hall, room = np.array((1.0, 1.0, 1.5)), np.array((6.0, 1.0, 1.5))
    plan = everything_in(level)

    def heard(openness, **effects):
        paths = DirectPaths.of(level.with_doors([openness]), replace(plan, **effects))
        return float((paths.images(hall, room)[1] ** 2).sum())

    assert heard(1.0, transmission=False) > 0
    assert heard(1.0, transmission=False, diffraction=False) == 0
    beside = np.array((4.0, 4.5, 1.5)), np.array((2.0, 4.5, 1.5))
    through = DirectPaths.of(level, replace(plan, diffraction=False)).images(*beside)[1]
    assert (through**2).sum() > 0
    for effects in ({"transmission": False}, {"transmission": True}):
        tracer = RoomTracer.of(level, replace(plan, **effects), room[None])
        energy = tracer.energy(hall, rays=300, rng=np.random.default_rng(1))
        assert energy.any() == effects["transmission"]


@pytest.mark.parametrize(
    ("name", "is_on", "fix"),
    [
        ("directivity", True, "rendered"),
        ("transmission", True, r"needs surface_mass_kg_m2 of a material \(geometry.materials\) or of a door"),
        ("early_reflections", True, "rays trace what more than one surface mirrors: leave it out"),
        ("per_source_tail", False, "leave it out"),
    ],
)
def test_what_cannot_be_in_a_level_is_refused_by_name_and_the_fix_is_told(box, name, is_on, fix):
    with pytest.raises(SceneFileError, match=rf"level: effects\.{name}: .*{fix}"):
        planner_of(level_of(box), 0).plan({SimulatedEffect(name): is_on})


@pytest.mark.parametrize("is_on", [True, False])
def test_overrides_are_followed_and_told(box, is_on):
    names = {*CHANGED_BY_RAYS, SimulatedEffect.DIFFRACTION}
    plan, told = decided(level_of(box), dict.fromkeys(names, is_on))
    assert all(told[name].called_for == is_on and told[name].overridden for name in names)
    assert plan.rays == (box.simulation.rays if is_on else 0)
    assert (plan.scattering, plan.air_absorption, plan.diffraction) == (is_on,) * 3


def test_the_plan_of_everything_has_all_that_the_level_has(box):
    for level in (level_of(box), level_of(box, surface_mass_kg_m2=900.0)):
        assert planner_of(level, 0).everything.settings == everything_in(level).settings


def test_effects_of_its_scene_file_survive_and_unknown_ones_are_refused(box, tmp_path):
    level = level_of(box)
    assert "effects" not in level.identity
    file = level.file.model_copy(update={"effects": {"air_absorption": False, "hrtf": True}})
    replace(level, file=file).write(tmp_path)
    again = read_scene(tmp_path)
    assert again.effects == {"air_absorption": False, "hrtf": True}
    assert again.identity["effects"] == again.effects
    text = (tmp_path / "scene.toml").read_text(encoding="utf-8")
    (tmp_path / "scene.toml").write_text(text.replace("hrtf = true", "echo = true"), encoding="utf-8")
    with pytest.raises(SceneFileError, match=r"effects: .*no effect 'echo', only direct_path"):
        read_scene(tmp_path)


def test_responses_shorter_than_the_reverberation_of_a_level_are_told(box):
    plan, _ = decided(level_of(box, absorption=0.03))
    (note,) = plan.notes
    assert "simulation.duration_s: reverberation lasts" in note


def test_a_plan_of_a_level_is_checked_with_its_doors_in_the_states_of_a_dataset(box):
    level = level_of(two_rooms(box), door=sliding(surface_mass_kg_m2=5.0))
    plan = everything_in(level)
    check = check_plan(level, plan, plan, emitters=1, seed=0, track=lambda emitters: emitters)
    assert all(error == 0 for error in check.errors.values())
    assert check.floor["level"] > 0
