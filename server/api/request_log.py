"""A line in the log for each request and each refused handshake, an id by which it is found again, counts of those
that were refused, and how long answers took.

The id is that of the request's `X-Request-ID` if it is a plain word, and random otherwise. The answer has it, and so
has every line that is written on the way, that of a stream included.
"""

import json
import logging
import re
import time
import uuid
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Final

from starlette.datastructures import Headers, MutableHeaders
from starlette.routing import BaseRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from server.api.declared_routes import RouteTable
from server.api.http_durations import HttpDurations
from server.api.problem_codes import PROBLEM_CODES
from server.runtime.logs import begin_about
from server.runtime.traces import span

REQUEST_ID: Final = "X-Request-ID"
_PLAIN: Final = re.compile(r"[A-Za-z0-9._-]{1,64}")
_QUIET: Final = frozenset({"/livez", "/readyz", "/metrics", "/metrics/process", "/streams/process"})
"""Paths that are asked for every few seconds, or by another process: only what goes wrong with them is written."""
_LONGEST_PATH: Final = 256
"""Characters of a path that are written."""
_CLIENT_CLOSED_REQUEST = 499
_REFUSED: Final = ("401", "403", "429")
"""Statuses of refusals that are counted: those that depend on who asks, and not on what is asked."""
_OTHER: Final = "other"

_logger = logging.getLogger(__name__)


def request_id(headers: Headers) -> str:
    """The id of a request, as its client gave it or a new one."""
    given = headers.getlist(REQUEST_ID)
    return given[0] if len(given) == 1 and _PLAIN.fullmatch(given[0]) else uuid.uuid4().hex


class RefusedRequests:
    """How many requests and handshakes were refused because of who asked, by status and code. There is a count for each
    code of such a status from the start, and one for all others, so clients cannot make new ones."""

    def __init__(self) -> None:
        self.counts: Counter[tuple[str, str]] = Counter()
        for status in _REFUSED:
            codes = (code for code, meaning in PROBLEM_CODES.items() if meaning.startswith(status))
            self.counts.update(dict.fromkeys(((status, code) for code in (*codes, _OTHER)), 0))

    def note(self, status: int, code: str | None) -> None:
        """Count an answer, if it is such a refusal."""
        if str(status) in _REFUSED:
            told = (str(status), code or _OTHER)
            self.counts[told if told in self.counts else (str(status), _OTHER)] += 1


class RequestLog:
    """ASGI middleware, the outermost, over the application with these `routes`, which may be added until the first
    request."""

    def __init__(
        self,
        app: ASGIApp,
        *,
        routes: Sequence[BaseRoute],
        refused: RefusedRequests,
        durations: HttpDurations,
        time_s: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._app = app
        self._routes = RouteTable(routes)
        self._refused = refused
        self._durations = durations
        self._time_s = time_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in {"http", "websocket"}:
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        identifier = request_id(headers)
        begin_about(request_id=identifier)
        scope[REQUEST_ID] = identifier  # for the answer to a request that fails, which is given outside of this
        status, code, is_problem, started_s = None, None, False, self._time_s()

        async def send_noted(message: Message) -> None:
            nonlocal status, code, is_problem
            match message["type"]:
                case "http.response.start" | "websocket.http.response.start":
                    answered = MutableHeaders(scope=message)
                    answered[REQUEST_ID] = identifier
                    status, is_problem = message["status"], "problem+json" in answered.get("content-type", "")
                case "http.response.body" | "websocket.http.response.body" if is_problem:
                    is_problem, code = False, _code_of(message.get("body", b""))
                case "websocket.accept":
                    given = (REQUEST_ID.lower().encode(), identifier.encode())
                    message = {**message, "headers": [*message.get("headers", ()), given]}
                    status = 101
                case "websocket.close" if status is None:
                    status, code = 403, message.get("reason")
            await send(message)

        method = scope.get("method", "WEBSOCKET")
        route = self._routes.template(scope)
        noted = {"http.request.method": method, "nafir.request_id": identifier}
        try:
            with span(method, noted, headers=headers) as traced:
                try:
                    await self._app(scope, receive, send_noted)
                finally:
                    if route is not None:
                        traced.update_name(f"{method} {route}")
                        traced.set_attribute("http.route", route)
                    if status is not None:
                        traced.set_attribute("http.response.status_code", status)
        except Exception:
            status, code = status or 500, code or "internal_error"
            raise
        finally:
            duration_s = self._time_s() - started_s
            if status is not None:
                self._refused.note(status, code)
            if status != 101:  # the handshake of a stream ends when the stream does
                self._durations.note(
                    scope.get("method", "GET"), route, _CLIENT_CLOSED_REQUEST if status is None else status, duration_s
                )
            if status != 101 and not (scope["path"] in _QUIET and status in {200, 204}):
                _logger.info(
                    "request",
                    extra={
                        "method": method,
                        "path": _shown(scope["path"]),  # without the query, in which people put keys
                        "status": _CLIENT_CLOSED_REQUEST if status is None else status,
                        **({} if code is None else {"code": code}),
                        "duration_ms": round(1000 * duration_s, 1),
                        "client": scope["client"][0] if scope.get("client") else None,
                    },
                )


def _shown(path: str) -> str:
    return path if len(path) <= _LONGEST_PATH else f"{path[:_LONGEST_PATH]}…"


def _code_of(document: bytes) -> str | None:
    """The code of a problem document; None if it has none, as the answer to a HEAD."""
    try:
        told = json.loads(document).get("code")
    except (ValueError, AttributeError):
        return None
    return told if isinstance(told, str) else None
