"""The schema of `benchmarks/results/*.json`: what was measured, where, when, at which commit, and by which command.

Facts that were not recorded are "unknown". Numbers keep the digits that were written: 1.40 is not 1.4.
"""

import json
from collections.abc import Mapping
from datetime import date
from decimal import Decimal
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from server.bench.machine import describe_machine

FOLDER = Path(__file__).with_name("results")
Unknown = Literal["unknown"]
UNKNOWN: Unknown = "unknown"


def _of_days(text: str) -> str:
    for part in text.split("/"):
        date.fromisoformat(part)
    return text


Days = Annotated[str, AfterValidator(_of_days)]
"""A day, or the first and the last day separated by a slash."""
Commit = Annotated[str, Field(pattern=r"^[0-9a-f]{7,40}(\+changes)?$")]


class _Form(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Host(_Form):
    """The machine of a measurement; `cores` is the number that the command could use."""

    processor: str
    instruction_set: str
    cores: int | Unknown
    note: str = ""

    @classmethod
    def this(cls, note: str = "") -> Self:
        """This machine."""
        machine = describe_machine()
        return cls(
            processor=str(machine["processor"]),
            instruction_set=str(machine["instruction_set"]),
            cores=machine["cores"] or UNKNOWN,
            note=note,
        )

    def __str__(self) -> str:
        known = [self.processor, self.instruction_set, *([] if self.cores == UNKNOWN else [_cores(self.cores)])]
        said = [part for part in (*known, self.note) if part and part != UNKNOWN]
        return "; ".join(said) or UNKNOWN


def _cores(number: int) -> str:
    return "one core" if number == 1 else f"{number} cores"


class Value(_Form):
    """A number in a table. It has a `unit` if its column has none; `is_best` marks the best of a row or column; `note`
    is printed in brackets."""

    value: Decimal
    unit: str = ""
    is_best: bool = False
    note: str = ""

    def __str__(self) -> str:
        text = f"{self.value} {self.unit}".strip()
        return (f"**{text}**" if self.is_best else text) + (f" ({self.note})" if self.note else "")


Cell = Value | int | Decimal | str | None
"""A cell of a table: None means not measured; text may contain Markdown."""


class Column(_Form):
    title: str
    is_number: bool = False


class Table(_Form):
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]

    def markdown(self) -> str:
        """Return the table in Markdown. Raises ValueError if a row does not have one cell for each column."""
        heading = [column.title for column in self.columns]
        rule = ["---:" if column.is_number else "---" for column in self.columns]
        rows = [["" if cell is None else str(cell) for cell in row] for row in self.rows]
        return markdown_table([heading, rule, *rows])

    def column(self, title: str) -> list[float | None]:
        """Return the numbers of a column; None for a cell without one."""
        at = [column.title for column in self.columns].index(title)
        return [_number(row[at]) for row in self.rows]


def _number(cell: Cell) -> float | None:
    cell = cell.value if isinstance(cell, Value) else cell
    return None if cell is None or isinstance(cell, str) else float(cell)


class Result(_Form):
    """The results of one run of a command. `facts` are further conditions of the run; `tables` are keyed by the names
    used in pages."""

    host: Host
    date: Days
    commit: Commit | Unknown
    command: str
    facts: Mapping[str, str] = {}
    tables: Mapping[str, Table] = {}
    plots: Mapping[str, str] = {}
    """Plots, as names of functions in `benchmarks.plots` by file below `docs/results/`."""
    values: Mapping[str, object] = {}
    """Data for plots that are not in the tables."""

    @classmethod
    def read(cls, path: Path) -> Self:
        return cls.model_validate(json.loads(path.read_text(encoding="utf-8"), parse_float=Decimal))

    def provenance(self) -> str:
        rows = {
            "Host": str(self.host),
            "Recorded": self.date.replace("/", " to "),
            "Commit": self.commit,
            "Command": self.command,
            **self.facts,
        }
        return markdown_table([["", ""], ["---", "---"], *([name, text] for name, text in rows.items())])


def markdown_table(rows: list[list[str]]) -> str:
    """Return rows as a Markdown table. Raises ValueError if rows have different lengths."""
    if len({len(row) for row in rows}) > 1:
        raise ValueError(f"a table of rows of {sorted({len(row) for row in rows})} cells")
    cells = ([f" {cell} ".replace("|", "\\|") if cell else " " for cell in row] for row in rows)
    return "".join(f"|{'|'.join(row)}|\n" for row in cells)


def read_results() -> dict[str, Result]:
    """Read all results, by file name without suffix."""
    return {path.stem: Result.read(path) for path in sorted(FOLDER.glob("*.json"))}
