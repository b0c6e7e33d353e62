"""Simulation by a plan: what is off is not computed, and what a plan leaves out is not missed."""

from dataclasses import replace

import numpy as np
import pytest

from training.data.dataset import GEOMETRIC_ORDER, TAKES
from training.data.scene_file import HISTOGRAM_BIN_S, SceneFile
from training.data.simulation_plan import SimulatedEffect, SimulationPlan
from training.simulation.pairs import PairSimulation
from training.simulation.planner import planner_of
from training.simulation.rays import RayTracer
from training.simulation.synthesis import BinauralSynthesis
from training.simulation.tracing import RoomTracer
from training.trials.field_decay import MOST_FROM_DATA
from training.trials.own_scenes import OWN
from training.trials.reverberation import reverberation_time_s

YAWS = 2 * np.pi * np.arange(4) / 4
EVERYTHING = SimulationPlan.everything(2, 500)


@pytest.fixture(scope="module")
def box(tiny_scene):
    return SceneFile.read(tiny_scene)


def simulation_of(scene, plan, seed=0):
    return PairSimulation.prepare(scene, scene.probe_positions(0), YAWS, seed=seed, plan=plan)


def taken(simulation, emitter=0, take=0):
    listeners = np.delete(np.arange(len(simulation.probes)), emitter)
    _, energies, responses = zip(*simulation.take(emitter, listeners, take), strict=True)
    return np.stack(energies).astype(float), np.stack(responses).astype(float)


def test_the_same_seed_gives_the_same_numbers_in_any_order(box):
    plan = planner_of(box, 0).plan({})
    one, other = simulation_of(box, plan), simulation_of(box, plan)
    taken(other, emitter=3)
    for first, second in zip(taken(one, emitter=1), taken(other, emitter=1), strict=True):
        np.testing.assert_array_equal(first, second)


def test_a_plan_of_everything_draws_whole_responses_of_each_pair(box):
    """As `BinauralSynthesis.render` has them."""
    simulation = simulation_of(box, EVERYTHING)
    _, responses = taken(simulation)
    probes = simulation.probes
    tracer = RoomTracer.of(box, EVERYTHING, probes[1:], least_order=GEOMETRIC_ORDER + 1)
    arrivals = tracer.trace(probes[0], rays=EVERYTHING.rays, rng=np.random.default_rng([0, 2, 0, 0]))
    synthesis = simulation.late_sound.synthesis
    for listener, (place, arrival, response) in enumerate(zip(probes[1:], arrivals, responses, strict=True), start=1):
        onset_s = np.linalg.norm(place - probes[0]) / 343
        expected = synthesis.render(arrival, place, onset_s, np.random.default_rng([0, 5, 0, 0, listener]))
        np.testing.assert_allclose(response, expected, atol=1e-3 * np.abs(expected).max())


def test_plans_draw_the_same_noise(box):
    """Of which fewer rays than everything on change little, and another draw as much as there is."""
    everything, few = (simulation_of(box, SimulationPlan.everything(2, rays)) for rays in (3000, 1500))
    other = simulation_of(box, SimulationPlan.everything(2, 3000), seed=1)
    (_, reference), (_, fewer), (_, redrawn) = (taken(simulation) for simulation in (everything, few, other))
    assert np.square(fewer - reference).mean() < 0.3 * np.square(redrawn - reference).mean()


def test_a_listener_hears_the_same_whoever_else_is_asked_for(box):
    """But for rays, which are traced to all at once."""
    simulation = simulation_of(box, EVERYTHING)
    energies, responses = taken(simulation)
    rng = np.random.default_rng([0, 5, 0, 0, 2])
    onset_s = np.linalg.norm(simulation.probes[2] - simulation.probes[0]) / 343
    synthesis = simulation.late_sound.synthesis
    late = synthesis.late(energies[1].astype(np.float32), onset_s, rng)
    tracer = RoomTracer.of(box, EVERYTHING, simulation.probes[2:3], least_order=GEOMETRIC_ORDER + 1)
    expected = late + synthesis.specular(*tracer.images(simulation.probes[0])[0], simulation.probes[2])
    np.testing.assert_allclose(responses[1], expected, atol=1e-3 * np.abs(expected).max())


