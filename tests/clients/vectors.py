"""What tests of several clients share: the table of test vectors, and what READMEs tell one to type."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

CLIENTS = Path(__file__).resolve().parents[2] / "client_examples"
TABLE: dict[str, Any] = json.loads((CLIENTS / "vectors" / "vectors.json").read_text())


def poses(engine: str) -> npt.NDArray[np.float64]:
    """(n, 7) the table's poses as an engine has them, or as `nafir` does: position, then x, y, z, w."""
    turn = "orientation" if engine == "nafir" else "rotation"
    return np.array([[*each[engine]["position"], *each[engine][turn]] for each in TABLE["poses"]])


def readme_commands(client: str) -> list[str]:
    """The lines of the first block of commands in a client's README: what its user types."""
    text = (CLIENTS / client / "README.md").read_text()
    return re.search(r"```sh\n(.*?)```", text, re.DOTALL)[1].splitlines()


def assert_same_poses(found: npt.ArrayLike, wanted: npt.ArrayLike, atol: float = 1e-6) -> None:
    """Compares (n, 7). A quaternion and its negative are the same orientation."""
    found, wanted = np.asarray(found, np.float64), np.asarray(wanted, np.float64)
    signs = np.sign(np.sum(found[:, 3:] * wanted[:, 3:], axis=1, keepdims=True))
    np.testing.assert_allclose(found[:, :3], wanted[:, :3], rtol=1e-6, atol=atol)
    np.testing.assert_allclose(signs * found[:, 3:], wanted[:, 3:], atol=atol)
