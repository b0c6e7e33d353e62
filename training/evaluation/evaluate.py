"""Evaluation of any number of methods on held-out pairs: errors entry by entry, storage, and time per response.

Axes: one held-out pair's impulse responses are `(yaw, channel, sample)`. Errors are those of
`server.acoustics.metrics`, entry by entry `(pair, yaw)`.
"""

import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
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
from training.evaluation.kept_errors import Errors, KeptErrors

FLOOR = "floor"
ONE_SIMULATION = "one simulation"
METRICS: tuple[Metric, ...] = (SPECTRAL_LOSS, *PARAMETER_METRICS)
# Means that are nearer to each other are taken for luck of the draw.
_STANDARD_ERRORS = 2.0
# A method that cannot be measured where another can must not win by leaving those entries out.
_MISSING_ALLOWANCE = 0.01
_TIMED_PAIRS = 7
_TIMED_S = 5.0
_SPECTRAL_WINDOW_S = 0.0107
_SPECTRAL_FLOOR = 1e-5

Kind = Literal["field", "baseline", "simulation", "floor"]
RATED = frozenset({"field", "baseline"})
"""What is told from what, and how long it takes: simulations are there to compare with."""
Source = Callable[[int, npt.NDArray[np.integer]], Responses | None]
"""Held-out index and orientations (n,), indices into the yaws of the data, to (n, channel, sample); None where the
method has no answer. Called from several threads."""
_Errors = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Column:
    """One method. storage_bytes: what it has to keep of the scene; method: its name in published tables;
    extra_ms: time per response that `source` does not spend because it was spent beforehand. Of kind "floor" it is a
    second simulation, compared with the first whatever the others are compared with, and of kind "simulation" one that
    is compared as they are."""

    name: str
    source: Source
    kind: Kind
    storage_bytes: int | None = None
    method: str = ""
    extra_ms: float = 0.0


