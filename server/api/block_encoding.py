"""Encoding of a stream's blocks on a thread of its own kind, since it takes longer than the event loop should wait.

A frame of 10 ms of two channels takes some 35 us, third-order ambisonics eight times that. On the event loop it would
delay everybody's blocks, and on an audio thread everybody's rendering.
"""

import logging
import time
from collections.abc import Callable, Sequence
from typing import Final

from server.protocol.packets import BlockEncoder
from server.protocol.server_messages import ListenerRemoved
from server.runtime.thread_pool import ThreadPool
from server.streaming.stream import Outgoing, StreamFailed, TimedBlock

CHANNEL_SHARE: Final = 4e-3
"""Share of a core that encoding a channel takes until a stream has shown it: a little more than measured on an EPYC."""
_logger = logging.getLogger(__name__)


class BlockEncoding:
    """Encodes the blocks of one stream on a thread of `pool`, each listener's with an encoder of its own made by
    `new_encoder`, and hands the stream's output on in its order. Everything but the encoding happens on the event loop,
    whose `call_soon_threadsafe` is `post`.

    While output is being encoded, more may come: it waits, and is encoded together. If more than `capacity` blocks and
    messages wait, `put` takes nothing and returns False.
    """

    def __init__(
        self,
        new_encoder: Callable[[], BlockEncoder],
        pool: ThreadPool,
        *,
        block_s: float,
        capacity: int,
        post: Callable[[Callable[[], None]], object],
        deliver: Callable[[list[Outgoing]], None],
    ) -> None:
        self._new_encoder = new_encoder
        self._encoders: dict[int, BlockEncoder] = {}
        """By the numbers of listeners."""
        self._pool = pool
        self._block_s = block_s
        self.capacity = capacity
        """How many blocks and messages may wait."""
        self._post = post
        self._deliver = deliver
        self._heard_blocks = 0.0
        """How long the sound was that has passed, in blocks, whoever of the listeners had it."""
        self._heard_until: int | None = None
        self._cpu_s = 0.0
        self._waiting: list[Outgoing] = []
        self._is_encoding = False

    @property
    def load(self) -> float:
        """Share of a core that encoding the blocks of all listeners has taken so far; 0 before the first block."""
        return self._cpu_s / (self._heard_blocks * self._block_s) if self._heard_blocks else 0.0

    def put(self, outgoing: list[Outgoing]) -> bool:
        if len(self._waiting) + len(outgoing) > self.capacity:
            return False
        self._waiting += outgoing
        self._begin()
        return True

    def _begin(self) -> None:
        if self._waiting and not self._is_encoding:
            self._is_encoding = True
            taken, self._waiting = self._waiting, []
            self._pool.submit(lambda: self._encode(taken))

    def _encode(self, outgoing: list[Outgoing]) -> None:
        """Runs on a thread of the pool."""
        began_s = time.thread_time()
        try:
            for each in outgoing:
                match each:
                    case TimedBlock(block):
                        each.packets = self._encoder_of(block.listener).encode(block.sample_clock, block.samples)
                    case ListenerRemoved():
                        self._encoders.pop(each.index, None)
        except Exception:
            _logger.exception("a stream could not be encoded")
            outgoing = [StreamFailed()]
        self._note_heard(outgoing)
        self._cpu_s += time.thread_time() - began_s
        try:
            self._post(lambda: self._finish(outgoing))
        except RuntimeError:  # the loop is closed
            _logger.debug("the server ended while a stream was encoded")

    def _note_heard(self, outgoing: Sequence[Outgoing]) -> None:
        """Count the sound that passes with these blocks: by the clock, since any listener's window may be full."""
        for each in outgoing:
            if isinstance(each, TimedBlock):
                size = each.block.samples.shape[-1]
                end = each.block.sample_clock + size
                since = end - size if self._heard_until is None else self._heard_until
                self._heard_blocks += max(0, end - since) / size
                self._heard_until = max(since, end)

    def _encoder_of(self, listener: int) -> BlockEncoder:
        if listener not in self._encoders:
            self._encoders[listener] = self._new_encoder()
        return self._encoders[listener]

    def _finish(self, encoded: list[Outgoing]) -> None:
        self._is_encoding = False
        self._deliver(encoded)
        self._begin()
