"""The gate that asks every request and every WebSocket handshake for a key.

An outsider gets nothing but `/livez`. Any key opens `/readyz` and the files of the page, those of /docs and /redoc
among them; programs on this machine need none for `/readyz`. A path that is not listed here needs the scope `admin`,
so that a new route is closed until somebody decides who may use it. One path is for the server's own processes alone.

A key comes in `Authorization: Bearer KEY`. A browser's `WebSocket` cannot set headers, so there it may come among the
subprotocols, as `nafir.key.` and the key in base64url. It is never taken from the query, which servers and proxies log.

A browser sets no header for a page either. If it is told to (`Basic`, RFC 7617), it asks its user for a name and a
password, and from then on sends both by itself: the password is the key, the name is ignored. Only files of the page
tell it to, so that no request of a script opens that dialog.
"""

import base64
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from server.api import api_keys
from server.api.access import OWN_SCOPE, Access, AccessError, Caller, OwnScope
from server.api.api_keys import SCOPES
from server.api.client_address import is_of_this_machine
from server.api.connection_limits import LIVENESS_PATH, READINESS_PATH
from server.api.problems import Refusal, refuse
from server.runtime.logs import about

KEY_PROTOCOL: Final = "nafir.key."
"""Begins the subprotocol that carries a key."""
_BEARER: Final = 'Bearer realm="nafir"'
_BASIC: Final = 'Basic realm="nafir", charset="UTF-8"'
_READ: Final = frozenset({"GET", "HEAD", "OPTIONS"})


@dataclass(frozen=True)
class Rule:
    """Paths that match `path`, with one of the `methods` if there are any, need one of the `scopes`."""

    path: re.Pattern[str]
    scopes: frozenset[api_keys.Scope | OwnScope]
    methods: frozenset[str] | None = None


def _rule(path: str, *scopes: api_keys.Scope | OwnScope, methods: frozenset[str] | None = None) -> Rule:
    return Rule(re.compile(path), frozenset(scopes), methods)


RULES: Final = (
    _rule(re.escape(READINESS_PATH), *SCOPES, methods=_READ),
    _rule(r"/v1/scenes(/[^/]+(/frontier)?)?", "listen", "render", methods=_READ),
    _rule(r"/v1/scenes/[^/]+/[^/]+", "render"),
    _rule(r"/v1/scenes/[^/]+/bundle/[^/]+", "render", methods=_READ),
    _rule(r"/v1/clips(/.*)?", "listen", "upload", methods=_READ),
    _rule(r"/v1/clips(/.*)?", "upload"),
    _rule(r"/v1/(encodings|hrtfs)(/.*)?", "listen", "render", methods=_READ),
    _rule(r"/v1/stream(/.*)?", "listen"),
    _rule(r"/(openapi|asyncapi)\.json|/v1/schemas(/.*)?", "listen", "render", "upload", "admin", methods=_READ),
    _rule(r"/metrics(/process)?", "metrics", "admin", methods=_READ),
    _rule(r"/streams/process", OWN_SCOPE),
)
"""The first rule that matches decides; where none does, the scope is `admin`."""


def scopes_for(method: str, path: str) -> frozenset[api_keys.Scope | OwnScope]:
    """The scopes of which a request needs one. A WebSocket handshake is a GET."""
    for rule in RULES:
        if rule.path.fullmatch(path) and (rule.methods is None or method in rule.methods):
            return rule.scopes
    return frozenset({"admin"})


def page_paths(folder: Path) -> frozenset[str]:
    """Paths of the files of a page: compressed ones by their own names, pages also without `.html`, and `/`."""
    files = [file.relative_to(folder).as_posix() for file in folder.rglob("*") if file.is_file()]
    pages = (name.removesuffix(".html") for name in files if name.endswith(".html"))
    return frozenset({"/", *(f"/{name.removesuffix('.gz')}" for name in files), *(f"/{name}" for name in pages)})


def caller_of(scope: Scope) -> Caller | None:
    """Who sends a request that passed the gate; None on an open path without a key, and where there is no gate."""
    caller: Caller | None = scope.get("nafir.caller")
    return caller


