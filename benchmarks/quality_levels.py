"""Records a frontier as the result that `docs/results/quality-levels.md` shows:
`python -m benchmarks.quality_levels FRONTIER_JSON COMMAND --data TEXT --fields TEXT [--note TEXT]`.

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

PATH: Final = FOLDER / "quality-levels.json"
_COLUMNS: Final = (
    "mean ms",
    "p50 ms",
    "p99 ms",
    "nothing kept, ms",
    "turn only, ms",
    "block, us",
    "mean error, JND",
    "largest step over 1 cm, JND",
)


def result_of(
    frontier: Mapping[str, Any], *, host: Host, command: str, commit: str, facts: Mapping[str, str]
) -> Result:
    """The optimal levels of `nafir-train frontier`'s frontier.json, quickest first, then those of directions that are
    not optimal, and the floor."""
    floor = frontier["floor"]["errors_jnd"]
    points = [point for point in frontier["points"] if not point["is_bound"]]
    best = [point for point in points if point["is_pareto_optimal"]]
    others = [point for point in points if point not in best and point["predicts"] == "directions"]
    rows = [_row(point, frontier["default"]) for point in [*best, *others]]
    rows.append(("floor", *(None,) * 6, _number(sum(floor.values()) / len(floor), 3), None))
    first = Column(title=f"level of the {frontier['scene']}; (o) offered")
    columns = (first, *(Column(title=title, is_number=True) for title in _COLUMNS))
    counts = {"Levels": f"{len(points)} were measured; {len(best)} of them are Pareto-optimal"}
    return Result(
        host=host,
        date=datetime.now(UTC).date().isoformat(),
        commit=commit,
        command=command,
        facts={**facts, **counts},
        tables={"levels": Table(columns=columns, rows=tuple(rows))},
        plots={"frontier-apartment.png": "error_over_time"},
    )


def _row(point: Mapping[str, Any], default: str) -> tuple[Cell, ...]:
    marks = ["o"] if point["is_offered"] else []
    if point["name"] == default:
        marks.append("default")
    if not point["is_pareto_optimal"]:
        marks.append("not optimal")
    name = f"`{point['name']}`" + (f" ({', '.join(marks)})" if marks else "")
    times = ("ms_mean", "ms_p50", "ms_p99", "ms_miss", "ms_turn", "block_us")
    steps = point["steps_jnd"]
    largest = _number(max(steps.values()), 1) if steps else None
    return (name, *(_significant(point[key]) for key in times), _number(point["audible_error_jnd"], 3), largest)


def _significant(value: float | None) -> Value | None:
    """To two digits."""
    if value is None:
        return None
    rounded = f"{Decimal(f'{value:#.2g}'):f}"
    return Value(value=Decimal(rounded))


def _number(value: float, digits: int) -> Value:
    return Value(value=Decimal(f"{value:.{digits}f}"))


def main() -> None:
    parser = argparse.ArgumentParser(description="Record a frontier as a result.")
    parser.add_argument("frontier", type=Path)
    parser.add_argument("command")
    parser.add_argument("--data", required=True, help="which pairs errors are of")
    parser.add_argument("--fields", required=True, help="how the fields were trained")
    parser.add_argument("--note", default="", help="what else is to be known of the machine")
    given = parser.parse_args()
    host = Host.this(given.note)
    frontier = json.loads(given.frontier.read_text(encoding="utf-8"))
    facts = {"Data": given.data, "Fields": given.fields}
    result = result_of(frontier, host=host, command=given.command, commit=current_commit(), facts=facts)
    PATH.write_text(result.model_dump_json(indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
