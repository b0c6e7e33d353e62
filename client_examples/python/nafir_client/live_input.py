"""Samples of a live emitter on their way to the server, which should have a few blocks of them in advance.

The server's clock counts: it plays one block for each that it renders. So a block is sent for each that arrives. What
waits at the server is estimated from that, and put right by what its status says.
"""

from collections import deque

import numpy as np

from nafir_client.opus import OpusWriter
from nafir_client.wire import Samples


class LiveInput:
    """Takes samples in chunks of any size, and gives blocks that are due. Lengths are in samples.

    `ahead` is how much should wait at the server. Beyond `longest`, the oldest samples that wait here are dropped.
    With a `writer` they go as packets, which are as long as its frames.
    """

    def __init__(self, block_size: int, *, ahead: int, longest: int, writer: OpusWriter | None = None) -> None:
        self.writer = writer
        self._block_size = block_size if writer is None else writer.frame_samples
        self._ahead = ahead
        self._longest = longest
        self._chunks: deque[Samples] = deque()
        self.waiting = 0
        self.dropped = 0
        self.sequence = 0
        """That of the next block."""
        self._at_server = 0
        self._is_open = False

    def write(self, samples: Samples) -> None:
        """Append samples (n,)."""
        self._chunks.append(np.array(samples, np.float32))
        self.waiting += len(samples)
        if self.waiting > self._longest:
            self.dropped += self.waiting - self._longest
            self._take(self.waiting - self._longest)

    def open(self) -> None:
        """The server hears the emitter from now on, and has no samples of it yet."""
        self._at_server, self._is_open = 0, True

    def close(self) -> None:
        """The connection is lost, and with it what waited at the server."""
        self._is_open = False

    def advance(self, frames: int) -> None:
        """The server has rendered so many frames more."""
        self._at_server = max(0, self._at_server - frames)

    def correct(self, samples_queued: int) -> None:
        """The server says how many samples wait there; those on their way to it are not among them."""
        self._at_server = max(self._at_server, samples_queued)

    def due(self) -> list[Samples]:
        """The blocks to send now. They are whole, unless the server is about to run out: then what there is goes, if it
        need not be a packet."""
        blocks = []
        while self._is_open and self.waiting and self._at_server < self._ahead:
            is_whole = self.waiting >= self._block_size
            if not is_whole and (self.writer is not None or self._at_server >= self._ahead / 2):
                break
            block = self._take(min(self._block_size, self.waiting))
            self._at_server += len(block)
            blocks.append(block)
        return blocks

    def _take(self, count: int) -> Samples:
        """The next samples (count,), of at least as many that wait."""
        parts, left = [], count
        while left > 0:
            chunk = self._chunks.popleft()
            parts.append(chunk[:left])
            if len(chunk) > left:
                self._chunks.appendleft(chunk[left:])
            left -= len(parts[-1])
        self.waiting -= count
        return np.concatenate(parts) if parts else np.zeros(0, np.float32)
