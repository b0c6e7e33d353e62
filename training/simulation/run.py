"""The simulation of late reverberation between all pairs of probes of a scene. It can be resumed emitter by emitter,
and gives the same result for the same seed, wherever its emitters are simulated.

In one process that is in threads; the compiled code releases the interpreter's lock.
"""

from collections.abc import Iterable
from concurrent.futures import CancelledError
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.progress import Progress

from training.data.dataset import Dataset
from training.data.dataset_check import DatasetError
from training.data.door_states import DoorStates
from training.data.levels.level_scene import read_scene
from training.data.simulated_scene import SimulatedScene
from training.data.simulation_plan import SimulationPlan, overrides_among
from training.parallel.jobs import IsOver, Job, Jobs
from training.simulation.half_precision import to_half
from training.simulation.pairs import PairSimulation
from training.simulation.planner import planner_of

_Takes = list[dict[int, npt.NDArray[np.float16]]]


def prepared(
    scene: SimulatedScene,
    *,
    seed: int,
    plan: SimulationPlan,
    most_tail_rays: int | None = None,
    begun: Dataset | None = None,
) -> PairSimulation:
    """Prepare the simulation of all pairs of probes in a dataset of this seed; `most_tail_rays` as in
    `PairSimulation.prepare`. One that is `begun` keeps its probes, which another version may have placed elsewhere."""
    yaws = 2 * np.pi * np.arange(scene.simulation.yaws) / scene.simulation.yaws
    probes = scene.probe_positions(seed) if begun is None else begun.probes
    states = DoorStates.of(scene, len(probes), seed) if begun is None else begun.states
    return PairSimulation.prepare(
        scene, probes, yaws, seed=seed, plan=plan, most_tail_rays=most_tail_rays, states=states
    )


def simulate(
    scene_path: Path,
    folder: Path,
    *,
    seed: int,
    jobs: Jobs,
    progress: Progress,
    simulation: PairSimulation | None = None,
) -> Dataset:
    """Fill the dataset folder, or resume an earlier run. Without a prepared `simulation`, all effects that the scene
    calls for are simulated.

    The scene is a scene file or the folder of a level. Raises SceneFileError for a bad one, and DatasetError for a
    folder that contains another scene, or other probes than `simulation`.
    """
    scene = read_scene(scene_path)
    plan = planner_of(scene, seed).plan(overrides_among(scene.effects)) if simulation is None else simulation.plan
    dataset = Dataset.create(folder, scene_path, seed, plan)
    remaining = dataset.remaining()
    task = progress.add_task("simulating", total=len(dataset.probes), completed=len(dataset.probes) - len(remaining))
    if not remaining:
        return dataset
    simulation = simulation or prepared(scene, seed=seed, plan=plan, begun=dataset)
    if not np.array_equal(simulation.probes, dataset.probes):
        raise DatasetError(f"{folder}: was begun with probes at other places; choose an empty folder")
    if simulation.tail is not None:
        dataset.write_tail(simulation.tail)
    with closing(jobs.run(_simulate, simulation, list(_emitters(dataset, remaining)))) as simulated:
        for emitter, takes in simulated:
            dataset.write(emitter.number, takes)
            progress.advance(task)
    return dataset


@dataclass(frozen=True)
class _Emitter:
    """An emitter to simulate, and the listeners of its first and of its second take."""

    number: int
    listeners: npt.NDArray[np.int64]
    repeated: npt.NDArray[np.int64]


def _emitters(dataset: Dataset, remaining: Iterable[int]) -> Iterable[Job[_Emitter]]:
    for number in remaining:
        repeated = dataset.held_out[number]
        emitter = _Emitter(number, np.flatnonzero(dataset.trained[number] | repeated), np.flatnonzero(repeated))
        yield Job(f"scene {dataset.place.id}, emitter {number}", emitter)


def _simulate(simulation: PairSimulation, emitter: _Emitter, is_over: IsOver) -> _Takes:
    """The log energies of an emitter by take and listener; the second take has only the `repeated` listeners. Raises
    CancelledError once it is over."""
    takes = []
    for number, wanted in enumerate((emitter.listeners, emitter.repeated)):
        energies = simulation.energies(emitter.number, wanted, number)
        if is_over():
            raise CancelledError
        with np.errstate(divide="ignore"):  # the logarithm is -inf where no ray arrived
            takes.append(dict(zip(map(int, wanted), to_half(np.log(energies)), strict=True)))
    return takes
