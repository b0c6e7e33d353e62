"""Protection against requests from other sites' pages in a browser.

Any page that a user visits can send requests to servers that only this user can reach, such as `localhost`. Two checks
keep such pages out, for HTTP requests and WebSocket upgrades alike:

- **Host.** A page can make the name of its own site point to this server (DNS rebinding). The browser then takes the
  server for the page's own, but its requests carry that name. So the server answers only to names it knows. Numeric
  addresses are never a site's name, so they are allowed; a server on a loopback address allows only loopback addresses.
- **Origin.** A browser says from which site a page came (RFC 6454; Fetch, `Sec-Fetch-Site`). The server's own page and
  sites that the operator named are allowed. Programs other than browsers send no origin and are allowed.

A browser adds a key that it was given by HTTP Basic to whatever it sends to this server, whichever page asks. So that
key is taken out of requests of named sites, which have keys of their own. What a page of another site can ask without
an origin, such as a picture, are files of the page, and it can change nothing.

Each of these headers may occur only once. Otherwise a proxy and this server could each go by a different one. Health
checks are answered in any case: they reveal nothing and cost nothing.
"""

from dataclasses import dataclass
from typing import Self

from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware.cors import CORSMiddleware
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from server.api.authority import Authority
from server.api.connection_limits import HEALTH_PATHS
from server.api.problems import Refusal, problem, refuse
from server.api.settings import Settings

_ANY = "*"
_USUAL_PORTS = {"http": 80, "https": 443}
_EXPOSED = ("ETag", "Retry-After", "WWW-Authenticate", "X-Request-ID")
_METHODS = ("GET", "HEAD", "POST", "DELETE")
_HEADERS = ("Authorization", "Content-Type", "If-None-Match", "Range", "X-Request-ID")
_DECISIVE = ("Host", "Origin", "Sec-Fetch-Site")
_READ = frozenset({"GET", "HEAD", "OPTIONS"})
_FOR_PROGRAMS = ("/v1/", "/metrics")
"""Paths for programs, to which no link of a page leads."""


@dataclass(frozen=True)
class SitePolicy:
    """Hosts and origins that are allowed, in lower case; the host `*` allows any. With `is_loopback`, only loopback
    addresses are allowed among numeric addresses."""

    hosts: frozenset[str]
    origins: frozenset[str]
    is_loopback: bool

    @classmethod
    def of(cls, settings: Settings) -> Self:
        hosts = {settings.host.lower(), *(name.lower() for name in settings.allowed_hosts)}
        return cls(
            hosts=frozenset(hosts),
            origins=frozenset(origin.lower().rstrip("/") for origin in settings.allowed_origins),
            is_loopback=settings.is_loopback,
        )

    def refusal(self, path: str, headers: Headers, *, scheme: str = "http", method: str = "GET") -> Refusal | None:
        """The refusal of a request; None if it is allowed. `scheme` is that of its URL: `http`, `https`, `ws` or
        `wss`."""
        for name in _DECISIVE:
            if (times := len(headers.getlist(name))) > 1:
                return Refusal(400, "doubled_header", f"{name} is given {times} times: give it once")
        host = Authority.parsed(headers.get("host", ""))
        if not self._may_be_called(host):
            return Refusal(
                421, "host_not_allowed", f"this server does not answer to {host.name!r}: name it in NAFIR_ALLOWED_HOSTS"
            )
        origin, site = headers.get("origin"), headers.get("sec-fetch-site")
        if origin is None:
            # For instance a picture in another site's page. A visitor may still follow a link from there to our page.
            # Fetch has browsers send an origin with every method that may change something; some old ones do not.
            is_foreign = path.startswith(_FOR_PROGRAMS) and site == "cross-site"
            is_foreign |= method not in _READ and site in {"cross-site", "same-site"}
            origin = "another site" if is_foreign else None
        elif origin.lower() in self.origins or _is_own(origin, host, scheme=scheme, site=site):
            origin = None
        if origin is None:
            return None
        return Refusal(
            403, "origin_not_allowed", f"pages of {origin} may not use this server: name it in NAFIR_ALLOWED_ORIGINS"
        )

    def is_of_another_site(self, headers: Headers, *, scheme: str = "http") -> bool:
        """Whether a request that is allowed comes from a page other than the server's own, as far as browsers say."""
        origin, site = headers.get("origin"), headers.get("sec-fetch-site")
        if origin is None or (scheme in {"http", "https"} and site == "same-origin"):
            return False
        return not _is_own(origin, Authority.parsed(headers.get("host", "")), scheme=scheme, site=site)

    def _may_be_called(self, host: Authority) -> bool:
        if _ANY in self.hosts or host.name in self.hosts or host.is_loopback:
            return True
        return host.address is not None and not self.is_loopback


class CrossSiteGate:
    """ASGI middleware that applies a `SitePolicy`. Responses to allowed sites get CORS headers."""

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
        if scope["type"] not in {"http", "websocket"} or scope["path"] in HEALTH_PATHS:
            await self._app(scope, receive, send)
            return
        headers, scheme = Headers(scope=scope), scope.get("scheme", "http")
        refusal = self._policy.refusal(scope["path"], headers, scheme=scheme, method=scope.get("method", "GET"))
        if refusal is not None:
            await refuse(refusal, scope, receive, send)
            return
        if self._policy.is_of_another_site(headers, scheme=scheme):
            scope = {**scope, "headers": [each for each in scope["headers"] if not _is_basic(*each)]}
        await self._app(scope, receive, _varying(send) if self._policy.origins else send)


class _Cors(CORSMiddleware):
    """CORS middleware whose refusals of preflights are problem documents, like all other errors."""

    def preflight_response(self, request_headers: Headers) -> Response:
        response = super().preflight_response(request_headers)
        if response.status_code < 400:
            return response
        methods, headers = ", ".join(_METHODS), ", ".join(_HEADERS)
        detail = f"pages of other sites may send {methods}, with no header of their own but {headers}"
        refused = problem(response.status_code, "preflight_refused", detail)
        for name, value in response.headers.items():
            if name not in {"content-type", "content-length"}:
                refused.headers[name] = value
        return refused


def _is_basic(name: bytes, value: bytes) -> bool:
    """Whether a header is one by which a browser sends a key of its own accord."""
    return name.lower() == b"authorization" and value.partition(b" ")[0].lower() == b"basic"


def _is_own(origin: str, host: Authority, *, scheme: str, site: str | None) -> bool:
    """Whether a page has the same origin as its request, `scheme` included (RFC 6454, 4).

    A proxy in front may speak TLS without saying so. Then `scheme` is `http` for pages of either scheme, and `site`,
    the browser's `Sec-Fetch-Site`, tells them apart. Browsers disagree on `site` for WebSockets, so it is not used
    there.
    """
    page_scheme, _, rest = origin.lower().partition("://")
    if scheme in {"https", "wss"} and page_scheme != "https":
        return False
    if scheme in {"http", "https"} and site not in {None, "same-origin"}:
        return False
    usual = _USUAL_PORTS.get(page_scheme)
    if usual is None:
        return False
    page = Authority.parsed(rest)
    ports = (page.port or usual, host.port or usual)
    return bool(page.name) and page.name == host.name and ports[0] == ports[1]


def _varying(send: Send) -> Send:
    """Add `Vary: Origin`, so that caches do not give one site the response to another."""

    async def send_varying(message: Message) -> None:
        if message["type"] == "http.response.start":
            MutableHeaders(scope=message).add_vary_header("Origin")
        await send(message)

    return send_varying
