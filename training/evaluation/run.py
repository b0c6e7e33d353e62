"""`nafir-train evaluate`: fields, baselines and the repeatability floor on one dataset."""

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from server.scene.bundle import Bundle
from training.baselines.coded import Track
from training.baselines.held_out import EvaluationError, HeldOut
from training.data.dataset import Half
from training.evaluation.draws import median_parameters
from training.evaluation.elsewhere import Comparison, measure_elsewhere
from training.evaluation.evaluate import Column, Evaluation, Kind, evaluate
from training.evaluation.figure import draw_figure
from training.evaluation.methods import DEFAULT_METHODS, floor_columns, simulation_column
from training.evaluation.published import PublishedTable, published_table
from training.evaluation.stored_errors import StoredErrors
from training.parallel.jobs import ALL_CORES, Jobs


def evaluate_bundles(
    bundles: Sequence[Bundle],
    data: Path,
    *,
    runs: Sequence[Path] = (),
    methods: Sequence[str] = DEFAULT_METHODS,
    pairs: int | None = None,
    yaws: int | None = None,
    half: Half | None = None,
    draws: int = 1,
    hrtf: Path | None = None,
    tilt_deg: float = 0.0,
    seed: int = 0,
    figure: Path | None = None,
    keep: Path | None = None,
    jobs: Jobs = ALL_CORES,
    track: Track = lambda steps, _: steps,
) -> tuple[Evaluation, PublishedTable]:
    """Evaluate each quality level of each bundle, and the field of each run folder on measured data, beside `methods`
    and the floor. All are evaluated on the same held-out pairs and orientations: all of them, or the numbers given by
    `pairs` and `yaws`, and with `half` only those of one half of the held-out pairs. Parameters are compared with
    medians over `draws` simulations, or with those of the dataset's own simulation. With `hrtf` (a SOFA file) or
    `tilt_deg`, all are heard through that head, or with the head tilted by so many degrees. `figure` is the path of a
    PNG to draw. Errors are stored in the file `keep` pair by pair, so that an interrupted evaluation can be resumed;
    the file is removed at the end. With `jobs` on other nodes, these measure errors, a column at a time, from the same
    paths; times are measured here.

    Raises EvaluationError, DatasetError if the dataset and a bundle are of different scenes, and RunError for a run on
    other data.
    """
    if hrtf is not None or tilt_deg:
        _require_waveforms(methods, draws)
    comparison = Comparison(tuple(bundles), data, tuple(runs), tuple(methods), pairs, yaws, half, hrtf, tilt_deg, seed)
    of, held_out = comparison.open()
    truth = median_parameters(held_out, draws, jobs=jobs, track=track) if draws > 1 else []
    columns = comparison.columns(held_out, track)
    measured = [*columns, *([simulation_column(held_out)] if truth else []), *floor_columns(held_out)]
    with _stored(keep, comparison, [column.name for column in measured], draws) as stored:
        if jobs.are_elsewhere:
            measure_elsewhere(comparison, held_out, measured, truth, stored, jobs=jobs, track=track)
        evaluation = evaluate(
            held_out,
            measured,
            of=of,
            truth=truth,
            draws=draws,
            stored=stored,
            track=lambda steps: track(steps, "evaluating"),
        )
        if figure is not None:
            _draw(evaluation, figure, held_out, columns)
        stored.discard()
    return evaluation, published_table(simulated=held_out.simulated is not None)


@contextmanager
def _stored(keep: Path | None, comparison: Comparison, names: list[str], draws: int) -> Iterator[StoredErrors]:
    """The errors that are stored in a file, or in a temporary one."""
    depends_on: list[Any] = [comparison.files(), names, comparison.pairs, comparison.yaws, comparison.half, draws]
    depends_on += [comparison.seed, comparison.tilt_deg, str(comparison.hrtf)]
    if keep is not None:
        yield StoredErrors(keep, depends_on)
        return
    with tempfile.TemporaryDirectory(prefix="nafir-") as folder:
        yield StoredErrors(Path(folder) / "errors", depends_on)


def _require_waveforms(methods: Sequence[str], draws: int) -> None:
    """Raises EvaluationError for methods that hear through the data's own head, or for medians over simulations of
    it."""
    if draws > 1:
        raise EvaluationError(
            "--draws: are simulations through the data's own head; leave it out with --hrtf or --tilt"
        )
    for name in methods:
        if name not in DEFAULT_METHODS:
            known = ", ".join(DEFAULT_METHODS)
            raise EvaluationError(
                f"--methods: {name} knows the data's own head only; with --hrtf or --tilt take {known}"
            )


def _draw(evaluation: Evaluation, path: Path, held_out: HeldOut, columns: Sequence[Column]) -> None:
    draw_figure(
        evaluation,
        path,
        references=held_out.reference,
        reference_name="measured response" if held_out.simulated is None else "simulated response",
        columns={column.name: column.source for column in _drawn(columns)},
        yaw_index=held_out.yaw_indices[:1],
        examples=_examples(held_out),
        sample_rate=held_out.sample_rate,
    )


def _drawn(columns: Sequence[Column]) -> list[Column]:
    """The columns to draw: the first field and the first baseline. A second level of a field would hide the first."""
    first: dict[Kind, Column] = {}
    for column in columns:
        first.setdefault(column.kind, column)
    return list(first.values())


def _examples(held_out: HeldOut) -> list[tuple[int, str]]:
    """Held-out pairs to show: the closest and the farthest, in sight and out of sight."""
    distance = np.linalg.norm(held_out.emitters - held_out.listeners, axis=-1)
    examples = []
    for visible, label in ((True, "in sight"), (False, "round the corner")):
        chosen = np.flatnonzero(held_out.visible == visible)
        ordered = chosen[np.argsort(distance[chosen])]
        ends = dict.fromkeys([*ordered[:1], *ordered[-1:]])
        examples += [(int(index), f"{label}, {distance[index]:.1f} m") for index in ends]
    return examples
