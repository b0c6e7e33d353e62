"""What an evaluation compares, named by files, so that any process on any node can open the same and measure a part.

A part of the errors is one column on a few held-out pairs. A process prepares a column when it gets the first part of
it, and keeps it until it gets one of another column.
"""

import socket
from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from server.acoustics.room_parameters import RoomParameters
from server.scene.bundle import Bundle
from training.baselines.coded import Track
from training.baselines.held_out import EvaluationError, HeldOut, open_held_out
from training.data.dataset import Half
from training.evaluation.evaluate import DECAY_DB, FLOOR, ONE_SIMULATION, Column, PairErrors
from training.evaluation.fields import field_columns
from training.evaluation.methods import floor_columns, method_columns, simulation_column
from training.evaluation.stored_errors import ColumnErrors, StoredErrors, signature
from training.parallel.jobs import IsOver, Job, Jobs
from training.simulation.responses import open_responses

_PAIRS_OF_A_JOB = 8
"""So few that little is lost with a node; so many that a column is not prepared for each."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """The bundles, the folders of data and runs, the methods, and which of the held-out pairs are evaluated, as in
    `nafir-train evaluate`."""

    bundles: tuple[Bundle, ...]
    data: Path
    runs: tuple[Path, ...] = ()
    methods: tuple[str, ...] = ()
    pairs: int | None = None
    yaws: int | None = None
    half: Half | None = None
    hrtf: Path | None = None
    tilt_deg: float = 0.0
    seed: int = 0

    def files(self) -> list[Any]:
        """What identifies the contents of the files, in plain values: equal on all nodes that see the same files.

        Raises OSError for a folder that is missing.
        """
        digests = [bundle.digest for bundle in self.bundles]
        signatures = [signature(folder) for folder in (*self.runs, self.data)]
        head = None if self.hrtf is None else [self.hrtf.stat().st_size, self.hrtf.stat().st_mtime_ns]
        return [digests, signatures, head]

    def open(self) -> tuple[int, HeldOut]:
        """How many pairs are held out, and those that are evaluated.

        Raises DatasetError or ResponsesError if the folder holds no dataset, and EvaluationError if nothing is left.
        """
        with open_held_out(self.data) as everything:
            everything = everything if self.half is None else everything.of_half(self.half)
            held_out = everything.sample(pairs=self.pairs, yaws=self.yaws, seed=self.seed)
            if self.hrtf is not None or self.tilt_deg:
                held_out = held_out.reheard(self.hrtf, tilt_deg=self.tilt_deg)
            return len(everything), held_out

    def columns(self, held_out: HeldOut, track: Track = lambda steps, _: steps) -> list[Column]:
        """The columns of fields and methods."""
        return [*self._fields(held_out), *method_columns(self.methods, held_out, track)]

    def column(self, held_out: HeldOut, name: str) -> Column:
        """One column, of fields, methods or the simulation itself."""
        if name in self.methods:
            return method_columns([name], held_out)[0]
        if name == ONE_SIMULATION:
            return simulation_column(held_out)
        columns = floor_columns(held_out) if name == FLOOR else self._fields(held_out)
        return next(column for column in columns if column.name == name)

    def _fields(self, held_out: HeldOut) -> list[Column]:
        columns = field_columns(self.bundles, held_out)
        if self.runs:
            # Torch takes seconds to load, and bundles do not need it.
            from training.evaluation.measured_fields import run_columns

            responses = open_responses(self.data)
            columns += [column for run in self.runs for column in run_columns(run, responses, held_out)]
        return columns


@dataclass(frozen=True)
class _Shared:
    comparison: Comparison
    files: list[Any]
    truth: Sequence[RoomParameters]


@dataclass(frozen=True)
class _Part:
    """A column by its number and name, and indices of held-out pairs."""

    number: int
    name: str
    pairs: tuple[int, ...]


def measure_elsewhere(
    comparison: Comparison,
    held_out: HeldOut,
    columns: Sequence[Column],
    truth: Sequence[RoomParameters],
    stored: StoredErrors,
    *,
    jobs: Jobs,
    track: Track,
) -> None:
    """Measure, by `jobs`, the errors that are missing in `stored`, and put them there as they come."""
    parts = list(_missing(held_out, columns, stored))
    shared = _Shared(comparison, comparison.files(), truth)
    with closing(jobs.run(_measure, shared, parts)) as measured:
        for _, (part, found) in zip(track(range(len(parts)), "evaluating"), measured, strict=True):
            for pair, errors in zip(part.pairs, found, strict=True):
                stored.put(pair, {part.number: errors})


def _missing(held_out: HeldOut, columns: Sequence[Column], stored: StoredErrors) -> Iterable[Job[_Part]]:
    emitters = held_out.pairs.pair_emitter[held_out.held_out]
    known = [stored.get(pair).keys() for pair in range(len(held_out))]
    for number, column in enumerate(columns):
        pairs = [pair for pair in range(len(held_out)) if number not in known[pair]]
        for start in range(0, len(pairs), _PAIRS_OF_A_JOB):
            some = pairs[start : start + _PAIRS_OF_A_JOB]
            of_emitters = ", ".join(str(emitter) for emitter in sorted({int(emitters[pair]) for pair in some}))
            yield Job(
                f"scene {held_out.name}, {column.name}, emitters {of_emitters}",
                _Part(number, column.name, tuple(some)),
            )


def _measure(shared: _Shared, part: _Part, _: IsOver) -> list[ColumnErrors]:
    """The errors of each pair of a part. Raises EvaluationError where the files are others than at the beginning."""
    comparison = shared.comparison
    try:
        are_equal = comparison.files() == shared.files
    except OSError as exc:
        raise EvaluationError(f"node {socket.gethostname()} has no {exc.filename}: {exc.strerror}") from exc
    if not are_equal:
        raise EvaluationError(
            f"node {socket.gethostname()} has another version of {comparison.data} or of what is evaluated: put them "
            "where all nodes see the same files"
        )
    held_out, column = _opened(comparison), _prepared(comparison, part.name)
    errors = PairErrors(held_out, [column], shared.truth, DECAY_DB)
    return [errors.of_pair(pair)[0] for pair in part.pairs]


@lru_cache(maxsize=1)
def _opened(comparison: Comparison) -> HeldOut:
    return comparison.open()[1]


@lru_cache(maxsize=1)
def _prepared(comparison: Comparison, name: str) -> Column:
    return comparison.column(_opened(comparison), name)
