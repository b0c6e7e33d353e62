"""Storage for the errors that an evaluation has measured, so that an interrupted evaluation can be resumed."""

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
"""The errors of one pair: for each column, errors (yaw,) by metric."""


class StoredErrors:
    """A file with a line of JSON per pair, after a first line with a digest of everything on which the errors depend.
    Several threads may use it.

    A file with another digest, or from other code, is started again.
    """

    def __init__(self, path: Path, depends_on: Any) -> None:
        """`depends_on` is everything besides the code on which the errors depend, in plain values for `json.dumps`."""
        self._path = path
        self._lock = threading.Lock()
        key = hashlib.sha256(json.dumps([depends_on, _code()]).encode()).hexdigest()
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
        """Remove the file when the evaluation is finished."""
        self._path.unlink(missing_ok=True)


def signature(folder: Path) -> list[tuple[str, int, int]]:
    """The name, size and modification time of each file in a folder."""
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
