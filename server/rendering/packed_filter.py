"""Impulse responses (IRs) in the memory layout of the compiled convolver."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import carray

from server.kernels import odd_fft
from server.kernels.array_pool import ArrayPool
from server.kernels.compiled import compiled
from server.kernels.copying import copy
from server.kernels.energy import energy_of
from server.kernels.simd import load_int, pointer
from server.rendering.multiply_accumulate import filter_offset
from server.rendering.partitions import Partitioning

FloatArray = npt.NDArray[np.float32]
DoubleArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

_PER_STAGE = 3
_PER_PLAN = 6
_PLANS = 64
"""How many plans are kept: responses have few lengths, unless their ends are silent."""
_SEED, _FACTOR = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xFF51AFD7ED558CCD)
_STEP = np.uint64(0xC4CEB9FE1A85EC53)
_SHIFT = np.uint64(32)
_POOL = ArrayPool(64 * 1024 * 1024)
"""Enough for a few dozen responses of one second: an exchanged response frees the memory that the next one needs."""


def address(array: npt.NDArray[np.generic]) -> int:
    return int(array.__array_interface__["data"][0])


@dataclass(frozen=True)
class PackedFilter:
    """An IR (channel, sample) transformed for every stage. Immutable, so threads may share it.

    `header` holds, per stage, the address of its spectra, how many partitions they have, and the address of the digests
    of the partitions' samples. `energies` are the sums of squares of each stage's samples, over all channels.
    """

    header: IntArray
    spectra: tuple[FloatArray, ...]
    digests: tuple[IntArray, ...]
    energies: tuple[float, ...]

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
    if ir.dtype != np.float32 or not ir.flags.carray:  # asking first takes a tenth of the time
        ir = np.require(ir, np.float32, ["C", "A", "W"])
    # Reused stages come last.
    made = len(partitioning.stages) if like is None else sum(stage.start < same_from for stage in partitioning.stages)
    plan = _plan_of(partitioning, *ir.shape, made)
    spectra = _POOL.floats(plan.floats)  # every value is written below
    numbers, energies = np.zeros(plan.numbers, np.int64), np.zeros(made)
    header = numbers[plan.header]
    _pack(ir, plan.stages, spectra, header, numbers[plan.header.stop :], energies)
    of_stages = PackedFilter(
        header,
        tuple([spectra[part] for part in plan.spectra]),
        tuple([numbers[part] for part in plan.digests]),
        tuple(energies.tolist()),
    )
    if like is None:
        return of_stages
    header[_PER_STAGE * made :] = like.header[_PER_STAGE * made :]
    return PackedFilter(
        header,
        of_stages.spectra + like.spectra[made:],
        of_stages.digests + like.digests[made:],
        of_stages.energies + like.energies[made:],
    )


class _Plan(NamedTuple):
    """Where the parts of a filter are: each stage's spectra among so many `floats`, and the header and each stage's
    digests among so many `numbers`. `stages` (stage, 6) are the start of each stage, the number and size of its
    partitions, and the addresses of its transform's tables; `tables` keep these alive."""

    floats: int
    numbers: int
    header: slice
    spectra: tuple[slice, ...]
    digests: tuple[slice, ...]
    stages: IntArray
    tables: tuple[odd_fft.Tables, ...]


@lru_cache(_PLANS)
def _plan_of(partitioning: Partitioning, channels: int, samples: int, made: int) -> _Plan:
    """The plan for the first `made` stages of a response (channels, samples)."""
    stages = partitioning.stages[:made]
    counts = [max(0, min(stage.partitions, -(-(samples - stage.start) // stage.size))) for stage in stages]
    spectra = _parts(2 * stage.size * count * channels for stage, count in zip(stages, counts, strict=True))
    header = slice(0, _PER_STAGE * len(partitioning.stages))
    digests = _parts(counts, header.stop)
    tables = tuple(odd_fft.tables(stage.size) for stage in stages)
    rows = [
        (stage.start, count, stage.size, address(of.twist), address(of.passes), address(of.lanes))
        for stage, count, of in zip(stages, counts, tables, strict=True)
    ]
    return _Plan(
        spectra[-1].stop if spectra else 0,
        digests[-1].stop if digests else header.stop,
        header,
        spectra,
        digests,
        np.array(rows, np.int64).reshape(made, _PER_PLAN),
        tables,
    )


def _parts(lengths: Iterable[int], start: int = 0) -> tuple[slice, ...]:
    """Slices of these lengths from `start` on, one after the other."""
    ends = accumulate(lengths, initial=start)
    return tuple(slice(begin, end) for begin, end in pairwise(ends))


@compiled
def _pack(
    ir: FloatArray, stages: IntArray, spectra: FloatArray, header: IntArray, digests: IntArray, energies: DoubleArray
) -> None:
    """Transform an IR into the `spectra` of all `stages`, one after the other, and fill their header, digests and
    energies."""
    channels, samples = ir.shape
    longest = stages[-1, 2] if len(stages) > 0 else 0
    room = np.zeros((4, longest), np.float32)
    bins, silence = room.ctypes.data, room[2].ctypes.data
    padded = room[3]
    done, to = 0, spectra.ctypes.data
    for number in range(len(stages)):
        start, count, size = stages[number, 0], stages[number, 1], stages[number, 2]
        twist, passes, lanes = stages[number, 3], stages[number, 4], stages[number, 5]
        header[_PER_STAGE * number] = to
        header[_PER_STAGE * number + 1] = count
        header[_PER_STAGE * number + 2] = digests.ctypes.data + digests.itemsize * done
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
                digest = _digest(first, size, digest)
                energies[number] += energy_of(carray(pointer(first), (size,), np.float32))
                at = filter_offset(channels, size // 8, count, 0, partition)
                step = filter_offset(channels, size // 8, count, 1, partition) - at
                odd_fft.forward(first, silence, bins, to + 4 * (at + 16 * channel), step, 8, size, twist, passes, lanes)
            digests[done] = np.int64(digest)
            done += 1
        to += 4 * 2 * size * count * channels


@compiled
def _digest(samples: int, size: int, seed: Any) -> Any:
    """A digest of the bits of `size` samples, a multiple of 16, at an address: equal samples give equal digests, and
    different ones do except with probability 2^-64. It takes two samples at a time into each of eight sums, every step
    of which is invertible."""
    a, b, c, d = seed, seed ^ _FACTOR, seed + _FACTOR, ~seed
    e, f, g, h = a + _STEP, b + _STEP, c + _STEP, d + _STEP
    for n in range(0, size // 2, 8):
        a, b = _mixed(a, load_int(samples, n)), _mixed(b, load_int(samples, n + 1))
        c, d = _mixed(c, load_int(samples, n + 2)), _mixed(d, load_int(samples, n + 3))
        e, f = _mixed(e, load_int(samples, n + 4)), _mixed(f, load_int(samples, n + 5))
        g, h = _mixed(g, load_int(samples, n + 6)), _mixed(h, load_int(samples, n + 7))
    for other in (b, c, d, e, f, g, h):
        a = (a ^ other) * _FACTOR
        a ^= a >> _SHIFT
    return a


@compiled
def _mixed(digest: Any, word: int) -> Any:
    digest = (digest ^ np.uint64(word)) * _FACTOR
    return digest ^ (digest >> _SHIFT)
