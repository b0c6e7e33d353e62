"""Strict checks of methods and query parameters for all routes, from the routes' declarations.

Every route with `GET` also has `HEAD`. `OPTIONS` and the refusal of an unknown method list the methods in `Allow`. A
parameter that the route does not have, or that is given twice although it is not repeatable, is refused and not
ignored.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from urllib.parse import parse_qsl

from starlette.responses import Response
from starlette.routing import BaseRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from server.api.declared_routes import DeclaredRoute, RouteTable
from server.api.problems import problem
from server.core.near_names import suggestion


class StrictRequests:
    """ASGI middleware over the application with these `routes`. Routes may be added until the first request.

    A plain GET of a WebSocket's address gets the answer of `closed`, if there is one: browsers do not tell a page why a
    WebSocket was refused, so it asks again in this way.
    """

    def __init__(
        self, app: ASGIApp, *, routes: Sequence[BaseRoute], closed: Callable[[Scope], Response | None] = lambda _: None
    ) -> None:
        self._app = app
        self._routes = RouteTable(routes)
        self._closed = closed

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        found = self._routes.find(scope)
        if not found:
            await self._app(scope, receive, send)
            return
        refusal = _refusal(scope, found, self._closed)
        if refusal is not None:
            await refusal(scope, receive, send)
        elif scope["method"] == "HEAD":
            await self._app({**scope, "method": "GET"}, receive, _without_body(send))
        else:
            await self._app(scope, receive, send)


def _refusal(
    scope: Scope, found: Sequence[DeclaredRoute], closed: Callable[[Scope], Response | None]
) -> Response | None:
    """The answer in place of the route's; None if the request is allowed."""
    methods = set().union(*(route.methods for route in found))
    if not methods:
        if (answer := closed(scope)) is not None:
            return answer
        refused = problem(426, "upgrade_required", "this is a WebSocket: connect with ws:// or wss://")
        refused.headers["Upgrade"] = "websocket"
        return refused
    methods |= {"OPTIONS"} | ({"HEAD"} if "GET" in methods else set())
    allow, method = {"Allow": ", ".join(sorted(methods))}, scope["method"]
    if method == "OPTIONS":
        return Response(status_code=204, headers=allow)
    if method not in methods:
        refused = problem(405, "method_not_allowed", f"{method} is none of {allow['Allow']}")
        refused.headers.update(allow)
        return refused
    known: dict[str, bool] = {}
    for route in found:
        known |= route.parameters
    return _refused_query(scope["query_string"].decode("latin-1"), known)


def _refused_query(query: str, known: dict[str, bool]) -> Response | None:
    given = Counter(name for name, _ in parse_qsl(query, keep_blank_values=True))
    for name, times in given.items():
        if name not in known:
            detail = f"there is no parameter {name[:80]!r}{suggestion(name, known)}"
            return problem(422, "unknown_parameter", detail, name[:80])
        if times > 1 and not known[name]:
            return problem(422, "doubled_parameter", f"{name} is given {times} times: give it once", name)
    return None


def _without_body(send: Send) -> Send:
    """A `send` that passes on the response's status and headers but not its body."""

    async def pass_on(message: Message) -> None:
        if message["type"] == "http.response.body":
            if message.get("more_body", False):
                return
            message = {"type": "http.response.body", "body": b"", "more_body": False}
        await send(message)

    return pass_on
