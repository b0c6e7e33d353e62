"""Time of new processes: until the first convolved block, for commands, and until a server is ready."""

import os
import re
import resource
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable
from dataclasses import asdict
from typing import Any, TextIO

from server.bench.machine import describe_machine
from server.bench.report import Goal
from server.core.errors import NafirError

_NAFIR = (sys.executable, "-m", "server")

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


HELP_CPU_S = Goal("cpu_s of nafir --help", 0.3, is_at_most=True)
IR_CPU_S = Goal("cpu_s of nafir ir", 1.2, is_at_most=True)
READY_S = Goal("s until nafir serve is ready", 2.5, is_at_most=True)
FIRST_READY_S = Goal("s until nafir serve is ready, everything to compile", 75.0, is_at_most=True)

_READY_WITHIN_S = 900.0
_POLL_S = 0.02


def measure_starts(rounds: int, *, is_first: bool = False) -> dict[str, Any]:
    """Measure new processes: processor time (user and system) of `nafir --help` and of one `nafir ir`, and the time
    until `nafir serve` is ready. Each is the median of `rounds`, which take turns, with compiled code on disk. With
    `is_first`, also measure the server once with an empty cache of compiled code.

    Raises NafirError if a process fails.
    """
    times: dict[Goal, list[float]] = {HELP_CPU_S: [], IR_CPU_S: [], READY_S: []}
    with tempfile.TemporaryDirectory() as folder:
        place = ["--listener=2,2,1.5", "--emitter=4,2,1.5", f"--output={folder}/response.npy"]
        measures: dict[Goal, Callable[[], float]] = {
            HELP_CPU_S: lambda: _cpu_s("--help"),
            IR_CPU_S: lambda: _cpu_s("ir", "apartment", *place),
            READY_S: lambda: _ready_s(os.environ),
        }
        for number in range(rounds + 1):
            for goal, measure in measures.items():
                taken_s = measure()
                if number:  # the first round compiles what is missing on disk
                    times[goal].append(taken_s)
        judgements = [goal.judge(statistics.median(taken)) for goal, taken in times.items()]
        if is_first:
            judgements.append(FIRST_READY_S.judge(_ready_s({**os.environ, "NUMBA_CACHE_DIR": f"{folder}/compiled"})))
    return {"host": describe_machine(), "rounds": rounds, "summary": [asdict(each) for each in judgements]}


def _cpu_s(*arguments: str) -> float:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([*_NAFIR, *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise NafirError(f"nafir {' '.join(arguments)} failed: {done.stderr.strip()}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def _ready_s(environment: "os._Environ[str] | dict[str, str]") -> float:
    """Time from the start of a server until it says that it is ready."""
    began_s = time.perf_counter()
    # Files, since a pipe that nobody empties would stall the server at its access log.
    with tempfile.TemporaryFile("w+") as said, tempfile.TemporaryFile("w+") as log:
        server = subprocess.Popen([*_NAFIR, "serve", "--port=0"], env=dict(environment), stdout=said, stderr=log)
        try:
            while not _is_ready(_text(said)):
                if server.poll() is not None or time.perf_counter() - began_s > _READY_WITHIN_S:
                    raise NafirError(f"nafir serve did not become ready: {_text(log).strip()}")
                time.sleep(_POLL_S)
            return time.perf_counter() - began_s
        finally:
            server.kill()
            server.wait()


def _text(file: TextIO) -> str:
    file.seek(0)
    return file.read()


def _is_ready(said: str) -> bool:
    address = re.search(r"http://\S+", said)
    if address is None:
        return False
    try:
        with urllib.request.urlopen(f"{address[0]}/readyz", timeout=5):
            return True
    except OSError:  # it does not listen yet, or is not ready
        return False
