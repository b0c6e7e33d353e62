"""The simulation of late reverberation between all pairs of probes of a scene. It can be resumed emitter by emitter,
and gives the same result for the same seed.

Emitters are simulated in threads; the compiled code releases the interpreter's lock.
"""

import threading
from concurrent.futures import CancelledError, ThreadPoolExecutor, as_completed
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.progress import Progress

from training.data.dataset import Dataset
from training.data.scene_file import SceneFile
from training.data.simulation_plan import SimulationPlan, overrides_among
from training.simulation.half_precision import to_half
from training.simulation.pairs import PairSimulation
from training.simulation.planner import planner_of


def prepared(scene: SceneFile, *, seed: int, plan: SimulationPlan, most_tail_rays: int | None = None) -> PairSimulation:
    """Prepare the simulation of all pairs of probes in a dataset of this seed; `most_tail_rays` as in
    `PairSimulation.prepare`."""
    yaws = 2 * np.pi * np.arange(scene.simulation.yaws) / scene.simulation.yaws
    probes = scene.probe_positions(seed)
    return PairSimulation.prepare(scene, probes, yaws, seed=seed, plan=plan, most_tail_rays=most_tail_rays)


def simulate(
    scene_path: Path,
    folder: Path,
    *,
    seed: int,
    workers: int,
    progress: Progress,
    simulation: PairSimulation | None = None,
) -> Dataset:
    """Fill the dataset folder, or resume an earlier run. Without a prepared `simulation`, all effects that the scene
    calls for are simulated.

    Raises SceneFileError for a bad scene file, and DatasetError for a folder that contains another scene.
    """
    scene = SceneFile.read(scene_path)
    plan = planner_of(scene, seed).plan(overrides_among(scene.effects)) if simulation is None else simulation.plan
    dataset = Dataset.create(folder, scene_path, seed, plan)
    remaining = dataset.remaining()
    task = progress.add_task("simulating", total=len(dataset.probes), completed=len(dataset.probes) - len(remaining))
    if not remaining:
        return dataset
    simulation = simulation or prepared(scene, seed=seed, plan=plan)
    if simulation.tail is not None:
        dataset.write_tail(simulation.tail)
    is_over = threading.Event()
    with ThreadPoolExecutor(workers, "simulate") as pool:
        running = {
            pool.submit(_simulate_emitter, simulation, emitter, np.flatnonzero(dataset.held_out[emitter]), is_over)
            for emitter in remaining
        }
        try:
            for future in as_completed(running):
                running.remove(future)
                dataset.write(*future.result())
                progress.advance(task)
        except BaseException:
            # After an interrupt or a full disk, do not wait for the emitters in progress.
            is_over.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return dataset


def _simulate_emitter(
    simulation: PairSimulation, emitter: int, repeated: npt.NDArray[np.int64], is_over: threading.Event
) -> tuple[int, list[dict[int, npt.NDArray[np.float16]]]]:
    """Return the emitter, and its log energies by take and listener; the second take has only the `repeated` listeners.
    Raises CancelledError once `is_over` is set."""
    listeners = np.flatnonzero(np.arange(len(simulation.probes)) != emitter)
    takes = []
    for number, wanted in enumerate((listeners, repeated)):
        energies = simulation.energies(emitter, wanted, number)
        if is_over.is_set():
            raise CancelledError
        with np.errstate(divide="ignore"):  # the logarithm is -inf where no ray arrived
            takes.append(dict(zip(map(int, wanted), to_half(np.log(energies)), strict=True)))
    return emitter, takes
