"""uvicorn's WebSocket protocol, with a short way for what an application sends and hears hundreds of times a second.

By way of ASGI a message passes through three layers, a task that wakes for it, and a state machine, which for a block
of audio is most of what its listener costs beside rendering. A whole binary message needs none of that where the
connection is open and its buffer has room: a header of a few bytes (RFC 6455, 5.2), and the transport. ASGI allows such
*extensions*: an application finds this one in its scope, and does without where another server runs it.
"""

import struct
from collections.abc import Callable, Mapping, MutableMapping
from typing import Any, Final

from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.http11 import Request

Write = Callable[[bytes], bool]
"""Sends a binary message at once, or says False and has not: then it goes the way of all others."""

_EXTENSION: Final = "nafir.direct"
_WHOLE_BINARY: Final = 0x82
_SHORT, _LONG = 126, 127
_MOST_WAITING = 16
"""Messages that may wait for the application before its client is heard no more."""


def direct_write(scope: Mapping[str, Any]) -> Write | None:
    """That of a connection, where its server has one."""
    write: Write | None = scope.get("extensions", {}).get(_EXTENSION, {}).get("write")
    return write


def watched(scope: MutableMapping[str, Any], watch: Callable[[bytes], None]) -> MutableMapping[str, Any]:
    """A scope of which `watch` is told what was sent directly, after it was."""
    write = direct_write(scope)
    if write is None:
        return scope

    def write_watched(payload: bytes) -> bool:
        is_sent = write(payload)
        if is_sent:
            watch(payload)
        return is_sent

    return {**scope, "extensions": {**scope["extensions"], _EXTENSION: {"write": write_watched}}}


def header(length: int) -> bytes:
    """Of a whole binary message that a server sends, of so many bytes."""
    if length < _SHORT:
        return struct.pack(">BB", _WHOLE_BINARY, length)
    if length < 1 << 16:
        return struct.pack(">BBH", _WHOLE_BINARY, _SHORT, length)
    return struct.pack(">BBQ", _WHOLE_BINARY, _LONG, length)


class WebSocketProtocol(WebSocketsSansIOProtocol):
    """For uvicorn, by `ws="server.web_socket:WebSocketProtocol"`, without extensions of the protocol's own: what is
    written here is neither compressed nor cut."""

    def handle_connect(self, event: Request) -> None:
        super().handle_connect(event)
        if not self.handshake_complete:  # as it is where the request was refused
            self.scope["extensions"][_EXTENSION] = {"write": self.write_binary}

    def write_binary(self, payload: bytes) -> bool:
        """As `Write`."""
        is_open = self.handshake_complete and not self.close_sent and not self.transport.is_closing()
        if not is_open or not self.writable.is_set():
            return False
        self.transport.write(header(len(payload)) + payload)
        return True

    def send_receive_event_to_app(self) -> None:
        """uvicorn stops reading with every message, until the application has taken it in."""
        super().send_receive_event_to_app()
        if self.read_paused and self.queue.qsize() < _MOST_WAITING:
            self.read_paused = False
            self.transport.resume_reading()
