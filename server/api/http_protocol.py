"""uvicorn's HTTP protocol with limits on sizes and times.

uvicorn's parser collects request lines and headers without a limit. Here every byte is measured first
(`server.api.request_meter`), requests are parsed one at a time, and every connection has a seat (`server.api.seats`)
that another connection may take over while no request is in progress. Twice a second all connections are checked, and
overdue ones are ended.
"""

import asyncio
import logging
from functools import partial
from typing import Any

from uvicorn._types import ASGI3Application
from uvicorn.config import Config
from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol, RequestResponseCycle
from uvicorn.server import ServerState

from server.api.connection_limits import HEALTH_PATHS, UPLOAD_PATH, ConnectionLimits
from server.api.problems import Refusal, problem
from server.api.request_meter import RequestMeter
from server.api.resetting import reset
from server.api.seats import Seat, Seats
from server.api.turn_taking import TurnTaking
from server.api.web_socket import WebSocketProtocol

_CHECK_EVERY_S = 0.5
_LINGER_S = 2.0
"""How long a refused client may go on sending. What it sends is ignored; a reset instead would lose the answer."""
_MOST_IGNORED_BYTES = 1024 * 1024
_MOST_WAITING_BYTES = 64 * 1024
"""Most bytes of further requests that wait while one is not answered yet."""
_PACE_BYTES = 64 * 1024
"""A client has to read this much of a response, or the rest of it, within `response_timeout_s`."""
_RETRY_AFTER_S = 10
_HEALTH = frozenset(path.encode() for path in HEALTH_PATHS)
_MALFORMED = Refusal(400, "malformed_request", "that is not HTTP/1.1")
_NO_ROOM = Refusal(503, "too_many_connections", "the server has no free connection: ask again later")


_logger = logging.getLogger(__name__)


def limited_http(limits: ConnectionLimits) -> Any:
    """A factory of protocols, for uvicorn's option `http`. The protocols share one `Room`."""
    return partial(HttpProtocol, room=Room(limits))


class Room:
    """State that all connections of a server share."""

    def __init__(self, limits: ConnectionLimits) -> None:
        self.limits = limits
        self.seats = Seats(limits)
        self.turns = TurnTaking()
        self._connections: set[HttpProtocol | WebSocketProtocol] = set()
        self._is_watching = False

    def enter(self, connection: "HttpProtocol | WebSocketProtocol", loop: asyncio.AbstractEventLoop) -> None:
        self._connections.add(connection)
        if not self._is_watching:
            self._is_watching = True
            loop.call_later(_CHECK_EVERY_S, self._watch, loop)

    def leave(self, connection: "HttpProtocol | WebSocketProtocol") -> None:
        self._connections.discard(connection)

    def _watch(self, loop: asyncio.AbstractEventLoop) -> None:
        now_s = loop.time()
        for connection in list(self._connections):
            connection.end_if_overdue(now_s)
        self._is_watching = bool(self._connections)
        if self._is_watching:
            loop.call_later(_CHECK_EVERY_S, self._watch, loop)


class _RefusedError(Exception):
    """Stops the parser when it is raised from one of its callbacks."""


