"""Blocks of one listener that have arrived and wait to be taken."""

import asyncio
from collections import deque

from nafir_client.errors import ClosedError, NafirClientError
from nafir_client.wire import Block


class Arrivals:
    """A bounded queue in asyncio that ends."""

    def __init__(self) -> None:
        self._blocks: deque[Block] = deque()
        self._frames = 0
        self._has_news = asyncio.Event()
        self.failure: NafirClientError | None = None
        """Why nothing more will come; ClosedError if that is as it should be."""

    def put(self, block: Block, *, longest: int) -> int:
        """Append a block, and leave out the oldest beyond `longest` frames. Returns how many those were."""
        self._blocks.append(block)
        self._frames += block.frames
        left_out = 0
        while self._frames > longest and len(self._blocks) > 1:
            self._frames -= self._blocks.popleft().frames
            left_out += 1
        self._has_news.set()
        return left_out

    def end(self, failure: NafirClientError) -> None:
        """What has arrived can still be taken. A ClosedError takes the place of an earlier failure."""
        if self.failure is None or isinstance(failure, ClosedError):
            self.failure = failure
        self._has_news.set()

    async def take(self) -> Block:
        """The oldest block, or the next one. Raises StopAsyncIteration after the last block if the queue was closed, or
        else its failure."""
        while not self._blocks:
            if isinstance(self.failure, ClosedError):
                raise StopAsyncIteration
            if self.failure is not None:
                raise self.failure
            self._has_news.clear()
            await self._has_news.wait()
        block = self._blocks.popleft()
        self._frames -= block.frames
        return block
