"""Errors of the HTTP interface: problem documents (RFC 9457) with the `code` and `field` of the WebSocket's errors."""

from dataclasses import dataclass
from http import HTTPStatus

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException
from starlette.types import Receive, Scope, Send

from server.api.request_log import REQUEST_ID
from server.core.errors import RequestError
from server.protocol.codes import POLICY_VIOLATION

_POSE_PARAMETERS = frozenset({"listener", "emitter", "yaw_deg", "pitch_deg", "roll_deg", "orientation", "height_m"})
_STATUSES = {"position_out_of_bounds": 404, "unknown_level": 404, "map_too_fine": 409, "map_too_slow": 409}
"""Statuses of well-formed requests that ask for something that does not exist, or for too much. Malformed ones get
422."""
_CODES = {404: "not_found", 405: "method_not_allowed"}


@dataclass(frozen=True)
class Refusal:
    """An answer to a request that never reaches the application: the HTTP `status`, a `code` for programs and a
    `detail` for people."""

    status: int
    code: str
    detail: str
    headers: tuple[tuple[str, str], ...] = ()


async def refuse(refusal: Refusal, scope: Scope, receive: Receive, send: Send) -> None:
    """Answer a request or a WebSocket handshake by a refusal."""
    if scope["type"] == "websocket" and "websocket.http.response" not in scope.get("extensions", {}):
        # A close before acceptance answers the upgrade with 403 and no body.
        await send({"type": "websocket.close", "code": POLICY_VIOLATION, "reason": refusal.code})
        return
    response = problem(refusal.status, refusal.code, refusal.detail)
    for name, value in refusal.headers:  # a name may come twice
        response.headers.append(name, value)
    await response(scope, receive, send)


def problem(
    status: int, code: str, detail: str, field: str | None = None, *, retry_after_s: int | None = None
) -> JSONResponse:
    """A problem document. `code` is for programs and does not change, `detail` is for people, and `field` is the
    parameter at fault. `retry_after_s` says after how long a retry is worthwhile, if it is."""
    return JSONResponse(
        {
            "type": "about:blank",
            "title": HTTPStatus(status).phrase,
            "status": status,
            "detail": detail,
            "code": code,
            "field": field,
        },
        status_code=status,
        media_type="application/problem+json",
        headers=None if retry_after_s is None else {"Retry-After": str(retry_after_s)},
    )


def install_problems(app: FastAPI) -> None:
    """Answer every error with a problem document."""

    async def refused(_: Request, exc: Exception) -> JSONResponse:
        assert isinstance(exc, RequestError)
        status = _STATUSES.get(exc.code, exc.status)
        return problem(status, exc.code, str(exc), exc.field, retry_after_s=exc.retry_after_s)

    async def invalid(_: Request, exc: Exception) -> JSONResponse:
        assert isinstance(exc, RequestValidationError)
        first = exc.errors()[0]
        field = str(first["loc"][-1])
        code = "malformed_pose" if field in _POSE_PARAMETERS else "malformed_request"
        return problem(422, code, f"{field}: {first['msg'].removeprefix('Value error, ')}", field)

    async def http(_: Request, exc: Exception) -> JSONResponse:
        assert isinstance(exc, HTTPException)
        response = problem(exc.status_code, _CODES.get(exc.status_code, "http_error"), str(exc.detail))
        response.headers.update(exc.headers or {})
        return response

    async def crashed(request: Request, _: Exception) -> JSONResponse:
        response = problem(500, "internal_error", "the server failed to answer; its log says why")
        if (identifier := request.scope.get(REQUEST_ID)) is not None:
            response.headers[REQUEST_ID] = identifier
        return response

    app.add_exception_handler(RequestError, refused)
    app.add_exception_handler(RequestValidationError, invalid)
    app.add_exception_handler(HTTPException, http)
    app.add_exception_handler(Exception, crashed)
