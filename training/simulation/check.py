"""A check that a plan leaves out nothing audible: a few emitters of a scene are simulated by the plan, and with every
effect on for two seeds.

The difference between the latter two is the repeatability floor. An error within it cannot be distinguished from
randomness.
"""

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from time import process_time
from typing import Any

import numpy as np
import numpy.typing as npt

from server.acoustics.metrics import parameter_errors, summarise
from server.acoustics.room_parameters import RoomParameters, measure
from server.rendering.hrtf import kemar
from training.data.dataset import GEOMETRIC_ORDER
from training.data.door_states import DoorStates, EmitterScenes
from training.data.simulated_scene import SimulatedScene
from training.data.simulation_plan import SimulationPlan
from training.simulation.direct_paths import DirectPaths
from training.simulation.pairs import PairSimulation
from training.simulation.rays import sphere_directions
from training.simulation.synthesis import BinauralSynthesis
from training.simulation.tracing import RoomTracer

_Floats = npt.NDArray[np.float64]
_Responses = npt.NDArray[np.float32]

_YAWS_HEARD = 4


@dataclass(frozen=True)
class PlanCheck:
    """The result of a check. `errors` compares the plan with every effect on; `floor` compares every effect on with a
    second random draw. Both are means by metric, in its unit. Plan and reference use the same random numbers until the
    plan's shared tail sets in. Until then, errors are caused by what the plan leaves out; later, the rays differ too.
    `everything_s` and `plan_s` are seconds of one core for the emitters that were simulated. `once_s` is
    the time of the plan's preparations, which are done once for all `probes` of a whole simulation."""

    scene: str
    emitters: int
    probes: int
    pairs: int
    everything_s: float
    plan_s: float
    once_s: float
    errors: dict[str, float]
    floor: dict[str, float]

    @property
    def speedup(self) -> float:
        """The time of a whole simulation with every effect on, divided by its time by the plan."""
        everything, plan = (seconds / self.emitters * self.probes for seconds in (self.everything_s, self.plan_s))
        return everything / (plan + self.once_s)

    def to_json(self) -> dict[str, Any]:
        return {**asdict(self), "speedup": self.speedup}


def check_plan(
    scene: SimulatedScene,
    plan: SimulationPlan,
    everything: SimulationPlan,
    *,
    emitters: int,
    seed: int,
    track: Callable[[Iterable[int]], Iterable[int]],
) -> PlanCheck:
    """Simulate `emitters` emitters by the plan and with every effect on, and compare. Second takes, as of held-out
    pairs, are also simulated and timed, but not compared. Doors are in the states of a dataset with this seed."""
    probes = scene.probe_positions(seed)
    states = DoorStates.of(scene, len(probes), seed)
    yaws = 2 * np.pi * np.arange(scene.simulation.yaws) / scene.simulation.yaws
    settings = {"everything": (everything, seed), "again": (everything, seed + 1), "plan": (plan, seed)}
    simulations, once_s = {}, 0.0
    for name, (of, drawn) in settings.items():  # the plan comes last, because the first simulation also loads code
        began = process_time()
        simulations[name] = PairSimulation.prepare(scene, probes, yaws, seed=drawn, plan=of, states=states)
        once_s = process_time() - began
    seconds = dict.fromkeys(simulations, 0.0)
    measured: dict[str, list[RoomParameters]] = {name: [] for name in simulations}
    geometry = GeometricResponses(scene, everything, probes, yaws, states)
    for emitter in track(np.unique(np.linspace(0, len(probes) - 1, emitters).astype(int)).tolist()):
        listeners = np.delete(np.arange(len(probes)), emitter)
        known = geometry.responses(emitter, listeners)
        repeated = listeners[:: round(1 / scene.simulation.held_out_share)]
        for name, simulation in simulations.items():
            began = process_time()
            energies = simulation.energies(emitter, listeners, 0)
            simulation.energies(emitter, repeated, 1)
            seconds[name] += process_time() - began
            late_sound = simulation.late_sound.turned(_compared(yaws))
            late = [
                late_sound.response(emitter, int(listener), 0, simulation.joined(own, 0))
                for listener, own in zip(listeners, energies, strict=True)
            ]
            measured[name].append(measure(np.stack(late) + known, scene.simulation.sample_rate))
    return PlanCheck(
        scene=scene.id,
        emitters=len(measured["plan"]),
        probes=len(probes),
        pairs=len(measured["plan"]) * (len(probes) - 1),
        everything_s=seconds["everything"],
        plan_s=seconds["plan"],
        once_s=once_s,
        errors=_mean_errors(measured["everything"], measured["plan"]),
        floor=_mean_errors(measured["everything"], measured["again"]),
    )


class GeometricResponses:
    """Computes the direct sound and the first reflections, which datasets do not store, at the orientations that are
    compared."""

    def __init__(
        self,
        scene: SimulatedScene,
        plan: SimulationPlan,
        probes: _Floats,
        yaws: _Floats,
        states: DoorStates | None = None,
    ) -> None:
        """`states` of doors as in `PairSimulation`."""
        settings = scene.simulation
        samples = round(settings.duration_s * settings.sample_rate)
        directions = sphere_directions(settings.arrival_directions)
        self._synthesis = BinauralSynthesis(kemar(settings.sample_rate), directions, _compared(yaws), samples)
        self._probes = probes
        self._scenes, self._plan = EmitterScenes(scene, states or DoorStates.none(len(probes))), plan

    def responses(self, emitter: int, listeners: npt.NDArray[np.integer]) -> _Responses:
        """(listener, yaw, ear, sample) direct sound and first reflections of one emitter."""
        scene, place = self._scenes.of(emitter), self._probes[emitter]
        direct = DirectPaths.of(scene, self._plan)
        tracer = RoomTracer.of(scene, self._plan, self._probes, image_order=GEOMETRIC_ORDER, few_rays=True)
        reflections = tracer.images(place)

        def response(images: tuple[_Floats, _Floats], receiver: _Floats) -> npt.NDArray[np.float32]:
            positions, amplitudes = images
            return self._synthesis.specular(positions, amplitudes, receiver)

        return np.stack(
            [
                response(direct.images(place, self._probes[listener]), self._probes[listener])
                + response(reflections[listener], self._probes[listener])
                for listener in listeners
            ]
        )


def _compared(yaws: _Floats) -> _Floats:
    """The yaws at which responses are compared."""
    return yaws[:: max(1, len(yaws) // _YAWS_HEARD)]


def _mean_errors(reference: list[RoomParameters], estimate: list[RoomParameters]) -> dict[str, float]:
    """The mean errors by metric, without metrics that could not be measured."""
    each = [parameter_errors(first, second) for first, second in zip(reference, estimate, strict=True)]
    means = {name: summarise(np.concatenate([of_one[name] for of_one in each])).mean for name in each[0]}
    return {name: mean for name, mean in means.items() if mean is not None}
