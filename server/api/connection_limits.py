"""Limits of HTTP connections: sizes, times and numbers."""

from dataclasses import dataclass

from server.api.settings import Settings

LIVENESS_PATH = "/livez"
READINESS_PATH = "/readyz"
HEALTH_PATHS = LIVENESS_PATH, READINESS_PATH
"""Paths for process supervisors. They are answered for any `Host`, and also when all other connections are taken."""

UPLOAD_PATH = "/v1/clips"


@dataclass(frozen=True)
class ConnectionLimits:
    """Limits of HTTP requests and WebSocket handshakes. The settings of the same names explain each."""

    max_request_line_bytes: int
    max_header_bytes: int
    """Longest single header line. It is below the limit of the WebSocket library (8,192)."""
    max_headers_bytes: int
    max_headers: int
    max_body_bytes: int
    request_timeout_s: float
    response_timeout_s: float
    max_upload_bytes: int
    """Longest body of `POST` to `UPLOAD_PATH`; as other bodies where there are no uploads."""
    upload_timeout_s: float
    max_connections: int
    max_connections_per_address: int
    reserve_connections: int = 32
    """Connections beyond `max_connections`, for health checks and for answering others that there is no room."""

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
            max_upload_bytes=settings.max_clip_bytes if settings.takes_clips else settings.max_body_bytes,
            upload_timeout_s=settings.upload_timeout_s if settings.takes_clips else settings.request_timeout_s,
            max_connections=settings.max_connections,
            max_connections_per_address=min(settings.max_connections_per_address, settings.max_connections),
        )
