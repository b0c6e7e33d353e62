"""Compression of answers (gzip) where it helps: JSON and the page's text. Sound, pictures and archives are not
compressed again, nor is a part of a file.

Compressed bytes are another representation (RFC 9110, 8.8.3), so their entity tag is weak: it stands for the same
content and not for the same bytes. `If-None-Match` compares weakly, so a client's tag is found again. No answer holds a
secret that a page of another site could guess from its length (BREACH): the server knows no cookies.
"""

import asyncio
import zlib
from concurrent.futures import Executor, ThreadPoolExecutor
from functools import partial
from typing import Final

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from server.runtime.priority import become_background

_LEAST_BYTES: Final = 1024
_INLINE_BYTES: Final = 16 * 1024
"""Shorter pieces are compressed on the event loop, in a fraction of a millisecond."""
_LEVEL: Final = 5
_NICENESS: Final = 10
"""As that of threads that compute answers."""
_TYPES: Final = frozenset(
    {
        "application/javascript",
        "application/json",
        "application/problem+json",
        "application/schema+json",
        "image/svg+xml",
        "text/css",
        "text/html",
        "text/javascript",
        "text/plain",
    }
)


def accepts_gzip(headers: Headers) -> bool:
    """Whether a request's `Accept-Encoding` names gzip, or anything, with a weight above zero."""
    weights = {}
    for each in headers.get("accept-encoding", "").lower().split(","):
        name, *parameters = (part.strip() for part in each.split(";"))
        weights[name] = next((_weight(part[2:]) for part in parameters if part.startswith("q=")), 1.0)
    return weights.get("gzip", weights.get("*", 0.0)) > 0


def _weight(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return 0.0


class Compression:
    """ASGI middleware. One thread of low priority compresses what would keep the event loop from its streams."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._executor = ThreadPoolExecutor(1, "nafir-gzip", initializer=partial(become_background, _NICENESS))

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and scope["method"] in {"GET", "HEAD", "POST"}:
            send = _Compressed(scope, send, self._executor)
        await self._app(scope, receive, send)


class _Compressed:
    """The `send` of one request."""

    def __init__(self, scope: Scope, send: Send, executor: Executor) -> None:
        self._headers = Headers(scope=scope)
        self._is_head = scope["method"] == "HEAD"
        self._send = send
        self._executor = executor
        self._start: Message | None = None
        self._compressor: zlib._Compress | None = None

    async def __call__(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            self._start = self._judged(message)
            if self._start is None:
                await self._send(message)
        elif self._start is not None:
            start, self._start = self._start, None
            await self._begin(start, message)
        else:
            await self._send(message if self._compressor is None else await self._compressed(message))

    def _judged(self, start: Message) -> Message | None:
        """The start of an answer that may be compressed, to be sent with its body's first part; None otherwise."""
        headers = MutableHeaders(raw=start["headers"])
        tag = headers.get("etag", "")
        if start["status"] == 304 and f"W/{tag}" in self._headers.get("if-none-match", ""):
            headers["ETag"] = f"W/{tag}"
        kind = headers.get("content-type", "").partition(";")[0].strip().lower()
        if start["status"] in {204, 206, 304} or "content-encoding" in headers or kind not in _TYPES:
            return None
        return start

    async def _begin(self, start: Message, body: Message) -> None:
        headers = MutableHeaders(raw=start["headers"])
        length = int(headers.get("content-length", -1))
        if length < 0 and not body.get("more_body", False):
            length = len(body.get("body", b""))
        if 0 <= length < _LEAST_BYTES:
            await self._send(start)
            await self._send(body)
            return
        headers.add_vary_header("Accept-Encoding")
        if not accepts_gzip(self._headers):
            await self._send(start)
            await self._send(body)
            return
        headers["Content-Encoding"] = "gzip"
        del headers["Content-Length"], headers["Accept-Ranges"]
        if headers.get("etag", "").startswith('"'):
            headers["ETag"] = f"W/{headers['etag']}"
        if not self._is_head:
            self._compressor = zlib.compressobj(_LEVEL, zlib.DEFLATED, 16 + zlib.MAX_WBITS)
            body = await self._compressed(body)
            if not body["more_body"]:
                headers["Content-Length"] = str(len(body["body"]))
        await self._send(start)
        await self._send(body)

    async def _compressed(self, message: Message) -> Message:
        data, is_last = message.get("body", b""), not message.get("more_body", False)
        if len(data) < _INLINE_BYTES:
            body = self._compress(data, is_last)
        else:
            loop = asyncio.get_running_loop()
            body = await loop.run_in_executor(self._executor, self._compress, data, is_last)
        return {"type": "http.response.body", "body": body, "more_body": not is_last}

    def _compress(self, data: bytes, is_last: bool) -> bytes:
        assert self._compressor is not None
        return self._compressor.compress(data) + self._compressor.flush(zlib.Z_FINISH if is_last else zlib.Z_SYNC_FLUSH)
