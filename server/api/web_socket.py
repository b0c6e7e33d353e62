"""uvicorn's WebSocket protocol, with a short way for what an application sends and hears hundreds of times a second.

By way of ASGI a message passes through three layers, a task that wakes for it, and a state machine, which for a block
of audio is most of what its listener costs beside rendering. A whole binary message needs none of that where the
connection is open and its buffer has room: a header of a few bytes (RFC 6455, 5.2), and the transport; nor does a
message that comes, where none waits before it. ASGI allows such *extensions*: an application finds this one in its
scope, and does without where another server runs it.

No client keeps others waiting: of what comes, a few frames are taken in at a time, between which others have their
turn, and once a client has spent its budget (`server.api.inflow`) nothing is read from it for a while.
"""

import asyncio
import logging
from collections.abc import Callable, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, replace
from http import HTTPStatus
from itertools import zip_longest
from typing import Any, Final

from uvicorn._types import ASGIReceiveEvent
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

Hear = Callable[[str | bytes], bool]
"""Takes a message in at once, or says False and has not: then it goes the way of all others."""

_EXTENSION: Final = "nafir.direct"
_END_OF_REQUEST: Final = b"\r\n\r\n"
_MOST_WAITING = 16
"""Messages that may wait for the application before its client is heard no more."""
_FRAMES_AT_ONCE = 32
"""Taken in before others have their turn: at most a millisecond."""
_SHORTEST_WAIT_S = 0.01
"""Once a budget is spent: more comes at once then, which costs less than many small pieces."""
_MOST_FRAGMENTS = 64
"""Of a message, that wait in pieces."""


def _no_allowance(_: Allowance) -> None:
    """Where a server has no budgets."""


@dataclass(frozen=True)
class FastPath:
    """Past ASGI, in order with what goes by way of it."""

    write: Callable[[Sequence[bytes]], bool]
    """Sends binary messages at once, or says False and has not sent any."""
    listen: Callable[[Hear], None]
    """From now on, whoever is given is told of messages before which none waits, if they come in one piece; but not of
    poses of the listener that a newer one follows directly."""
    allow: Callable[[Allowance], None] = _no_allowance
    """Has the client's budget fill at this rate."""
    is_open: Callable[[], bool] = lambda: True
    """Whether the client is still there, as far as is known."""


def direct_way(scope: Mapping[str, Any]) -> FastPath | None:
    """That of a connection, where its server has one."""
    way: FastPath | None = scope.get("extensions", {}).get(_EXTENSION, {}).get("way")
    return way


def watched(
    scope: MutableMapping[str, Any], *, sent: Callable[[Sequence[bytes]], None], heard: Callable[[str | bytes], None]
) -> MutableMapping[str, Any]:
    """A scope that tells of what went the direct way: of what was `sent`, and of what was `heard`."""
    way = direct_way(scope)
    if way is None:
        return scope

    def write(payloads: Sequence[bytes]) -> bool:
        is_sent = way.write(payloads)
        if is_sent:
            sent(payloads)
        return is_sent

    def listen(hear: Hear) -> None:
        def hear_watched(message: str | bytes) -> bool:
            is_heard = hear(message)
            if is_heard:
                heard(message)
            return is_heard

        way.listen(hear_watched)

    return {
        **scope,
        "extensions": {**scope["extensions"], _EXTENSION: {"way": replace(way, write=write, listen=listen)}},
    }


class _Handshake(ServerProtocol):
    """The library's state of a connection, whose refusals to open it are problem documents."""

    def reject(self, status: HTTPStatus | int, text: str) -> Response:
        response = super().reject(status, text)
        document = problem(status, "handshake_refused", text.strip() or HTTPStatus(status).phrase)
        response.body = bytes(document.body)
        for name in ("Content-Type", "Content-Length"):
            del response.headers[name]
            response.headers[name] = document.headers[name]
        return response


