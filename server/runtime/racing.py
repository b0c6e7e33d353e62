"""Work on the event loop that ends early when something else happens first."""

import asyncio
from collections.abc import Coroutine
from typing import Any, TypeVar

T = TypeVar("T")


class StoppedError(Exception):
    """The work was cancelled, because what it was raced against ended first."""


async def run_until(work: Coroutine[Any, Any, T], stop: Coroutine[Any, Any, object]) -> T:
    """The result of `work`, or what it raises. Raises StoppedError where `stop` ends first: `work` is then cancelled,
    and has cleaned up after itself. Neither goes on after this returns."""
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
                task.exception()  # looked at, or asyncio logs that nobody did
        # What is raised holds this frame, and with the tasks in it all would wait for the collector.
        del task, working, stopping
