"""The history of a benchmark: results of runs with host, date and commit."""

import json
import subprocess
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Self

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from server.bench.machine import describe_machine
from server.core.errors import NafirError

FOLDER = Path("benchmarks/history")
UNKNOWN = "unknown"


class RunHost(BaseModel):
    """The host of a run. `load` is the system load over the last minute at the end of the run; above one, times are too
    long."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    processor: str
    instruction_set: str
    cores: int | None
    load: float | None

    @property
    def name(self) -> str:
        return f"{self.processor}, {self.instruction_set}"


class Run(BaseModel):
    """One run of a benchmark. `commit` ends in "+changes" if the checkout had uncommitted changes. `failures` say which
    goals were not reached and what went wrong."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    host: RunHost
    date: datetime
    commit: str
    command: str
    figures: Mapping[str, float | None]
    failures: tuple[str, ...] = ()

    @classmethod
    def now(cls, command: str, figures: Mapping[str, float | None], failures: tuple[str, ...]) -> Self:
        machine = describe_machine()
        return cls(
            host=RunHost(**{name: machine[name] for name in RunHost.model_fields}),
            date=datetime.now(UTC).replace(microsecond=0),
            commit=current_commit(),
            command=command,
            figures=figures,
            failures=failures,
        )


_RUNS = TypeAdapter(tuple[Run, ...])


def current_commit() -> str:
    """Commit of the checkout that contains this code; "unknown" if there is none, as in an installed package."""
    folder = Path(__file__).parent
    try:
        commit = _git(folder, "rev-parse", "HEAD")
        changes = _git(folder, "status", "--porcelain", "--", ":/server", ":/pyproject.toml")
    except (OSError, subprocess.SubprocessError):
        return UNKNOWN
    return f"{commit}+changes" if changes else commit


def _git(folder: Path, *arguments: str) -> str:
    run = ["git", "-C", str(folder), *arguments]
    return subprocess.run(run, check=True, capture_output=True, text=True, timeout=30).stdout.strip()


def read_history(path: Path) -> list[Run]:
    """The runs in a history, oldest first; none if the file does not exist. Raises NafirError if it is not a
    history."""
    try:
        return list(_RUNS.validate_json(path.read_bytes()))
    except FileNotFoundError:
        return []
    except (OSError, ValidationError) as exc:
        raise NafirError(f"{path} is no history of a benchmark: {exc}") from exc


def append_run(path: Path, run: Run) -> None:
    """Add a run to a history. A new file replaces the old one at once. Raises NafirError if it cannot be written."""
    runs = [*read_history(path), run]
    text = ",\n".join(json.dumps(each.model_dump(mode="json"), ensure_ascii=False, indent=2) for each in runs)
    beside = path.with_suffix(".json.new")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside.write_text(f"[\n{text}\n]\n", encoding="utf-8")
        beside.replace(path)
    except OSError as exc:
        raise NafirError(f"{path}: {exc}") from exc
