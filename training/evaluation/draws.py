"""Reference parameters of held-out pairs: medians over many simulations.

A simulation is random in its rays and in the noise of diffuse sound. If two fields are both nearer to the expected
response than a single simulation is, that simulation cannot tell which is better. Medians of parameters over many draws
can, and a single draw in which the direct sound is mistaken for a reflection does not change them.

Draws are simulations with the seeds that follow the dataset's, by the dataset's own plan, except that a shared tail
gets more rays. Its random error is the same for every pair, so a median over pairs would not remove it. Parameters are
stored beside the dataset, in a file per draw and emitter, so that an interrupted evaluation can be resumed and nothing
is simulated twice.

The median of an odd number of draws is one of the drawn values. For an even number, two values are averaged. This may
give a value that no draw has, if an interaural time difference takes one of two values.
"""

import hashlib
import json
import os
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from server.acoustics.room_parameters import RoomParameters, measure
from training.baselines.coded import Track
from training.baselines.held_out import EvaluationError, HeldOut
from training.data.dataset import TAKES, Dataset
from training.simulation.pairs import PairSimulation
from training.simulation.references import GeometricSound

_FOLDER = "draws"
_FORMAT = 3
"""This number must change whenever simulations, or the parameters measured in them, change."""
_WORKERS = 2
# With 20,000 rays, the reverberation time of a small room has an error of 0.9 %, the same for all pairs.
_TAIL_RAYS = 16
_NAMES = tuple(field.name for field in fields(RoomParameters))
_Floats = npt.NDArray[np.float64]


def median_parameters(
    held_out: HeldOut, draws: int, *, decay_db: float = 30.0, track: Track = lambda steps, _: steps
) -> list[RoomParameters]:
    """The parameters of each held-out pair at the evaluated orientations: medians over `draws` simulations, none of
    which is in the dataset. A value that cannot be measured in more than half of the draws is missing.

    Raises EvaluationError for measured data.
    """
    dataset = held_out.simulated
    if dataset is None:
        raise EvaluationError("--draws: what was measured cannot be drawn again; leave it out")
    ends = [divmod(int(pair), len(dataset.probes)) for pair in held_out.held_out]
    medians = _Draws(dataset, decay_db).medians(sorted({emitter for emitter, _ in ends}), draws, track)
    return [
        RoomParameters(**{name: values[held_out.yaw_indices] for name, values in medians[emitter, listener].items()})
        for emitter, listener in ends
    ]


class _Draws:
    """Simulates draws for one dataset and stores their parameters. Responses are complete; decay times are measured
    over `decay_db`."""

    def __init__(self, dataset: Dataset, decay_db: float) -> None:
        self._dataset = dataset
        self._decay_db = decay_db
        self._geometric = GeometricSound(dataset)
        self._simulations: dict[int, PairSimulation] = {}
        self._plan = replace(dataset.effects, tail_rays=_TAIL_RAYS * dataset.effects.tail_rays)
        simulated = hashlib.sha256((dataset.folder / "scene.toml").read_bytes())
        simulated.update(json.dumps([_FORMAT, dataset.seed, self._plan.to_json(), decay_db, _NAMES]).encode())
        self._folder = dataset.folder / _FOLDER / simulated.hexdigest()[:12]

    def medians(self, emitters: list[int], draws: int, track: Track) -> dict[tuple[int, int], dict[str, _Floats]]:
        """Median parameters (yaw,) or (yaw, ear) by name, for each held-out pair of these emitters, by (emitter,
        listener)."""
        steps = [(draw, emitter) for draw in range(draws) for emitter in emitters]
        missing = [step for step in steps if not self._file(*step).exists()]
        if missing:
            self._simulate(missing, track)
        of_pairs = {}
        for emitter in emitters:
            drawn = [np.load(self._file(draw, emitter)) for draw in range(draws)]
            medians = {name: _median(np.stack([parameters[name] for parameters in drawn])) for name in _NAMES}
            for row, listener in enumerate(self._listeners(emitter)):
                of_pairs[emitter, listener] = {name: values[row] for name, values in medians.items()}
        return of_pairs

    def _listeners(self, emitter: int) -> list[int]:
        """All held-out listeners of an emitter, even if only some are evaluated."""
        return [int(listener) for listener in np.flatnonzero(self._dataset.held_out[emitter])]

    def _file(self, draw: int, emitter: int) -> Path:
        return self._folder / f"{draw}-{emitter}.npz"

    def _simulate(self, steps: list[tuple[int, int]], track: Track) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        dataset = self._dataset
        for number in sorted({draw // len(TAKES) for draw, _ in steps}):
            self._simulations[number] = PairSimulation.prepare(
                dataset.scene, dataset.probes, dataset.yaws, seed=dataset.seed + 1 + number, plan=self._plan
            )
        # The compiled code, which takes most of the time, releases the interpreter's lock.
        pool = ThreadPoolExecutor(_WORKERS, "draw")
        try:
            results = pool.map(self._draw, steps)
            for _ in zip(track(range(len(steps)), "drawing references"), results, strict=True):
                pass
        finally:
            pool.shutdown(cancel_futures=True)

    def _draw(self, step: tuple[int, int]) -> None:
        draw, emitter = step
        number, take = divmod(draw, len(TAKES))
        simulation = self._simulations[number]
        measured = []
        for listener, _, late in simulation.take(emitter, np.array(self._listeners(emitter)), take):
            response = self._geometric.complete(emitter, listener, late)
            measured.append(vars(measure(response, self._dataset.sample_rate, decay_db=self._decay_db)))
        path = self._file(draw, emitter)
        partial = path.with_suffix(f".{os.getpid()}.partial")  # another process may write the same file
        with partial.open("wb") as file:
            columns: dict[str, Any] = {name: np.stack([of_pair[name] for of_pair in measured]) for name in _NAMES}
            np.savez(file, **columns)
        partial.replace(path)


def _median(values: _Floats) -> _Floats:
    """The median over the first axis; NaN where more than half of the values are missing."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # raised where all values are NaN
        median = np.nanmedian(values, axis=0)
    return np.where(np.isnan(values).mean(axis=0) > 0.5, np.nan, median)
