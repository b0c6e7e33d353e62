"""`nafir-train benchmark`: scores a folder of predicted responses by every definition, and says what was scored.

Two scores can be compared if their digests of the benchmark are the same: then references, split, rate, length and
definitions are.
"""

import hashlib
import json
import os
import platform
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
import numpy.typing as npt

from server.acoustics.metrics import Summary, summarise
from training.evaluation.benchmark_data import BenchmarkData, truth_digest
from training.evaluation.comparison import Comparison, Metric, digest
from training.evaluation.literature import METRICS
from training.evaluation.predictions import PredictionError, Predictions, first
from training.evaluation.stored_errors import StoredErrors

FORMAT = 1
_LIBRARIES = ("nafir", "numpy", "scipy", "soxr", "soundfile")
_Rows = Mapping[str, npt.NDArray[np.float64]]


@dataclass(frozen=True)
class Score:
    """The result of a benchmark. summaries: by metric; None where the data have too few channels for it. silent: names
    of responses whose reference is silent, which nobody can be scored on. missing: names without a prediction. rates:
    how many predictions had each rate. padded, cut: how many were changed in length. benchmark: the digest by which
    scores can be compared; None if this one cannot."""

    dataset: str
    data: BenchmarkData
    scored: int
    silent: tuple[str, ...]
    missing: tuple[str, ...]
    rates: Mapping[int, int]
    padded: int
    cut: int
    unused: int
    others: tuple[str, ...]
    truth: str
    definitions: str
    summaries: Mapping[str, Summary | None]

    @property
    def comparable(self) -> bool:
        return not self.missing

    @property
    def benchmark(self) -> str | None:
        if not self.comparable:
            return None
        identity = [self.truth, self.data.split.digest, self.data.scored_rate, self.data.duration_s, self.definitions]
        return hashlib.sha256(json.dumps(identity).encode()).hexdigest()

    def notes(self) -> list[str]:
        """What was done to predictions and references, in sentences."""
        notes = []
        if self.data.scored_rate != self.data.sample_rate:
            notes.append(f"References were resampled from {self.data.sample_rate} to {self.data.scored_rate} Hz.")
        for rate, count in sorted(self.rates.items()):
            if rate != self.data.scored_rate:
                notes.append(f"{count} predictions were resampled from {rate} to {self.data.scored_rate} Hz.")
        if self.data.duration_s is not None:
            notes.append(f"Only the first {self.data.duration_s:g} s of each response were scored.")
        if self.padded:
            notes.append(f"{self.padded} predictions were padded with zeros by a few samples.")
        if self.cut:
            notes.append(f"{self.cut} predictions are longer than their references; the rest was not scored.")
        if self.silent:
            notes.append(f"{len(self.silent)} references are silent and scored for nobody: {first(self.silent)}.")
        if self.unused:
            notes.append(
                f"{self.unused} predictions are of responses that the split does not test; they were not read."
            )
        if self.others:
            notes.append(
                f"{len(self.others)} files are neither WAV nor NumPy files and were not read: {first(self.others)}."
            )
        return notes

    def to_json(self) -> dict[str, Any]:
        split = self.data.split
        return {
            "format": FORMAT,
            "comparable": self.comparable,
            "benchmark": self.benchmark,
            "dataset": {
                "name": self.dataset,
                "layout": self.data.layout,
                "channels": self.data.channels,
                "sample_rate": self.data.sample_rate,
                "references_sha256": self.truth,
            },
            "split": {
                "name": split.name,
                "source": split.source,
                "sha256": split.digest,
                "train": len(split.train),
                "validation": len(split.validation),
                "test": len(split.test),
            },
            "scored": {
                "responses": self.scored,
                "sample_rate": self.data.scored_rate,
                "duration_s": self.data.duration_s,
                "silent_references": list(self.silent),
                "missing_predictions": list(self.missing),
            },
            "predictions": {
                "rates": {str(rate): count for rate, count in sorted(self.rates.items())},
                "padded": self.padded,
                "cut": self.cut,
                "not_tested": self.unused,
                "other_files": len(self.others),
            },
            "notes": self.notes(),
            "definitions_sha256": self.definitions,
            "metrics": [{**metric.to_json(), **_summary_json(self.summaries[metric.name])} for metric in METRICS],
            "versions": {
                "python": platform.python_version(),
                **{library: version(library) for library in _LIBRARIES},
            },
        }


def _summary_json(summary: Summary | None) -> dict[str, Any]:
    """`count` errors are in the mean; `failed` could not be measured."""
    if summary is None:
        return {"mean": None, "median": None, "count": 0, "failed": 0}
    return {"mean": summary.mean, "median": summary.median, "count": summary.count, "failed": summary.missing}


