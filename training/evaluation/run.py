"""`nafir-train evaluate`: fields, baselines and the repeatability floor on one dataset."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from server.scene.bundle import Bundle
from training.baselines.coded import Track
from training.baselines.held_out import HeldOut, open_held_out
from training.data.responses import open_responses
from training.evaluation.draws import median_parameters
from training.evaluation.evaluate import Column, Evaluation, Kind, evaluate
from training.evaluation.fields import field_columns
from training.evaluation.figure import draw_figure
from training.evaluation.kept_errors import KeptErrors, signature
from training.evaluation.methods import DEFAULT_METHODS, floor_columns, method_columns, simulation_column
from training.evaluation.published import PublishedTable, published_table


def evaluate_bundles(
    bundles: Sequence[Bundle],
    data: Path,
    *,
    runs: Sequence[Path] = (),
    methods: Sequence[str] = DEFAULT_METHODS,
    pairs: int | None = None,
    yaws: int | None = None,
    draws: int = 1,
    seed: int = 0,
    figure: Path | None = None,
    keep: Path | None = None,
    track: Track = lambda steps, _: steps,
) -> tuple[Evaluation, PublishedTable]:
    """Every quality level of every bundle, and the field of every run folder on measured data, beside `methods` and the
    floor, on the same pairs and orientations: all that are held out, or as many as asked for. Parameters are compared
    with the medians of so many `draws` of the simulation, or of one with its own. Optionally with a figure (PNG). What
    is measured is put into the file `keep` pair by pair, to go on with if interrupted, which in the end is removed.

    Raises EvaluationError, DatasetError if the dataset is of another scene than a bundle, and RunError for a run of
    other data.
    """
    with open_held_out(data) as everything:
        held_out = everything.sample(pairs=pairs, yaws=yaws, seed=seed)
        truth = median_parameters(held_out, draws, track=track) if draws > 1 else []
        columns = field_columns(bundles, held_out)
        if runs:
            # Torch takes seconds to load, and bundles do without.
            from training.evaluation.measured_fields import run_column

            responses = open_responses(data)
            columns += [run_column(run, responses, held_out) for run in runs]
        columns += method_columns(methods, held_out, track)
        measured = [*columns, *([simulation_column(held_out)] if truth else []), *floor_columns(held_out)]
        kept = None
        if keep is not None:
            made_of = [[bundle.digest for bundle in bundles], [signature(folder) for folder in (*runs, data)]]
            kept = KeptErrors(keep, [made_of, [column.name for column in measured], pairs, yaws, draws, seed])
        evaluation = evaluate(
            held_out,
            measured,
            of=len(everything),
            truth=truth,
            draws=draws,
            kept=kept,
            track=lambda steps: track(steps, "evaluating"),
        )
        if figure is not None:
            _draw(evaluation, figure, held_out, columns)
        if kept is not None:
            kept.discard()
        return evaluation, published_table(simulated=held_out.simulated is not None)


def _draw(evaluation: Evaluation, path: Path, held_out: HeldOut, columns: Sequence[Column]) -> None:
    draw_figure(
        evaluation,
        path,
        references=held_out.reference,
        reference_name="measured response" if held_out.simulated is None else "simulated response",
        columns={column.name: column.source for column in _drawn(columns)},
        turn=held_out.heard[:1],
        examples=_examples(held_out),
        sample_rate=held_out.sample_rate,
    )


def _drawn(columns: Sequence[Column]) -> list[Column]:
    """The first field and the first baseline: two levels of a field would hide each other."""
    first: dict[Kind, Column] = {}
    for column in columns:
        first.setdefault(column.kind, column)
    return list(first.values())


def _examples(held_out: HeldOut) -> list[tuple[int, str]]:
    """Held-out pairs worth looking at: the closest and farthest in sight, and out of sight."""
    distance = np.linalg.norm(held_out.emitters - held_out.listeners, axis=-1)
    examples = []
    for visible, label in ((True, "in sight"), (False, "round the corner")):
        chosen = np.flatnonzero(held_out.visible == visible)
        ordered = chosen[np.argsort(distance[chosen])]
        ends = dict.fromkeys([*ordered[:1], *ordered[-1:]])
        examples += [(int(index), f"{label}, {distance[index]:.1f} m") for index in ends]
    return examples
