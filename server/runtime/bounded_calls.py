"""Calls that may never return, such as those of a network: so many at once, and none is waited for beyond its time."""

import asyncio
from collections.abc import Callable
from typing import TypeVar

from server.runtime.own_thread import run_in_own_thread

T = TypeVar("T")


class BoundedCalls:
    """Runs at most `most` calls at once, each on a thread of its own called `name`. It belongs to one event loop."""

    def __init__(self, most: int, name: str) -> None:
        self._free = asyncio.Semaphore(most)
        self._name = name
        self._running: set[asyncio.Task[object]] = set()

    async def run(self, work: Callable[[], T], timeout_s: float) -> T:
        """Return or raise what `work` returns or raises. Raises TimeoutError if it takes longer, together with the
        wait for a thread. A call that is given up keeps its thread until it returns."""
        async with asyncio.timeout(timeout_s):
            await self._free.acquire()
            task = asyncio.create_task(run_in_own_thread(work, self._name))
            self._running.add(task)
            task.add_done_callback(self._let_go)
            return await asyncio.shield(task)

    def _let_go(self, task: asyncio.Task[object]) -> None:
        self._running.discard(task)
        self._free.release()
        if not task.cancelled():
            task.exception()  # of a call that nothing waits for any more, it is not reported
