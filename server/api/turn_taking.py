"""Requests and streams start one after the other, so that they leave time for other work."""

import asyncio
from collections import deque
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")
_LONGEST_PAUSE_S = 0.02


class TurnTaking:
    """Starts one piece of work at a time on an event loop, first come first served.

    After each start the loop runs everything else that is ready, and then other work for as long again. So work started
    here takes at most half of the loop's time, and streams have the other half.
    """

    def __init__(self) -> None:
        self._waiting: deque[Callable[[], None]] = deque()
        self._is_taken = False

    def __len__(self) -> int:
        """Number of pieces of work that wait."""
        return len(self._waiting)

    def begin(self, loop: asyncio.AbstractEventLoop, start: Callable[[], None]) -> None:
        """Call `start` now or when its turn comes. `start` has to return soon, so it leaves long work to a task."""
        self._waiting.append(start)
        if not self._is_taken:
            self._next(loop)

    def _next(self, loop: asyncio.AbstractEventLoop) -> None:
        self._is_taken = bool(self._waiting)
        if self._waiting:
            begin_s = loop.time()
            start = self._waiting.popleft()
            # A task created by `start` takes its first step before this is called.
            start()
            loop.call_soon(self._pause, loop, begin_s)

    def _pause(self, loop: asyncio.AbstractEventLoop, begin_s: float) -> None:
        loop.call_later(min(loop.time() - begin_s, _LONGEST_PAUSE_S), self._next, loop)


class OneAtATime:
    """Does one piece of work at a time on another thread, first come first served, and then rests for as long again. So
    it takes at most half of a core, and other threads can take the interpreter's lock in between.
    """

    def __init__(self) -> None:
        self._lock = asyncio.Lock()

    async def run(self, work: Callable[[], T], *, is_wanted: Callable[[], bool]) -> T | None:
        """Return or raise what `work` returns or raises. Returns None without calling it if it is not wanted any more
        when its turn comes."""
        loop = asyncio.get_running_loop()
        await self._lock.acquire()
        begin_s = loop.time()
        try:
            return await asyncio.to_thread(work) if is_wanted() else None
        finally:
            loop.call_later(min(loop.time() - begin_s, _LONGEST_PAUSE_S), self._lock.release)
