"""Runs a command and records its time: `python -m training.cli.stopwatch LOG STEP COMMAND ...`.

Each run adds a line of JSON to the log: `step`, `wall_s`, `cpu_s` of the command and the processes it waited for, and
the exit code `rc`. An interrupted command adds its line, too, so the times of all parts of a step can be added.
"""

import json
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path


def timed(log: Path, step: str, command: Sequence[str]) -> int:
    """The exit code of the command: 128 plus the number of the signal if a signal ended it."""
    started_s = time.monotonic()
    # An interrupt from the keyboard reaches the command too. This process waits until the command has ended.
    previous = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        code = subprocess.run(command, check=False, preexec_fn=_interruptible).returncode
    finally:
        signal.signal(signal.SIGINT, previous)
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    line = {
        "step": step,
        "wall_s": round(time.monotonic() - started_s, 2),
        "cpu_s": round(usage.ru_utime + usage.ru_stime, 2),
        "rc": code,
    }
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as file:
        file.write(json.dumps(line) + "\n")
    return code if code >= 0 else 128 - code


def _interruptible() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)


if __name__ == "__main__":
    sys.exit(timed(Path(sys.argv[1]), sys.argv[2], sys.argv[3:]))
