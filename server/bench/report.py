"""How measurements are printed: one JSON document for programs, tables for people, goals beside what was reached."""

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any, Literal

import typer
from rich.console import Console
from rich.table import Table


@dataclass(frozen=True)
class Goal:
    """What a measure should be `at_least`, and better, `stretch`; for levels and times that means: at most."""

    measure: str
    at_least: float
    stretch: float | None = None
    is_at_most: bool = False

    def judge(self, value: float | None) -> "Judgement":
        """A value that could not be measured, None, reaches nothing."""
        reached: Literal["stretch", "at_least"] | None = None
        if value is not None:
            if self._is_met(value, self.at_least):
                reached = "at_least"
            if self.stretch is not None and self._is_met(value, self.stretch):
                reached = "stretch"
        return Judgement(self.measure, value, self.at_least, self.stretch, reached)

    def _is_met(self, value: float, limit: float) -> bool:
        return value <= limit if self.is_at_most else value >= limit


@dataclass(frozen=True)
class Judgement:
    measure: str
    value: float | None
    at_least: float
    stretch: float | None
    reached: Literal["stretch", "at_least"] | None


def print_json(measured: dict[str, Any]) -> None:
    typer.echo(json.dumps(measured))


def print_measures(title: str, measured: dict[str, Any]) -> None:
    """One row per measure."""
    table = Table("measure", "value", title=title)
    for name, value in measured.items():
        table.add_row(name.replace("_", " "), show(value))
    Console().print(table)


def print_rows(title: str, rows: Iterable[dict[str, Any]]) -> None:
    """One column per key, which all rows share."""
    rows = list(rows)
    table = Table(*(name.replace("_", " ") for name in rows[0]), title=title)
    for row in rows:
        table.add_row(*(show(value) for value in row.values()))
    Console().print(table)


def print_judgements(title: str, judgements: Iterable[Judgement]) -> None:
    print_rows(title, [asdict(judgement) for judgement in judgements])


def show(value: object) -> str:
    """As short as it can be told apart."""
    if value is None:
        return "–"
    if isinstance(value, dict):
        return ", ".join(f"{name} {show(part)}" for name, part in value.items())
    return f"{value:.4g}" if isinstance(value, float) else str(value)
