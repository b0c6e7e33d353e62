"""The gate that asks every request and every WebSocket handshake for a key.

It refuses by default: a path that is not listed here needs the scope `admin`, so that a new route is closed until
somebody decides who may use it. One path is for the server's own processes alone. Open to all are the health checks and
the files of the page, which are the same on every server: those of /docs and /redoc too, which fetch the description of
the interface with the key of their tab.

A key comes in `Authorization: Bearer KEY`. A browser's `WebSocket` cannot set headers, so there it may come among the
subprotocols, as `nafir.key.` and the key in base64url. It is never taken from the query, which servers and proxies log.
"""

import base64
import binascii
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from server.api import api_keys
from server.api.access import OWN_SCOPE, Access, AccessError, Caller, OwnScope
from server.api.api_keys import SCOPES
from server.api.connection_limits import HEALTH_PATHS
from server.api.problems import Refusal, refuse
from server.runtime.logs import about

KEY_PROTOCOL: Final = "nafir.key."
"""Begins the subprotocol that carries a key."""
_REALM: Final = 'Bearer realm="nafir"'
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
    """ASGI middleware that lets through who has a key with the scope for it. `page` are paths that need none."""

    def __init__(self, app: ASGIApp, *, access: Access, page: frozenset[str]) -> None:
        self._app = app
        self._access = access
        self._open = page | frozenset(HEALTH_PATHS)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in {"http", "websocket"}:
            await self._app(scope, receive, send)
            return
        path = scope["path"].removeprefix(scope.get("root_path", ""))
        is_open = path in self._open
        admitted = self._admit(scope.get("method", "GET"), path, scope)
        if isinstance(admitted, Refusal) and not is_open:
            await refuse(admitted, scope, receive, send)
        else:
            caller = None if isinstance(admitted, Refusal) else admitted
            if caller is not None:
                about(caller=caller.name)
            await self._app({**_without_keys(scope), "nafir.caller": caller}, receive, send)

    def _admit(self, method: str, path: str, scope: Scope) -> Caller | Refusal:
        given = list(_credentials(scope))
        if len(given) > 1:
            return Refusal(400, "doubled_header", f"{len(given)} keys are given: give one, once")
        if not given:
            how = "send it as Authorization: Bearer KEY"
            return Refusal(401, "key_required", f"this needs a key: {how}", _challenge())
        try:
            caller = self._access.admit(given[0])
        except AccessError as exc:
            return Refusal(401, exc.code, str(exc), _challenge('error="invalid_token"'))
        needed = scopes_for(method, path)
        if caller.scopes & needed:
            return caller
        if OWN_SCOPE in needed:
            own = "this is for the server's own processes alone"
            return Refusal(403, "scope_missing", own, _challenge('error="insufficient_scope"'))
        wanted = " or ".join(scope for scope in SCOPES if scope in needed)
        challenge = _challenge(f'error="insufficient_scope", scope="{next(each for each in SCOPES if each in needed)}"')
        return Refusal(403, "scope_missing", f"this needs a key with the scope {wanted}", challenge)


def _challenge(*parts: str) -> tuple[tuple[str, str], ...]:
    return (("WWW-Authenticate", ", ".join((_REALM, *parts))),)


def _credentials(scope: Scope) -> Iterator[str]:
    """Everything that a request gives as a key. What cannot be read as one is yielded empty, and opens nothing."""
    for value in Headers(scope=scope).getlist("authorization"):
        scheme, _, key = value.partition(" ")
        yield key.strip() if scheme.lower() == "bearer" else ""
    if scope["type"] == "websocket":
        for protocol in scope.get("subprotocols", ()):
            if protocol.startswith(KEY_PROTOCOL):
                yield _decoded(protocol.removeprefix(KEY_PROTOCOL))


def _decoded(text: str) -> str:
    """A key in base64url, with or without padding; empty if it is not."""
    unpadded = text.rstrip("=")
    padded = unpadded + "=" * (-len(unpadded) % 4)
    try:
        return base64.b64decode(padded, altchars=b"-_", validate=True).decode()
    except (binascii.Error, ValueError):
        return ""


def _without_keys(scope: Scope) -> dict[str, Any]:
    """The scope without what carried a key, so that nothing behind the gate can show it."""
    hidden = {b"authorization", b"sec-websocket-protocol"}
    cleared: dict[str, Any] = {**scope, "headers": [each for each in scope["headers"] if each[0].lower() not in hidden]}
    if "subprotocols" in scope:
        cleared["subprotocols"] = [each for each in scope["subprotocols"] if not each.startswith(KEY_PROTOCOL)]
    return cleared
