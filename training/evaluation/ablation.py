"""An ablation: trains one run per factor on the same data, with all else equal, and compares their errors.

Every run can be resumed, and finished runs are not trained again. Errors are those of the held-out pairs against the
responses themselves, in units that do not depend on how a run was trained.
"""

from collections.abc import Iterable
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from rich.progress import Progress

from server.core.errors import NafirError
from training.data.responses import ResponseSet
from training.learning.factorised import FactorisedLearner
from training.learning.runs import Configuration, FactorisedRecipe
from training.learning.train import load_learner, train
from training.models.factorised import ExportedField
from training.models.targets import align, delay_samples
from training.parallel.jobs import ALL_CORES, IsOver, Job, Jobs
from training.simulation.responses import SimulatedResponses, open_responses

_MOST_ROWS = 600
_BATCH = 32
_DECAY_RANGE_DB = 40.0


class AblationError(NafirError):
    """There is nothing to compare."""


@dataclass(frozen=True)
class Row:
    """One run and its errors. `spectral`: mean absolute error in ln magnitude. `level_db`: mean error of the energy of
    each response. `decay_db`: mean error of decay curves over their first 40 dB."""

    name: str
    configuration: Configuration
    spectral: float
    level_db: float
    decay_db: float


def variants(base: Configuration, responses: ResponseSet, teacher: Path | None) -> dict[str, Configuration]:
    """The base configuration and its variants by name, each with one factor changed; variants that the data do not
    allow are left out."""
    recipe = base.recipe
    if not isinstance(recipe, FactorisedRecipe):
        raise AblationError(f"field: {base.name} has no factors to vary; the factorised field has")
    changed = {
        "no level correction": replace(recipe, level_correction=False),
        "no error of energies": replace(recipe, energy_weight=0.0),
        "half the fine frames": replace(recipe, fine_frames=recipe.fine_frames // 2),
    }
    if isinstance(responses, SimulatedResponses):
        changed["drawn responses"] = replace(recipe, expected=False)
    if responses.channels == 1:
        changed["swapped ends"] = replace(recipe, swap=True)
    if teacher is not None:
        changed["taught by naf"] = replace(recipe, teacher=str(teacher.resolve()))
    return {"as it is": base, **{name: replace(base, recipe=each) for name, each in changed.items()}}


def ablate(
    responses: ResponseSet,
    folder: Path,
    configurations: dict[str, Configuration],
    progress: Progress,
    *,
    jobs: Jobs = ALL_CORES,
) -> list[Row]:
    """Train each configuration in its own folder, unless it is already trained, and measure the errors of all.

    In this process that is one after the other, with all of torch's threads. With `jobs` on other nodes each
    configuration is one of them, with as many threads as here, and the data and `folder` have the same paths there.

    Raises AblationError if no pair is held out.
    """
    if not responses.held_out.any():
        raise AblationError("data: no pair is held out, so nothing can be measured; import them with a share held out")
    if not jobs.are_elsewhere:
        return [_row(responses, folder, name, each, progress) for name, each in configurations.items()]
    data, threads = responses.file.parent.resolve(), torch.get_num_threads()
    variants = [
        Job(f"data {data.name}, ablation {name!r}", _Variant(name, each)) for name, each in configurations.items()
    ]
    task = progress.add_task("training", total=len(variants))
    found: dict[str, Row] = {}
    with closing(jobs.run(_train, _Ablation(data, folder.resolve(), threads), variants, cores=threads)) as rows:
        for variant, row in rows:
            found[variant.name] = row
            progress.advance(task)
    return [found[name] for name in configurations]


@dataclass(frozen=True)
class _Ablation:
    """Folders of the data and of the runs, and the number of torch's threads."""

    data: Path
    folder: Path
    threads: int


@dataclass(frozen=True)
class _Variant:
    name: str
    configuration: Configuration


def _train(ablation: _Ablation, variant: _Variant, _: IsOver) -> Row:
    torch.set_num_threads(ablation.threads)
    responses = open_responses(ablation.data)
    return _row(responses, ablation.folder, variant.name, variant.configuration, Progress(disable=True))


def _row(responses: ResponseSet, folder: Path, name: str, configuration: Configuration, progress: Progress) -> Row:
    """Train a configuration, or go on with it, and measure its errors."""
    run = folder / name.replace(" ", "-")
    train(responses, run, configuration, progress)
    learner = load_learner(responses, run)
    if not isinstance(learner, FactorisedLearner):
        raise TypeError(f"{run} holds no factorised field")
    rows = np.flatnonzero(responses.held_out)
    return Row(name, configuration, *_errors(learner, rows[:: -(-len(rows) // _MOST_ROWS)]))


@torch.no_grad()
def _errors(learner: FactorisedLearner, rows: npt.NDArray[np.int64]) -> tuple[float, float, float]:
    """The spectral, level and decay errors on these rows of the responses."""
    responses, codec = learner.responses, learner.cells.codec
    graph = ExportedField(learner.field, learner.cells).eval()
    spectral, level, decay = [], [], []
    for start in range(0, len(rows), _BATCH):
        some = rows[start : start + _BATCH]
        listener, emitter = responses.listener[some], responses.emitter[some]
        poses = (listener, emitter, responses.yaw[some], learner.site.paths(listener, emitter))
        tensors = (torch.from_numpy(part.astype(np.float32)) for part in poses)
        predicted = graph.forward_all_frames(*tensors)[0].numpy().astype(np.float64)
        read = responses.read(some)
        truth = np.stack([align(one, delay_samples(responses, row)) for one, row in zip(read, some, strict=True)])
        power = np.abs(codec.transform(truth)) ** 2
        spectral.append(np.abs(predicted - codec.log_magnitude(np.sqrt(power))).mean(axis=(1, 2, 3)))
        curves = [_decay_db(each) for each in (codec.magnitude(predicted) ** 2, power)]
        level.append(np.abs(curves[0][..., 0] - curves[1][..., 0]).mean(axis=1))
        relative = [curve - curve[..., :1] for curve in curves]
        within = relative[1] > -_DECAY_RANGE_DB
        decay.append((np.abs(relative[0] - relative[1]) * within).sum(axis=(1, 2)) / within.sum(axis=(1, 2)))
    of_spectrum, of_level, of_decay = (float(np.mean(np.concatenate(part))) for part in (spectral, level, decay))
    return of_spectrum, of_level, of_decay


def _decay_db(power: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """Convert power (..., frequency, frame) to energy (..., frame) from each frame on, summed over frequencies."""
    energy = power.sum(axis=-2)
    return np.asarray(10 * np.log10(np.maximum(np.cumsum(energy[..., ::-1], axis=-1)[..., ::-1], 1e-30)))


def table(rows: Iterable[Row]) -> list[tuple[str, ...]]:
    """The header and the rows, as text."""
    lines = [(row.name, f"{row.spectral:.4f}", f"{row.level_db:.2f}", f"{row.decay_db:.2f}") for row in rows]
    return [("factor", "spectral (ln)", "level (dB)", "decay (dB)"), *lines]
