"""Requests and streams begin one after the other, and leave time for everything else."""

import asyncio
from collections import deque
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")
_LONGEST_PAUSE_S = 0.02


class TurnTaking:
    """Begins one thing at a time on an event loop, first come first served.

    Before the next one the loop has been through all else that was ready, and then for as long again as that took: what
    begins here takes at most half of the loop's time, and streams have the other half.
    """

    def __init__(self) -> None:
        self._waiting: deque[Callable[[], None]] = deque()
        self._is_taken = False

    def __len__(self) -> int:
        """Those that wait."""
        return len(self._waiting)

    def begin(self, loop: asyncio.AbstractEventLoop, start: Callable[[], None]) -> None:
        """Call `start` now, or when its turn comes. It returns soon: what is long it leaves to a task."""
        self._waiting.append(start)
        if not self._is_taken:
            self._next(loop)

    def _next(self, loop: asyncio.AbstractEventLoop) -> None:
        self._is_taken = bool(self._waiting)
        if self._waiting:
            begin_s = loop.time()
            start = self._waiting.popleft()
            # The task that it makes takes its first step before this is called.
            start()
            loop.call_soon(self._pause, loop, begin_s)

    def _pause(self, loop: asyncio.AbstractEventLoop, begin_s: float) -> None:
        loop.call_later(min(loop.time() - begin_s, _LONGEST_PAUSE_S), self._next, loop)


class OneAtATime:
    """Does one piece of work at a time on another thread, first come first served, and then rests for as long again as
    that took: however many ask, it takes at most half of a processor, and others have the interpreter's lock between.
    """

    def __init__(self) -> None:
        self._lock = asyncio.Lock()

    async def run(self, work: Callable[[], T], *, is_wanted: Callable[[], bool]) -> T | None:
        """What `work` returns or raises; None, and nothing done, where it is no longer wanted when its turn comes."""
        loop = asyncio.get_running_loop()
        await self._lock.acquire()
        begin_s = loop.time()
        try:
            return await asyncio.to_thread(work) if is_wanted() else None
        finally:
            loop.call_later(min(loop.time() - begin_s, _LONGEST_PAUSE_S), self._lock.release)
