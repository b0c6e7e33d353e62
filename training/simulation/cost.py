"""A prediction of how long a simulation takes on this host, in seconds of one core, from short runs of its parts."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from time import thread_time

import numpy as np

from training.data.levels.level_scene import LevelScene
from training.data.scene_file import SceneFile
from training.data.simulation_plan import SimulatedEffect, SimulationPlan
from training.simulation.pairs import PairSimulation
from training.simulation.size import SimulationSize

_RAYS_TRIED = 500
_LISTENERS_TRIED, _LISTENERS_TRACED = 4, 64
_TIMES = 3
# Seconds of one core that the prediction of a cost may take.
_LONGEST_TRIAL_S = 1.0


def predicted_s(simulation: PairSimulation) -> float:
    """Predict the seconds of one core for all emitters and pairs, with preparation. Measuring takes a fraction of a
    second, or more if code must be compiled first."""
    plan, probes = simulation.plan, len(simulation.probes)
    listeners = simulation.scene.simulation.listeners_of(probes)
    brief = replace(simulation, plan=replace(plan, rays=min(plan.rays, _RAYS_TRIED)))
    many, few = (np.arange(1, 1 + min(count, probes - 1)) for count in (_LISTENERS_TRACED, _LISTENERS_TRIED))
    brief.energies(0, few, 0)  # the first run also compiles code
    many_traced_s, few_traced_s = (_seconds(partial(brief.energies, 0, some, 0)) for some in (many, few))
    # Every listener takes the same time.
    per_listener_s = (many_traced_s - few_traced_s) / max(1, len(many) - len(few))
    tracing_s = many_traced_s + per_listener_s * (listeners - len(many))
    # The second take has only the held-out listeners.
    states = simulation.states
    repeated = probes if states is None or not states.unseen.any() else int(states.unseen.sum())
    of_rays_s = probes * tracing_s + repeated * few_traced_s
    return float(simulation.prepared_s + of_rays_s * plan.rays / max(brief.plan.rays, 1))


def is_brief(scene: SceneFile | LevelScene) -> bool:
    """Whether the short runs that predict the cost of this scene take little time. Those of a level do, since rays in a
    mesh take little longer where it has more triangles."""
    if isinstance(scene, LevelScene):
        return True
    size = SimulationSize(scene)
    rays = min(1.0, _RAYS_TRIED / scene.simulation.rays)
    return size.tracing_s * rays < _LONGEST_TRIAL_S


def with_costs(simulation: PairSimulation) -> SimulationPlan:
    """The simulation's plan, with the seconds that each effect costs, or saves if it is off."""
    plan, settings = simulation.plan, simulation.scene.simulation
    takes_s = predicted_s(simulation)
    changed = {}
    tailless = replace(simulation, tail=None, prepared_s=0.0)
    if plan.rays:
        silent = replace(plan, rays=0, tail_start_s=None, tail_rays=0)
        changed[SimulatedEffect.LATE_REVERBERATION] = replace(tailless, plan=silent)
    if plan.tail_start_s is not None:
        own = replace(plan, rays=settings.rays, tail_start_s=None, tail_rays=0)
        changed[SimulatedEffect.PER_SOURCE_TAIL] = replace(tailless, plan=own)
    costs = {name: abs(predicted_s(other) - takes_s) for name, other in changed.items()}
    decisions = tuple(replace(each, cost_s=costs.get(each.name)) for each in plan.decisions)
    return replace(plan, decisions=decisions, cost_s=takes_s)


def _seconds(work: Callable[[], object]) -> float:
    """The least time of a few runs, because compilation and other processes make some of them too long."""
    times = []
    for _ in range(_TIMES):
        began = thread_time()
        work()
        times.append(thread_time() - began)
    return min(times)
