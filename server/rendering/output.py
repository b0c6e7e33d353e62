"""What reaches a listener: the sum of its mixers, limited, the frames interleaved as they go over a wire.

`mix_all` renders many listeners in one call without the interpreter's lock. To let go of that lock and to get it back
costs little by itself; but where others want it, each time may mean to wait for them.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from server.compiled import HAS_NUMBA
from server.rendering.convolver import FloatArray
from server.rendering.limiter import Limiter
from server.rendering.mixing import Mixer, mix

if HAS_NUMBA:
    from server.rendering.output_kernel import mixing_with, record_of


class Output:
    """So many channels for one listener; with a `ceiling`, no sample is beyond it."""

    def __init__(self, *, channels: int, block_size: int, sample_rate: int, ceiling: float | None) -> None:
        self.channels = channels
        self.limiter: Limiter | None = None
        if ceiling is not None:
            self.limiter = Limiter(channels=channels, block_size=block_size, sample_rate=sample_rate, ceiling=ceiling)
        self.sum = np.zeros((channels, block_size), np.float32)
        if HAS_NUMBA:
            self._record = record_of(self)
            self.address = int(self._record.ctypes.data)


class Rendered(NamedTuple):
    """A block (channel, block_size), in an array of its own."""

    samples: FloatArray
    is_exchange: bool
    """Whether an impulse response was exchanged in it."""
    is_limited: bool
    """Whether it would have been too loud, and was turned down."""


def mix_all(listeners: Sequence[tuple[Output, Sequence[Mixer]]]) -> list[Rendered]:
    """The next block of each, of its one or two mixers. Who stands there several times, in a row, gets so many; that is
    for mixers that play by themselves."""
    mixers = [mixer for _, mixed in listeners for mixer in mixed]
    for mixer in mixers:
        mixer.fill()
    for mixer in mixers:
        mixer.follow()
    size = sum(output.sum.size for output, _ in listeners)
    frames = np.empty(size, np.float32)
    blocks = []
    end = 0
    rows = []
    for output, mixed in listeners:
        start, end = end, end + output.sum.size
        blocks.append(frames[start:end].reshape(-1, output.channels).T)
        if HAS_NUMBA:
            rows.append((output.address, mixed[0].address, mixed[1].address if len(mixed) > 1 else 0, start, 0, 0))
    if not HAS_NUMBA:
        return [_mix(output, mixed, block) for (output, mixed), block in zip(listeners, blocks, strict=True)]
    if not rows:
        return []
    like = next((mixer.direct_state for mixer in mixers if mixer.direct_state is not None), None)
    limiter = next((output.limiter.state for output, _ in listeners if output.limiter is not None), None)
    kinds = (None if each is None else each.kind for each in (like, limiter))
    table = np.array(rows, np.int64)
    mixing_with(*kinds)(table, frames, like, limiter)
    for mixer in mixers:
        if mixer.convolver is not None:
            mixer.convolver.release()
    flags = table[:, 4:].tolist()
    return [Rendered(block, bool(one), bool(other)) for block, (one, other) in zip(blocks, flags, strict=True)]


def _mix(output: Output, mixers: Sequence[Mixer], block: FloatArray) -> Rendered:
    output.sum.fill(0)
    for mixer in mixers:
        mix(mixer)
        # One ear without a head is as good as either of two; a head's two make one by their mean.
        output.sum += mixer.output if mixer.channels <= output.channels else mixer.output.mean(axis=0)
    if output.limiter is not None:
        output.limiter.process(output.sum)
    block[:] = output.sum
    is_exchange = any(mixer.convolver is not None and mixer.convolver.exchanged for mixer in mixers)
    return Rendered(block, is_exchange, output.limiter is not None and output.limiter.acted)