class AccessGate:
    """ASGI middleware that lets through who has a key with the scope for it. `page` are the paths that any key opens,
    and for which a browser asks its user."""

    def __init__(self, app: ASGIApp, *, access: Access, page: frozenset[str]) -> None:
        self._app = app
        self._access = access
        self._page = page

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in {"http", "websocket"}:
            await self._app(scope, receive, send)
            return
        path = scope["path"].removeprefix(scope.get("root_path", ""))
        admitted = self._admitted(path, scope)
        if isinstance(admitted, Refusal):
            await refuse(admitted, scope, receive, send)
            return
        if admitted is not None:
            about(caller=admitted.name)
        await self._app({**_without_keys(scope), "nafir.caller": admitted}, receive, _privately(send))

    def _admitted(self, path: str, scope: Scope) -> Caller | Refusal | None:
        """Who asks, or the refusal; None for whoever needs no key."""
        health = path if scope["type"] == "http" else None
        if health == LIVENESS_PATH:
            return None
        admitted = self._admit(path, scope)
        if isinstance(admitted, Refusal) and health == READINESS_PATH and is_of_this_machine(scope):
            return None
        return admitted

    def _admit(self, path: str, scope: Scope) -> Caller | Refusal:
        is_page = scope["type"] == "http" and path in self._page
        given = list(_credentials(scope))
        if len(given) > 1:
            return Refusal(400, "doubled_header", f"{len(given)} keys are given: give one, once")
        if not given:
            how = "give it as the password, with any name" if is_page else "send it as Authorization: Bearer KEY"
            return Refusal(401, "key_required", f"this needs a key: {how}", _challenges(is_page=is_page))
        try:
            caller = self._access.admit(given[0])
        except AccessError as exc:
            return Refusal(401, exc.code, str(exc), _challenges('error="invalid_token"', is_page=is_page))
        needed = frozenset(SCOPES) if is_page else scopes_for(scope.get("method", "GET"), path)
        if caller.scopes & needed:
            return caller
        if OWN_SCOPE in needed:
            own = "this is for the server's own processes alone"
            return Refusal(403, "scope_missing", own, _challenges('error="insufficient_scope"'))
        wanted = " or ".join(scope for scope in SCOPES if scope in needed)
        scope_said = f'scope="{next(each for each in SCOPES if each in needed)}"'
        challenges = _challenges('error="insufficient_scope"', scope_said)
        return Refusal(403, "scope_missing", f"this needs a key with the scope {wanted}", challenges)


def _challenges(*of_bearer: str, is_page: bool = False) -> tuple[tuple[str, str], ...]:
    """The headers that say how to send a key. Each scheme has its own: some clients read only one from a header."""
    schemes = (*((_BASIC,) if is_page else ()), ", ".join((_BEARER, *of_bearer)))
    return tuple(("WWW-Authenticate", scheme) for scheme in schemes)


def _credentials(scope: Scope) -> Iterator[str]:
    """Everything that a request gives as a key. What cannot be read as one is yielded empty, and opens nothing. A key
    that a browser sends by itself gives way to one that the page gives."""
    headers = Headers(scope=scope).getlist("authorization")
    protocols = scope.get("subprotocols", ()) if scope["type"] == "websocket" else ()
    of_page = [each.removeprefix(KEY_PROTOCOL) for each in protocols if each.startswith(KEY_PROTOCOL)]
    if not (of_page and len(headers) == 1 and _is_basic(headers[0])):
        yield from map(_key_of, headers)
    for encoded in of_page:
        yield _decoded(encoded)


def _is_basic(authorization: str) -> bool:
    """Whether a header gives a name and a password, which a browser does by itself."""
    return authorization.partition(" ")[0].lower() == "basic"


def _key_of(authorization: str) -> str:
    """The key in a header; empty if it has none."""
    scheme, _, given = authorization.partition(" ")
    if scheme.lower() == "bearer":
        return given.strip()
    if not _is_basic(authorization):
        return ""
    try:
        name_and_password = base64.b64decode(given.strip(), validate=True).decode()
    except ValueError:  # of base64, of UTF-8, and of a header that is not ASCII
        return ""
    return name_and_password.partition(":")[2].strip()


def _decoded(text: str) -> str:
    """A key in base64url, with or without padding; empty if it is not."""
    unpadded = text.rstrip("=")
    padded = unpadded + "=" * (-len(unpadded) % 4)
    try:
        return base64.b64decode(padded, altchars=b"-_", validate=True).decode()
    except ValueError:
        return ""


def _without_keys(scope: Scope) -> dict[str, Any]:
    """The scope without what carried a key, so that nothing behind the gate can show it."""
    hidden = {b"authorization", b"sec-websocket-protocol"}
    cleared: dict[str, Any] = {**scope, "headers": [each for each in scope["headers"] if each[0].lower() not in hidden]}
    if "subprotocols" in scope:
        cleared["subprotocols"] = [each for each in scope["subprotocols"] if not each.startswith(KEY_PROTOCOL)]
    return cleared


def _privately(send: Send) -> Send:
    """Tell caches that others share to keep nothing: they would show it to outsiders."""

    async def send_privately(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            if (control := headers.get("cache-control")) is not None:
                headers["cache-control"] = control.replace("public", "private")
        await send(message)

    return send_privately
