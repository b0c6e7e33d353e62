"""`nafir-train evaluate`: fields, baselines and the repeatability floor on one dataset."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from server.scene.bundle import Bundle
from training.baselines.coded import Track
from training.baselines.held_out import EvaluationError, HeldOut, open_held_out
from training.data.dataset import Half
from training.evaluation.draws import median_parameters
from training.evaluation.evaluate import Column, Evaluation, Kind, evaluate
from training.evaluation.fields import field_columns
from training.evaluation.figure import draw_figure
from training.evaluation.methods import DEFAULT_METHODS, floor_columns, method_columns, simulation_column
from training.evaluation.published import PublishedTable, published_table
from training.evaluation.stored_errors import StoredErrors, signature
from training.simulation.responses import open_responses


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
    track: Track = lambda steps, _: steps,
) -> tuple[Evaluation, PublishedTable]:
    """Evaluate each quality level of each bundle, and the field of each run folder on measured data, beside `methods`
    and the floor. All are evaluated on the same held-out pairs and orientations: all of them, or the numbers given by
    `pairs` and `yaws`, and with `half` only those of one half of the held-out pairs. Parameters are compared with
    medians over `draws` simulations, or with those of the dataset's own simulation. With `hrtf` (a SOFA file) or
    `tilt_deg`, all are heard through that head, or with the head tilted by so many degrees. `figure` is the path of a
    PNG to draw. Errors are stored in the file `keep` pair by pair, so that an interrupted evaluation can be resumed;
    the file is removed at the end.

    Raises EvaluationError, DatasetError if the dataset and a bundle are of different scenes, and RunError for a run on
    other data.
    """
    with open_held_out(data) as everything:
        everything = everything if half is None else everything.of_half(half)
        held_out = everything.sample(pairs=pairs, yaws=yaws, seed=seed)
        if hrtf is not None or tilt_deg:
            _require_waveforms(methods, draws)
            held_out = held_out.reheard(hrtf, tilt_deg=tilt_deg)
        truth = median_parameters(held_out, draws, track=track) if draws > 1 else []
        columns = field_columns(bundles, held_out)
        if runs:
            # Torch takes seconds to load, and bundles do not need it.
            from training.evaluation.measured_fields import run_columns

            responses = open_responses(data)
            columns += [column for run in runs for column in run_columns(run, responses, held_out)]
        columns += method_columns(methods, held_out, track)
        measured = [*columns, *([simulation_column(held_out)] if truth else []), *floor_columns(held_out)]
        stored = None
        if keep is not None:
            depends_on = [[bundle.digest for bundle in bundles], [signature(folder) for folder in (*runs, data)]]
            head = None if hrtf is None else [str(hrtf), hrtf.stat().st_size, hrtf.stat().st_mtime_ns]
            names = [column.name for column in measured]
            stored = StoredErrors(keep, [depends_on, names, pairs, yaws, half, draws, seed, tilt_deg, head])
        evaluation = evaluate(
            held_out,
            measured,
            of=len(everything),
            truth=truth,
            draws=draws,
            stored=stored,
            track=lambda steps: track(steps, "evaluating"),
        )
        if figure is not None:
            _draw(evaluation, figure, held_out, columns)
        if stored is not None:
            stored.discard()
        return evaluation, published_table(simulated=held_out.simulated is not None)


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
