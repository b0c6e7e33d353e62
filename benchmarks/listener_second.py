"""Writes `benchmarks/results/listener-second.json` from files of `nafir bench costs`, one for each scene:

    python -m benchmarks.listener_second costs-apartment.json costs-bench.json

The files come from one machine; `--note` says what else is to be known of it. `make results` then fills the page.
"""

import argparse
import json
from pathlib import Path
from typing import Any, Final

from benchmarks.record import FOLDER, Result
from server.bench.capacity import TERMS, Machine, Measured, Model, Run, limits, size
from server.bench.costs import listener_second, read_costs
from server.bench.meter import PARTS
from server.core.errors import NafirError

PATH: Final = FOLDER / "listener-second.json"
EMITTERS: Final = 1, 16
CROWDS: Final = 100, 1_000, 1_000_000
MACHINE: Final = Machine(cores=16, memory_bytes=64 * 2**30, network_bits_per_s=10e9, open_files=1_048_576)
"""The machine that crowds are planned for."""
_LATE_SHARE: Final = 0.01
_SPARE: Final = "the rest of the thread: waking, sleeping, the interpreter"


def result_of(measured: list[Measured], note: str = "") -> Result:
    """Raises NafirError if the files come from different machines or commits, or two from the same scene."""
    first = measured[0]
    if len({(each.processor, each.instruction_set, each.commit) for each in measured}) > 1:
        raise NafirError("processor, instruction_set, commit: the files are not of one machine and commit")
    scenes = [each.scene for each in measured]
    if len(set(scenes)) < len(scenes):
        raise NafirError("scene: two files are of the same scene")
    days = sorted({each.date for each in measured})
    tables: dict[str, Any] = {each.scene: _parts(each) for each in measured}
    tables["capacity"] = _capacity(measured)
    tables["crowds"] = _crowds(measured)
    tables["limits"] = _limits(measured)
    commands = "<br>".join(f"`nafir bench costs --scene {each.scene}`" for each in measured)
    return Result.model_validate(
        {
            "host": {
                "processor": first.processor,
                "instruction_set": first.instruction_set,
                "cores": 1,
                "note": note,
            },
            "date": days[0] if len(days) == 1 else f"{days[0]}/{days[-1]}",
            "commit": first.commit,
            "command": commands,
            "tables": tables,
        }
    )


def _parts(measured: Measured) -> dict[str, Any]:
    """The table of a scene: milliseconds of a core by part, with few sessions and with many."""
    runs = [run for emitters in EMITTERS for run in _extremes(measured, emitters)]
    columns = [f"{run.sessions} × {run.emitters}" for run in runs]
    meanings: dict[str, str] = {part: meaning for part, (_, meaning) in PARTS.items()}
    by_run = [{row["part"]: row["ms"] for row in listener_second(run)} for run in runs]
    rows: list[list[Any]] = [
        [part, meanings.get(part, _SPARE), *(_number(each[part]) for each in by_run)] for part in TERMS
    ]
    rows.append(["all", "", *(_number(sum(each.values())) for each in by_run)])
    rates = ["responses per second and emitter", "", *(_number(run.ir_rate_hz) for run in runs)]
    return _table(["part, ms of a core", "what it is", *columns], [*rows, rates], numbers=2)


def _extremes(measured: Measured, emitters: int) -> list[Run]:
    """The runs with the fewest and with the most sessions. A run whose blocks were late did not do all of its work, so
    it counts only where all were."""
    runs = sorted((run for run in measured.runs if run.emitters == emitters), key=lambda run: run.sessions)
    in_time = [run for run in runs if run.late_share < _LATE_SHARE] or runs
    return [in_time[0], in_time[-1]] if len(in_time) > 1 else in_time


def _capacity(measured: list[Measured]) -> dict[str, Any]:
    rows = [
        [each.scene, emitters, Model.of(each).most_at_best(emitters), Model.of(each).most(emitters)]
        for each in measured
        for emitters in (1, 4, 16)
    ]
    return _table(["scene", "emitters", "listeners of a core, best quality", "before blocks are late"], rows, numbers=1)


def _crowds(measured: list[Measured]) -> dict[str, Any]:
    rows = []
    for each in measured:
        for listeners in CROWDS:
            needs = size(Model.of(each), MACHINE, listeners, EMITTERS[-1])
            rows.append(
                [
                    each.scene,
                    f"{listeners:,}",
                    f"{needs.cores_best:,}",
                    f"{needs.machines:,}",
                    _number(needs.memory_bytes / 2**30),
                    _number(needs.down_bits_per_s["f32"] / 1e9),
                    _number(needs.down_bits_per_s["s16"] / 1e9),
                    _number(needs.up_bits_per_s / 1e9),
                ]
            )
    titles = ["scene", "listeners", "cores", "machines", "memory, GiB", "f32, Gbit/s", "s16, Gbit/s", "up, Gbit/s"]
    return _table(titles, rows, numbers=1)


def _limits(measured: list[Measured]) -> dict[str, Any]:
    rows = [
        [each.scene, limit.part, limit.listeners, limit.reason]
        for each in measured
        for limit in limits(Model.of(each), MACHINE, EMITTERS[-1])
    ]
    return _table(["scene", "part of a machine", "listeners that it bears", "because"], rows, numbers=None)


def _table(titles: list[str], rows: list[list[Any]], *, numbers: int | None) -> dict[str, Any]:
    """A table whose columns from `numbers` on are of numbers."""
    columns = [{"title": title, "is_number": numbers is not None and at >= numbers} for at, title in enumerate(titles)]
    return {"columns": columns, "rows": rows}


def _number(value: float) -> str:
    return f"{value:.3g}" if value < 1000 else f"{value:,.0f}"


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("costs", nargs="+", type=Path, help="files of `nafir bench costs`")
    parser.add_argument("--note", default="", help="what else is to be known of the machine")
    given = parser.parse_args(arguments)
    result = result_of([read_costs(path) for path in given.costs], given.note)
    PATH.write_text(json.dumps(result.model_dump(mode="json"), indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
