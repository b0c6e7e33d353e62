"""Orderly shutdown. The server accepts nothing new, tells its streams, finishes the requests in flight, and ends within
a stated time.

A `Drain` belongs to the event loop. Its times count from the beginning of the shutdown.
"""

import asyncio
import contextlib
import math
import time
from collections.abc import Callable, Iterator

_FOR_REQUESTS = 0.7
"""Share of the drain time after which open requests are answered with 503."""
_FOR_ANSWERS = 0.85
"""Share of the drain time after which the server stops waiting for clients to read those answers."""
_FOR_STREAMS = 0.5
"""Share of the drain time in which streams end one after the other, where others take them."""
_STREAMS_COME_BACK_S = 1
"""When streams that have ended at once may come back. Another server takes them by then, and this one has ended unless
a request is in flight. If it is not back yet, the attempt costs little, and clients make each later than the last."""


class Drain:
    """A shutdown that takes at most `drain_s` seconds. Streams end at once, or `in_turn`, if other servers take them
    meanwhile: all at once would be more than these can let in."""

    def __init__(self, drain_s: float, *, in_turn: bool = False, time_s: Callable[[], float] = time.monotonic) -> None:
        self.drain_s = drain_s
        self._spread_s = _FOR_STREAMS * drain_s if in_turn else 0.0
        self._streams: dict[object, float] = {}
        """Seconds from the beginning to the turn of each stream."""
        self._time_s = time_s
        self._began_s: float | None = None
        self._has_begun = asyncio.Event()
        self._is_out_of_time = asyncio.Event()
        self._in_flight = 0
        self._is_idle = asyncio.Event()
        self._is_idle.set()

    @property
    def has_begun(self) -> bool:
        return self._has_begun.is_set()

    @property
    def retry_after_s(self) -> int:
        """Whole seconds, at least 1, until this server has ended and another can take its place."""
        passed_s = 0.0 if self._began_s is None else self._time_s() - self._began_s
        return max(1, math.ceil(self.drain_s - passed_s))

    @property
    def streams_retry_after_s(self) -> int | None:
        """Whole seconds until a stream that was told may come back; None if others take it at once."""
        return None if self._spread_s else _STREAMS_COME_BACK_S

    def begin(self) -> None:
        """Accept nothing new from now on. A second call changes nothing."""
        if self._began_s is None:
            self._began_s = self._time_s()
            step_s = self._spread_s / max(1, len(self._streams))
            self._streams = {stream: number * step_s for number, stream in enumerate(self._streams)}
            self._has_begun.set()

    async def turn(self) -> None:
        """Return when the stream that awaits this has to end."""
        stream = object()
        self._streams[stream] = 0.0
        try:
            await self._has_begun.wait()
            await asyncio.sleep(self._streams[stream])
        finally:
            del self._streams[stream]

    async def out_of_time(self) -> None:
        """Return once the time for open requests is over."""
        await self._is_out_of_time.wait()

    @contextlib.contextmanager
    def in_flight(self) -> Iterator[None]:
        """Context of a request or stream that the shutdown waits for."""
        self._in_flight += 1
        self._is_idle.clear()
        try:
            yield
        finally:
            self._in_flight -= 1
            if not self._in_flight:
                self._is_idle.set()

    async def settle(self) -> None:
        """Begin the shutdown. Return when nothing is in flight any more or the time is over."""
        self.begin()
        await self._wait_until_idle(_FOR_REQUESTS)
        self._is_out_of_time.set()
        await self._wait_until_idle(_FOR_ANSWERS)

    async def _wait_until_idle(self, share: float) -> None:
        assert self._began_s is not None
        left_s = self._began_s + share * self.drain_s - self._time_s()
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._is_idle.wait(), max(0.0, left_s))
