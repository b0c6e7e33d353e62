"""Work on the event loop that is cancelled if another event comes first."""

import asyncio
from collections.abc import Coroutine
from typing import Any, TypeVar

T = TypeVar("T")


class StoppedError(Exception):
    """The work was cancelled because `stop` ended first."""


async def run_until(work: Coroutine[Any, Any, T], stop: Coroutine[Any, Any, object]) -> T:
    """Return or raise what `work` returns or raises. If `stop` ends first, `work` is cancelled, and StoppedError is
    raised once it has cleaned up. Neither goes on after this returns."""
    working, stopping = asyncio.ensure_future(work), asyncio.ensure_future(stop)
    try:
        await asyncio.wait({working, stopping}, return_when=asyncio.FIRST_COMPLETED)
        if not working.done():
            raise StoppedError
        return working.result()
    finally:
        for task in (working, stopping):
            task.cancel()
        await asyncio.wait({working, stopping})
        for task in (working, stopping):
            if not task.cancelled():
                task.exception()  # retrieved, or asyncio logs that it never was
        # The exception refers to this frame. With the tasks in it there would be a cycle for the garbage collector.
        del task, working, stopping
