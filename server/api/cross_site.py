"""Who may use the server from within a browser.

Every page that somebody visits can send requests to servers that only they can reach, `localhost` above all. Two checks
keep such pages out, on HTTP requests and WebSocket upgrades alike:

- **Host.** A page that has the name of its own site point to this server (DNS rebinding) counts as this server's own to
  the browser, but its requests carry that name. So a server answers to names it knows. Addresses in numbers are never
  a site's name; a server on a loopback address answers to loopback addresses alone.
- **Origin.** A browser says from which site a page came (RFC 6454; Fetch, `Sec-Fetch-Site`). The server's own page and
  sites that the operator named may use it. Programs that are no browsers send no origin, and may.

A header that decides this may be there once: a proxy in front and this server could each believe another of two.
Health checks are answered whatever they say: they tell nothing and cost nothing.
"""

import ipaddress
from dataclasses import dataclass
from typing import Self
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware.cors import CORSMiddleware
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from server.api.problems import Refusal, problem
from server.api.settings import Settings

_HEALTH = frozenset({"/livez", "/readyz"})
_ANY = "*"
_USUAL_PORTS = {"http": 80, "https": 443}
_EXPOSED = ("ETag", "Retry-After")
_METHODS = ("GET", "HEAD")
_HEADERS = ("If-None-Match",)
_DECISIVE = ("Host", "Origin", "Sec-Fetch-Site")
_FOR_PROGRAMS = ("/v1/", "/metrics")
"""Paths that no link leads to."""


@dataclass(frozen=True)
class SitePolicy:
    """`hosts` and `origins` are lower case; `*` among hosts is any. With `is_loopback`, of addresses in numbers only
    those of the machine itself are answered to."""

    hosts: frozenset[str]
    origins: frozenset[str]
    is_loopback: bool

    @classmethod
    def of(cls, settings: Settings) -> Self:
        hosts = {settings.host.lower(), *(name.lower() for name in settings.allowed_hosts)}
        return cls(
            hosts=frozenset(hosts),
            origins=frozenset(origin.lower().rstrip("/") for origin in settings.allowed_origins),
            is_loopback=_is_loopback(settings.host),
        )

    def refusal(self, path: str, headers: Headers, *, scheme: str = "http") -> Refusal | None:
        """What a request is answered in place of the application, if anything. `scheme` is that of its address: `http`,
        `https`, `ws` or `wss`."""
        for name in _DECISIVE:
            if (times := len(headers.getlist(name))) > 1:
                return Refusal(400, "doubled_header", f"{name} is given {times} times: give it once")
        host = _Authority.parsed(headers.get("host", ""))
        if not self._may_be_called(host):
            return Refusal(
                421, "host_not_allowed", f"this server does not answer to {host.name!r}: name it in NAFIR_ALLOWED_HOSTS"
            )
        origin, site = headers.get("origin"), headers.get("sec-fetch-site")
        if origin is None:
            # As of a picture in another site's page. A visitor may follow a link from there to the page itself.
            is_foreign = path.startswith(_FOR_PROGRAMS) and site == "cross-site"
            origin = "another site" if is_foreign else None
        elif origin.lower() in self.origins or _is_own(origin, host, scheme=scheme, site=site):
            origin = None
        if origin is None:
            return None
        return Refusal(
            403, "origin_not_allowed", f"pages of {origin} may not use this server: name it in NAFIR_ALLOWED_ORIGINS"
        )

    def _may_be_called(self, host: "_Authority") -> bool:
        if _ANY in self.hosts or host.name in self.hosts:
            return True
        if host.name == "localhost" or host.name.endswith(".localhost"):  # RFC 6761, 6.3: never another's
            return True
        address = _address(host.name)
        return address is not None and (address.is_loopback or not self.is_loopback)


class CrossSiteGate:
    """ASGI middleware that refuses what a `SitePolicy` does. Sites it allows are given their CORS headers."""

    def __init__(self, app: ASGIApp, *, policy: SitePolicy) -> None:
        self._policy = policy
        self._app = app
        if policy.origins:
            self._app = _Cors(
                app,
                allow_origins=sorted(policy.origins),
                allow_methods=_METHODS,
                allow_headers=_HEADERS,
                expose_headers=_EXPOSED,
            )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in {"http", "websocket"} or scope["path"] in _HEALTH:
            await self._app(scope, receive, send)
            return
        refusal = self._policy.refusal(scope["path"], Headers(scope=scope), scheme=scope.get("scheme", "http"))
        if refusal is None:
            await self._app(scope, receive, _varying(send) if self._policy.origins else send)
        elif scope["type"] == "websocket" and "websocket.http.response" not in scope.get("extensions", {}):
            # Before it is accepted: the upgrade is answered 403, and without a body.
            await send({"type": "websocket.close", "code": 1008, "reason": refusal.code})
        else:
            await problem(refusal.status, refusal.code, refusal.detail)(scope, receive, send)


class _Cors(CORSMiddleware):
    """Refuses preflights with a problem document, as every other error."""

    def preflight_response(self, request_headers: Headers) -> Response:
        response = super().preflight_response(request_headers)
        if response.status_code < 400:
            return response
        detail = f"pages of other sites may send {', '.join(_METHODS)}, with no header of their own but {_HEADERS[0]}"
        refused = problem(response.status_code, "preflight_refused", detail)
        for name, value in response.headers.items():
            if name not in {"content-type", "content-length"}:
                refused.headers[name] = value
        return refused


@dataclass(frozen=True)
class _Authority:
    """A host's name in lower case, without brackets, and its port where one is given."""

    name: str
    port: int | None

    @classmethod
    def parsed(cls, text: str) -> Self:
        try:
            parts = urlsplit(f"//{text}")
            return cls((parts.hostname or "").rstrip("."), parts.port)
        except ValueError:  # no authority at all
            return cls(text, None)


def _is_own(origin: str, host: _Authority, *, scheme: str, site: str | None) -> bool:
    """Whether a page came from where its request goes, `scheme` included (RFC 6454, 4).

    A proxy in front may speak TLS and not say so: then `scheme` is `http` for a page of either kind, and `site`, what
    the browser says in `Sec-Fetch-Site`, tells the two apart. Browsers disagree on it for WebSockets, whose scheme is
    another than a page's.
    """
    page_scheme, _, rest = origin.lower().partition("://")
    if scheme in {"https", "wss"} and page_scheme != "https":
        return False
    if scheme in {"http", "https"} and site not in {None, "same-origin"}:
        return False
    usual = _USUAL_PORTS.get(page_scheme)
    if usual is None:
        return False
    page = _Authority.parsed(rest)
    ports = (page.port or usual, host.port or usual)
    return bool(page.name) and page.name == host.name and ports[0] == ports[1]


def _address(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(name)
    except ValueError:
        return None


def _is_loopback(host: str) -> bool:
    address = _address(host)
    return host.lower() == "localhost" or (address is not None and address.is_loopback)


def _varying(send: Send) -> Send:
    """Caches must not give one site what another was answered."""

    async def send_varying(message: Message) -> None:
        if message["type"] == "http.response.start":
            MutableHeaders(scope=message).add_vary_header("Origin")
        await send(message)

    return send_varying
