"""Impulse responses (IRs) in the memory layout of the compiled convolver."""

from collections.abc import Iterable
from functools import cache, cached_property, lru_cache
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import carray

from server.kernels import odd_fft
from server.kernels.array_pool import ArrayPool
from server.kernels.cache_lines import zeros_on_lines
from server.kernels.compiled import compiled
from server.kernels.copying import copy
from server.kernels.energy import energy_of
from server.kernels.simd import DIGEST_FACTOR, HAS_WIDE_REGISTERS, lanes, load_int, mix_bits, pointer, store
from server.rendering.multiply_accumulate import filter_offset
from server.rendering.partitions import Partitioning

FloatArray = npt.NDArray[np.float32]
DoubleArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

_PER_STAGE = 3
_PER_PLAN = 6
_PLANS = 64
"""How many plans are kept: responses have few lengths, unless their ends are silent."""
_SEEDS = np.random.PCG64(0x9E3779B97F4A7C15).random_raw(4 * 8)
_FACTOR, _SHIFT = np.uint64(DIGEST_FACTOR), np.uint64(32)
_WORDS = 16
"""Lanes of a digest: eight words."""
_load_wide = lanes(_WORDS).load
_ROOM = 7
"""Of each sample of a partition, numbers in a buffer: four of a transform of two channels, one of silence, and one for
each of two channels that end within the partition."""
_POOL = ArrayPool(64 * 1024 * 1024)
"""Enough for a few dozen responses of one second: an exchanged response frees the memory that the next one needs."""


def address(array: npt.NDArray[np.generic]) -> int:
    return int(array.__array_interface__["data"][0])


class PackedFilter:
    """An IR (channel, sample) transformed for every stage. Immutable, so threads may share it.

    `header` holds, per stage, the address of its spectra, how many partitions they have, and the address of the digests
    of the partitions' samples. `energies` are the sums of squares of each stage's samples, over all channels. The first
    `made` stages are in `floats` and `numbers`, as the plan has it, and the others those of `like`.
    """

    def __init__(
        self,
        plan: "_Plan",
        floats: FloatArray,
        numbers: IntArray,
        energies: tuple[float, ...],
        like: "PackedFilter | None" = None,
    ) -> None:
        self.header = numbers[plan.header]
        self.energies = energies
        self._plan, self._floats, self._numbers = plan, floats, numbers
        if like is not None:
            made = len(energies)
            self.header[_PER_STAGE * made :] = like.header[_PER_STAGE * made :]
            self.energies += like.energies[made:]
            # Now, so that `like` itself is not kept, nor what it was like.
            self.spectra += like.spectra[made:]
            self.digests += like.digests[made:]

    @cached_property
    def spectra(self) -> tuple[FloatArray, ...]:
        """The spectra of each stage."""
        return tuple([self._floats[part] for part in self._plan.spectra])

    @cached_property
    def digests(self) -> tuple[IntArray, ...]:
        """The digests of each stage's partitions."""
        return tuple([self._numbers[part] for part in self._plan.digests])

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
    floats = _POOL.floats(plan.floats)  # every value is written below
    numbers, energies = np.zeros(plan.numbers, np.int64), np.zeros(made)
    try:
        room = plan.rooms.pop()
    except IndexError:
        room = zeros_on_lines(plan.room)
    _pack(ir, plan.stages, room, floats, numbers, plan.header.stop, energies)
    plan.rooms.append(room)
    return PackedFilter(plan, floats, numbers, tuple(energies.tolist()), like)


class _Plan(NamedTuple):
    """Where the parts of a filter are: each stage's spectra among so many `floats`, and the header and each stage's
    digests among so many `numbers`. `stages` (stage, 6) are the start of each stage, the number and size of its
    partitions, and the addresses of its transform's tables; `tables` keep these alive. `rooms` are buffers of `room`
    floats that no thread uses now."""

    floats: int
    numbers: int
    header: slice
    spectra: tuple[slice, ...]
    digests: tuple[slice, ...]
    stages: IntArray
    tables: tuple[odd_fft.Tables, ...]
    room: int
    rooms: list[FloatArray]


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
        *_rooms(stages[-1].size if stages else 0),
    )


