"""The sockets that a server listens at. They are bound before anything is loaded, so that a port that cannot be had is
reported at once."""

import socket

from server.core.errors import NafirError

_BACKLOG = 2048


def bind(host: str, port: int) -> list[socket.socket]:
    """Listening sockets, one for each address of `host`. With `port` 0 all share one free port.

    Connections wait until the server accepts them. Raises NafirError if an address cannot be bound.
    """
    try:
        found = socket.getaddrinfo(host or None, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except (OSError, UnicodeError) as exc:
        raise NafirError(f"host: {host!r} is not an address of this machine ({exc}): give another with --host") from exc
    listeners: list[socket.socket] = []
    for family, _, _, _, address in dict.fromkeys(found):
        chosen = listeners[0].getsockname()[1] if listeners else port
        try:
            listeners.append(_listening(family, (address[0], chosen, *address[2:])))
        except OSError as exc:
            for listener in listeners:
                listener.close()
            raise NafirError(_refusal(host, chosen, exc)) from exc
    return listeners


def _listening(family: int, address: tuple[object, ...]) -> socket.socket:
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if family == socket.AF_INET6:
            listener.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
        listener.bind(address)
        # Two servers can bind the same port as long as neither listens.
        listener.listen(_BACKLOG)
    except OSError:
        listener.close()
        raise
    return listener


def _refusal(host: str, port: int, exc: OSError) -> str:
    reason = exc.strerror or str(exc)
    return f"port: cannot listen at {host}:{port} ({reason}): give another with --port, or 0 for one that is free"


def url_of(listener: socket.socket, host: str) -> str:
    """URL of a listening socket that was bound to `host`."""
    shown = f"[{host}]" if ":" in host else host
    return f"http://{shown}:{listener.getsockname()[1]}"
