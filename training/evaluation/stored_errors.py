"""Storage for the errors that an evaluation has measured, so that an interrupted evaluation can be resumed."""

import hashlib
import json
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from training.parallel.code_digest import code_digest

ColumnErrors = Mapping[str, npt.NDArray[np.float64]]
"""The errors of one pair in one column: (yaw,) by metric."""
Errors = Mapping[int, ColumnErrors]
"""The errors of one pair by the number of the column."""


class StoredErrors:
    """A file with a line of JSON for each pair, or for some of its columns, after a first line with a digest of
    everything on which the errors depend. Several threads may use it.

    A file with another digest, or from other code, is started again.
    """

    def __init__(self, path: Path, depends_on: Any) -> None:
        """`depends_on` is everything besides the code on which the errors depend, in plain values for `json.dumps`."""
        self._path = path
        self._lock = threading.Lock()
        key = hashlib.sha256(json.dumps([depends_on, code_digest()]).encode()).hexdigest()
        text = path.read_text() if path.exists() else ""
        # The last line may have been interrupted.
        lines = text[: text.rfind("\n") + 1].splitlines(keepends=True)
        if lines[:1] != [f"{key}\n"]:
            lines = [f"{key}\n"]
        path.write_text("".join(lines))
        self._pairs: dict[int, dict[int, ColumnErrors]] = {}
        for line in lines[1:]:
            pair, errors = _parsed(line)
            self._pairs.setdefault(pair, {}).update(errors)

    def __len__(self) -> int:
        return len(self._pairs)

    def get(self, pair: int) -> Errors:
        """The errors of those columns of a pair that were in the file when it was opened, or were put."""
        with self._lock:
            return dict(self._pairs.get(pair, {}))

    def put(self, pair: int, errors: Errors) -> None:
        values = {
            number: {metric: of_yaws.tolist() for metric, of_yaws in column.items()}
            for number, column in errors.items()
        }
        with self._lock, self._path.open("a") as file:
            self._pairs.setdefault(pair, {}).update(errors)
            file.write(json.dumps([pair, values]) + "\n")

    def discard(self) -> None:
        """Remove the file when the evaluation is finished."""
        self._path.unlink(missing_ok=True)


def signature(folder: Path) -> list[tuple[str, int, int]]:
    """The name, size and modification time of each file in a folder."""
    files = sorted(path for path in folder.iterdir() if path.is_file())
    return [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in files]


def _parsed(line: str) -> tuple[int, dict[int, ColumnErrors]]:
    """The pair of a line, and its errors by column."""
    pair, values = json.loads(line)
    return pair, {
        int(number): {metric: np.array(of_yaws, np.float64) for metric, of_yaws in column.items()}
        for number, column in values.items()
    }
