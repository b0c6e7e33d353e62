"""Files, on disk and in memory, of which clients may ask for a part (RFC 9110, 14)."""

import re
from collections.abc import Mapping
from http import HTTPStatus
from typing import Final

from starlette.datastructures import Headers
from starlette.responses import FileResponse, Response
from starlette.types import Receive, Scope, Send

from server.api.problems import problem

_ONE_RANGE: Final = re.compile(r"bytes=(?:(?P<first>[0-9]{1,18})-(?P<last>[0-9]{1,18})?|-(?P<suffix>[0-9]{1,18}))")


_PIECE_BYTES: Final = 64 * 1024


class RangedFile(FileResponse):
    """A file of which `stat_result` is known, or the one part of it that is asked for. A range that is malformed or of
    another unit is answered with the whole file, as are several, which the standard allows; one behind the end of the
    file with a problem document."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        asked = _asked(scope, self.headers.get("etag"))
        if asked is None:
            scope = {**scope, "headers": [each for each in scope["headers"] if each[0].lower() != b"range"]}
        elif _is_behind(asked, size := int(self.headers["content-length"])):
            await _refusal(size)(scope, receive, send)
            return
        await super().__call__(scope, receive, send)


class RangedBytes(Response):
    """Bytes in memory, or a part of them, as of a `RangedFile`. They are sent in pieces, so that no second copy of them
    all waits for a client that reads slowly."""

    def __init__(self, content: bytes, *, headers: Mapping[str, str], media_type: str) -> None:
        super().__init__(content, headers={**headers, "Accept-Ranges": "bytes"}, media_type=media_type)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        content, size = memoryview(self.body), len(self.body)
        asked = _asked(scope, self.headers.get("etag"))
        if asked is not None:
            if _is_behind(asked, size):
                await _refusal(size)(scope, receive, send)
                return
            part = _part(asked, size)
            content, self.status_code = content[part], HTTPStatus.PARTIAL_CONTENT
            self.headers["Content-Range"] = f"bytes {part.start}-{part.stop - 1}/{size}"
            self.headers["Content-Length"] = str(len(content))
        await send({"type": "http.response.start", "status": self.status_code, "headers": self.raw_headers})
        for start in range(0, len(content), _PIECE_BYTES):
            piece = bytes(content[start : start + _PIECE_BYTES])
            await send({"type": "http.response.body", "body": piece, "more_body": True})
        await send({"type": "http.response.body", "body": b"", "more_body": False})


def _asked(scope: Scope, etag: str | None) -> re.Match[str] | None:
    """The one part that is asked for of the present version; None for the whole."""
    headers = Headers(scope=scope)
    asked = _ONE_RANGE.fullmatch(headers.get("range", "").replace(" ", ""))
    is_current = headers.get("if-range", etag) == etag
    return None if asked is None or not is_current or _is_backwards(asked) else asked


def _part(asked: re.Match[str], size: int) -> slice:
    if asked["first"] is None:
        return slice(max(0, size - int(asked["suffix"])), size)
    return slice(int(asked["first"]), size if asked["last"] is None else min(size, int(asked["last"]) + 1))


def _refusal(size: int) -> Response:
    refused = problem(416, "range_not_satisfiable", f"Range: the file has {size} bytes", "Range")
    refused.headers["Content-Range"] = f"bytes */{size}"
    return refused


def _is_backwards(asked: re.Match[str]) -> bool:
    return asked["last"] is not None and int(asked["last"]) < int(asked["first"])


def _is_behind(asked: re.Match[str], size: int) -> bool:
    return int(asked["suffix"]) == 0 or size == 0 if asked["first"] is None else int(asked["first"]) >= size
