"""Builds what takes long once for all workers of a test run: `once`."""

import fcntl
import os
from collections.abc import Callable
from pathlib import Path

import pytest


def once(name: str, build: Callable[[Path], object], factory: pytest.TempPathFactory) -> Path:
    """A folder for all workers, filled by `build`, which the first that asks calls while others wait. Nobody may change
    what is in it."""
    shared = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        shared = shared.parent  # that of the whole run
    folder, is_built = shared / name, shared / f"{name}.built"
    with (shared / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not is_built.exists():
            folder.mkdir()  # fails where an earlier worker failed, which has told why
            build(folder)
            is_built.touch()
    return folder