class HttpProtocol(HttpToolsProtocol):
    """An HTTP connection until it closes or becomes a WebSocket."""

    def __init__(
        self,
        config: Config,
        server_state: ServerState,
        app_state: dict[str, Any],
        _loop: asyncio.AbstractEventLoop | None = None,
        *,
        room: Room,
    ) -> None:
        super().__init__(config, server_state, app_state, _loop)
        self._room = room
        self._meter = RequestMeter(room.limits)
        self._seat: Seat | None = None
        self._refusal = _MALFORMED
        """The answer if the parser refuses the request."""
        self._due_s: float | None = None
        """When the request has to be complete, or when a refused client is cut off."""
        self._timeout_s = room.limits.request_timeout_s
        """How long the present request may take to arrive."""
        self._unsent: tuple[int, float] | None = None
        """Bytes that the client has not read yet, and since when the number has not fallen."""
        self._waiting = bytearray()
        """Further requests, which wait while one is not answered yet."""
        self._ignored_bytes = 0
        self._has_head = False
        """Whether the parser has the head of the present request."""
        self._is_whole = False
        """Whether the parser has all of the present request."""
        self._is_last = False
        """Whether anything more from the client is ignored."""
        self._is_upgraded = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._seat = self._room.seats.take(self.client[0] if self.client else "", transport.abort)
        if self._seat is None:
            transport.abort()
            return
        self._due_s = self.loop.time() + self._room.limits.request_timeout_s
        self._room.enter(self, self.loop)

    def connection_lost(self, exc: Exception | None) -> None:
        self._room.leave(self)
        if self._seat is not None:
            self._seat.leave()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        while data and not self._is_upgraded:
            if self._is_last:
                self._ignore(data)
                return
            if self._is_whole:
                self._keep(data)
                return
            data = self._read(data)

    def pause_writing(self) -> None:
        """The client does not read its response, so another connection may take over its seat."""
        super().pause_writing()
        if self._seat is not None:
            self._seat.rest()

    def resume_writing(self) -> None:
        super().resume_writing()
        self._unsent = None
        if self._seat is not None:
            self._seat.use()

    def end_if_overdue(self, now_s: float) -> None:
        """End the connection if the client does not read its response or does not complete its request."""
        unsent_bytes = self.transport.get_write_buffer_size()
        if not unsent_bytes:
            self._unsent = None
        elif self._unsent is None or unsent_bytes <= self._unsent[0] - _PACE_BYTES:
            self._unsent = unsent_bytes, now_s
        elif now_s - self._unsent[1] > self._room.limits.response_timeout_s:
            reset(self.transport)
        if self._due_s is not None and now_s > self._due_s:
            self._time_out()

    # Callbacks of the parser and of uvicorn.

    def on_headers_complete(self) -> None:
        if self._is_last:
            raise _RefusedError  # a further request, which came together with the end of a chunked body
        refusal = self._judge_head()
        if refusal is not None:
            self._refusal = refusal
            raise _RefusedError
        self._has_head = True
        super().on_headers_complete()
        if self._is_upgrading:
            return
        assert self._seat is not None
        self._seat.use()
        if self._seat.is_reserve:
            self.cycle.keep_alive = False

    def on_message_complete(self) -> None:
        super().on_message_complete()
        if self._is_upgrading:
            return
        self._is_whole, self._due_s = True, None
        if not self._meter.has_body:  # the end of a chunked body is known only to the parser
            self.cycle.keep_alive = False
        self._is_last = not self.cycle.keep_alive
        if self.cycle.response_complete:
            self._begin_next()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        if self._is_whole:
            self._begin_next()

    def send_400_response(self, msg: str) -> None:  # noqa: ARG002  uvicorn always passes the same text
        self._refuse(self._refusal)

    def handle_websocket_upgrade(self) -> None:
        seat, self._seat = self._seat, None
        assert seat is not None
        self._is_upgraded = True
        super().handle_websocket_upgrade()
        successor = self.transport.get_protocol()
        assert isinstance(successor, WebSocketProtocol)
        successor.take_seat(seat, partial(self._room.leave, successor), self._room.turns)
        self._room.leave(self)
        self._room.enter(successor, self.loop)
        # The parser refers to this protocol. uvicorn drops it in `connection_lost`, which is not called here any more.
        self.parser = None  # type: ignore[assignment]

    @property
    def _is_upgrading(self) -> bool:
        return bool(self.parser.should_upgrade()) and self._should_upgrade()

    def _start_asgi_task(self, cycle: RequestResponseCycle, app: ASGI3Application) -> None:
        """Requests of all connections start in turn; health checks start at once."""
        start = partial(super()._start_asgi_task, cycle, app)
        if self._is_health_check:
            start()
        else:
            self._room.turns.begin(self.loop, lambda: None if cycle.disconnected else start())

    @property
    def _is_health_check(self) -> bool:
        return self.url.partition(b"?")[0] in _HEALTH

    @property
    def _is_upload(self) -> bool:
        return self.parser.get_method() == b"POST" and self.url.partition(b"?")[0] == UPLOAD_PATH.encode()

    # Handling of incoming bytes.

    def _read(self, data: bytes) -> bytes:
        """Parse the next part of the present request. Returns the bytes after it."""
        if self._due_s is None:
            self._timeout_s = self._room.limits.request_timeout_s
            self._due_s = self.loop.time() + self._timeout_s
        measured = self._meter.measure(data)
        if isinstance(measured, Refusal):
            self._refuse(measured)
            return b""
        super().data_received(measured.part)
        if not self._is_last and not self._is_upgraded and self._has_head != self._meter.has_head:
            self._refuse(_MALFORMED)
        if self._is_upgraded and measured.rest:
            self.transport.get_protocol().data_received(measured.rest)  # type: ignore[attr-defined]
        return measured.rest

    def _judge_head(self) -> Refusal | None:
        assert self._seat is not None
        if self._seat.is_reserve and not self._is_health_check:
            return _NO_ROOM
        if self._is_upload:
            limits = self._room.limits
            self._meter.allow_body(limits.max_upload_bytes)
            self._timeout_s = limits.upload_timeout_s
            self._due_s = self.loop.time() + self._timeout_s
        refusal = self._meter.expect_body(0)
        for name, value in self.headers:
            if name == b"content-length":
                refusal = self._meter.expect_body(int(value))
            elif name == b"transfer-encoding":
                refusal = self._meter.expect_body(None)
        if refusal is None and self.parser.should_upgrade() and not self._meter.has_body:
            return Refusal(400, "malformed_request", "a request to upgrade has no body")
        return refusal

    def _begin_next(self) -> None:
        """Continue after a request was read completely and answered."""
        if self.transport.is_closing():
            return
        if self._is_last:
            self._hang_up()
            return
        assert self._seat is not None
        self._seat.rest()
        self._is_whole = self._has_head = False
        self._meter.begin()
        waiting, self._waiting = bytes(self._waiting), bytearray()
        self.data_received(waiting)

    def _keep(self, data: bytes) -> None:
        self._waiting += data
        if len(self._waiting) > _MOST_WAITING_BYTES:
            self._is_last, self._waiting = True, bytearray()
            self.cycle.keep_alive = False

    def _ignore(self, data: bytes) -> None:
        self._ignored_bytes += len(data)
        if self._ignored_bytes > _MOST_IGNORED_BYTES:
            self.flow.pause_reading()

    # End of the connection.

    def _time_out(self) -> None:
        if self._is_last or self.transport.is_closing():
            reset(self.transport)
        elif self._meter.is_fresh:
            self.transport.close()
        else:
            within = f"within {self._timeout_s:g} s"
            self._refuse(Refusal(408, "request_timeout", f"a request has to be complete {within}"))

    def _refuse(self, refusal: Refusal) -> None:
        """Answer with an error, and end the connection once the client has had time to read it."""
        if self._is_last:
            return
        self._is_last = True
        self._unset_keepalive_if_required()
        if not self._has_head or not self.cycle.response_started:
            client = self.client[0] if self.client else None
            _logger.info(
                "request refused unread", extra={"status": refusal.status, "code": refusal.code, "client": client}
            )
            self.transport.write(_answer(refusal, self.server_state.default_headers))
        elif not self.cycle.response_complete:
            self.transport.abort()
            return
        if self._has_head:
            # Anything the application still sends is dropped.
            self.cycle.disconnected = True
            self.cycle.message_event.set()
        self._hang_up()

    def _hang_up(self) -> None:
        """Close our side of the connection. The client may close its side until `_LINGER_S` is over."""
        self._due_s = self.loop.time() + _LINGER_S
        if self._seat is not None:
            self._seat.rest()
        if self.transport.can_write_eof():
            self.transport.write_eof()
        else:
            self.transport.close()


def _answer(refusal: Refusal, default_headers: list[tuple[bytes, bytes]]) -> bytes:
    """The bytes of a response to a refused request."""
    response = problem(refusal.status, refusal.code, refusal.detail)
    response.headers["Connection"] = "close"
    if refusal.status == 503:
        response.headers["Retry-After"] = str(_RETRY_AFTER_S)
    lines = [name + b": " + value for name, value in [*default_headers, *response.raw_headers]]
    return b"\r\n".join([STATUS_LINE[refusal.status].rstrip(), *lines, b"", bytes(response.body)])
