"""Files of which clients may ask for a part (RFC 9110, 14)."""

import re
from typing import Final

from starlette.datastructures import Headers
from starlette.responses import FileResponse
from starlette.types import Receive, Scope, Send

from server.api.problems import problem

_ONE_RANGE: Final = re.compile(r"bytes=(?:(?P<first>[0-9]{1,18})-(?P<last>[0-9]{1,18})?|-(?P<suffix>[0-9]{1,18}))")


class RangedFile(FileResponse):
    """A file of which `stat_result` is known, or the one part of it that is asked for. A range that is malformed or of
    another unit is answered with the whole file, as are several, which the standard allows; one behind the end of the
    file with a problem document."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers = Headers(scope=scope)
        asked = _ONE_RANGE.fullmatch(headers.get("range", "").replace(" ", ""))
        is_current = headers.get("if-range", self.headers.get("etag")) == self.headers.get("etag")
        if asked is None or not is_current or _is_backwards(asked):
            scope = {**scope, "headers": [each for each in scope["headers"] if each[0].lower() != b"range"]}
        elif _is_behind(asked, size := int(self.headers["content-length"])):
            refused = problem(416, "range_not_satisfiable", f"Range: the file has {size} bytes", "Range")
            refused.headers["Content-Range"] = f"bytes */{size}"
            await refused(scope, receive, send)
            return
        await super().__call__(scope, receive, send)


def _is_backwards(asked: re.Match[str]) -> bool:
    return asked["last"] is not None and int(asked["last"]) < int(asked["first"])


def _is_behind(asked: re.Match[str], size: int) -> bool:
    return int(asked["suffix"]) == 0 or size == 0 if asked["first"] is None else int(asked["first"]) >= size
