"""What an evaluation has measured so far, so that one that is interrupted goes on where it stopped."""

import hashlib
import json
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import server
import training

Errors = Sequence[Mapping[str, npt.NDArray[np.float64]]]
"""Of one pair: column by column, what is (yaw,) by metric."""


class KeptErrors:
    """A line of JSON per pair, after one that says what they were made by; thread-safe.

    What was made of anything else, or by other code, is not gone on with.
    """

    def __init__(self, path: Path, made_of: Any) -> None:
        """`made_of` is whatever errors depend on but the code, plain values for `json.dumps`."""
        self._path = path
        self._lock = threading.Lock()
        key = hashlib.sha256(json.dumps([made_of, _code()]).encode()).hexdigest()
        text = path.read_text() if path.exists() else ""
        # The last line may have been interrupted.
        lines = text[: text.rfind("\n") + 1].splitlines(keepends=True)
        if lines[:1] != [f"{key}\n"]:
            lines = [f"{key}\n"]
        path.write_text("".join(lines))
        self._pairs = dict(map(_pair, lines[1:]))

    def __len__(self) -> int:
        return len(self._pairs)

    def get(self, pair: int) -> Errors | None:
        return self._pairs.get(pair)

    def put(self, pair: int, errors: Errors) -> None:
        values = [{metric: of_yaws.tolist() for metric, of_yaws in column.items()} for column in errors]
        with self._lock, self._path.open("a") as file:
            file.write(json.dumps([pair, values]) + "\n")

    def discard(self) -> None:
        """Where nothing is left to go on with."""
        self._path.unlink(missing_ok=True)


def signature(folder: Path) -> list[tuple[str, int, int]]:
    """Name, size and time of every file in a folder: others wherever it was written to."""
    files = sorted(path for path in folder.iterdir() if path.is_file())
    return [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in files]


def _code() -> str:
    digest = hashlib.sha256()
    for package in (server, training):
        for path in sorted(Path(package.__path__[0]).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _pair(line: str) -> tuple[int, Errors]:
    pair, values = json.loads(line)
    return pair, [{metric: np.array(of_yaws, np.float64) for metric, of_yaws in column.items()} for column in values]
