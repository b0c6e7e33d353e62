"""The answers of one listener as CSV: a row per sound of a trial, written when the trial is answered.

All rows of a trial are appended in one write. If the process is killed in the middle of it, the torn trial is dropped
and asked again. Columns:

- `trial`: its number in the listener's plan
- `part`: screening-1, screening-2, practice, test, hidden-reference or anchor
- `place`, `clip`: index and music of the place; empty for tones
- `slot`, `method`: what the listener saw, and what was behind it
- `answer`: 1 for the sound that was chosen and 0 for others, or the rating; empty for the open reference
- `plays`: how often it was played
- `seconds`: from the question to the answer, to a tenth
"""

import csv
import io
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from server.listening.design import REFERENCE, Design
from server.listening.plan import ListenerPlan, PlannedTrial

COLUMNS: Final = ("trial", "part", "place", "clip", "slot", "method", "answer", "plays", "seconds")
OPEN_REFERENCE: Final = "reference"
"""The slot of the reference that is known to be it."""
TONES: Final = "tones"
"""The slot of three tones in one sound, which are played together."""


@dataclass(frozen=True)
class Row:
    """A row of the file; `answer` is None for the open reference."""

    trial: int
    part: str
    place: int | None
    clip: str
    slot: str
    method: str
    answer: float | None
    plays: int
    seconds: float

    @classmethod
    def read(cls, cells: Mapping[str, str]) -> "Row":
        """Raises ValueError."""
        return cls(
            trial=int(cells["trial"]),
            part=cells["part"],
            place=int(cells["place"]) if cells["place"] else None,
            clip=cells["clip"],
            slot=cells["slot"],
            method=cells["method"],
            answer=float(cells["answer"]) if cells["answer"] else None,
            plays=int(cells["plays"]),
            seconds=float(cells["seconds"]),
        )

    @property
    def cells(self) -> tuple[str, ...]:
        answer = "" if self.answer is None else f"{self.answer:g}"
        place = "" if self.place is None else str(self.place)
        numbered = f"{self.trial}", self.part, place, self.clip, self.slot, self.method
        return *numbered, answer, f"{self.plays}", f"{self.seconds:.1f}"


@dataclass(frozen=True)
class AnsweredTrial:
    """The rows of one trial, complete."""

    rows: tuple[Row, ...]

    @property
    def part(self) -> str:
        return self.rows[0].part

    @property
    def place(self) -> int | None:
        return self.rows[0].place

    @property
    def chosen(self) -> str:
        """The method that was chosen."""
        return next(row.method for row in self.rows if row.answer == 1)

    @property
    def methods(self) -> frozenset[str]:
        return frozenset(row.method for row in self.rows if row.answer is not None)

    @property
    def ratings(self) -> dict[str, float]:
        """Ratings by method."""
        return {row.method: row.answer for row in self.rows if row.answer is not None}


def rows_of(
    number: int,
    trial: PlannedTrial,
    design: Design,
    answers: Mapping[str, float],
    plays: Mapping[str, int],
    seconds: float,
) -> tuple[Row, ...]:
    """The rows of a trial that was answered. `answers` and `plays` are by slot."""
    is_tones = trial.place is None
    clip = "" if trial.place is None else design.places[trial.place].clip
    slots = dict(trial.slots) if is_tones else {**trial.slots, OPEN_REFERENCE: REFERENCE}
    return tuple(
        Row(
            trial=number,
            part=trial.part,
            place=trial.place,
            clip=clip,
            slot=slot,
            method=method,
            answer=answers.get(slot),
            plays=plays.get(TONES if is_tones else slot, 0),
            seconds=seconds,
        )
        for slot, method in slots.items()
    )


class AnswerFile:
    """The file of one listener. Not to be used by two threads at once."""

    def __init__(self, path: Path, plan: ListenerPlan) -> None:
        self.path = path
        self._plan = plan
        self._sizes = {number: len(trial.slots) + (trial.place is not None) for number, trial in enumerate(plan.trials)}

    def read(self) -> dict[int, AnsweredTrial]:
        """The answered trials by number, in the order in which they were answered."""
        content, _ = self._whole_trials()
        return content

    def append(self, rows: tuple[Row, ...]) -> None:
        """Appends a trial, in one write. A torn trial at the end of the file is removed first."""
        _, end = self._whole_trials()
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        if end == 0:
            writer.writerow(COLUMNS)
        writer.writerows(row.cells for row in rows)
        handle = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        try:
            if os.fstat(handle).st_size > end:
                os.ftruncate(handle, end)
            _write_all(handle, text.getvalue().encode())
            os.fsync(handle)
        finally:
            os.close(handle)

    def _whole_trials(self) -> tuple[dict[int, AnsweredTrial], int]:
        """The trials that are complete, and the number of bytes that they take, with the header."""
        if not self.path.exists():
            return {}, 0
        content = self.path.read_bytes()
        lines = content.split(b"\n")[:-1]  # what follows the last line break is torn
        header = ",".join(COLUMNS).encode()
        if not lines or lines[0] != header:
            return {}, 0
        trials: dict[int, AnsweredTrial] = {}
        end = at = len(header) + 1
        pending: list[Row] = []
        for line, row in self._rows(lines[1:]):
            at += len(line) + 1
            pending.append(row)
            if len(pending) == self._sizes[row.trial]:
                trials[row.trial] = AnsweredTrial(tuple(pending))
                pending, end = [], at
        return trials, end

    def _rows(self, lines: list[bytes]) -> Iterator[tuple[bytes, Row]]:
        """Lines and their rows, up to the first that is damaged or does not belong to the plan."""
        last: int | None = None
        count = 0
        for line in lines:
            try:
                (cells,) = csv.reader([line.decode()])
                row = Row.read(dict(zip(COLUMNS, cells, strict=True)))
            except (UnicodeDecodeError, ValueError):
                return
            is_new = count == 0
            if row.trial not in self._sizes or (not is_new and row.trial != last):
                return
            last = row.trial
            count = (count + 1) % self._sizes[row.trial]
            yield line, row


def _write_all(handle: int, content: bytes) -> None:
    written = 0
    while written < len(content):
        written += os.write(handle, content[written:])
