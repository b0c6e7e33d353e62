"""The compiled code of `server.rendering.output`."""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import carray, types

from server.kernels.by_reference import Reference, ReferenceType, reference_at
from server.kernels.compiled import compiled
from server.kernels.flush_to_zero import flush_to_zero, restore
from server.kernels.simd import pointer
from server.rendering.convolver_kernel import has_exchanged
from server.rendering.limiter import limit
from server.rendering.mixing_kernel import MIXER, mix

OUTPUT = np.dtype(
    [
        (name, np.int64)
        for name in (
            "channels",
            "block_size",
            "sum",  # (channel, block_size) float32
            "limiter",  # address of a reference to a LimiterState, 0 for none
        )
    ]
)


@compiled
def mix_listeners(
    rows: npt.NDArray[np.int64],
    frames: npt.NDArray[np.float32],
    flags: npt.NDArray[np.int64],
    like: Reference | None,
    like_limiter: Reference,
) -> None:
    """Render the next blocks of every row, in order. A row (6,) holds: the address of an OUTPUT record, the addresses
    of two MIXER records (the second 0 for none), the number of blocks, the row of `flags` (block, 2) for the first
    block, and the index in `frames` at which it begins. The flags of a block say whether an IR was exchanged in it, and
    whether it would have been too loud. `like` refers to any direct path's state, or is None if there is none,
    and `like_limiter` to any limiter's."""
    mode = flush_to_zero()
    for number in range(rows.shape[0]):
        output = carray(pointer(rows[number, 0]), (1,), OUTPUT)[0]
        total = carray(pointer(output.sum), (output.channels, output.block_size), np.float32)
        at = rows[number, 5]
        for block in range(rows[number, 4], rows[number, 4] + rows[number, 3]):
            total[:] = 0
            for place in range(1, 3):
                if rows[number, place] != 0:
                    mixer = carray(pointer(rows[number, place]), (1,), MIXER)[0]
                    mix(mixer, like)
                    _add(mixer, total)
                    if mixer.convolver != 0 and has_exchanged(mixer.convolver):
                        flags[block, 0] = 1
            if output.limiter != 0:
                limiter = reference_at(output.limiter, like_limiter)
                limit(limiter, total)
                flags[block, 1] = limiter.counts[0]
            for n in range(output.block_size):
                for channel in range(output.channels):
                    frames[at] = total[channel, n]
                    at += 1
    restore(mode)


@compiled
def _add(mixer, total) -> None:
    """Add a mixer's output to the total. One channel without a head is copied to both outputs; the two ears of a head
    are averaged to one output."""
    channels, size = total.shape
    made = carray(pointer(mixer.output), (mixer.channels, size), np.float32)
    for channel in range(channels):
        if mixer.channels <= channels:
            own = made[min(channel, mixer.channels - 1)]
            for n in range(size):
                total[channel, n] += own[n]
        else:
            for n in range(size):
                total[channel, n] += np.float32(0.5) * (made[0, n] + made[1, n])


@cache
def mixing_with(kind: ReferenceType | None, limiter: ReferenceType) -> Callable[..., None]:
    """`mix_listeners` compiled for these types of reference. Calling it directly would let numba look up the types in
    Python at every call."""
    signature = (
        types.Array(types.int64, 2, "C"),
        types.Array(types.float32, 1, "C"),
        types.Array(types.int64, 2, "C"),
        types.none if kind is None else kind,
        limiter,
    )
    return mix_listeners.compile(signature)  # type: ignore[attr-defined]


def record_of(output: Any) -> npt.NDArray[np.void]:
    """The OUTPUT record (1,) of a `server.rendering.output.Output`, which must outlive the record."""
    record = np.zeros(1, OUTPUT)
    record["channels"], record["block_size"] = output.sum.shape
    record["sum"] = output.sum.ctypes.data
    record["limiter"] = 0 if output.limiter is None else output.limiter.state.address
    return record
