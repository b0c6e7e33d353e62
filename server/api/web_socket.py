"""uvicorn's WebSocket protocol with a fast path for messages that are sent and received hundreds of times a second.

Through ASGI a message passes three layers, a task that wakes for it, and a state machine. For a block of audio that is
most of a listener's cost besides rendering. On the fast path a whole binary message needs only a header of a few bytes
(RFC 6455, 5.2) and the transport, if the connection is open and its buffer has room. A received message is handed over
directly if none waits before it. The fast path is an ASGI *extension*: the application finds it in its scope, and works
without it on another server.

No client delays others. Only a few frames of a client are handled at a time, and once a client has spent its budget
(`server.api.inflow`), nothing is read from it for a while.
"""

import asyncio
import logging
from collections.abc import Callable, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, replace
from http import HTTPStatus
from itertools import zip_longest
from typing import Any, Final

from uvicorn._types import ASGIReceiveEvent, ASGISendEvent
from uvicorn.config import Config
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from uvicorn.server import ServerState
from websockets.exceptions import InvalidState
from websockets.frames import Frame
from websockets.http11 import Request, Response
from websockets.protocol import CONNECTING, OPEN
from websockets.server import ServerProtocol

from server.api.inflow import (
    OTHER_FRAME_COST,
    READ_COST,
    SUPERSEDED_COST,
    USUAL,
    Allowance,
    Budget,
    message_cost,
    supersedes,
)
from server.api.problems import problem
from server.api.resetting import reset
from server.api.seats import Seat
from server.api.turn_taking import TurnTaking
from server.api.web_socket_frames import FrameSplitter, ReceivedFrame, header
from server.protocol.codes import LOST

Handler = Callable[[str | bytes], bool]
"""Handles a message at once. Returns False if it does not; the message then goes through ASGI."""

_EXTENSION: Final = "nafir.direct"
_END_OF_REQUEST: Final = b"\r\n\r\n"
_MOST_WAITING = 16
"""Messages that may wait for the application before reading pauses."""
_FRAMES_AT_ONCE = 32
"""Frames of one client handled before other clients' turn; they take at most a millisecond."""
_SHORTEST_WAIT_S = 0.01
"""Shortest pause once a budget is spent. After it more bytes come at once, which costs less than many small reads."""
_MOST_FRAGMENTS = 64
"""Fragments of one message that may wait separately."""


def _no_allowance(_: Allowance) -> None:
    """The default of `FastPath.allow`, for servers without budgets."""


def _no_charge(_: float) -> None:
    """The default of `FastPath.charge`, for servers without budgets."""


@dataclass(frozen=True)
class FastPath:
    """Direct access to a WebSocket connection that bypasses ASGI. Messages stay in order with those sent through
    ASGI."""

    write: Callable[[Sequence[bytes]], bool]
    """Sends binary messages at once. Returns False if it could not, and then none was sent."""
    listen: Callable[[Handler], None]
    """Sets the handler, which from then on gets whole messages before which none waits. It does not get listener poses
    that a newer one follows directly."""
    allow: Callable[[Allowance], None] = _no_allowance
    """Sets the rate at which the client's budget fills."""
    charge: Callable[[float], None] = _no_charge
    """Takes so many units (`server.api.inflow`) from the client's budget, for what a message has made the server do."""
    is_open: Callable[[], bool] = lambda: True
    """Whether the connection is still open, as far as is known."""


def fast_path(scope: Mapping[str, Any]) -> FastPath | None:
    """The fast path of a connection; None if the server has none."""
    path: FastPath | None = scope.get("extensions", {}).get(_EXTENSION, {}).get("path")
    return path


