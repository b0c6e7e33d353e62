"""Evaluation of any number of methods on held-out pairs: errors, storage, and time per response.

Axes: the responses of one held-out pair are `(yaw, channel, sample)`. Errors are those of `server.acoustics.metrics`,
for each `(pair, yaw)`.
"""

import os
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
import numpy.typing as npt

from server.acoustics.codec import Codec
from server.acoustics.metrics import (
    PARAMETER_METRICS,
    SPECTRAL_LOSS,
    Metric,
    Summary,
    parameter_errors,
    spectral_loss,
    summarise,
)
from server.acoustics.room_parameters import RoomParameters, measure
from training.baselines.held_out import EvaluationError, HeldOut, Responses
from training.evaluation.paper_metrics import PAPER_METRICS, PaperErrors
from training.evaluation.stored_errors import Errors, StoredErrors
from training.learning.record import TrainingRecord

FLOOR = "floor"
ONE_SIMULATION = "one simulation"
METRICS: tuple[Metric, ...] = (SPECTRAL_LOSS, *PARAMETER_METRICS, *PAPER_METRICS)
# A difference of means within this many standard errors is attributed to chance.
_STANDARD_ERRORS = 2.0
# A method must not win because its hardest entries cannot be measured.
_MISSING_ALLOWANCE = 0.01
DECAY_DB = 30.0
"""Decay times are measured over so much, unless a caller wants another range."""
_TIMED_PAIRS = 7
_TIMED_S = 5.0
SPECTRAL_WINDOW_S = 0.0107
SPECTRAL_FLOOR = 1e-5

Kind = Literal["field", "baseline", "simulation", "floor"]
RATED = frozenset({"field", "baseline"})
"""The kinds of column that are compared with each other and timed. Simulations only serve for comparison."""
Source = Callable[[int, npt.NDArray[np.integer]], Responses | None]
"""A function that takes the index of a held-out pair and indices (n,) of the data's yaws. It returns responses (n,
channel, sample), or None if the method has no estimate. Several threads call it."""
_Errors = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Column:
    """One method. storage_bytes: what it must store for the scene. method: its name in published tables. extra_ms: time
    per response that was spent in advance, and that `source` therefore does not take. training: how far a network was
    trained. A column of kind "floor" is a
    second simulation, which is always compared with the first. One of kind "simulation" is compared like a method."""

    name: str
    source: Source
    kind: Kind
    storage_bytes: int | None = None
    method: str = ""
    extra_ms: float = 0.0
    training: TrainingRecord | None = None


@dataclass(frozen=True)
class Result:
    """The results of a column. ms: time of one response on one core, everything included. beats: baselines with a
    larger mean error, by metric, over the entries that both have. surpassed_by: fields and baselines whose error is
    smaller by more than two standard errors of the difference over pairs."""

    name: str
    kind: Kind
    method: str
    storage_bytes: int | None
    ms: float | None
    summaries: Mapping[str, Summary]
    beats: Mapping[str, tuple[str, ...]]
    surpassed_by: Mapping[str, tuple[str, ...]]
    errors: Mapping[str, _Errors] = field(repr=False, compare=False)
    training: TrainingRecord | None = None


@dataclass(frozen=True)
class Evaluation:
    """The result of `nafir-train evaluate`. `held_out` is the number of held-out pairs, `pairs` that of the evaluated
    ones, and `draws` the number of simulations whose median parameters are the reference. The floor is the difference
    between two simulations, so with several draws errors are not given in multiples of it."""

    data: str
    pairs: int
    held_out: int
    visible_pairs: int
    yaws: int
    channels: int
    left_out: int
    draws: int
    results: tuple[Result, ...]

    def of(self, name: str) -> Result:
        return next(result for result in self.results if result.name == name)

    @property
    def baselines(self) -> tuple[str, ...]:
        return tuple(result.name for result in self.results if result.kind == "baseline")

    @property
    def floor(self) -> Result | None:
        return next((result for result in self.results if result.kind == "floor"), None)

    def to_json(self) -> dict[str, object]:
        """Convert to plain values for `json.dumps`, without the errors of single entries."""
        floor = self.floor
        columns = {}
        for result in self.results:
            columns[result.name] = {
                "kind": result.kind,
                "method": result.method,
                "storage_bytes": result.storage_bytes,
                "ms": result.ms,
                "training": None if result.training is None else asdict(result.training),
                "metrics": {
                    metric.name: {
                        **asdict(result.summaries[metric.name]),
                        "times_floor": None if self.draws > 1 else _ratio(result.summaries[metric.name], floor, metric),
                        "beats": list(result.beats[metric.name]),
                        "surpassed_by": list(result.surpassed_by[metric.name]),
                    }
                    for metric in METRICS
                },
            }
        return {
            "data": self.data,
            "pairs": self.pairs,
            "held_out_pairs": self.held_out,
            "visible_pairs": self.visible_pairs,
            "left_out_pairs": self.left_out,
            "yaws": self.yaws,
            "channels": self.channels,
            "draws": self.draws,
            "metrics": [{"name": metric.name, "label": metric.label, "unit": metric.unit} for metric in METRICS],
            "columns": columns,
        }


