"""Answers to HTTP requests: computed by few threads, and kept by entity tag, for what one asks for others will."""

from collections import OrderedDict
from collections.abc import Callable

import anyio
import anyio.to_thread

from server.errors import RequestError


class Answers:
    """At most `workers` answers are computed at once, off the event loop, and at most `waiting` more wait for that."""

    def __init__(self, *, workers: int, waiting: int) -> None:
        self._limiter = anyio.CapacityLimiter(workers)
        self._room = workers + waiting
        self._cache = AnswerCache()

    async def get(self, etag: str, compute: Callable[[], bytes]) -> bytes:
        """The body kept or computed. Raises RequestError server_busy where too many wait, and what `compute` raises."""
        if (body := self._cache.get(etag)) is not None:
            return body
        if not self._room:
            raise RequestError("server_busy", "too many requests wait for an answer", status=503)
        self._room -= 1
        try:
            body = await anyio.to_thread.run_sync(compute, limiter=self._limiter)
        finally:
            self._room += 1
        self._cache.put(etag, body)
        return body


class AnswerCache:
    """The most recently used bodies, `max_bytes` of them in all; the tag says all there is to say of a body."""

    def __init__(self, max_bytes: int = 32 * 1024 * 1024) -> None:
        self._max_bytes = max_bytes
        self._bytes = 0
        self._bodies: OrderedDict[str, bytes] = OrderedDict()

    def get(self, etag: str) -> bytes | None:
        if etag in self._bodies:
            self._bodies.move_to_end(etag)
        return self._bodies.get(etag)

    def put(self, etag: str, body: bytes) -> None:
        """Keep a body, and let go of those unused for longest until all fit."""
        self._bytes += len(body) - len(self._bodies.pop(etag, b""))
        self._bodies[etag] = body
        while self._bytes > self._max_bytes:
            _, oldest = self._bodies.popitem(last=False)
            self._bytes -= len(oldest)
