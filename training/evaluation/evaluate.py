"""Evaluation of a field on held-out pairs, beside the baselines and the repeatability floor.

Axes: one held-out pair's impulse responses are `(yaw, channel, sample)`. Errors are those of
`server.acoustics.metrics`, entry by entry `(pair, yaw)`.
"""

from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field

import numpy as np
import numpy.typing as npt
from rich.table import Table

from server.acoustics.metrics import (
    PARAMETER_METRICS,
    SPECTRAL_LOSS,
    Metric,
    Summary,
    parameter_errors,
    spectral_loss,
    summarise,
)
from server.acoustics.room_parameters import measure

FIELD = "field"
FLOOR = "floor"
METRICS = (*PARAMETER_METRICS[:5], SPECTRAL_LOSS, *PARAMETER_METRICS[5:])
# A field that cannot be measured where a baseline can must not win by leaving those entries out.
_MISSING_ALLOWANCE = 0.01

Responses = npt.NDArray[np.floating]
PairSource = Callable[[int], Responses]  # held-out index -> (yaw, 2, sample)
_Errors = npt.NDArray[np.float64]


@dataclass(frozen=True)
class MetricRow:
    """One metric: a summary per column, and the verdict.

    beats_baselines: the field's mean error is below that of each baseline over the entries both could be measured in.
    above_floor: the best baseline's mean error exceeds the repeatability floor, so there is something to win.
    """

    name: str
    label: str
    unit: str
    columns: Mapping[str, Summary]
    beats_baselines: bool
    above_floor: bool

    @property
    def passes(self) -> bool:
        return self.beats_baselines or not self.above_floor


@dataclass(frozen=True)
class Evaluation:
    """What `nafir-train evaluate` reports. `errors[column][metric]` is `(pair, yaw)`, NaN where missing."""

    pairs: int
    visible_pairs: int
    yaws: int
    baselines: tuple[str, ...]
    rows: tuple[MetricRow, ...]
    errors: Mapping[str, Mapping[str, _Errors]] = field(repr=False, compare=False)

    def to_json(self) -> dict[str, object]:
        """Plain values for `json.dumps`; entry-wise errors are left out."""
        rows = [{**asdict(row), "passes": row.passes} for row in self.rows]
        return {
            "pairs": self.pairs,
            "visible_pairs": self.visible_pairs,
            "yaws": self.yaws,
            "baselines": list(self.baselines),
            "rows": rows,
        }


def evaluate(
    references: PairSource,
    *,
    field: PairSource,
    baselines: Mapping[str, PairSource],
    repeats: PairSource,
    visible: npt.NDArray[np.bool_],
    sample_rate: float,
    log_magnitude: Callable[[Responses], npt.NDArray[np.floating]],
    informational: Mapping[str, PairSource] | None = None,
    decay_db: float = 30.0,
    threads: int = 2,
    track: Callable[[range], Iterable[int]] = iter,
) -> Evaluation:
    """Measures every held-out pair at every yaw in every column.

    `visible` (pair,): whether the emitter is in sight; without sight there is no direct sound, and metrics that need
    one are missing. The direct sound is sought within 3 ms of where the reference has it. `repeats` is a second
    independent simulation of the references. `log_magnitude` maps `(yaw, 2, sample)` to the codec's spectrogram.
    The sources are called from several `threads`; `track` may wrap the loop over pairs in a progress bar.
    """
    if len(visible) == 0:
        raise ValueError("no pair is held out")
    if not baselines:
        raise ValueError("a field is judged against baselines: give at least one")
    sources = {FIELD: field, **baselines, **(informational or {}), FLOOR: repeats}
    if len(sources) != 2 + len(baselines) + len(informational or {}):
        raise ValueError("two columns have the same name")

    def pair_errors(pair: int) -> dict[str, dict[str, _Errors]]:
        reference = np.asarray(references(pair), dtype=np.float32)  # stored as float16, which is slow to compute with
        reference_parameters = measure(reference, sample_rate, decay_db=decay_db)
        onset = np.round(np.nan_to_num(reference_parameters.onset_s, nan=0.0) * sample_rate).astype(np.int64)
        reference_spectrogram = log_magnitude(reference)
        errors: dict[str, dict[str, _Errors]] = {}
        for column, source in sources.items():
            estimate = np.asarray(source(pair), dtype=np.float32)
            if estimate.shape != reference.shape:
                raise ValueError(f"{column}: responses of {estimate.shape} where the reference has {reference.shape}")
            parameters = measure(estimate, sample_rate, decay_db=decay_db, onset=onset)
            errors[column] = parameter_errors(reference_parameters, parameters)
            errors[column][SPECTRAL_LOSS.name] = spectral_loss(reference_spectrogram, log_magnitude(estimate))
            for metric in METRICS:
                if metric.needs_direct_sound and not visible[pair]:
                    errors[column][metric.name] = np.full_like(errors[column][metric.name], np.nan)
        return errors

    pool = ThreadPoolExecutor(threads)
    try:
        pairs = range(len(visible))
        by_pair = [errors for _, errors in zip(track(pairs), pool.map(pair_errors, pairs), strict=True)]
    finally:
        pool.shutdown(cancel_futures=True)
    errors_by_column = {
        column: {metric.name: np.stack([errors[column][metric.name] for errors in by_pair]) for metric in METRICS}
        for column in sources
    }
    return Evaluation(
        pairs=len(visible),
        visible_pairs=int(np.count_nonzero(visible)),
        yaws=errors_by_column[FIELD][METRICS[0].name].shape[1],
        baselines=tuple(baselines),
        rows=tuple(_row(metric, errors_by_column, tuple(baselines)) for metric in METRICS),
        errors=errors_by_column,
    )


