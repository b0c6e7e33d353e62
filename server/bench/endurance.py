"""Drift of a convolver over minutes, and scaling with two threads."""

import statistics
import threading
import time
from typing import Any

import numpy as np

from server.bench.peers import error_db, reference
from server.bench.rooms import FloatArray, noise, room
from server.bench.throughput import SAMPLE_RATE
from server.rendering.convolver import Convolver

_BLOCK_SIZE = 256
_LOOP_BLOCKS = 1_024
"""Length of the loop. It is a whole number of the convolver's cycles, so that without drift every round has the same
bits."""


def measure_drift(*, duration_s: float, ir_s: float = 1.0) -> dict[str, Any]:
    """Largest error against float64 in the first and in the last second of a stream of looped noise, in dB relative to
    that second's largest sample. The drift is the error of the last second minus that of the same part of the loop in
    its first round."""
    ir_samples = round(ir_s * SAMPLE_RATE)
    loop = noise(3, _LOOP_BLOCKS, 1, _BLOCK_SIZE)
    ir = room(4, ir_samples)
    convolver = Convolver(sources=1, channels=2, block_size=_BLOCK_SIZE, ir_samples=ir_samples)
    convolver.set_ir(0, ir)
    second = -(-SAMPLE_RATE // _BLOCK_SIZE)
    blocks = max(4 * _LOOP_BLOCKS, round(duration_s * SAMPLE_RATE / _BLOCK_SIZE))
    # The same part of the loop in the first round in which the reverberation has built up.
    like_last = _LOOP_BLOCKS + (blocks - second) % _LOOP_BLOCKS
    errors_db: dict[int, float] = {}
    stretches: dict[int, list[FloatArray]] = {start: [] for start in (0, like_last, blocks - second)}
    for number in range(blocks):
        wet = convolver.process(loop[number % _LOOP_BLOCKS])
        for start, stretch in stretches.items():
            if start <= number < start + second:
                stretch.append(wet)
    for start, stretch in stretches.items():
        since = max(0, start - -(-ir_samples // _BLOCK_SIZE))  # the IR reaches back to here
        dry = loop[np.arange(since, start + second) % _LOOP_BLOCKS].reshape(-1)
        expected = reference(dry, ir)[:, -second * _BLOCK_SIZE :]
        errors_db[start] = error_db(np.concatenate(stretch, axis=1), expected)
    return {
        "duration_s": blocks * _BLOCK_SIZE / SAMPLE_RATE,
        "blocks": blocks,
        "first_second_error_db": errors_db[0],
        "last_second_error_db": errors_db[blocks - second],
        "drift_db": errors_db[blocks - second] - errors_db[like_last],
    }


def threads_scale(*, sources: int, rounds: int, blocks: int, ir_s: float = 1.0) -> float:
    """Throughput of two threads with a convolver each, divided by that of one, by wall time. 2 is perfect and needs two
    idle cores."""
    ir_samples = round(ir_s * SAMPLE_RATE)
    convolvers = [
        Convolver(sources=sources, channels=2, block_size=_BLOCK_SIZE, ir_samples=ir_samples) for _ in range(2)
    ]
    for convolver in convolvers:
        for source in range(sources):
            convolver.set_ir(source, room(source, ir_samples))
    dry = noise(5, blocks, sources, _BLOCK_SIZE)

    def play(convolver: Convolver) -> None:
        for block in dry:
            convolver.process(block)

    def wall_s(players: list[Convolver]) -> float:
        threads = [threading.Thread(target=play, args=(player,)) for player in players]
        started_s = time.perf_counter()
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return time.perf_counter() - started_s

    wall_s(convolvers)
    times_s = [(wall_s(convolvers[:1]), wall_s(convolvers)) for _ in range(rounds)]
    alone_s, together_s = (statistics.median(times) for times in zip(*times_s, strict=True))
    return float(2 * alone_s / together_s)