@cache
def _rooms(longest: int) -> tuple[int, list[FloatArray]]:
    """The size of a buffer for partitions of at most `longest` samples, and those that no thread uses now: as many as
    there were threads at once."""
    return _ROOM * longest + _WORDS, []


def _parts(lengths: Iterable[int], start: int = 0) -> tuple[slice, ...]:
    """Slices of these lengths from `start` on, one after the other."""
    ends = accumulate(lengths, initial=start)
    return tuple(slice(begin, end) for begin, end in pairwise(ends))


@compiled
def _pack(
    ir: FloatArray,
    stages: IntArray,
    room: FloatArray,
    spectra: FloatArray,
    header: IntArray,
    done: int,
    energies: DoubleArray,
) -> None:
    """Transform an IR into the `spectra` of all `stages`, one after the other, and fill their energies and header,
    where digests begin with number `done`. `room` is a buffer of the size of `_rooms`."""
    channels, samples = ir.shape
    longest = stages[-1, 2] if len(stages) > 0 else 0
    words, bins, silence = room.ctypes.data, room[_WORDS:].ctypes.data, room[_WORDS + 4 * longest :].ctypes.data
    padded = room[_WORDS + 5 * longest :].reshape(2, longest)
    in_pairs = channels // 2 * 2 if HAS_WIDE_REGISTERS else 0
    to = spectra.ctypes.data
    for number in range(len(stages)):
        start, count, size = stages[number, 0], stages[number, 1], stages[number, 2]
        twist, passes, lanes = stages[number, 3], stages[number, 4], stages[number, 5]
        header[_PER_STAGE * number] = to
        header[_PER_STAGE * number + 1] = count
        header[_PER_STAGE * number + 2] = header.ctypes.data + header.itemsize * done
        for partition in range(count):
            begin = start + partition * size
            end = min(begin + size, samples)
            digest, before = _load_wide(_SEEDS.ctypes.data, 48), 0
            at = filter_offset(channels, size // 8, count, 0, partition)
            step = filter_offset(channels, size // 8, count, 1, partition) - at
            for channel in range(channels):
                first = ir[channel, begin:end].ctypes.data
                if end < begin + size:
                    beyond = padded[channel % 2]
                    copy(ir[channel, begin:end], beyond)
                    beyond[end - begin : size] = 0
                    first = beyond.ctypes.data
                digest = _digest(first, size, digest)
                energies[number] += energy_of(carray(pointer(first), (size,), np.float32))
                of_channel = to + 4 * (at + 16 * channel)
                if channel >= in_pairs:
                    odd_fft.forward(first, silence, bins, of_channel, step, 8, size, twist, passes, lanes)
                elif channel % 2 == 1:
                    odd_fft.forward_pair(before, first, bins, of_channel - 64, step, size, twist, passes, lanes)
                before = first
            header[done] = np.int64(_folded(digest, words))
            done += 1
        to += 4 * 2 * size * count * channels


@compiled
def _digest(samples: int, size: int, before: Any) -> Any:
    """A digest (16 lanes) of the bits of `size` samples, a multiple of 64, at an address, and of what the digest
    `before` is of: equal samples give equal digests, and different ones do except with probability 2^-64. There are
    four sums of eight words each, since a word must wait for the one before it; every step is invertible."""
    seeds = _SEEDS.ctypes.data
    a, b, c, d = before, _load_wide(seeds, 0), _load_wide(seeds, 16), _load_wide(seeds, 32)
    for n in range(0, size, 64):
        a = mix_bits(a, _load_wide(samples, n))
        b = mix_bits(b, _load_wide(samples, n + 16))
        c = mix_bits(c, _load_wide(samples, n + 32))
        d = mix_bits(d, _load_wide(samples, n + 48))
    return mix_bits(mix_bits(mix_bits(a, b), c), d)


@compiled
def _folded(digest: Any, words: int) -> Any:
    """One number for the eight of a digest, which are written to `words`."""
    store(words, 0, digest)
    folded = np.uint64(0)
    for n in range(8):
        folded = (folded ^ np.uint64(load_int(words, n))) * _FACTOR
        folded ^= folded >> _SHIFT
    return folded
