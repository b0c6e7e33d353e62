"""Time of a new process until its first convolved block."""

import os
import statistics
import subprocess
import sys
import tempfile
import time

from server.core.errors import NafirError

_FIRST_BLOCK = """
import numpy as np
from server.rendering.convolver import Convolver
convolver = Convolver(sources=1, channels=2, block_size=256, ir_samples=48_000)
convolver.set_ir(0, np.ones((2, 48_000), np.float32))
assert np.isfinite(convolver.process(np.ones((1, 256), np.float32))).all()
print("heard", flush=True)
"""


def warm_start_s(rounds: int) -> float:
    """Time with the compiled kernels already on disk."""
    _first_block_s(os.environ)
    return statistics.median(_first_block_s(os.environ) for _ in range(rounds))


def cold_start_s() -> float:
    """Time if all kernels have to be compiled."""
    with tempfile.TemporaryDirectory() as folder:
        return _first_block_s({**os.environ, "NUMBA_CACHE_DIR": folder})


def _first_block_s(environment: "os._Environ[str] | dict[str, str]") -> float:
    """Time from the start of the process until it reports the block, without the end of the process."""
    started_s = time.perf_counter()
    with (
        tempfile.TemporaryFile("w+") as complaint,
        subprocess.Popen(
            [sys.executable, "-c", _FIRST_BLOCK],
            env=dict(environment),
            stdout=subprocess.PIPE,
            stderr=complaint,
            text=True,
        ) as process,
    ):
        assert process.stdout is not None
        line = process.stdout.readline()
        taken_s = time.perf_counter() - started_s
        if line != "heard\n":
            process.wait()
            complaint.seek(0)
            raise NafirError(f"a fresh process could not convolve a block: {complaint.read().strip()}")
    return taken_s
