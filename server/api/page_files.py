"""The page's static files, with entity tags by content and correct `Allow` headers. NAME is also found as NAME.html,
and as NAME.gz, which is stored compressed."""

import gzip
import hashlib
import mimetypes
import os
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import anyio.to_thread
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.staticfiles import NotModifiedResponse, StaticFiles
from starlette.types import Scope

from server.api.compression import accepts_gzip
from server.api.ranged_files import RangedFile

_ALLOW = {"Allow": "GET, HEAD, OPTIONS"}
_COMPRESSED = ".gz"


class PageFiles(StaticFiles):
    """Static files with entity tags by content. Starlette's tags depend on size and modification time, which two builds
    of one image may share although the bytes differ. Starlette also sends no `Allow`, and knows no compressed files.
    `framed_by` are the only other origins whose pages may show the files in a frame; with None any may."""

    def __init__(self, *, framed_by: Sequence[str] | None = None, **options: Any) -> None:
        super().__init__(**options)
        self._policy = None if framed_by is None else " ".join(("frame-ancestors 'self'", *framed_by))

    def lookup_path(self, path: str) -> tuple[str, os.stat_result | None]:
        for suffix in ("", ".html", _COMPRESSED):
            found = super().lookup_path(path + suffix)
            if found[1] is not None:
                break
        return found

    async def get_response(self, path: str, scope: Scope) -> Response:
        if scope["method"] in {"GET", "HEAD"}:
            return await super().get_response(path, scope)
        _, found = await anyio.to_thread.run_sync(self.lookup_path, path)
        if found is None:
            raise HTTPException(status_code=404)
        if scope["method"] == "OPTIONS":
            return Response(status_code=204, headers=_ALLOW)
        raise HTTPException(status_code=405, headers=_ALLOW)

    def file_response(
        self, full_path: Any, stat_result: os.stat_result, scope: Scope, status_code: int = 200
    ) -> Response:
        tag = _tag(Path(full_path), stat_result.st_mtime_ns, stat_result.st_size)
        if not full_path.endswith(_COMPRESSED):
            response: Response = RangedFile(full_path, status_code, stat_result=stat_result)
        elif accepts_gzip(Headers(scope=scope)):
            response = RangedFile(full_path, status_code, stat_result=stat_result)
            response.headers["Content-Encoding"] = "gzip"
            response.headers["Vary"] = "Accept-Encoding"
        else:
            media_type = mimetypes.guess_type(full_path)[0]
            response = Response(gzip.decompress(Path(full_path).read_bytes()), status_code, media_type=media_type)
            response.headers["Vary"] = "Accept-Encoding"
            tag = f'{tag[:-1]}-whole"'
        response.headers["ETag"] = tag
        if self._policy is not None:
            response.headers["Content-Security-Policy"] = self._policy
        had = Headers(scope=scope).get("if-none-match", "")
        if response.headers["ETag"] in {tag.strip().removeprefix("W/") for tag in had.split(",")}:
            return NotModifiedResponse(response.headers)
        return response


@lru_cache(maxsize=1024)
def _tag(path: Path, mtime_ns: int, size: int) -> str:  # noqa: ARG001  a changed file is another key of the cache
    return f'"{hashlib.sha256(path.read_bytes()).hexdigest()[:32]}"'
