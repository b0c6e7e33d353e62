"""What a plan costs and what it leaves out, told on the command line before anything is simulated."""

import json
from dataclasses import replace
from time import process_time

import numpy as np
import pytest

from training.cli.main import main
from training.data.scene_file import SceneFile
from training.data.simulation_plan import SimulatedEffect, SimulationPlan
from training.simulation.check import check_plan
from training.simulation.cost import predicted_s, with_costs
from training.simulation.planner import planner_of
from training.simulation.run import prepared


@pytest.fixture(scope="module")
def box(tiny_scene):
    return SceneFile.read(tiny_scene)


@pytest.fixture
def nafir_train(monkeypatch, capfd):
    def run(*arguments):
        monkeypatch.setattr("sys.argv", ["nafir-train", *map(str, arguments)])
        with pytest.raises(SystemExit) as left:
            main()
        return left.value.code, *capfd.readouterr()

    return run


def checked(box, plan):
    everything = planner_of(box, 0).everything
    return check_plan(box, plan, everything, emitters=2, seed=0, track=lambda emitters: emitters)


def test_everything_on_differs_from_itself_in_nothing_and_from_another_draw_by_the_floor(box):
    check = checked(box, planner_of(box, 0).everything)
    assert all(error == 0 for error in check.errors.values())
    assert all(check.floor[name] > 0 for name in ("t60", "edt", "c50", "level", "iacc"))
    assert check.pairs == 2 * (check.probes - 1)


def test_what_a_plan_must_not_leave_out_is_found_out(box):
    """Without late reverberation, decays and levels are off by far more than two draws are from each other."""
    deaf = planner_of(box, 0).plan({SimulatedEffect.LATE_REVERBERATION: False})
    check = checked(box, deaf)
    assert check.errors["level"] > 5 * check.floor["level"]
    assert check.errors["edt"] > 3 * check.floor["edt"]


def test_what_is_predicted_to_be_inaudible_is_about_the_floor(box):
    check = checked(box, planner_of(box, 0).plan({}))
    for name in ("t60", "c50", "level", "iacc"):
        assert check.errors[name] < 2 * check.floor[name]  # of ten pairs


def test_the_predicted_cost_is_about_what_it_takes(box):
    simulation = prepared(box, seed=0, plan=SimulationPlan.everything(2, 3000))
    predicted = predicted_s(simulation)
    everyone = np.arange(len(simulation.probes))
    began = process_time()
    for emitter in everyone:
        simulation.energies(emitter, np.delete(everyone, emitter), 0)
    taken = process_time() - began
    assert taken / 2 < predicted < 4 * taken  # second takes are in it, too


def test_more_rays_are_predicted_to_take_longer(box):
    few, many = (
        predicted_s(prepared(box, seed=0, plan=SimulationPlan.everything(1, rays))) for rays in (2_000, 200_000)
    )
    assert many > 5 * few


def test_what_is_off_is_told_with_what_it_saves(box):
    plan = with_costs(prepared(box, seed=0, plan=planner_of(box, 0).plan({})))
    costs = {each.name: each.cost_s for each in plan.decisions}
    assert plan.cost_s > 0
    assert costs[SimulatedEffect.PER_SOURCE_TAIL] >= 0
    assert costs[SimulatedEffect.LATE_REVERBERATION] > 0
    assert costs[SimulatedEffect.DIFFRACTION] is None
    assert replace(plan, cost_s=None).settings == plan.settings


def test_the_plan_is_printed_and_nothing_simulated(nafir_train, tiny_scene):
    code, out, _ = nafir_train("plan", tiny_scene)
    assert code == 0
    for name in SimulatedEffect:
        assert name.replace("_", " ") in out
    assert "on (as asked)" in out  # by the scene file


def test_the_plan_as_json_with_its_check(nafir_train, tiny_scene):
    code, out, _ = nafir_train("plan", tiny_scene, "--check", "1", "--effects", "air_absorption=off", "--json")
    content = json.loads(out)
    assert code == 0
    plan = SimulationPlan.from_json(content["plan"])
    assert not plan.air_absorption
    assert {each.name for each in plan.decisions} == set(SimulatedEffect)
    assert content["check"]["errors"].keys() == content["check"]["floor"].keys()
    assert content["check"]["speedup"] > 0


@pytest.mark.parametrize("effects", ["echo=on", "scattering", "scattering=loud"])
def test_effects_that_cannot_be_read_are_refused(nafir_train, tiny_scene, effects):
    code, _, err = nafir_train("plan", tiny_scene, "--effects", effects)
    assert code == 2
    assert "--effects" in err


def test_effects_that_cannot_be_simulated_are_told_in_a_line(nafir_train, tiny_scene):
    code, _, err = nafir_train("plan", tiny_scene, "--effects", "directivity=on")
    assert code == 2
    assert err.strip().splitlines()[-1].startswith("nafir-train: tiny: effects.directivity: cannot be on")
