"""Measures how many streams one process carries, however many cores it has: `python -m benchmarks.process_limit
[NOTE]`.

Python code of a process runs on one core at a time. That is what the event loop does, and what an audio thread does
besides the compiled call that renders. The script serves the scene of `nafir bench stream` on one core, with clients on
another, and takes the processor time of both for a second of one stream. It writes
`benchmarks/results/process-limit.json`; NOTE says what else the machine did.

Processor time is counted by thread, and that of the compiled call around the call. Responses take some of the same
Python time; they are not counted, so the limit is an upper bound.
"""

import asyncio
import contextlib
import json
import os
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from decimal import Decimal
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.record import FOLDER, Cell, Column, Host, Result, Table

CASES = (1, 20), (1, 40), (4, 16), (16, 8), (16, 12)
"""Emitters of a stream, and streams."""
_SETTLE_S, _MEASURE_S = 3.0, 20.0
_READY_S = 600.0
_BLOCKS = 2_000
_LIMIT_COLUMNS = (
    "emitters of a stream",
    "streams",
    "event loop, ms",
    "audio thread in Python, ms",
    "audio thread in compiled code, ms",
    "whole process, ms",
    "streams that one process can carry",
)


def _host(core: int) -> None:
    """Serve on a core, and report the processor time of compiled calls too."""
    os.sched_setaffinity(0, {core})
    from server.bench import gauge, host, scene  # which start threads and count cores
    from server.rendering import output

    spent = {"compiled_s": 0.0}
    mixing_with, begin, report = vars(output)["mixing_with"], gauge.Gauge._begin, gauge.Gauge._report

    def timed_mixing_with(*kinds: Any) -> Callable[..., None]:
        mix = mixing_with(*kinds)

        def timed(*arguments: Any) -> None:
            began_s = time.thread_time()
            mix(*arguments)
            spent["compiled_s"] += time.thread_time() - began_s

        return timed

    def begin_anew(self: gauge.Gauge, server: Any) -> None:
        spent["compiled_s"] = 0.0
        begin(self, server)

    def with_compiled(self: gauge.Gauge) -> dict[str, Any]:
        return {**report(self), **spent}

    with (
        patch.object(output, "mixing_with", timed_mixing_with),
        patch.object(gauge.Gauge, "_begin", begin_anew),
        patch.object(gauge.Gauge, "_report", with_compiled),
    ):
        host.serve(scene.SCENE)


@contextlib.contextmanager
def _serving(core: int) -> Iterator[int]:
    command = [sys.executable, "-m", "benchmarks.process_limit", "host", str(core)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            yield int(json.loads(process.stdout.readline())["port"])
        finally:
            process.stdin.close()
            process.wait()


def _get(port: int, what: str) -> Any:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/{what}", timeout=60) as answer:
        return json.load(answer)


def _wait_until_settled(port: int) -> None:
    until_s = time.monotonic() + _READY_S
    while time.monotonic() < until_s:
        with contextlib.suppress(OSError):
            if _get(port, "readyz") and _get(port, "bench/settled")["is_settled"]:
                return
        time.sleep(0.5)
    raise TimeoutError("the server was not ready")


async def _measure(port: int, emitters: int, streams: int) -> list[Cell]:
    """Return a row of the table."""
    from server.bench.crowd import Crowd
    from server.bench.places import Places
    from server.bench.scene import SAMPLE_RATE, SCENE, bundle_of

    crowd = Crowd(port, Places.of(bundle_of(SCENE)), emitters=emitters, poses_per_s=30.0)
    try:
        await crowd.resize(streams)
        await asyncio.sleep(_SETTLE_S)
        await asyncio.to_thread(_get, port, "bench/begin")
        await asyncio.sleep(_MEASURE_S)
        report = await asyncio.to_thread(_get, port, "bench/report")
    finally:
        await crowd.close()
    stream_s = report["blocks_sent"] * 256 / SAMPLE_RATE
    cpu_s = {name: load * report["duration_s"] for name, load in report["server_load_by_thread"].items()}
    loop = 1000 * cpu_s["MainThread"] / stream_s
    audio = 1000 * sum(spent_s for name, spent_s in cpu_s.items() if name.startswith("nafir-audio")) / stream_s
    compiled = 1000 * report["compiled_s"] / stream_s
    whole = 1000 * report["server_load"] * report["duration_s"] / stream_s
    python = audio - compiled
    return [
        emitters,
        streams,
        *(Decimal(f"{ms:.3g}") for ms in (loop, python, compiled, whole)),
        Decimal(f"{1000 / (loop + python):.2g}"),
    ]


def _encodings() -> list[list[Cell]]:
    """Processor time to encode the blocks of a second of a stream of two channels at 48 kHz."""
    from server.bench.scene import SAMPLE_RATE
    from server.protocol.blocks import AudioBlock
    from server.protocol.codecs.registry import CODECS

    samples = 0.1 * np.random.default_rng(1).standard_normal((2, 256)).astype(np.float32)
    block = AudioBlock(5, 256, 1, 1, samples)
    rows: list[list[Cell]] = []
    for encoding in CODECS:
        times_s = []
        for _ in range(20):
            began_s = time.thread_time()
            for _ in range(_BLOCKS):
                block.serialize(encoding)
            times_s.append((time.thread_time() - began_s) / _BLOCKS)
        rows.append([f"`{encoding}`", Decimal(f"{1000 * min(times_s) * SAMPLE_RATE / 256:.2g}")])
    return rows


def _table(titles: tuple[str, ...], rows: list[list[Cell]]) -> Table:
    columns = tuple(Column(title=title, is_number=True) for title in titles)
    return Table(columns=columns, rows=tuple(map(tuple, rows)))


def main(note: str) -> None:
    from server.bench.machine import instruction_set, processor

    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, set(cores[:-1]) or {cores[-1]})
    rows = []
    with _serving(cores[-1]) as port:
        _wait_until_settled(port)
        for emitters, streams in CASES:
            rows.append(asyncio.run(_measure(port, emitters, streams)))
            sys.stdout.write(f"{dict(zip(_LIMIT_COLUMNS, map(str, rows[-1]), strict=True))}\n")
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True)
    result = Result(
        host=Host(processor=processor(), instruction_set=instruction_set(), cores=len(cores), note=note),
        date=f"{datetime.now(UTC):%Y-%m-%d}",
        commit=commit.stdout.strip(),
        command="`python -m benchmarks.process_limit`",
        tables={
            "limit": _table(_LIMIT_COLUMNS, rows),
            "encodings": _table(("encoding", "a second of a stream, ms"), _encodings()),
        },
    )
    text = json.dumps(result.model_dump(), indent=2, default=_as_number)
    (FOLDER / "process-limit.json").write_text(text + "\n", encoding="utf-8")


def _as_number(value: Decimal) -> float:
    return int(value) if value == int(value) else float(value)


if __name__ == "__main__":
    if sys.argv[1:2] == ["host"]:
        _host(int(sys.argv[2]))
    else:
        main(" ".join(sys.argv[1:]))
