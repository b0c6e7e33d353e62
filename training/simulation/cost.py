"""What a simulation will take on this host, predicted from short runs of its parts: seconds of one core."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from time import process_time

import numpy as np
import numpy.typing as npt

from training.dataset import GEOMETRIC_ORDER
from training.scene_file import SceneFile
from training.simulation.pairs import PairSimulation
from training.simulation.plan import SimulatedEffect, SimulationPlan

_Floats = npt.NDArray[np.float64]

_RAYS_TRIED = 500
_LISTENERS_TRIED = 6
_TIMES = 3


@dataclass(frozen=True)
class SimulationCost:
    """Of all emitters and pairs of one scene."""

    scene: SceneFile
    probes: _Floats
    yaws: _Floats

    def of(self, plan: SimulationPlan) -> float:
        """About a second is spent on finding out; more where something was never compiled."""
        brief = replace(plan, rays=min(plan.rays, _RAYS_TRIED), tail_rays=min(plan.tail_rays, _RAYS_TRIED))

        def prepare() -> PairSimulation:
            return PairSimulation.prepare(self.scene, self.probes, self.yaws, seed=0, plan=brief)

        seconds = _seconds(prepare) * plan.tail_rays / max(brief.tail_rays, 1)
        simulation = prepare()
        everyone, few = np.arange(1, len(self.probes)), np.arange(1, 1 + min(_LISTENERS_TRIED, len(self.probes) - 1))
        for _ in simulation.take(0, few[:1], 0):  # what serves all pairs is made with the first
            pass
        tracing_s = _seconds(lambda: simulation.energies(0, everyone, np.random.default_rng(0)))
        few_traced_s = _seconds(lambda: simulation.energies(0, few, np.random.default_rng(0)))
        taking_s = _seconds(lambda: list(simulation.take(0, few, 0)))
        pairs = len(self.probes) * len(everyone) * (1 + self.scene.simulation.held_out_share)
        # The second take is of the few that are held out.
        seconds += len(self.probes) * (tracing_s + few_traced_s) * plan.rays / max(brief.rays, 1)
        return seconds + pairs * max(0.0, taking_s - few_traced_s) / len(few)

    def with_costs(self, plan: SimulationPlan) -> SimulationPlan:
        """The plan whose decisions say what their effect takes, or saves where it is off."""
        takes_s = self.of(plan)
        settings = self.scene.simulation
        images = settings.image_order if plan.image_order == GEOMETRIC_ORDER else GEOMETRIC_ORDER
        changed = {SimulatedEffect.EARLY_REFLECTIONS: replace(plan, image_order=images)}
        if plan.rays:
            silent = replace(plan, rays=0, tail_start_s=None, tail_rays=0)
            changed[SimulatedEffect.LATE_REVERBERATION] = silent
        if plan.tail_start_s is not None:
            own = replace(plan, rays=settings.rays, tail_start_s=None, tail_rays=0)
            changed[SimulatedEffect.PER_SOURCE_TAIL] = own
        costs = {name: abs(self.of(other) - takes_s) for name, other in changed.items()}
        decisions = tuple(replace(each, cost_s=costs.get(each.name)) for each in plan.decisions)
        return replace(plan, decisions=decisions, cost_s=takes_s)


def _seconds(work: Callable[[], object]) -> float:
    """The least of a few times: compiling is not the work, and neither is what others do meanwhile."""
    times = []
    for _ in range(_TIMES):
        began = process_time()
        work()
        times.append(process_time() - began)
    return min(times)
