"""Simulation of what follows the direct sound and the first reflections, between all pairs of probes of a scene:
resumable emitter by emitter, the same for the same seed."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.progress import Progress

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.whole_field import kemar
from training.dataset import GEOMETRIC_ORDER, Dataset, DatasetError
from training.simulation.half_precision import to_half
from training.simulation.rays import sphere_directions
from training.simulation.synthesis import BinauralSynthesis
from training.simulation.tracing import Arrivals, RoomTracer


def simulate(scene_path: Path, folder: Path, *, seed: int, workers: int, progress: Progress) -> Dataset:
    """Fills the dataset folder, going on where an earlier run stopped.

    Raises SceneFileError for a bad scene file, and DatasetError for a folder that holds another scene or if a worker
    process dies.
    """
    dataset = Dataset.create(folder, scene_path, seed)
    remaining = dataset.remaining()
    task = progress.add_task("simulating", total=len(dataset.probes), completed=len(dataset.probes) - len(remaining))
    context = multiprocessing.get_context("spawn")
    bystanders = set(multiprocessing.active_children())
    leash, held = context.Pipe(duplex=False)
    with leash, held, ProcessPoolExecutor(workers, context, _live_on_leash, (leash,)) as pool:
        try:
            running = {pool.submit(_simulate_emitter, dataset, emitter): emitter for emitter in remaining}
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


def _live_on_leash(leash: Connection) -> None:
    """Prepares a worker: interrupts are for the parent to handle, and a worker must not outlive it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_die_when_released, args=(leash,), daemon=True).start()


def _die_when_released(leash: Connection) -> None:
    leash.poll(None)  # nothing is ever sent: it returns when the parent, sole holder of the other end, has died
    os._exit(1)


def _simulate_emitter(
    dataset: Dataset, emitter: int
) -> tuple[npt.NDArray[np.float16], npt.NDArray[np.float16], dict[int, npt.NDArray[np.float16]]]:
    """First takes of all listeners and the energies they were drawn from, and independent second takes of the held-out
    ones."""
    probes, settings = len(dataset.probes), dataset.scene.simulation
    directions = sphere_directions(settings.arrival_directions)
    synthesis = BinauralSynthesis(kemar(dataset.sample_rate), directions, dataset.yaws, dataset.samples)
    first = np.zeros((probes, len(dataset.yaws), 2, dataset.samples), dtype=np.float16)
    log_energy = np.full((probes, len(directions), len(OCTAVE_BANDS_HZ), settings.histogram_bins), -np.inf, np.float16)
    listeners = np.flatnonzero(np.arange(probes) != emitter)
    for listener, arrivals, response in _takes(dataset, emitter, listeners, synthesis, take=0):
        first[listener] = response
        with np.errstate(divide="ignore"):  # where no ray came by
            log_energy[listener] = to_half(np.log(arrivals.energy))
    repeated = np.flatnonzero(dataset.held_out[emitter])
    second = {listener: response for listener, _, response in _takes(dataset, emitter, repeated, synthesis, take=1)}
    return first, log_energy, second


def _takes(
    dataset: Dataset, emitter: int, listeners: npt.NDArray[np.int64], synthesis: BinauralSynthesis, take: int
) -> Iterator[tuple[int, Arrivals, npt.NDArray[np.float16]]]:
    """Each listener with what arrives there, and its (yaw, ear, sample) response."""
    settings = dataset.scene.simulation
    tracer = RoomTracer(
        dataset.scene.geometry,
        dataset.scene.air,
        dataset.probes[listeners],
        duration_s=settings.duration_s,
        image_order=settings.image_order,
        arrival_directions=synthesis.arrival_directions,
        least_order=GEOMETRIC_ORDER + 1,
    )
    rng = np.random.default_rng([dataset.seed, 2, emitter, take])
    traced = tracer.trace(dataset.probes[emitter], rays=settings.rays, rng=rng)
    for listener, arrivals in zip(map(int, listeners), traced, strict=True):
        response = synthesis.render(arrivals, dataset.probes[listener], dataset.onset_s[emitter, listener], rng)
        yield listener, arrivals, to_half(response)