@dataclass(frozen=True)
class PairErrors:
    """Measures the errors of all columns for one held-out pair at a time."""

    held_out: HeldOut
    columns: Sequence[Column]
    truth: Sequence[RoomParameters]
    decay_db: float
    stored: StoredErrors | None = None

    @cached_property
    def _codec(self) -> Codec:
        return spectral_codec(self.held_out.sample_rate, self.held_out.samples)

    def of_pair(self, pair: int) -> Errors:
        """The errors by column; read from `stored` if they are there, otherwise measured and stored."""
        found = {} if self.stored is None else self.stored.get(pair)
        missing = [number for number in range(len(self.columns)) if number not in found]
        if not missing:
            return found
        reference = np.asarray(self.held_out.reference(pair), dtype=np.float32)
        simulated = measure(reference, self.held_out.sample_rate, decay_db=self.decay_db)
        spectrogram = self._codec.log_magnitude(self._codec.transform(reference))
        paper = PaperErrors(reference, self.held_out.sample_rate)
        measured = {
            number: self._of_column(self.columns[number], pair, paper, simulated, spectrogram) for number in missing
        }
        if self.stored is not None:
            self.stored.put(pair, measured)
        return {**found, **measured}

    def _of_column(
        self,
        column: Column,
        pair: int,
        paper: PaperErrors,
        simulated: RoomParameters,
        spectrogram: npt.NDArray[np.floating],
    ) -> dict[str, _Errors]:
        """The errors (yaw,) by metric, compared with the reference of `paper`, which has these parameters and this
        log-magnitude spectrogram."""
        shape = paper.reference.shape
        answer = column.source(pair, self.held_out.yaw_indices)
        if answer is None:
            return {metric.name: np.full(shape[0], np.nan) for metric in METRICS}
        estimate = np.asarray(answer, dtype=np.float32)
        if estimate.shape != shape:
            raise EvaluationError(f"{column.name}: responses of {estimate.shape} where the data have {shape}")
        sample_rate = self.held_out.sample_rate
        true = self.truth[pair] if self.truth and column.kind != "floor" else simulated
        onset = np.round(np.nan_to_num(true.onset_s, nan=0.0) * sample_rate).astype(np.int64)
        estimated = measure(estimate, sample_rate, decay_db=self.decay_db, onset=onset)
        errors = parameter_errors(true, estimated)
        errors[SPECTRAL_LOSS.name] = spectral_loss(
            spectrogram, self._codec.log_magnitude(self._codec.transform(estimate))
        )
        errors |= paper.of(estimate)
        if column.kind == "simulation":  # it is the reference itself
            for metric in (SPECTRAL_LOSS, *PAPER_METRICS):
                errors[metric.name][:] = np.nan
        for metric in METRICS:
            if metric.needs_direct_sound and not self.held_out.visible[pair]:
                errors[metric.name] = np.full(shape[0], np.nan)
        return errors


def evaluate(
    held_out: HeldOut,
    columns: Sequence[Column],
    *,
    of: int | None = None,
    truth: Sequence[RoomParameters] = (),
    draws: int = 1,
    decay_db: float = DECAY_DB,
    threads: int | None = None,
    stored: StoredErrors | None = None,
    timed: bool = True,
    track: Callable[[range], Iterable[int]] = iter,
) -> Evaluation:
    """Measure every column on every held-out pair at every evaluated orientation.

    If the emitter is not in sight there is no direct sound, and metrics that need one are missing. If a method has no
    estimate, all metrics are missing. The direct sound is searched for within 3 ms of that of the reference.

    of: the number of held-out pairs from which these were drawn. truth: reference parameters by pair, which are medians
    over `draws` simulations; by default, those of the reference response. Spectra are always compared with the
    reference response. Sources are called from several `threads` (one per core) for errors, and one at a time for
    timing, if that is asked for (`timed`). Pairs in `stored` are not measured again. `track` may wrap the loop over
    pairs in a progress bar.
    """
    names = [column.name for column in columns]
    if len(set(names)) < len(names):
        raise EvaluationError(f"two columns have the same name among {', '.join(names)}")
    measurement = PairErrors(held_out, columns, truth, decay_db, stored)
    pool = ThreadPoolExecutor(threads or os.cpu_count())
    try:
        pairs = range(len(held_out))
        by_pair = [errors for _, errors in zip(track(pairs), pool.map(measurement.of_pair, pairs), strict=True)]
    finally:
        pool.shutdown(cancel_futures=True)
    errors = {
        name: {metric.name: np.stack([entry[number][metric.name] for entry in by_pair]) for metric in METRICS}
        for number, name in enumerate(names)
    }
    return Evaluation(
        data=held_out.name,
        pairs=len(held_out),
        held_out=of or len(held_out),
        visible_pairs=int(np.count_nonzero(held_out.visible)),
        yaws=len(held_out.yaw_indices),
        channels=held_out.channels,
        left_out=held_out.left_out,
        draws=draws,
        results=tuple(_result(column, held_out, errors, columns, timed=timed) for column in columns),
    )


