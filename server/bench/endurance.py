"""Whether a convolver stays exact for minutes, and whether two run side by side."""

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
"""Whole cycles of the stages: whatever does not drift says the same to the last bit each time round."""


def measure_drift(*, duration_s: float, ir_s: float = 1.0) -> dict[str, Any]:
    """The largest error against float64 in the first and in the last second of a stream of looped noise, in dB of the
    second's largest sample; and by how much that of the last has grown since the same stretch was played first."""
    ir_samples = round(ir_s * SAMPLE_RATE)
    loop = noise(3, _LOOP_BLOCKS, 1, _BLOCK_SIZE)
    ir = room(4, ir_samples)
    convolver = Convolver(sources=1, channels=2, block_size=_BLOCK_SIZE, ir_samples=ir_samples)
    convolver.set_ir(0, ir)
    second = -(-SAMPLE_RATE // _BLOCK_SIZE)
    blocks = max(4 * _LOOP_BLOCKS, round(duration_s * SAMPLE_RATE / _BLOCK_SIZE))
    # The first time round, no earlier than the room has filled.
    like_last = _LOOP_BLOCKS + (blocks - second) % _LOOP_BLOCKS
    errors_db: dict[int, float] = {}
    heard: dict[int, list[FloatArray]] = {start: [] for start in (0, like_last, blocks - second)}
    for number in range(blocks):
        wet = convolver.process(loop[number % _LOOP_BLOCKS])
        for start, stretch in heard.items():
            if start <= number < start + second:
                stretch.append(wet)
    for start, stretch in heard.items():
        since = max(0, start - -(-ir_samples // _BLOCK_SIZE))  # what the IR reaches back to
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
    """Blocks per second of wall time of two threads with a convolver each, over those of one; 2 is perfect, and needs
    two idle cores."""
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