def watched(
    scope: MutableMapping[str, Any],
    *,
    sent: Callable[[Sequence[bytes]], None],
    received: Callable[[str | bytes], None],
) -> MutableMapping[str, Any]:
    """A scope whose fast path calls `sent` for messages sent through it and `received` for messages handled through
    it."""
    path = fast_path(scope)
    if path is None:
        return scope

    def write(payloads: Sequence[bytes]) -> bool:
        is_sent = path.write(payloads)
        if is_sent:
            sent(payloads)
        return is_sent

    def listen(handler: Handler) -> None:
        def watched_handler(message: str | bytes) -> bool:
            is_handled = handler(message)
            if is_handled:
                received(message)
            return is_handled

        path.listen(watched_handler)

    return {
        **scope,
        "extensions": {**scope["extensions"], _EXTENSION: {"path": replace(path, write=write, listen=listen)}},
    }


class _Handshake(ServerProtocol):
    """The library's handshake, with refusals as problem documents."""

    def reject(self, status: HTTPStatus | int, text: str) -> Response:
        response = super().reject(status, text)
        document = problem(status, "handshake_refused", text.strip() or HTTPStatus(status).phrase)
        response.body = bytes(document.body)
        for name in ("Content-Type", "Content-Length"):
            del response.headers[name]
            response.headers[name] = document.headers[name]
        return response


