"""Impulse responses (IRs) in the memory layout of the compiled convolver."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from server.kernels import odd_fft
from server.kernels.array_pool import ArrayPool
from server.kernels.compiled import compiled
from server.kernels.copying import copy
from server.rendering.multiply_accumulate import filter_offset
from server.rendering.partitions import Partitioning

FloatArray = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int64]

_PER_STAGE = 3
_SEED, _FACTOR = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xFF51AFD7ED558CCD)
_SHIFT = np.uint64(32)
_POOL = ArrayPool(64 * 1024 * 1024)
"""Enough for a few dozen responses of one second: an exchanged response frees the memory that the next one needs."""


def address(array: npt.NDArray[np.generic]) -> int:
    return int(array.__array_interface__["data"][0])


@dataclass(frozen=True)
class PackedFilter:
    """An IR (channel, sample) transformed for every stage. Immutable, so threads may share it.

    `header` holds, per stage, the address of its spectra, how many partitions they have, and the address of the digests
    of the partitions' samples.
    """

    header: IntArray
    spectra: tuple[FloatArray, ...]
    digests: tuple[IntArray, ...]

    @property
    def address(self) -> int:
        return address(self.header)


def pack(
    ir: FloatArray, partitioning: Partitioning, like: PackedFilter | None = None, same_from: int = 0
) -> PackedFilter:
    """Transform an IR (channels, n), with n from 1 to the partitioning's `ir_samples`. Any thread may call it; it
    releases the interpreter's lock for nearly all of the work.

    From sample `same_from` on, the IR must equal the one from which `like` was made; stages that begin there or later
    are reused.
    """
    # one memory layout, because numba compiles for each layout separately
    ir = np.require(ir, np.float32, ["C", "A", "W"])
    channels, samples = ir.shape
    header = np.zeros(_PER_STAGE * len(partitioning.stages), np.int64)
    spectra: list[FloatArray] = []
    digests: list[IntArray] = []
    all_digests = np.zeros(sum(stage.partitions for stage in partitioning.stages), np.int64)
    made = taken = 0
    for number, stage in enumerate(partitioning.stages):
        at = _PER_STAGE * number
        if like is not None and stage.start >= same_from:
            header[at : at + _PER_STAGE] = like.header[at : at + _PER_STAGE]
            spectra.append(like.spectra[number])
            digests.append(like.digests[number])
            continue
        count = max(0, min(stage.partitions, -(-(samples - stage.start) // stage.size)))
        spectra.append(_POOL.floats(2 * stage.size * count * channels))  # every value is written below
        digests.append(all_digests[taken : taken + count])
        header[at : at + _PER_STAGE] = address(spectra[-1]), count, address(digests[-1])
        made, taken = number + 1, taken + count  # reused stages come last
    stages, _ = _stage_tables(partitioning)
    _pack(ir, ir.view(np.uint32), stages[:made], header, all_digests)
    return PackedFilter(header, tuple(spectra), tuple(digests))


@cache
def _stage_tables(partitioning: Partitioning) -> tuple[IntArray, tuple[odd_fft.Tables, ...]]:
    """(stage, 5) the start of each stage, the size of its partitions, and the addresses of its transform's tables; also
    these tables, to keep them alive."""
    all_tables = tuple(odd_fft.tables(stage.size) for stage in partitioning.stages)
    rows = [
        (stage.start, stage.size, address(tables.twist), address(tables.passes), address(tables.lanes))
        for stage, tables in zip(partitioning.stages, all_tables, strict=True)
    ]
    return np.array(rows, np.int64), all_tables


@compiled
def _pack(ir: FloatArray, words: Any, stages: IntArray, header: IntArray, digests: IntArray) -> None:
    """Transform an IR into the spectra of all stages. `words` are the bits of `ir`; `digests` covers all partitions of
    the stages, one after the other."""
    channels, samples = ir.shape
    longest = stages[-1, 1] if len(stages) > 0 else 0
    room = np.zeros((4, longest), np.float32)
    bins, silence = room.ctypes.data, room[2].ctypes.data
    padded = room[3]
    done = 0
    for number in range(len(stages)):
        start, size = stages[number, 0], stages[number, 1]
        twist, passes, lanes = stages[number, 2], stages[number, 3], stages[number, 4]
        spectra, count = header[3 * number], header[3 * number + 1]
        for partition in range(count):
            begin = start + partition * size
            end = min(begin + size, samples)
            digest = _SEED
            for channel in range(channels):
                first = ir[channel, begin:end].ctypes.data
                if end < begin + size:
                    copy(ir[channel, begin:end], padded)
                    padded[end - begin : size] = 0
                    first = padded.ctypes.data
                digest = _digest(words[channel, begin:end], size, digest)
                at = filter_offset(channels, size // 8, count, 0, partition)
                step = filter_offset(channels, size // 8, count, 1, partition) - at
                to = spectra + 4 * (at + 16 * channel)
                odd_fft.forward(first, silence, bins, to, step, 8, size, twist, passes, lanes)
            digests[done] = np.int64(digest)
            done += 1


@compiled
def _digest(words: Any, size: int, seed: Any) -> Any:
    """A digest of samples' bits, padded with zeros up to `size`: equal samples give equal digests, and different ones
    do except with probability 2^-64. It computes four sums in parallel, each step of which is invertible."""
    a, b, c, d = seed, seed ^ _FACTOR, seed + _FACTOR, ~seed
    given = len(words)
    for n in range(0, size, 4):
        if n + 4 <= given:
            a, b = _mixed(a, words[n]), _mixed(b, words[n + 1])
            c, d = _mixed(c, words[n + 2]), _mixed(d, words[n + 3])
        else:
            none = np.uint32(0)
            a = _mixed(a, words[n] if n < given else none)
            b = _mixed(b, words[n + 1] if n + 1 < given else none)
            c = _mixed(c, words[n + 2] if n + 2 < given else none)
            d = _mixed(d, none)
    for other in (b, c, d):
        a = (a ^ other) * _FACTOR
        a ^= a >> _SHIFT
    return a


@compiled
def _mixed(digest: Any, word: Any) -> Any:
    digest = (digest ^ np.uint64(word)) * _FACTOR
    return digest ^ (digest >> _SHIFT)
