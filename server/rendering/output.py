"""The output for a listener: the sum of its mixers, limited, with interleaved frames as they are sent.

`mix_all` renders many listeners in one call without the interpreter's lock. Releasing and taking the lock again costs
little by itself, but each time may mean waiting for other threads.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from server.rendering.convolver import FloatArray
from server.rendering.limiter import ANY_LIMITER, Limiter
from server.rendering.mixing import Mixer, mix
from server.rendering.output_kernel import mixing_with, record_of


class Output:
    """The output of one listener with `channels` channels; with a `ceiling`, no sample exceeds it."""

    def __init__(self, *, channels: int, block_size: int, sample_rate: int, ceiling: float | None) -> None:
        self.channels = channels
        self.limiter: Limiter | None = None
        if ceiling is not None:
            self.limiter = Limiter(channels=channels, block_size=block_size, sample_rate=sample_rate, ceiling=ceiling)
        self.sum = np.zeros((channels, block_size), np.float32)
        self._record = record_of(self)
        self.address = int(self._record.ctypes.data)


class Rendered(NamedTuple):
    """A rendered block (channel, block_size), in a new array."""

    samples: FloatArray
    is_exchange: bool
    """Whether an impulse response was exchanged in this block."""
    is_limited: bool
    """Whether the block would have been too loud and was turned down."""


def mix_all(listeners: Sequence[tuple[Output, Sequence[Mixer], int]]) -> list[list[Rendered]]:
    """Render the next blocks of each listener from its one or two mixers. The number is how many blocks to render: more
    than one only if all of its mixers read their sources by themselves."""
    mixers = [mixer for _, mixed, _ in listeners for mixer in mixed]
    for mixer in mixers:
        mixer.fill()
    for mixer in mixers:
        mixer.follow()
    if not all(mixer.is_compiled for mixer in mixers):
        return [[_mix(output, mixed) for _ in range(count)] for output, mixed, count in listeners]
    if not listeners:
        return []
    rows, blocks, samples = [], 0, 0
    for output, mixed, count in listeners:
        second = mixed[1].address if len(mixed) > 1 else 0
        rows.append((output.address, mixed[0].address, second, count, blocks, samples))
        blocks += count
        samples += count * output.sum.size
    like = next((mixer.direct_state for mixer in mixers if mixer.direct_state is not None), None)
    # guard: a block is handed out as a copy
    frames, flags = np.empty(samples, np.float32), np.zeros((blocks, 2), np.int64)
    render = mixing_with(None if like is None else like.kind, ANY_LIMITER.kind)
    render(np.array(rows, np.int64), frames, flags, like, ANY_LIMITER)
    for mixer in mixers:
        if mixer.convolver is not None:
            mixer.convolver.release()
    happened = iter(flags.astype(bool).tolist())
    made = []
    for (output, _, count), (*_, start) in zip(listeners, rows, strict=True):
        own = frames[start : start + count * output.sum.size].reshape(count, -1, output.channels)
        made.append([Rendered(block.T, *next(happened)) for block in own])
    return made


def _mix(output: Output, mixers: Sequence[Mixer]) -> Rendered:
    output.sum.fill(0)
    for mixer in mixers:
        mix(mixer)
        # One channel without a head is copied to both outputs; the two ears of a head are averaged to one output.
        output.sum += mixer.output if len(mixer.output) <= output.channels else mixer.output.mean(axis=0)
    if output.limiter is not None:
        output.limiter.process(output.sum)
    is_exchange = any(mixer.convolver is not None and mixer.convolver.exchanged for mixer in mixers)
    return Rendered(output.sum.copy(), is_exchange, output.limiter is not None and output.limiter.acted)