class WebSocketProtocol(WebSocketsSansIOProtocol):
    """The protocol for uvicorn's option `ws`. It uses no WebSocket extensions, so messages are neither compressed nor
    split."""

    _handler: Handler | None = None
    _splitter: FrameSplitter | None = None
    _has_failed = False
    """Whether the client broke the protocol and was told so."""
    _budget: Budget | None = None
    _next_slice: asyncio.Handle | None = None
    """The scheduled call that handles waiting frames or resumes reading. Nothing is read until then."""
    _pong: bytes = b""
    """The newest pong that could not be sent for lack of room."""
    _seat: Seat | None = None
    _leave_room: Callable[[], None] | None = None
    _turns: TurnTaking | None = None
    _closing_since_s: float | None = None

    def __init__(
        self,
        config: Config,
        server_state: ServerState,
        app_state: dict[str, Any],
        _loop: asyncio.AbstractEventLoop | None = None,
    ) -> None:
        super().__init__(config, server_state, app_state, _loop)
        self.conn = _Handshake(max_size=config.ws_max_size, logger=logging.getLogger("uvicorn.error"))

    def take_seat(self, seat: Seat, leave_room: Callable[[], None], turns: TurnTaking) -> None:
        """Take over the seat of the HTTP connection that became this WebSocket. The seat is in use once the application
        listens; until then another connection may take it. The handshake takes its turn in `turns` with other
        requests."""
        self._seat, self._leave_room, self._turns = seat, leave_room, turns

    async def run_asgi(self) -> None:
        """Start the application when the connection's turn comes, unless the client has gone by then."""
        if self._turns is not None:
            turn: asyncio.Future[None] = self.loop.create_future()
            self._turns.begin(self.loop, lambda: None if turn.done() else turn.set_result(None))
            await turn
        if not self.disconnected:
            await super().run_asgi()

    def _is_open(self) -> bool:
        return not (self.disconnected or self.transport.is_closing())

    def connection_lost(self, exc: Exception | None) -> None:
        if self._seat is not None and self._leave_room is not None:
            self._seat.leave()
            self._leave_room()
            self._seat = self._leave_room = None  # these refer to the transport and to this protocol
        if self.handshake_complete and not self.disconnected and self.conn.close_rcvd is None:
            # uvicorn would say 1005, as for a close frame without a code.
            self.queue.put_nowait({"type": "websocket.disconnect", "code": LOST})
        super().connection_lost(exc)
        if self._next_slice is not None:
            self._next_slice.cancel()
            self._next_slice = None

    def end_if_overdue(self, now_s: float) -> None:
        """Reset a connection that has been closing for too long. A closing transport first sends waiting data, which
        never happens if the client does not read."""
        if not self.transport.is_closing():
            return
        if self._closing_since_s is None:
            self._closing_since_s = now_s
        elif now_s - self._closing_since_s > self.close_timeout:
            reset(self.transport)

    def handle_connect(self, event: Request) -> None:
        super().handle_connect(event)
        if not self.handshake_complete:  # it is complete if the request was refused
            self.scope["extensions"][_EXTENSION] = {
                "path": FastPath(self._write, self._listen, self._allow, self._spend, self._is_open)
            }

    def on_task_complete(self, task: asyncio.Task[None]) -> None:
        """The application has ended. The fast path refers to this protocol, and the handler to the application. Both
        are dropped, so that no reference cycle waits for the garbage collector."""
        super().on_task_complete(task)
        self._handler = None
        self.scope["extensions"].pop(_EXTENSION, None)

    def data_received(self, data: bytes) -> None:
        if self._has_failed:
            return  # the client has not seen the close frame yet
        if self._splitter is None:
            was_open = self.handshake_initiated
            super().data_received(data)
            # If bytes follow the request, the parser may be in the middle of a frame.
            is_request = data.partition(_END_OF_REQUEST)[1:] == (_END_OF_REQUEST, b"")
            if is_request and self.handshake_initiated and not was_open:
                self._splitter = FrameSplitter(self.config.ws_max_size)
            return
        self._spend(READ_COST, len(data))
        if self._next_slice is None:
            self._take_slice(data)
        else:  # uvicorn has resumed reading
            self._splitter.keep(data)
            self.transport.pause_reading()

    def _take_slice(self, data: bytes = b"") -> None:
        """Handle a few frames, and schedule the next ones."""
        assert self._splitter is not None
        frames = self._splitter.split(data, most=_FRAMES_AT_ONCE)
        for_asgi: list[bytes] = []
        for frame, following in zip_longest(frames, frames[1:]):
            if self._is_superseded(frame, following):
                self._spend(SUPERSEDED_COST)
                continue
            if frame.message is None:
                self._spend(OTHER_FRAME_COST * frame.frames)
            else:
                self._spend(message_cost(frame.message, is_text=frame.is_text))
            # After the first frame for ASGI all others have to wait behind it.
            if for_asgi or frame.message is None or not self._is_handled(frame.message, is_text=frame.is_text):
                for_asgi.append(frame.raw)
        if for_asgi:
            super().data_received(b"".join(for_asgi))
        self._go_on_later()

    def _go_on_later(self) -> None:
        """Pause reading if more frames wait or the budget is spent."""
        wait_s = 0.0 if self._budget is None else self._budget.wait_s
        if self._splitter is None or not (self._splitter.has_more or wait_s):
            return
        self.transport.pause_reading()
        if wait_s:
            self._next_slice = self.loop.call_later(max(_SHORTEST_WAIT_S, wait_s), self._go_on)
        else:
            self._next_slice = self.loop.call_soon(self._go_on)

    def _go_on(self) -> None:
        self._next_slice = None
        if self._has_failed or self.transport.is_closing():
            return
        if self.read_paused:  # until the application has received what waits
            return
        self._spend(0.0)
        if self._budget is not None and self._budget.wait_s:  # it was charged meanwhile
            self._go_on_later()
            return
        self._take_slice()
        if self._next_slice is None and not self.read_paused and not self.transport.is_closing():
            self.transport.resume_reading()

    async def receive(self) -> ASGIReceiveEvent:
        message = await self.queue.get()
        if self.read_paused and self.queue.empty():
            self.read_paused = False
            if self._next_slice is None:
                # Not at once: the next message would be handled before this one is returned.
                self._next_slice = self.loop.call_soon(self._go_on)
        return message

    async def send(self, message: ASGISendEvent) -> None:
        await super().send(message)
        if message["type"] == "websocket.http.response.body" and not message.get("more_body", False):
            # A refusal is an answer too; uvicorn would report an application that gave none.
            self.handshake_complete = True

    def _spend(self, messages: float, nbytes: int = 0) -> None:
        now_s = self.loop.time()
        if self._budget is None:
            self._budget = Budget(USUAL, now_s)
        self._budget.spend(messages, nbytes, now_s)

    def _allow(self, allowance: Allowance) -> None:
        self._budget = Budget(allowance, self.loop.time())

    def _is_superseded(self, frame: ReceivedFrame, following: ReceivedFrame | None) -> bool:
        if self._handler is None or frame.message is None or following is None or following.message is None:
            return False
        return frame.is_text == following.is_text and supersedes(following.message, frame.message)

    def handle_cont(self, event: Frame) -> None:
        """Join the fragments of a message from time to time, so that few of them wait."""
        super().handle_cont(event)
        if len(self.frames) > _MOST_FRAGMENTS:
            self.frames = [b"".join(self.frames)]

    def send_receive_event_to_app(self) -> None:
        """Pass a message to the application. uvicorn pauses reading after every message; here some may wait."""
        try:
            super().send_receive_event_to_app()
        except InvalidState:  # text that is not UTF-8, before the connection is open or once the client closes it
            if self.conn.state is CONNECTING:
                self.transport.close()
        if self.read_paused and self.queue.qsize() < _MOST_WAITING:
            self.read_paused = False
            if self._next_slice is None:
                self.transport.resume_reading()

    def handle_parser_exception(self) -> None:
        """End the connection after a breach of the protocol. uvicorn closes it at once, so that a client that is still
        sending gets a reset instead of the reason. Here the client may go on, ignored, until it closes its side or
        `close_timeout` is over (RFC 6455, 7.1.1).
        """
        if self.close_sent:
            return  # the application has closed it already
        failure = self.conn.close_sent
        if failure is None:  # a breach before the connection is open
            self.transport.close()
            return
        self.queue.put_nowait({"type": "websocket.disconnect", "code": failure.code, "reason": failure.reason})
        self.transport.write(b"".join(self.conn.data_to_send()))
        # For the application the connection is lost, so that sending more is not an error.
        self.close_sent = self.disconnected = self._has_failed = True
        if not self.transport.can_write_eof():  # TLS has its own way to close
            self.transport.close()
            return
        self.transport.write_eof()
        self.close_timer = self.loop.call_later(self.close_timeout, self.transport.abort)
        if self.read_paused:
            self.read_paused = False
            self.transport.resume_reading()

    def handle_ping(self) -> None:
        """Answer the newest of several pings (RFC 6455, 5.5.3). While the client does not read, the newest pong
        waits."""
        if self._has_failed:
            return
        if self.conn.state is not OPEN:
            super().handle_ping()
        elif output := self.conn.data_to_send():
            if self.writable.is_set():
                self.transport.write(output[-1])
            else:
                self._pong = output[-1]

    def resume_writing(self) -> None:
        super().resume_writing()
        if self._pong and not self.close_sent and not self.transport.is_closing():
            self.transport.write(self._pong)
        self._pong = b""

    def _is_handled(self, message: bytes, *, is_text: bool) -> bool:
        """Whether the handler has handled the message."""
        if self._handler is None or self.close_sent or self.conn.state is not OPEN or not self.queue.empty():
            return False
        if not is_text:
            return self._handler(message)
        try:
            text = message.decode()
        except UnicodeDecodeError:
            return False  # uvicorn refuses it
        return self._handler(text)

    def _listen(self, handler: Handler) -> None:
        self._handler = handler
        if self._seat is not None:
            self._seat.use()

    def _write(self, payloads: Sequence[bytes]) -> bool:
        is_open = self.handshake_complete and not self.close_sent and not self.transport.is_closing()
        if not is_open or not self.writable.is_set():
            return False
        self.transport.write(b"".join([part for payload in payloads for part in (header(len(payload)), payload)]))
        return True