def score(
    data: BenchmarkData,
    predictions: Predictions,
    *,
    allow_missing: bool = False,
    stored: StoredErrors | None = None,
    threads: int | None = None,
    metrics: Sequence[Metric] = METRICS,
    track: Callable[[range], Iterable[int]] = iter,
) -> Score:
    """Scores all predictions. Cases in `stored` are not read again. `track` may show progress.

    Raises PredictionError for a prediction that cannot be scored, and for missing ones unless they are allowed; and
    SourceError for references that cannot be read.
    """
    scored = data.scored
    missing = predictions.missing(scored)
    if len(missing) == len(scored):
        raise PredictionError(
            f"{predictions.folder}: has none of the {len(scored)} test responses, the first of which are "
            f"{first(missing)}: each is a .wav or .npy file of that name"
        )
    if missing and not allow_missing:
        raise PredictionError(
            f"{predictions.folder}: lacks {len(missing)} of {len(scored)} predictions: {first(missing)}: add them, or "
            "give --allow-missing for a score that cannot be compared with others"
        )
    scoring = _Scoring(data, predictions, metrics, stored)
    numbers = range(len(data.cases))
    pool = ThreadPoolExecutor(threads or os.cpu_count())
    try:
        cases = [rows for _, rows in zip(track(numbers), pool.map(scoring.of_case, numbers), strict=True)]
    finally:
        pool.shutdown(cancel_futures=True)
    if stored is not None:
        stored.discard()
    return _collected(data, predictions, missing, cases, metrics)


@dataclass(frozen=True)
class _Scoring:
    data: BenchmarkData
    predictions: Predictions
    metrics: Sequence[Metric]
    stored: StoredErrors | None

    def of_case(self, number: int) -> tuple[_Rows, _Rows]:
        """Errors by metric, and facts about predictions and references, a value for each row."""
        if self.stored is not None and (found := self.stored.get(number)):
            return found[0], found[1]
        case = self.data.cases[number]
        truth = case.truth()
        reference = self.data.fit(truth)
        rows, channels, samples = reference.shape
        is_silent = ~reference.any(axis=-1).all(axis=-1)
        is_there = np.array([name in self.predictions.files for name in case.names])
        chosen = np.flatnonzero(is_there & ~is_silent)
        rate = self.data.scored_rate
        read = [
            self.predictions.read(case.names[row], channels=channels, samples=samples, sample_rate=rate)
            for row in chosen
        ]
        errors = {metric.name: np.full(rows, np.nan) for metric in self.metrics}
        if len(chosen):
            estimate = np.stack([each.response for each in read])
            compared = Comparison(reference[chosen], estimate, rate, case.in_sight)
            for metric in self.metrics:
                if channels >= metric.channels:
                    errors[metric.name][chosen] = metric.error(compared)
        facts = {name: np.zeros(rows) for name in ("rate", "padded", "cut", "is_scored", "is_silent")}
        facts["is_scored"][chosen] = 1.0
        facts["is_silent"][is_silent] = 1.0
        for row, each in zip(chosen, read, strict=True):
            facts["rate"][row], facts["padded"][row], facts["cut"][row] = each.rate, each.padded, each.cut
        # Bytes of a digest are small whole numbers.
        facts["sha256"] = np.array([[*hashlib.sha256(row.tobytes()).digest()] for row in truth], dtype=np.float64)
        if self.stored is not None:
            self.stored.put(number, {0: errors, 1: facts})
        return errors, facts


def _collected(
    data: BenchmarkData,
    predictions: Predictions,
    missing: Sequence[str],
    cases: Sequence[tuple[_Rows, _Rows]],
    metrics: Sequence[Metric],
) -> Score:
    names = [name for case in data.cases for name in case.names]
    facts = {fact: np.concatenate([of_case[fact] for _, of_case in cases]) for fact in cases[0][1]}
    is_scored = facts["is_scored"] > 0
    if not is_scored.any():
        raise PredictionError(f"{predictions.folder}: every response that has a prediction is silent in the dataset")
    summaries: dict[str, Summary | None] = {}
    for metric in metrics:
        errors = np.concatenate([of_case[metric.name] for of_case, _ in cases])[is_scored]
        summaries[metric.name] = None if data.channels < metric.channels else _summary(errors, metric)
    digests = {name: bytes(row.astype(np.uint8)).hex() for name, row in zip(names, facts["sha256"], strict=True)}
    return Score(
        dataset=data.name,
        data=data,
        scored=int(is_scored.sum()),
        silent=tuple(name for name, is_silent in zip(names, facts["is_silent"], strict=True) if is_silent),
        missing=tuple(missing),
        rates=Counter(facts["rate"][is_scored].astype(int).tolist()),
        padded=int(np.count_nonzero(facts["padded"])),
        cut=int(np.count_nonzero(facts["cut"])),
        unused=predictions.unused,
        others=predictions.others,
        truth=truth_digest(names, digests) if data.file_digest is None else data.file_digest(),
        definitions=digest(metrics),
        summaries=summaries,
    )


def _summary(errors: npt.NDArray[np.float64], metric: Metric) -> Summary:
    """The summary of a metric's errors. Errors that could not be measured are counted, and are in the mean if the
    definition of the metric says so."""
    missing = int(np.isnan(errors).sum())
    if metric.counted_as is None:
        return summarise(errors)
    counted = summarise(np.where(np.isnan(errors), metric.counted_as, errors))
    return Summary(counted.mean, counted.median, counted.count, missing)
