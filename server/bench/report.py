"""Output of measurements: JSON for programs, tables for people, and goals with the values reached."""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

import typer

Reached = Literal["stretch", "goal"]


@dataclass(frozen=True)
class Goal:
    """A goal for a measure: at least `limit`, or better `stretch`. With `is_at_most` these are upper limits."""

    measure: str
    limit: float
    stretch: float | None = None
    is_at_most: bool = False

    def judge(self, value: float | None, *, failure: str | None = None, note: str | None = None) -> "Judgement":
        """Compare `value` with the goal. The goal is not reached if `failure` says why the run did not pass, if the
        value is None because it could not be measured, or if it is NaN. A `note` says what else the value cost."""
        reached: Reached | None = None
        if failure is None and value is not None:
            if self._is_met(value, self.limit):
                reached = "goal"
            if self.stretch is not None and self._is_met(value, self.stretch):
                reached = "stretch"
        reason = failure if failure is not None or reached is not None else self._missed(value)
        return Judgement(self.measure, value, self.limit, self.stretch, self.is_at_most, reached, reason, note=note)

    def skip(self, reason: str) -> "Judgement":
        """The judgement of a goal that this run does not cover."""
        return Judgement(self.measure, None, self.limit, self.stretch, self.is_at_most, None, reason, is_skipped=True)

    def _is_met(self, value: float, limit: float) -> bool:
        return value <= limit if self.is_at_most else value >= limit

    def _missed(self, value: float | None) -> str:
        if value is None:
            return "could not be measured"
        return f"is {show(value)}, and may be {'at most' if self.is_at_most else 'no less than'} {show(self.limit)}"


@dataclass(frozen=True)
class Judgement:
    """A measure compared with its goal. `reason` says why the goal was not reached; None if it was."""

    measure: str
    value: float | None
    limit: float
    stretch: float | None
    is_at_most: bool
    reached: Reached | None
    reason: str | None
    is_skipped: bool = False
    note: str | None = None
    """What has to be known of the run besides, whether the goal was reached or not."""

    @property
    def is_missed(self) -> bool:
        return self.reached is None and not self.is_skipped


def missed(judgements: Iterable[Judgement]) -> list[str]:
    """One line for each goal that was not reached; skipped goals have none."""
    return [f"{judgement.measure}: {judgement.reason}" for judgement in judgements if judgement.is_missed]


def end_with(problems: Iterable[str]) -> None:
    """Print each problem on standard error. Raises typer.Exit with code 1 if there is any."""
    if lines := list(problems):
        for line in lines:
            typer.echo(f"not reached: {line}", err=True)
        raise typer.Exit(1)


def print_json(measured: dict[str, Any]) -> None:
    typer.echo(json.dumps(measured))


def print_measures(title: str, measured: dict[str, Any]) -> None:
    """Print a table with one row per measure."""
    from rich.console import Console
    from rich.table import Table

    table = Table("measure", "value", title=title)
    for name, value in measured.items():
        table.add_row(name.replace("_", " "), show(value))
    Console().print(table)


def print_rows(title: str, rows: Iterable[dict[str, Any]]) -> None:
    """Print a table with one column per key. All rows have the same keys."""
    from rich.console import Console
    from rich.table import Table

    rows = list(rows)
    table = Table(*(name.replace("_", " ") for name in rows[0]), title=title)
    for row in rows:
        table.add_row(*(show(value) for value in row.values()))
    Console().print(table)


def print_judgements(title: str, judgements: Iterable[Judgement]) -> None:
    """Print a table of goals; each limit has its direction (≤ or ≥)."""
    print_rows(title, [_row(judgement) for judgement in judgements])


def _row(judgement: Judgement) -> dict[str, object]:
    sign = "≤" if judgement.is_at_most else "≥"
    return {
        "measure": judgement.measure,
        "value": judgement.value,
        "goal": f"{sign} {show(judgement.limit)}",
        "stretch": None if judgement.stretch is None else f"{sign} {show(judgement.stretch)}",
        "reached": judgement.reached or ("skipped" if judgement.is_skipped else "no"),
        "why": "; ".join(text for text in (judgement.reason, judgement.note) if text) or None,
    }


def show(value: object) -> str:
    """The value as a short text."""
    if value is None:
        return "–"
    if isinstance(value, dict):
        return ", ".join(f"{name} {show(part)}" for name, part in value.items())
    return f"{value:.4g}" if isinstance(value, float) else str(value)
