"""How much a client may send, how long it may take, and how many connections there may be."""

from dataclasses import dataclass

from server.api.settings import Settings

HEALTH_PATHS = "/livez", "/readyz"
"""What a process supervisor asks: answered whatever `Host` says, and when all other connections are taken."""


@dataclass(frozen=True)
class ConnectionLimits:
    """Of the server's HTTP side, up to a WebSocket's handshake. The settings of the same names say what each is for."""

    max_request_line_bytes: int
    max_header_bytes: int
    """Of one line, so that the WebSocket handshake, which has a bound of its own (8,192), takes what this lets pass."""
    max_headers_bytes: int
    max_headers: int
    max_body_bytes: int
    request_timeout_s: float
    response_timeout_s: float
    max_connections: int
    max_connections_per_address: int
    reserve_connections: int = 32
    """Beyond `max_connections`, for health checks, and to tell others that there is no room."""

    @classmethod
    def of(cls, settings: Settings) -> "ConnectionLimits":
        return cls(
            max_request_line_bytes=8_000,
            max_header_bytes=8_000,
            max_headers_bytes=settings.max_headers_bytes,
            max_headers=100,
            max_body_bytes=settings.max_body_bytes,
            request_timeout_s=settings.request_timeout_s,
            response_timeout_s=settings.response_timeout_s,
            max_connections=settings.max_connections,
            max_connections_per_address=min(settings.max_connections_per_address, settings.max_connections),
        )