class WebSocketProtocol(WebSocketsSansIOProtocol):
    """For uvicorn, by `ws="server.api.web_socket:WebSocketProtocol"`, without extensions of the protocol's own: what is
    written here is neither compressed nor cut."""

    _hear: Hear | None = None
    _cutter: FrameSplitter | None = None
    _has_failed = False
    """Whether the client broke the protocol, and was told so."""
    _budget: Budget | None = None
    _next_slice: asyncio.Handle | None = None
    """When what waits is taken in, or reading goes on: until then nothing is read."""
    _pong: bytes = b""
    """The newest that there was no room to send."""
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
        """That of the HTTP connection which became this. It is in use once the application listens; until then it is
        another's who comes when there is no other. `turns` are those of requests, which a handshake is."""
        self._seat, self._leave_room, self._turns = seat, leave_room, turns

    async def run_asgi(self) -> None:
        """In turn with requests; not at all where the client has gone by then."""
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
            self._seat = self._leave_room = None  # which hold the transport and this
        super().connection_lost(exc)
        if self._next_slice is not None:
            self._next_slice.cancel()
            self._next_slice = None

    def end_if_overdue(self, now_s: float) -> None:
        """Called now and then. A transport that closes first sends what waits, to which a client that does not read
        never lets it come."""
        if not self.transport.is_closing():
            return
        if self._closing_since_s is None:
            self._closing_since_s = now_s
        elif now_s - self._closing_since_s > self.close_timeout:
            reset(self.transport)

    def handle_connect(self, event: Request) -> None:
        super().handle_connect(event)
        if not self.handshake_complete:  # as it is where the request was refused
            self.scope["extensions"][_EXTENSION] = {
                "way": FastPath(self._write, self._listen, self._allow, self._is_open)
            }

    def on_task_complete(self, task: asyncio.Task[None]) -> None:
        """The application is done. It holds this protocol by the way, and is held by whom it has listen: with neither,
        nothing of either waits for the collector."""
        super().on_task_complete(task)
        self._hear = None
        self.scope["extensions"].pop(_EXTENSION, None)

    def data_received(self, data: bytes) -> None:
        if self._has_failed:
            return  # the client does not know yet
        if self._cutter is None:
            was_open = self.handshake_initiated
            super().data_received(data)
            # With bytes behind the request, the parser may be in the midst of a frame.
            is_request = data.partition(_END_OF_REQUEST)[1:] == (_END_OF_REQUEST, b"")
            if is_request and self.handshake_initiated and not was_open:
                self._cutter = FrameSplitter(self.config.ws_max_size)
            return
        self._spend(READ_COST, len(data))
        if self._next_slice is None:
            self._take_slice(data)
        else:  # reading has been resumed by others
            self._cutter.keep(data)
            self.transport.pause_reading()

    def _take_slice(self, data: bytes = b"") -> None:
        """Take in a few frames, and see when to go on."""
        assert self._cutter is not None
        cuts = self._cutter.cut(data, most=_FRAMES_AT_ONCE)
        unheard: list[bytes] = []
        for cut, then in zip_longest(cuts, cuts[1:]):
            if self._is_superseded(cut, then):
                self._spend(SUPERSEDED_COST)
                continue
            if cut.message is None:
                self._spend(OTHER_FRAME_COST * cut.frames)
            else:
                self._spend(message_cost(cut.message, is_text=cut.is_text))
            # After the first that is not heard, all wait their turn.
            if unheard or cut.message is None or not self._is_heard(cut.message, is_text=cut.is_text):
                unheard.append(cut.raw)
        if unheard:
            super().data_received(b"".join(unheard))
        self._go_on_later()

    def _go_on_later(self) -> None:
        """Read no more where more waits, or the budget is spent."""
        wait_s = 0.0 if self._budget is None else self._budget.wait_s
        if self._cutter is None or not (self._cutter.has_more or wait_s):
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
        if self.read_paused:  # until the application has taken in what waits
            return
        self._spend(0.0)
        self._take_slice()
        if self._next_slice is None and not self.read_paused and not self.transport.is_closing():
            self.transport.resume_reading()

    async def receive(self) -> ASGIReceiveEvent:
        message = await self.queue.get()
        if self.read_paused and self.queue.empty():
            self.read_paused = False
            if self._next_slice is None:
                # Not at once: what comes next would be heard before this message is returned.
                self._next_slice = self.loop.call_soon(self._go_on)
        return message

    def _spend(self, messages: float, nbytes: int = 0) -> None:
        now_s = self.loop.time()
        if self._budget is None:
            self._budget = Budget(USUAL, now_s)
        self._budget.spend(messages, nbytes, now_s)

    def _allow(self, allowance: Allowance) -> None:
        self._budget = Budget(allowance, self.loop.time())

    def _is_superseded(self, cut: ReceivedFrame, then: ReceivedFrame | None) -> bool:
        if self._hear is None or cut.message is None or then is None or then.message is None:
            return False
        return cut.is_text == then.is_text and supersedes(then.message, cut.message)

    def handle_cont(self, event: Frame) -> None:
        """However small the pieces are in which a message comes, few of them wait."""
        super().handle_cont(event)
        if len(self.frames) > _MOST_FRAGMENTS:
            self.frames = [b"".join(self.frames)]

    def send_receive_event_to_app(self) -> None:
        """uvicorn stops reading with every message, until the application has taken it in."""
        try:
            super().send_receive_event_to_app()
        except InvalidState:  # text that is none, before the connection is open or once the client closes it
            if self.conn.state is CONNECTING:
                self.transport.close()
        if self.read_paused and self.queue.qsize() < _MOST_WAITING:
            self.read_paused = False
            if self._next_slice is None:
                self.transport.resume_reading()

    def handle_parser_exception(self) -> None:
        """uvicorn closes the connection at once, and a client that is still sending then meets a reset in place of the
        reason: here it may finish, unheard, until it has closed its side or `close_timeout` is over (RFC 6455, 7.1.1).
        """
        if self.close_sent:
            return  # the application said so first
        failure = self.conn.close_sent
        if failure is None:  # a breach before the connection is open
            self.transport.close()
            return
        self.queue.put_nowait({"type": "websocket.disconnect", "code": failure.code, "reason": failure.reason})
        self.transport.write(b"".join(self.conn.data_to_send()))
        # To the application it is lost: what that may still send is no fault of its own.
        self.close_sent = self.disconnected = self._has_failed = True
        if not self.transport.can_write_eof():  # as with TLS, which has a close of its own
            self.transport.close()
            return
        self.transport.write_eof()
        self.close_timer = self.loop.call_later(self.close_timeout, self.transport.abort)
        if self.read_paused:
            self.read_paused = False
            self.transport.resume_reading()

    def handle_ping(self) -> None:
        """Of pings that came together the newest is answered, and of those that come while the client reads nothing the
        newest once it does (RFC 6455, 5.5.3)."""
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

    def _is_heard(self, message: bytes, *, is_text: bool) -> bool:
        if self._hear is None or self.close_sent or self.conn.state is not OPEN or not self.queue.empty():
            return False
        if not is_text:
            return self._hear(message)
        try:
            text = message.decode()
        except UnicodeDecodeError:
            return False  # uvicorn knows what to do
        return self._hear(text)

    def _listen(self, hear: Hear) -> None:
        self._hear = hear
        if self._seat is not None:
            self._seat.use()

    def _write(self, payloads: Sequence[bytes]) -> bool:
        is_open = self.handshake_complete and not self.close_sent and not self.transport.is_closing()
        if not is_open or not self.writable.is_set():
            return False
        self.transport.write(b"".join([part for payload in payloads for part in (header(len(payload)), payload)]))
        return True
