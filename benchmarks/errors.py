"""Records the errors of an evaluation as a result that `docs/results/accuracy.md` shows:
`python -m benchmarks.errors EVALUATION_JSON NAME COMMAND --data TEXT --training TEXT [--note TEXT]`.

The machine is this one, and the commit that of this checkout. `make results` then fills the page.
"""

import argparse
import json
from collections.abc import Mapping
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path
from typing import Any, Final

from benchmarks.record import FOLDER, Cell, Column, Host, Result, Table, Value
from server.bench.history import current_commit

METRICS: Final = ("t60", "edt", "c50", "drr", "iacc", "spectral_loss", "level", "itd", "onset")
_FLOOR: Final = "floor"


def result_of(
    evaluation: Mapping[str, Any], *, host: Host, command: str, commit: str, facts: Mapping[str, str]
) -> Result:
    """A table of the mean errors of an evaluation by `nafir-train evaluate`: a row for each metric, with the bundle's
    default level, each baseline and the floor, how many times the floor the level errs by, and how many responses have
    an error at all."""
    columns: Mapping[str, Any] = evaluation["columns"]
    methods = [name for name, column in columns.items() if column["kind"] == "baseline"]
    level = next(name for name, column in columns.items() if column["kind"] == "field")
    named = {level: "rendered", **{name: name.replace("-", " ") for name in methods}, _FLOOR: _FLOOR}
    labels = {each["name"]: each for each in evaluation["metrics"]}
    rows = []
    for metric in METRICS:
        found = {name: columns[name]["metrics"][metric] for name in named}
        unit = labels[metric]["unit"]
        cells = (_error(each["mean"], unit) for each in found.values())
        times = found[level]["times_floor"]
        rows.append((labels[metric]["label"], *cells, _number(times, 2), found[level]["count"]))
    titles = ("", *named.values(), "times the floor", "responses")
    return Result(
        host=host,
        date=datetime.now(UTC).date().isoformat(),
        commit=commit,
        command=command,
        facts=facts,
        tables={"errors": Table(columns=tuple(Column(title=title) for title in titles), rows=tuple(rows))},
    )


def _error(value: float | None, unit: str) -> Cell:
    """To two digits, with its unit."""
    if value is None:
        return None
    digits = Decimal(f"{value:#.2g}")
    return Value(value=Decimal(f"{digits:f}".rstrip(".")), unit="" if unit == "ln" else unit)


def _number(value: float | None, digits: int) -> Cell:
    return None if value is None else Value(value=Decimal(f"{value:.{digits}f}"))


def main() -> None:
    parser = argparse.ArgumentParser(description="Record the errors of an evaluation as a result.")
    parser.add_argument("evaluation", type=Path)
    parser.add_argument("name", help="of the result")
    parser.add_argument("command")
    parser.add_argument("--data", required=True, help="which pairs errors are of")
    parser.add_argument("--training", required=True, help="how the data were simulated and the field was trained")
    parser.add_argument("--note", default="", help="what else is to be known of the machine")
    given = parser.parse_args()
    host = Host.this(given.note)
    evaluation = json.loads(given.evaluation.read_text(encoding="utf-8"))
    facts = {"Data": given.data, "Training": given.training}
    result = result_of(evaluation, host=host, command=given.command, commit=current_commit(), facts=facts)
    (FOLDER / f"{given.name}.json").write_text(result.model_dump_json(indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
