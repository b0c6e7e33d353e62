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
from contextlib import closing
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from server.acoustics.room_parameters import RoomParameters, measure
from training.baselines.coded import Track
from training.baselines.held_out import EvaluationError, HeldOut
from training.data.dataset import TAKES, Dataset
from training.parallel.jobs import ALL_CORES, IsOver, Job, Jobs
from training.simulation.pairs import PairSimulation
from training.simulation.references import GeometricSound

_FOLDER = "draws"
_FORMAT = 3
"""This number must change whenever simulations, or the parameters measured in them, change."""
# With 20,000 rays, the reverberation time of a small room has an error of 0.9 %, the same for all pairs.
_TAIL_RAYS = 16
_NAMES = tuple(field.name for field in fields(RoomParameters))
_Floats = npt.NDArray[np.float64]
_Parameters = dict[str, _Floats]


def median_parameters(
    held_out: HeldOut,
    draws: int,
    *,
    decay_db: float = 30.0,
    jobs: Jobs = ALL_CORES,
    track: Track = lambda steps, _: steps,
) -> list[RoomParameters]:
    """The parameters of each held-out pair at the evaluated orientations: medians over `draws` simulations, none of
    which is in the dataset. A value that cannot be measured in more than half of the draws is missing.

    Raises EvaluationError for measured data.
    """
    dataset = held_out.simulated
    if dataset is None:
        raise EvaluationError("--draws: what was measured cannot be drawn again; leave it out")
    ends = [divmod(int(pair), len(dataset.probes)) for pair in held_out.held_out]
    medians = _Draws(dataset, decay_db, jobs).medians(sorted({emitter for emitter, _ in ends}), draws, track)
    return [
        RoomParameters(**{name: values[held_out.yaw_indices] for name, values in medians[emitter, listener].items()})
        for emitter, listener in ends
    ]


class _Draws:
    """Simulates draws for one dataset and stores their parameters. Responses are complete; decay times are measured
    over `decay_db`."""

    def __init__(self, dataset: Dataset, decay_db: float, jobs: Jobs) -> None:
        self._dataset = dataset
        self._decay_db = decay_db
        self._jobs = jobs
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
            for row, listener in enumerate(_listeners(self._dataset, emitter)):
                of_pairs[emitter, int(listener)] = {name: values[row] for name, values in medians.items()}
        return of_pairs

    def _file(self, draw: int, emitter: int) -> Path:
        return self._folder / f"{draw}-{emitter}.npz"

    def _simulate(self, steps: list[tuple[int, int]], track: Track) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        dataset = self._dataset
        numbers = sorted({draw // len(TAKES) for draw, _ in steps})
        simulations = {
            number: PairSimulation.prepare(
                dataset.scene, dataset.probes, dataset.yaws, seed=dataset.seed + 1 + number, plan=self._plan
            )
            for number in numbers
        }
        drawing = _Drawing(dataset, GeometricSound(dataset), simulations, self._decay_db)
        jobs = [
            Job(f"scene {dataset.scene.id}, emitter {emitter}, draw {draw}", (draw, emitter)) for draw, emitter in steps
        ]
        with closing(self._jobs.run(_draw, drawing, jobs)) as drawn:
            for _, (step, parameters) in zip(track(range(len(steps)), "drawing references"), drawn, strict=True):
                self._write(step, parameters)

    def _write(self, step: tuple[int, int], parameters: _Parameters) -> None:
        path = self._file(*step)
        partial = path.with_suffix(f".{os.getpid()}.partial")  # another process may write the same file
        with partial.open("wb") as file:
            columns: dict[str, Any] = dict(parameters)
            np.savez(file, **columns)
        partial.replace(path)


@dataclass(frozen=True)
class _Drawing:
    """What all draws of a dataset need: simulations by number, and the sound that geometry computes."""

    dataset: Dataset
    geometric: GeometricSound
    simulations: dict[int, PairSimulation]
    decay_db: float


def _draw(drawing: _Drawing, step: tuple[int, int], _: IsOver) -> _Parameters:
    """The parameters (listener, yaw) or (listener, yaw, ear) by name of a draw of an emitter."""
    draw, emitter = step
    number, take = divmod(draw, len(TAKES))
    measured = []
    for listener, _energy, late in drawing.simulations[number].take(
        emitter, _listeners(drawing.dataset, emitter), take
    ):
        response = drawing.geometric.complete(emitter, listener, late)
        measured.append(vars(measure(response, drawing.dataset.sample_rate, decay_db=drawing.decay_db)))
    return {name: np.stack([of_pair[name] for of_pair in measured]) for name in _NAMES}


def _listeners(dataset: Dataset, emitter: int) -> npt.NDArray[np.int64]:
    """All held-out listeners of an emitter, even if only some are evaluated."""
    return np.flatnonzero(dataset.held_out[emitter])


def _median(values: _Floats) -> _Floats:
    """The median over the first axis; NaN where more than half of the values are missing."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # raised where all values are NaN
        median = np.nanmedian(values, axis=0)
    return np.where(np.isnan(values).mean(axis=0) > 0.5, np.nan, median)
