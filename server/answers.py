"""Answers to HTTP requests kept by entity tag, so that what everyone asks for is computed once."""

from collections import OrderedDict


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
