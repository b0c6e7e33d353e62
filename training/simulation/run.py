"""Simulation of what follows the direct sound and the first reflections, between all pairs of probes of a scene:
resumable emitter by emitter, the same for the same seed."""

import multiprocessing
import os
import signal
import threading
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import Connection
from pathlib import Path
from typing import ClassVar

import numpy as np
import numpy.typing as npt
from rich.progress import Progress

from server.acoustics.bands import OCTAVE_BANDS_HZ
from training.dataset import Dataset, DatasetError
from training.scene_file import SceneFile
from training.simulation.half_precision import to_half
from training.simulation.pairs import PairSimulation
from training.simulation.plan import SimulationPlan, overrides_among
from training.simulation.planner import planner_of


class _Worker:
    """What a worker process prepares for its first emitter serves all of them."""

    simulation: ClassVar[PairSimulation]


def simulate(
    scene_path: Path,
    folder: Path,
    *,
    seed: int,
    workers: int,
    progress: Progress,
    plan: SimulationPlan | None = None,
) -> Dataset:
    """Fills the dataset folder by the plan, or by one made for the scene, going on where an earlier run stopped.

    Raises SceneFileError for a bad scene file, and DatasetError for a folder that holds another scene or if a worker
    process dies.
    """
    scene = SceneFile.read(scene_path)
    plan = plan or planner_of(scene, seed).plan(overrides_among(scene.effects))
    dataset = Dataset.create(folder, scene_path, seed, plan)
    remaining = dataset.remaining()
    task = progress.add_task("simulating", total=len(dataset.probes), completed=len(dataset.probes) - len(remaining))
    if not remaining:
        return dataset
    context = multiprocessing.get_context("spawn")
    bystanders = set(multiprocessing.active_children())
    simulation = PairSimulation.prepare(dataset.scene, dataset.probes, dataset.yaws, seed=seed, plan=dataset.effects)
    leash, held = context.Pipe(duplex=False)
    with leash, held, ProcessPoolExecutor(workers, context, _prepare_worker, (leash, simulation)) as pool:
        try:
            running = {
                pool.submit(_simulate_emitter, emitter, np.flatnonzero(dataset.held_out[emitter])): emitter
                for emitter in remaining
            }
            for future in as_completed(running):
                dataset.write(running.pop(future), *future.result())
                progress.advance(task)
        except BaseException as exc:
            # Neither an interrupt nor a full disk waits for emitters under way.
            for worker in set(multiprocessing.active_children()) - bystanders:
                worker.terminate()
            if isinstance(exc, BrokenProcessPool):
                raise DatasetError(f"{folder}: a worker process died; run simulate again to go on") from exc
            raise
    return dataset


def _prepare_worker(leash: Connection, simulation: PairSimulation) -> None:
    """Interrupts are for the parent to handle, and a worker must not outlive it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_die_when_released, args=(leash,), daemon=True).start()
    _Worker.simulation = simulation


def _die_when_released(leash: Connection) -> None:
    leash.poll(None)  # nothing is ever sent: it returns when the parent, sole holder of the other end, has died
    os._exit(1)


def _simulate_emitter(
    emitter: int, repeated: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.float16], npt.NDArray[np.float16], dict[int, npt.NDArray[np.float16]]]:
    """First takes of all listeners and the energies they were drawn from, and independent second takes of those that
    are to be `repeated`."""
    simulation = _Worker.simulation
    settings, probes = simulation.scene.simulation, len(simulation.probes)
    samples = round(settings.duration_s * settings.sample_rate)
    first = np.zeros((probes, len(simulation.yaws), 2, samples), dtype=np.float16)
    shape = probes, settings.arrival_directions, len(OCTAVE_BANDS_HZ), settings.histogram_bins
    log_energy = np.full(shape, -np.inf, np.float16)
    listeners = np.flatnonzero(np.arange(probes) != emitter)
    for listener, energy, response in simulation.take(emitter, listeners, 0):
        first[listener] = response
        with np.errstate(divide="ignore"):  # where no ray came by
            log_energy[listener] = to_half(np.log(energy))
    second = {listener: response for listener, _, response in simulation.take(emitter, repeated, 1)}
    return first, log_energy, second