def spectral_codec(sample_rate: int, samples: int) -> Codec:
    """The codec of spectral losses, the same for every method. Windows are about 11 ms long (256 samples at 24 kHz)
    with a hop of a quarter, and the floor of magnitudes is 100 dB below a unit impulse. The paper's windows are twice
    as long, and its floor is 40 dB higher, which would hide all of our late tails."""
    n_fft = 2 ** round(np.log2(SPECTRAL_WINDOW_S * sample_rate))
    return Codec(sample_rate, n_fft, n_fft // 4, samples, SPECTRAL_FLOOR)


def milliseconds_per_response(column: Column, held_out: HeldOut) -> float | None:
    """The median time of one response, computed alone in this thread. A first run, which loads data from disk, does not
    count. None if the method has no estimate for any pair."""
    times_s = []
    began = time.perf_counter()
    for number, pair in enumerate(np.linspace(0, len(held_out) - 1, min(_TIMED_PAIRS, len(held_out))).astype(int)):
        yaw_index = held_out.yaw_indices[[number % len(held_out.yaw_indices)]]
        if column.source(int(pair), yaw_index) is None:
            continue
        start = time.perf_counter()
        column.source(int(pair), yaw_index)
        times_s.append(time.perf_counter() - start)
        if time.perf_counter() - began > _TIMED_S:
            break
    return 1e3 * statistics.median(times_s) + column.extra_ms if times_s else None


def _result(
    column: Column,
    held_out: HeldOut,
    errors: Mapping[str, Mapping[str, _Errors]],
    columns: Sequence[Column],
    *,
    timed: bool,
) -> Result:
    ours = errors[column.name]
    rivals = [other.name for other in columns if other.kind in RATED and other is not column]
    baselines = [other.name for other in columns if other.kind == "baseline" and other is not column]
    return Result(
        name=column.name,
        kind=column.kind,
        method=column.method,
        storage_bytes=column.storage_bytes,
        ms=milliseconds_per_response(column, held_out) if timed and column.kind in RATED else None,
        summaries={metric.name: summarise(ours[metric.name]) for metric in METRICS},
        beats={
            metric.name: tuple(name for name in baselines if _beats(ours[metric.name], errors[name][metric.name]))
            for metric in METRICS
        },
        surpassed_by={
            metric.name: tuple(name for name in rivals if _surpasses(errors[name][metric.name], ours[metric.name]))
            for metric in METRICS
        },
        errors=ours,
        training=column.training,
    )


def _ratio(summary: Summary, floor: Result | None, metric: Metric) -> float | None:
    """The mean error divided by the mean error of the floor; None if either is missing."""
    least = None if floor is None else floor.summaries[metric.name].mean
    return None if summary.mean is None or not least else summary.mean / least


def _beats(ours: _Errors, theirs: _Errors) -> bool:
    both = ~np.isnan(ours) & ~np.isnan(theirs)
    only_theirs = np.isnan(ours) & ~np.isnan(theirs)
    if not both.any() or only_theirs.sum() > _MISSING_ALLOWANCE * ours.size:
        return False
    return bool(ours[both].mean() < theirs[both].mean())


def _surpasses(ours: _Errors, theirs: _Errors) -> bool:
    """Whether the difference exceeds chance. The entries of one pair are averaged, because they are not independent."""
    gains = (theirs - ours).reshape(len(ours), -1)
    measured = ~np.isnan(gains)
    gain = np.sum(gains, axis=1, where=measured)[measured.any(axis=1)] / measured.sum(axis=1)[measured.any(axis=1)]
    if len(gain) < 2:
        return False
    return bool(gain.mean() > _STANDARD_ERRORS * gain.std(ddof=1) / np.sqrt(len(gain)))