def report(evaluation: Evaluation) -> Table:
    """The table for people: mean (median) per column; the best of field and baselines is bold."""
    in_sight = f"{evaluation.visible_pairs} in sight"
    table = Table(
        title=f"{evaluation.pairs} held-out pairs ({in_sight}), {evaluation.yaws} orientations each",
        caption="mean (median) error; n missing = entries that could not be measured or have no direct sound",
    )
    table.add_column("metric")
    for column in evaluation.errors:
        table.add_column(column, justify="right")
    table.add_column("verdict")
    for row in evaluation.rows:
        judged = {name: row.columns[name].mean for name in (FIELD, *evaluation.baselines)}
        best = min((mean for mean in judged.values() if mean is not None), default=None)
        cells = [
            _cell(summary, bold=name in judged and best is not None and summary.mean == best)
            for name, summary in row.columns.items()
        ]
        table.add_row(f"{row.label} ({row.unit})" if row.unit else row.label, *cells, _verdict(row))
    return table


def _cell(summary: Summary, *, bold: bool) -> str:
    if summary.mean is None or summary.median is None:
        return f"none, {summary.missing} missing"
    text = f"{summary.mean:.3g} ({summary.median:.3g})"
    missing = f"\n[dim]{summary.missing} missing[/dim]" if summary.missing else ""
    return (f"[bold]{text}[/bold]" if bold else text) + missing


def _verdict(row: MetricRow) -> str:
    if row.beats_baselines:
        return "[green]beats both[/green]" if len(row.columns) > 3 else "[green]beats it[/green]"
    return "[red]does not beat[/red]" if row.above_floor else "[yellow]at the floor[/yellow]"


def _row(metric: Metric, errors: Mapping[str, Mapping[str, _Errors]], baselines: tuple[str, ...]) -> MetricRow:
    columns = {column: summarise(by_metric[metric.name]) for column, by_metric in errors.items()}
    ours = errors[FIELD][metric.name]
    beats = all(_beats(ours, errors[baseline][metric.name]) for baseline in baselines)
    best = min((mean for name in baselines if (mean := columns[name].mean) is not None), default=None)
    floor = columns[FLOOR].mean
    above = best is not None and (floor is None or best > floor)
    return MetricRow(metric.name, metric.label, metric.unit, columns, beats, above)


def _beats(ours: _Errors, theirs: _Errors) -> bool:
    both = ~np.isnan(ours) & ~np.isnan(theirs)
    only_theirs = np.isnan(ours) & ~np.isnan(theirs)
    if not both.any() or only_theirs.sum() > _MISSING_ALLOWANCE * ours.size:
        return False
    return bool(ours[both].mean() < theirs[both].mean())
