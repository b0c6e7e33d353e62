"""Throughput of convolvers on one core, and how evenly the work is spread over blocks.

A case has a block size, an IR length and a number of sources. Each source is white noise with a stereo IR of its own.
All convolvers get the same blocks of the same sources, prepared beforehand, and each has run before it is timed. In
every round our convolver processes a number of blocks, then pedalboard the same ones, and then `oaconvolve` one source
of ten seconds, since its time per source does not depend on their number.

- `x_realtime`: source-seconds per CPU-second, the median of the rounds. CPU time is that of the process
  (`time.process_time`), so helper threads count, and other processes have little influence. Ours takes one call to
  `Convolver.process` per block for all sources and mixes them. Pedalboard takes one call to `Convolution.process` per
  block and source, without mixing.
- `ratio`: our throughput divided by pedalboard's.
- `max_error_db`: largest difference from `scipy.signal.fftconvolve` in float64, relative to the largest sample, over a
  stream longer than the IR and two cycles of the stages.
- `worst_to_mean_block`: time of the slowest block divided by the mean. The work of the stages repeats after a cycle of
  twice the longest partition. Each block of the cycle is timed by the wall clock in many cycles, and its median counts.
- `shared_tail_…`: the same with `Convolver(shared_tail=True)`.
"""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from server.bench.peers import Pedalboard, convolve_at_once, error_db, reference
from server.bench.rooms import FloatArray, noise, room
from server.rendering.convolver import Convolver
from server.rendering.partitions import Partitioning

SAMPLE_RATE = 48_000
_LONGEST_CYCLE = 32 * 512
_CYCLES_TIMED = 15
_AT_ONCE_S = 10


@dataclass(frozen=True)
class Case:
    block_size: int
    ir_s: float
    sources: int

    @property
    def ir_samples(self) -> int:
        return round(self.ir_s * SAMPLE_RATE)

    @property
    def cycle(self) -> int:
        """Number of blocks after which the work of the stages repeats."""
        return 2 * Partitioning(self.block_size, self.ir_samples).stages[-1].ticks

    @property
    def blocks(self) -> int:
        """Number of blocks in a round: whole cycles, and fewer for more sources, so that rounds last about as long."""
        return self.cycle * max(1, 32 // self.sources)


@dataclass(frozen=True)
class Rooms:
    """Sources with IRs of one length, and the exact mix of the first 1, 4, ... of them. Cases share them."""

    dry: FloatArray
    """(sources, samples) dry signals."""
    irs: FloatArray
    """(sources, 2, samples) impulse responses."""
    expected: dict[int, Any]
    """Exact mix (2, samples), float64, by number of sources."""

    @classmethod
    def of(cls, ir_samples: int, counts: set[int]) -> "Rooms":
        sources = max(counts)
        samples = -(-(ir_samples + 2 * _LONGEST_CYCLE) // _LONGEST_CYCLE) * _LONGEST_CYCLE
        dry = noise(1, sources, samples)
        irs = np.stack([room(2 + source, ir_samples) for source in range(sources)])
        mix = np.zeros((2, samples))
        expected = {}
        for source in range(sources):
            mix += reference(dry[source], irs[source])
            if source + 1 in counts:
                expected[source + 1] = mix.copy()
        return cls(dry, irs, expected)


def measure_case(case: Case, rooms: Rooms, *, rounds: int, peer: ModuleType | None) -> dict[str, Any]:
    """The measurements of one case. Those of pedalboard are None if it is not installed."""
    irs, blocks = rooms.irs[: case.sources], _cut(rooms.dry[: case.sources], case.block_size)
    ours = _convolver(case, irs)
    wet = np.concatenate([ours.process(block) for block in blocks], axis=1)
    lanes: dict[str, Callable[[], object]] = {"ours": _playing(ours, blocks, case.blocks)}
    source_s = case.sources * case.blocks * case.block_size / SAMPLE_RATE
    lengths_s = {"ours": source_s, "oaconvolve": float(_AT_ONCE_S), "peer": source_s, "shared_tail": source_s}
    if peer is not None:
        stereo = np.repeat(blocks[:, :, np.newaxis], 2, axis=2)
        lanes["peer"] = _playing(Pedalboard(peer, irs, SAMPLE_RATE), stereo, case.blocks)
    shared_tail = _convolver(case, irs, shared_tail=True) if case.sources > 1 else None
    if shared_tail is not None:
        lanes["shared_tail"] = _playing(shared_tail, blocks, case.blocks)
    long = np.resize(rooms.dry[0], _AT_ONCE_S * SAMPLE_RATE)
    lanes["oaconvolve"] = lambda: convolve_at_once(long, irs[0])
    times_s = time_in_turns(lanes, rounds)
    x_realtime = {name: lengths_s[name] / statistics.median(times_s[name]) for name in lanes}
    peer_x, shared_x = x_realtime.get("peer"), x_realtime.get("shared_tail")
    return {
        "block_size": case.block_size,
        "ir_s": case.ir_s,
        "sources": case.sources,
        "x_realtime": x_realtime["ours"],
        "peer_x_realtime": peer_x,
        "ratio": peer_x and x_realtime["ours"] / peer_x,
        "oaconvolve_x_realtime": x_realtime["oaconvolve"],
        "max_error_db": error_db(wet, rooms.expected[case.sources]),
        "worst_to_mean_block": worst_to_mean(ours, blocks, case.cycle),
        "shared_tail_x_realtime": shared_x,
        "shared_tail_ratio": shared_x and peer_x and shared_x / peer_x,
        "shared_tail_worst_to_mean_block": shared_tail and worst_to_mean(shared_tail, blocks, case.cycle),
    }


def time_in_turns(lanes: dict[str, Callable[[], object]], rounds: int) -> dict[str, list[float]]:
    """CPU-seconds of each lane in each round. The lanes run one after another; a first round warms up."""
    times_s: dict[str, list[float]] = {name: [] for name in lanes}
    for number in range(rounds + 1):
        for name, lane in lanes.items():
            started_s = time.process_time()
            lane()
            if number > 0:
                times_s[name].append(time.process_time() - started_s)
    return times_s


def worst_to_mean(convolver: Convolver, blocks: FloatArray, cycle: int) -> float:
    times_s = np.empty((_CYCLES_TIMED + 1, cycle))
    for number in range(times_s.size):
        block = blocks[number % len(blocks)]
        started_s = time.perf_counter()
        convolver.process(block)
        times_s.flat[number] = time.perf_counter() - started_s
    usual_s = np.median(times_s[1:], axis=0)
    return float(usual_s.max() / usual_s.mean())


def _convolver(case: Case, irs: FloatArray, *, shared_tail: bool = False) -> Convolver:
    convolver = Convolver(
        sources=case.sources,
        channels=2,
        block_size=case.block_size,
        ir_samples=case.ir_samples,
        shared_tail=shared_tail,
    )
    for source, ir in enumerate(irs):
        convolver.set_ir(source, ir)
    return convolver


def _cut(dry: FloatArray, block_size: int) -> FloatArray:
    """Cut (sources, n) into contiguous blocks (n / b, sources, b)."""
    return np.ascontiguousarray(dry.reshape(len(dry), -1, block_size).swapaxes(0, 1))


def _playing(player: Convolver | Pedalboard, blocks: FloatArray, count: int) -> Callable[[], object]:
    """A function that processes `count` blocks, starting over in `blocks` as often as necessary."""
    order = [blocks[number % len(blocks)] for number in range(count)]

    def play() -> None:
        for block in order:
            player.process(block)

    return play