def test_without_rays_nothing_is_traced_and_no_noise_drawn(box, monkeypatch):
    plan = planner_of(box, 0).plan({SimulatedEffect.LATE_REVERBERATION: False, SimulatedEffect.EARLY_REFLECTIONS: True})
    monkeypatch.setattr(RayTracer, "trace", None)
    monkeypatch.setattr(BinauralSynthesis, "late", None)
    energies, responses = taken(simulation_of(box, plan))
    assert not energies.any()
    assert responses.any()


def test_a_shared_tail_is_traced_once_and_rays_of_pairs_end_with_it(box, monkeypatch):
    traced_s = []
    trace = RayTracer.trace

    def counted(self, *arguments, **named):
        traced_s.append(self.shape[-1] * HISTOGRAM_BIN_S)
        return trace(self, *arguments, **named)

    plan = planner_of(box, 0).plan({})
    monkeypatch.setattr(RayTracer, "trace", counted)
    simulation = simulation_of(box, plan)
    once = len(traced_s)
    assert once == (len(TAKES) + 1) * len(simulation.probes)  # from all over the room, which has few probes
    taken(simulation)
    taken(simulation, emitter=1)
    assert len(traced_s) == once + 2
    assert max(traced_s[once:]) < 0.08
    assert min(traced_s[:once]) > 0.24


def test_one_tail_for_all_has_the_level_and_decay_of_own_ones(box):
    """Means over pairs and draws, of the part that is shared."""
    planner = planner_of(box, 0)
    start = round((planner.plan({}).tail_start_s + 0.01) * box.simulation.sample_rate)
    curves = []
    for plan in (planner.plan({}), planner.everything):
        late = [
            taken(simulation_of(box, replace(plan, tail_rays=min(plan.tail_rays, 500)), seed), emitter)[1][..., start:]
            for seed in range(4)
            for emitter in range(3)
        ]
        power = (np.stack(late) ** 2).mean(axis=(0, 1, 2, 3))
        curves.append(10 * np.log10(power[::-1].cumsum()[::-1]))
    shared, own = (curve[: len(curve) * 3 // 4 : 200] for curve in curves)
    # 500 rays leave the end of a decay, 25 dB down, uncertain by more than its beginning.
    np.testing.assert_allclose(shared[: len(shared) // 2], own[: len(own) // 2], atol=0.6)
    np.testing.assert_allclose(shared, own, atol=1.5)


def box_with_all_of_its_decay(box):
    return box.model_copy(update={"simulation": box.simulation.model_copy(update={"duration_s": 1.0, "rays": 4_000})})


def corridor(_):
    """Few rays run level, and late sound is theirs."""
    return SceneFile.read(OWN / "corridor-20m.toml")


@pytest.mark.parametrize("scene_of", [box_with_all_of_its_decay, pytest.param(corridor, marks=pytest.mark.long)])
def test_what_chance_makes_of_a_shared_tail_is_small(box, scene_of):
    """Fields are held to a tenth of what their data's decay is."""
    scene = scene_of(box)
    plan = planner_of(scene, 0).plan({SimulatedEffect.PER_SOURCE_TAIL: False})
    energies = simulation_of(scene, plan).tail.energies
    one_s, *others_s = (reverberation_time_s(tail.sum(axis=0)) for tail in energies)
    for other_s in others_s:
        np.testing.assert_allclose(one_s, other_s, rtol=MOST_FROM_DATA)


def test_energies_of_a_shared_tail_are_as_loud_in_responses_as_own_ones(box):
    """Through the same head, which adds its own gain to both."""
    gains_db = []
    for own_tail in (False, True):
        overrides = {SimulatedEffect.EARLY_REFLECTIONS: False, SimulatedEffect.PER_SOURCE_TAIL: own_tail}
        simulation = simulation_of(box, planner_of(box, 0).plan(overrides))
        energies, responses = zip(*(taken(simulation, emitter) for emitter in range(6)), strict=True)
        drawn_from = np.stack(energies).sum(axis=(2, 4)).mean()
        heard = (np.stack(responses) ** 2).sum(axis=-1).mean()
        gains_db.append(10 * np.log10(heard / drawn_from))
    assert gains_db[0] == pytest.approx(gains_db[1], abs=0.3)
