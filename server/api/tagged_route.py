"""Routes whose JSON answers have entity tags by content, so that a client that asks again and again is told in a few
bytes that nothing has changed."""

from collections.abc import Callable, Coroutine
from typing import Any

from fastapi.routing import APIRoute
from starlette.requests import Request
from starlette.responses import Response

from server.core.entity_tags import content_tag

CACHE_CONTROL_OF_LISTS = "no-cache"
"""What a list has may change at any time, so its tag is compared at each use."""


class TaggedRoute(APIRoute):
    """A route that tags the answers to GET that are JSON and have no tag yet."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        answer = super().get_route_handler()

        async def tagged(request: Request) -> Response:
            response = await answer(request)
            return _tagged(request, response) if request.method == "GET" else response

        return tagged


def has_tag(if_none_match: str, etag: str) -> bool:
    """Whether If-None-Match names the tag, by the weak comparison of RFC 9110."""
    tags = {tag.strip().removeprefix("W/") for tag in if_none_match.split(",")}
    return etag in tags or "*" in tags


def _tagged(request: Request, response: Response) -> Response:
    kind = response.headers.get("content-type", "").partition(";")[0]
    if response.status_code != 200 or "etag" in response.headers or not kind.endswith("json"):
        return response
    response.headers["ETag"] = etag = content_tag(bytes(response.body))
    response.headers.setdefault("Cache-Control", CACHE_CONTROL_OF_LISTS)
    if not has_tag(request.headers.get("if-none-match", ""), etag):
        return response
    kept = {name: response.headers[name] for name in ("ETag", "Cache-Control")}
    return Response(status_code=304, headers=kept)
