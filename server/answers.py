"""Answers to HTTP requests: computed by few threads, and kept by entity tag, which says all there is to say of a body:
what one asks for others will."""

from collections.abc import Callable

import anyio
import anyio.to_thread

from server.bounded_cache import BoundedCache
from server.errors import RequestError

_MAX_BYTES = 32 * 1024 * 1024


class Answers:
    """At most `workers` answers are computed at once, off the event loop, and at most `waiting` more wait for that."""

    def __init__(self, *, workers: int, waiting: int) -> None:
        self._limiter = anyio.CapacityLimiter(workers)
        self._room = workers + waiting
        self._cache: BoundedCache[str, bytes] = BoundedCache(_MAX_BYTES)

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
        self._cache.put(etag, body, len(body))
        return body
