"""Addresses of a server's stream and of its HTTP interface, from the one that a user gives."""

from urllib.parse import urlsplit, urlunsplit

from nafir_client.errors import UnreachableError

_SOCKETS = {"ws": "ws", "wss": "wss", "http": "ws", "https": "wss"}
_PATH = "/v1/stream"


def stream_url(url: str) -> str:
    """The address of the stream: `url` itself if its path ends with `/stream`, or else `/v1/stream` below it. Raises
    UnreachableError if it is no address of a server."""
    try:
        parts = urlsplit(url)
        scheme = _SOCKETS[parts.scheme]
        if not parts.hostname:
            raise ValueError("no host")
    except (KeyError, ValueError) as exc:
        problem = "is no address of a server: it has to begin like ws://HOST:PORT or https://HOST"
        raise UnreachableError(url, problem, is_passing=False) from exc
    path = parts.path.rstrip("/")
    if not path.endswith("/stream"):
        path += _PATH
    return urlunsplit((scheme, parts.netloc, path, parts.query, ""))


def api_url(url: str) -> str:
    """The address that those of the HTTP interface begin with: up to `/v1`. Raises UnreachableError."""
    parts = urlsplit(stream_url(url))
    scheme = {"ws": "http", "wss": "https"}[parts.scheme]
    return urlunsplit((scheme, parts.netloc, parts.path.removesuffix("/stream"), "", ""))