@dataclass(frozen=True)
class Result:
    """A column measured. ms: of one response on one core, everything included; beats: baselines whose mean error is
    larger over the entries both could be measured in, by metric; surpassed_by: fields and baselines whose error is
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


@dataclass(frozen=True)
class Evaluation:
    """What `nafir-train evaluate` reports; `held_out` is how many pairs there are, `pairs` how many were measured,
    `draws` of how many simulations parameters were compared with the medians. The floor is what two simulations differ
    by, so where there are several nothing is told in its multiples."""

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
        """Plain values for `json.dumps`; entry-wise errors are left out."""
        floor = self.floor
        columns = {}
        for result in self.results:
            columns[result.name] = {
                "kind": result.kind,
                "method": result.method,
                "storage_bytes": result.storage_bytes,
                "ms": result.ms,
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


def evaluate(
    held_out: HeldOut,
    columns: Sequence[Column],
    *,
    of: int | None = None,
    truth: Sequence[RoomParameters] = (),
    draws: int = 1,
    decay_db: float = 30.0,
    threads: int = 2,
    kept: KeptErrors | None = None,
    track: Callable[[range], Iterable[int]] = iter,
) -> Evaluation:
    """Measures every held-out pair at every orientation that is heard, in every column.

    Where the emitter is not in sight there is no direct sound, and metrics that need one are missing; what a method
    does not answer is missing in all of them. The direct sound is sought within 3 ms of where the reference has it.
    `of`: the held-out pairs that these were drawn from. `truth`: what parameters are compared with, pair by pair,
    medians of so many `draws`; where there is none, with the reference's own. Spectra are always compared with the
    reference. Sources are called from several `threads` for errors, and one at a time for what they take. Errors of
    pairs that `kept` holds are not measured again. `track` may wrap the loop over pairs in a progress bar.
    """
    codec = spectral_codec(held_out.sample_rate, held_out.samples)
    names = [column.name for column in columns]
    if len(set(names)) < len(names):
        raise EvaluationError(f"two columns have the same name among {', '.join(names)}")

    def pair_errors(pair: int) -> Errors:
        if kept is not None and (found := kept.get(pair)) is not None:
            return found
        reference = np.asarray(held_out.reference(pair), dtype=np.float32)
        simulated = measure(reference, held_out.sample_rate, decay_db=decay_db)
        parameters = truth[pair] if truth else simulated
        spectrogram = codec.log_magnitude(codec.transform(reference))

        def errors_of(column: Column) -> dict[str, _Errors]:
            answer = column.source(pair, held_out.heard)
            if answer is None:
                return {metric.name: np.full(len(reference), np.nan) for metric in METRICS}
            estimate = np.asarray(answer, dtype=np.float32)
            if estimate.shape != reference.shape:
                raise EvaluationError(
                    f"{column.name}: responses of {estimate.shape} where the data have {reference.shape}"
                )
            true = simulated if column.kind == "floor" else parameters
            onset = np.round(np.nan_to_num(true.onset_s, nan=0.0) * held_out.sample_rate).astype(np.int64)
            estimated = measure(estimate, held_out.sample_rate, decay_db=decay_db, onset=onset)
            errors = parameter_errors(true, estimated)
            errors[SPECTRAL_LOSS.name] = spectral_loss(spectrogram, codec.log_magnitude(codec.transform(estimate)))
            if column.kind == "simulation":  # the reference itself
                errors[SPECTRAL_LOSS.name][:] = np.nan
            for metric in METRICS:
                if metric.needs_direct_sound and not held_out.visible[pair]:
                    errors[metric.name] = np.full(len(reference), np.nan)
            return errors

        errors = [errors_of(column) for column in columns]
        if kept is not None:
            kept.put(pair, errors)
        return errors

    pool = ThreadPoolExecutor(threads)
    try:
        pairs = range(len(held_out))
        by_pair = [errors for _, errors in zip(track(pairs), pool.map(pair_errors, pairs), strict=True)]
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
        yaws=len(held_out.heard),
        channels=held_out.channels,
        left_out=held_out.left_out,
        draws=draws,
        results=tuple(_result(column, held_out, errors, columns) for column in columns),
    )


def spectral_codec(sample_rate: int, samples: int) -> Codec:
    """Of spectral losses, the same for every method: windows of about 11 ms (256 at 24 kHz), a quarter of one apart,
    and a floor under magnitudes 100 dB below a unit impulse. The paper's windows are twice as long and its floor 40 dB
    higher, which hides all of our late tails."""
    n_fft = 2 ** round(np.log2(_SPECTRAL_WINDOW_S * sample_rate))
    return Codec(sample_rate, n_fft, n_fft // 4, samples, _SPECTRAL_FLOOR)


def milliseconds_per_response(column: Column, held_out: HeldOut) -> float | None:
    """Median time of one response, asked for alone in this thread after a first time that does not count: what a
    method reads from disk is in memory by then. None if the method has no answer to any pair."""
    times_s = []
    began = time.perf_counter()
    for number, pair in enumerate(np.linspace(0, len(held_out) - 1, min(_TIMED_PAIRS, len(held_out))).astype(int)):
        turn = held_out.heard[[number % len(held_out.heard)]]
        if column.source(int(pair), turn) is None:
            continue
        start = time.perf_counter()
        column.source(int(pair), turn)
        times_s.append(time.perf_counter() - start)
        if time.perf_counter() - began > _TIMED_S:
            break
    return 1e3 * statistics.median(times_s) + column.extra_ms if times_s else None


def _result(
    column: Column, held_out: HeldOut, errors: Mapping[str, Mapping[str, _Errors]], columns: Sequence[Column]
) -> Result:
    ours = errors[column.name]
    rivals = [other.name for other in columns if other.kind in RATED and other is not column]
    baselines = [other.name for other in columns if other.kind == "baseline" and other is not column]
    return Result(
        name=column.name,
        kind=column.kind,
        method=column.method,
        storage_bytes=column.storage_bytes,
        ms=milliseconds_per_response(column, held_out) if column.kind in RATED else None,
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
    )


def _ratio(summary: Summary, floor: Result | None, metric: Metric) -> float | None:
    """Mean error over that of the floor."""
    least = None if floor is None else floor.summaries[metric.name].mean
    return None if summary.mean is None or not least else summary.mean / least


def _beats(ours: _Errors, theirs: _Errors) -> bool:
    both = ~np.isnan(ours) & ~np.isnan(theirs)
    only_theirs = np.isnan(ours) & ~np.isnan(theirs)
    if not both.any() or only_theirs.sum() > _MISSING_ALLOWANCE * ours.size:
        return False
    return bool(ours[both].mean() < theirs[both].mean())


def _surpasses(ours: _Errors, theirs: _Errors) -> bool:
    """By more than chance: entries of one pair are no draws of their own."""
    gains = (theirs - ours).reshape(len(ours), -1)
    measured = ~np.isnan(gains)
    gain = np.sum(gains, axis=1, where=measured)[measured.any(axis=1)] / measured.sum(axis=1)[measured.any(axis=1)]
    if len(gain) < 2:
        return False
    return bool(gain.mean() > _STANDARD_ERRORS * gain.std(ddof=1) / np.sqrt(len(gain)))
