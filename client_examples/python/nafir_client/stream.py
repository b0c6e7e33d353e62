"""A stream in asyncio: `async with connect(URL, scene=...) as stream`.

One task reads from the socket and makes the connection anew when it is lost; another writes. What a stream has to say
waits in the outbox of its session, where newer poses take the place of older ones. Blocks of each listener wait to be
taken; if they are not, the oldest are dropped and counted.

A stream is its first listener: iterating it takes that one's blocks. `Stream.add_listener` adds others, who hear the
same emitters at the same clock.
"""

import asyncio
import contextlib
import itertools
import random
import time
from collections.abc import AsyncIterator, Callable, Container, Iterable, Mapping
from types import TracebackType
from typing import Any, Final, Self, TypeVar, Unpack

import numpy as np
import numpy.typing as npt
from websockets.asyncio.client import ClientConnection
from websockets.asyncio.client import connect as connect_socket
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException

from nafir_client.address import stream_url
from nafir_client.arrivals import Arrivals
from nafir_client.backoff import Backoff
from nafir_client.client import refused
from nafir_client.errors import (
    ClosedError,
    ConnectionLostError,
    NafirClientError,
    RefusedError,
    UnreachableError,
)
from nafir_client.live_input import LiveInput
from nafir_client.pose import Pose, Position
from nafir_client.scene import Scene, Welcome
from nafir_client.session import (
    EmitterOptions,
    Message,
    Session,
    SessionEmitter,
    SessionListener,
    StreamOptions,
    refusal,
    require_id,
)
from nafir_client.stream_statistics import ListenerStatistics, StreamStatistics
from nafir_client.wire import Block

T = TypeVar("T")
_OPEN_S = 10.0
_CLOSE_S = 1.0
_WELCOME_S = 30.0
"""How long the server may take to answer a hello: it may measure what ambisonics of a scene cost first."""
_PING_EVERY_S = 1.0
_SILENCE_S = 6.0
"""A connection over which no answer to a ping came for so long is lost."""
_KEPT_S = 4.0
"""Blocks of this much time may wait to be taken."""
_MOST_WAITING = 1_000
"""Messages that may wait to be sent before callers have to wait."""
_OF_CLIPS: Final = (
    "loop",
    "start_at",
    "stop_at",
    "offset_s",
    "loop_start_s",
    "loop_end_s",
    "remove_when_ended",
)
_LIVE_S = 1.0
"""Samples of this much time may wait in a live emitter."""


def connect(
    url: str,
    *,
    scene: str,
    api_key: str | None = None,
    reconnect: Backoff | None = Backoff(),  # noqa: B008  frozen
    patience_s: float = 0.0,
    on_message: Callable[[Message], None] | None = None,
    **options: Unpack[StreamOptions],
) -> "Stream":
    """A stream of a scene, which opens in `async with`.

    `url` is the server's, such as `ws://127.0.0.1:8000`. `reconnect` says how a lost connection is made anew; with None
    it ends the stream. For `patience_s` seconds the first connection is tried again, too, if the server is not there or
    is busy. `on_message` gets every text message of the server in its order among blocks: it has to be quick. Other
    `options` are those of the stream.
    """
    return Stream(
        url,
        Session(scene, options),
        api_key=api_key,
        reconnect=reconnect,
        patience_s=patience_s,
        on_message=on_message,
    )


class Emitter:
    """A source of sound in a stream. `Stream.add_emitter` makes it."""

    def __init__(self, stream: "Stream", state: SessionEmitter) -> None:
        self._stream = stream
        self._state = state

    @property
    def id(self) -> str:
        return self._state.id

    @property
    def start_clock(self) -> int:
        """The clock from which on it is heard, in the present connection."""
        return self._state.start_clock

    @property
    def samples_dropped(self) -> int:
        """Live samples that came faster than the server plays them."""
        return 0 if self._state.live is None else self._state.live.dropped

    async def move(
        self, position: Iterable[float], *, yaw: float | None = None, orientation: Iterable[float] | None = None
    ) -> int:
        """Move it; without yaw and orientation its front keeps its direction. Returns the pose's id."""
        return await self._stream.move_emitter(self._state, position, yaw=yaw, orientation=orientation)

    @property
    def has_ended(self) -> bool:
        """Whether all sound of its clip has been heard."""
        return self._state.has_ended

    async def set_gain(self, gain_db: float, *, ramp_s: float = 0.0) -> None:
        """Change its gain, by a ramp of so many seconds."""
        await self._stream.change(lambda session: session.set_gain(self._state, gain_db, ramp_s))

    async def stop(self, *, at: int | None = None, fade_s: float = 0.01) -> None:
        """Let its clip fade out, from the clock `at` on or at once."""
        await self._stream.change(lambda session: session.stop_emitter(self._state, at, fade_s))

    async def wait_until_ended(self) -> None:
        """Return once all sound of its clip has been heard. Raises NafirClientError if the stream ends first."""
        await self._stream.wait_until_ended(self._state)

    async def remove(self) -> None:
        await self._stream.change(lambda session: session.remove_emitter(self._state))

    async def write(self, samples: npt.ArrayLike) -> None:
        """Play samples (n,) at the stream's rate, full scale 1, any number at once; waits while enough of them wait.

        Raises ValueError if the emitter is not live.
        """
        await self._stream.write(self._state, samples)

    def require_live(self) -> None:
        """Raises ValueError for an emitter that plays a clip."""
        _live(self._state)

    def offer(self, samples: npt.ArrayLike) -> None:
        """The same without waiting, as a microphone needs it: beyond a second the oldest samples are dropped."""
        self._stream.offer(self._state, samples)


class Listener:
    """A listener of a stream beside its first. `Stream.add_listener` makes it. Iterating takes its blocks, until it is
    removed; a NafirClientError says that it cannot be there any more, though the stream may go on."""

    def __init__(self, stream: "Stream", state: SessionListener, arrivals: Arrivals) -> None:
        self._stream = stream
        self._state = state
        self._arrivals = arrivals

    @property
    def id(self) -> str:
        return self._state.id

    @property
    def pose(self) -> Pose:
        """Its newest pose."""
        return self._state.pose

    @property
    def start_clock(self) -> int:
        """The clock of its first block, in the present connection."""
        return self._state.start_clock

    @property
    def sample_clock(self) -> int:
        """The clock of the frame after its newest block."""
        return self._state.next_clock

    @property
    def level(self) -> str:
        """Its present quality level, which under load may be another than that of others."""
        return self._state.level

    @property
    def statistics(self) -> ListenerStatistics:
        return self._state.statistics

    @property
    def failure(self) -> NafirClientError | None:
        """Why no more blocks of it will come: ClosedError after it was removed; None while it is there."""
        return self._arrivals.failure

    def __aiter__(self) -> AsyncIterator[Block]:
        return self

    async def __anext__(self) -> Block:
        """Its oldest block that has not been taken. Raises RefusedError if a new connection may not have it again, or
        another NafirClientError if the stream has ended."""
        return await self._arrivals.take()

    async def move(
        self, position: Iterable[float], *, yaw: float | None = None, orientation: Iterable[float] | None = None
    ) -> int:
        """Move it: metres, and a yaw in radians or a quaternion. Returns the pose's id, which its blocks name once it
        hears from there. Raises ValueError for numbers that are no pose, and `failure` if it is not there any more."""
        return await self._stream.move_added_listener(
            self._state, Pose.of(position, yaw=yaw, orientation=orientation), self._arrivals
        )

    async def remove(self) -> None:
        """Take it out of the stream. Its blocks that have arrived can still be taken."""
        await self._stream.remove_listener(self._state, self._arrivals)

    async def fail(self, failure: NafirClientError) -> None:
        """Take it out of the stream because nobody takes its blocks any more: `failure` says why."""
        await self._stream.remove_listener(self._state, self._arrivals, failure)


class Stream:
    """One scene and its first listener, for as long as it is open. Iterating takes the first listener's blocks."""

    def __init__(
        self,
        url: str,
        session: Session,
        *,
        api_key: str | None,
        reconnect: Backoff | None,
        patience_s: float,
        on_message: Callable[[Message], None] | None,
    ) -> None:
        self.url = url
        self._address = stream_url(url)
        self._session = session
        self._headers = {} if api_key is None else {"Authorization": f"Bearer {api_key}"}
        self._backoff = reconnect
        self.patience_s = patience_s
        self._on_message = on_message
        self._arrivals = Arrivals()
        self._arrivals_of: dict[str, Arrivals] = {}
        """By the ids of listeners beside the first."""
        self._has_outgoing = asyncio.Event()
        self._has_room = asyncio.Event()
        self._has_message = asyncio.Event()
        self._adding: dict[str, asyncio.Future[None]] = {}
        """By the ids of emitters that are not heard yet."""
        self._joining: dict[str, asyncio.Future[None]] = {}
        """By the ids of listeners who are not there yet."""
        self._numbers = {"emitter": itertools.count(1), "listener": itertools.count(2)}
        self._task: asyncio.Task[None] | None = None
        self._failure: NafirClientError | None = None
        self.is_connected = False
        """Whether there is a connection at present."""

    async def __aenter__(self) -> Self:
        started_s = time.monotonic()
        socket = await self._connect_again(Backoff(give_up_after_s=self.patience_s), started_s, None)
        self._task = asyncio.create_task(self._run(socket))
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """End the stream. Blocks that have arrived can still be taken."""
        if self._task is not None:
            self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task
        self._end(ClosedError("the stream is closed"))

    @property
    def welcome(self) -> Welcome:
        """What the server has agreed to. Raises ClosedError before the stream is open."""
        if self._session.welcome is None:
            raise ClosedError("the stream is not open yet")
        return self._session.welcome

    @property
    def scene(self) -> Scene:
        return self.welcome.scene

    @property
    def sample_rate(self) -> int:
        return self.welcome.sample_rate

    @property
    def block_size(self) -> int:
        return self.welcome.block_size

    @property
    def channels(self) -> int:
        return self.welcome.channels

    @property
    def listener(self) -> Pose:
        """The newest pose of the first listener."""
        start = self.scene.listener
        return self._session.listener or Pose.of(start.position, yaw=start.yaw)

    @property
    def level(self) -> str:
        """The present quality level."""
        return self._session.level

    @property
    def sample_clock(self) -> int:
        """The clock of the frame after the newest block."""
        return self._session.next_clock

    @property
    def statistics(self) -> StreamStatistics:
        return self._session.statistics

    @property
    def failure(self) -> NafirClientError | None:
        """Why no more blocks will come; None while the stream is open."""
        return self._arrivals.failure

    def __aiter__(self) -> AsyncIterator[Block]:
        return self

    async def __anext__(self) -> Block:
        """The oldest block that has not been taken. Waits while a lost connection is made anew. Raises
        NafirClientError if that is given up."""
        return await self._arrivals.take()

    async def move_listener(
        self, position: Iterable[float], *, yaw: float | None = None, orientation: Iterable[float] | None = None
    ) -> int:
        """Move the first listener: metres, and a yaw in radians or a quaternion. Returns the pose's id, which
        its blocks name once it hears from there. Raises ValueError for numbers that are no pose."""
        pose = Pose.of(position, yaw=yaw, orientation=orientation)
        return await self.change(lambda session: session.move_listener(pose, time.monotonic()))

    async def add_emitter(self, **options: Unpack[EmitterOptions]) -> Emitter:
        """Add an emitter and return once it is heard. Raises RefusedError, or another NafirClientError if the stream
        ends first, and ValueError for an id or numbers that no server takes."""
        fields, live = self._emitter_fields(options)
        added = asyncio.get_running_loop().create_future()
        state = await self.change(lambda session: session.add_emitter(fields, live))
        self._adding[state.id] = added
        try:
            await added
        except BaseException:
            self._session.remove_emitter(state)
            self._has_outgoing.set()
            raise
        finally:
            _drop(self._adding, state.id, added)
        return Emitter(self, state)

    async def add_listener(
        self,
        position: Iterable[float] | None = None,
        *,
        yaw: float | None = None,
        orientation: Iterable[float] | None = None,
        id: str | None = None,  # noqa: A002  the protocol's word, as for emitters
        hrtf: str | None = None,
    ) -> Listener:
        """Add a listener who hears the same emitters at the same clock, and return once it is there. Without a position
        it begins where the scene suggests. `hrtf` names its head, by default that of the stream; without an `id` it
        gets one.

        Raises RefusedError if the server does not take it, with its id as `listener`: too_many_listeners, server_busy,
        position_out_of_bounds, unknown_hrtf and others. The stream then goes on as it was. Raises another
        NafirClientError if the stream ends first, and ValueError for an id or numbers that no server takes.
        """
        if position is None:
            start = self.scene.listener
            position = start.position
            yaw = start.yaw if yaw is None and orientation is None else yaw
        pose = Pose.of(position, yaw=yaw, orientation=orientation)
        identifier = self._free_id("listener", self._session.listeners) if id is None else require_id(id)
        state = await self.change(lambda session: session.add_listener(identifier, pose, hrtf))
        joining = self._joining[identifier] = asyncio.get_running_loop().create_future()
        arrivals = self._arrivals_of[identifier] = Arrivals()
        try:
            await joining
        except BaseException:
            self._session.remove_listener(state)
            self._has_outgoing.set()
            _drop(self._arrivals_of, identifier, arrivals)
            raise
        finally:
            _drop(self._joining, identifier, joining)
        return Listener(self, state, arrivals)

    async def move_added_listener(self, state: SessionListener, pose: Pose, arrivals: Arrivals) -> int:
        if arrivals.failure is not None:
            raise arrivals.failure
        return await self.change(lambda session: session.move_added_listener(state, pose, time.monotonic()))

    async def remove_listener(
        self, state: SessionListener, arrivals: Arrivals, failure: NafirClientError | None = None
    ) -> None:
        """It ends with `failure`, or as one that was removed."""
        if arrivals.failure is not None:
            return
        await self.change(lambda session: session.remove_listener(state))
        _drop(self._arrivals_of, state.id, arrivals)
        arrivals.end(failure or ClosedError(f"listener {state.id!r} was removed"))

    async def fail(self, failure: NafirClientError) -> None:
        """Nobody takes the blocks of the first listener any more, because of `failure`."""
        self._arrivals.end(failure)

    async def wait_until_ended(self, state: SessionEmitter) -> None:
        while not state.has_ended:
            self._require_open()
            self._has_message.clear()
            await self._has_message.wait()

    async def set_level(self, level: str) -> None:
        """Choose a quality level, or `auto`. A `level_changed` says from when on it is heard."""
        await self.change(lambda session: session.set_level(level))

    async def set_door(self, door: str, openness: float) -> None:
        """Open a door of the scene so far, from 0, shut, to 1. `Welcome.doors` has those there are."""
        await self.change(lambda session: session.set_door(door, openness))

    async def set_effects(self, effects: Mapping[str, bool | None], *, output: str | None = None) -> None:
        """Switch effects on or off; None leaves one to the server's plan. `output` is `headphones` or `mono`."""
        await self.change(lambda session: session.set_effects(effects, output))

    async def move_emitter(
        self,
        state: SessionEmitter,
        position: Iterable[float],
        *,
        yaw: float | None = None,
        orientation: Iterable[float] | None = None,
    ) -> int:
        pose = Pose.of(position, yaw=yaw, orientation=orientation)
        turned = None if yaw is None and orientation is None else pose.orientation
        place: Position = pose.position
        return await self.change(lambda session: session.move_emitter(state, place, turned, time.monotonic()))

    async def write(self, state: SessionEmitter, samples: npt.ArrayLike) -> None:
        live, left = _live(state), _mono(samples)
        # A block at a time makes the wait short, whatever is written at once.
        while len(left):
            while live.waiting >= self.block_size:
                self._require_open()
                self._has_room.clear()
                await self._has_room.wait()
            self._require_open()
            live.write(left[: self.block_size])
            left = left[self.block_size :]
            self._pump()

    def offer(self, state: SessionEmitter, samples: npt.ArrayLike) -> None:
        _live(state).write(_mono(samples))
        self._pump()

    async def change(self, put: Callable[[Session], T]) -> T:
        """Have the session say something. Waits while very much waits to be said."""
        self._require_open()
        while len(self._session.outbox) >= _MOST_WAITING:
            self._has_room.clear()
            await self._has_room.wait()
            self._require_open()
        done = put(self._session)
        self._has_outgoing.set()
        return done

    def _emitter_fields(self, options: EmitterOptions) -> tuple[dict[str, Any], LiveInput | None]:
        """The fields of an `add_emitter`, and where samples wait if it is live."""
        yaw, orientation = options.get("yaw"), options.get("orientation")
        pose = Pose.of(options.get("position", self.scene.emitter.position), yaw=yaw, orientation=orientation)
        given = options.get("id")
        identifier = self._free_id("emitter", self._session.emitters) if given is None else require_id(given)
        fields: dict[str, Any] = {"id": identifier, "position": pose.position}
        if yaw is not None or orientation is not None:
            fields["orientation"] = pose.orientation
        if "gain_db" in options:
            fields["gain_db"] = options["gain_db"]
        if "directivity" in options:
            fields["directivity"] = dict(options["directivity"])
        if "jitter_ms" in options:
            fields["jitter_ms"] = options["jitter_ms"]
        clip = options.get("clip")
        if clip is not None:
            fields.update({name: options[name] for name in _OF_CLIPS if name in options})
            return {"loop": True, **fields, "clip": clip}, None
        return {**fields, "live": True}, self._session.live_input(options.get("ahead_blocks", 4), _LIVE_S)

    def _free_id(self, kind: str, taken: Container[str]) -> str:
        return next(name for number in self._numbers[kind] if (name := f"{kind}-{number}") not in taken)

    async def _connect_again(
        self, backoff: Backoff, started_s: float, lost: ConnectionLostError | None
    ) -> ClientConnection:
        """Connect, and try again as long as that may help. Raises what the last attempt met with."""
        advised_s = None if lost is None else lost.retry_after_s
        for attempt in itertools.count():
            if lost is not None or attempt:
                await asyncio.sleep(backoff.wait_s(attempt, advised_s, random.Random()))
            try:
                return await self._connect()
            except (UnreachableError, ConnectionLostError, RefusedError) as exc:
                advised_s = getattr(exc, "retry_after_s", None)
                wait_s = backoff.wait_s(attempt + 1, advised_s, random.Random())
                if not exc.is_passing or time.monotonic() + wait_s - started_s > backoff.give_up_after_s:
                    raise
        raise AssertionError

    async def _connect(self) -> ClientConnection:
        """A connection whose hello has been answered. Raises UnreachableError, ConnectionLostError or RefusedError."""
        try:
            # Without compression, which takes time and does not make audio smaller.
            socket = await connect_socket(
                self._address,
                compression=None,
                max_size=None,
                additional_headers=self._headers,
                open_timeout=_OPEN_S,
                close_timeout=_CLOSE_S,
                ping_interval=_SILENCE_S / 2,
                ping_timeout=_SILENCE_S / 2,
            )
        except InvalidStatus as exc:
            raise _turned_away(self.url, exc) from exc
        except (OSError, WebSocketException) as exc:
            raise UnreachableError(self.url, str(exc) or type(exc).__name__) from exc
        try:
            async with asyncio.timeout(_WELCOME_S):
                with contextlib.suppress(ConnectionClosed):  # a server that is not ready says so before it goes
                    await socket.send(self._session.first_message())
                self._session.greet(await socket.recv(), time.monotonic())
        except ConnectionClosed as exc:
            raise _lost(self.url, exc, None) from exc
        except TimeoutError as exc:
            await socket.close()
            raise UnreachableError(self.url, f"no answer to the hello came within {_WELCOME_S:g} s") from exc
        except NafirClientError:
            await socket.close()
            raise
        self.is_connected = True
        for identifier, added in self._adding.items():
            state = self._session.emitters.get(identifier)
            if state is not None and state.is_heard:
                _fulfil(added)
        for identifier, joining in self._joining.items():
            listener = self._session.listeners.get(identifier)
            if listener is not None and listener.is_there:
                _fulfil(joining)
        return socket

    async def _run(self, socket: ClientConnection) -> None:
        """Serve one connection after the other until the stream is closed or fails."""
        try:
            while True:
                lost = await self._serve(socket)
                self._session.disconnect()
                if self._backoff is None or not lost.is_passing:
                    raise lost
                socket = await self._connect_again(self._backoff, time.monotonic(), lost)
                self.statistics.reconnections += 1
        except NafirClientError as exc:
            self._end(exc)
        except Exception as exc:  # noqa: BLE001  a callback's: whoever waits for blocks has to learn of it
            failure = NafirClientError(f"the stream's task failed: {exc!r}")
            failure.__cause__ = exc
            self._end(failure)

    async def _serve(self, socket: ClientConnection) -> ConnectionLostError:
        """Read and write until the connection ends. Raises ProtocolError for what cannot be read."""
        others = asyncio.create_task(self._send(socket)), asyncio.create_task(self._ping())
        try:
            while True:
                self._receive(await socket.recv())
        except ConnectionClosed as exc:
            return _lost(self.url, exc, self._session.last_error)
        finally:
            self.is_connected = False
            for task in others:
                task.cancel()
            await asyncio.gather(*others, return_exceptions=True)
            await socket.close()

    async def _send(self, socket: ClientConnection) -> None:
        outbox = self._session.outbox
        with contextlib.suppress(ConnectionClosed):  # which the reader sees too
            while True:
                while (message := outbox.take()) is not None:
                    await socket.send(message)
                self._has_room.set()
                self._has_outgoing.clear()
                await self._has_outgoing.wait()

    async def _ping(self) -> None:
        while True:
            self._session.ping(time.monotonic())
            self._has_outgoing.set()
            await asyncio.sleep(_PING_EVERY_S)

    def _receive(self, data: str | bytes) -> None:
        received = self._session.receive(data, time.monotonic())
        if isinstance(received, Block):
            self._keep(received)
        elif received is not None:
            self._has_message.set()
            self._settle(received)
            if self._on_message is not None:
                self._on_message(received)
        self._pump()

    def _keep(self, block: Block) -> None:
        """Let a block wait for whoever takes it."""
        longest = round(_KEPT_S * self.sample_rate)
        if not block.listener:
            self.statistics.blocks_dropped += self._arrivals.put(block, longest=longest)
        elif (listener := self._session.listener_at(block.listener)) is not None:
            listener.statistics.blocks_dropped += self._arrivals_of[listener.id].put(block, longest=longest)

    def _settle(self, message: Message) -> None:
        """End the wait of whoever has added an emitter that is now heard or a listener who is now there, or is
        refused."""
        match message:
            case {"type": "emitter_added", "id": identifier}:
                _fulfil(self._adding.get(identifier))
            case {"type": "listener_added", "id": identifier}:
                _fulfil(self._joining.get(identifier))
            case {"type": "error"}:
                self._refuse(refusal(message))

    def _refuse(self, error: RefusedError) -> None:
        """Tell whoever has added what an error is about. A listener whom a new connection may not have ends."""
        state = self._session.refused_emitter(error)
        added = None if state is None else self._adding.get(state.id)
        if state is not None and added is not None and not added.done():
            self._session.forget_emitter(state, error)
            added.set_exception(error)
        if state is not None or (listener := self._session.take_refused_listener(error)) is None:
            return
        joining = self._joining.get(listener.id)
        if joining is not None and not joining.done():
            joining.set_exception(error)
        arrivals = self._arrivals_of.pop(listener.id, None)
        if arrivals is not None:
            arrivals.end(error)

    def _pump(self) -> None:
        self._session.pump()
        self._has_outgoing.set()
        self._has_room.set()

    def _require_open(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _end(self, failure: NafirClientError) -> None:
        if self._failure is None:
            self._failure = failure
        for added in (*self._adding.values(), *self._joining.values()):
            if not added.done():
                added.set_exception(self._failure)
        for arrivals in (self._arrivals, *self._arrivals_of.values()):
            arrivals.end(failure)
        for event in (self._has_room, self._has_message, self._has_outgoing):
            event.set()


def _fulfil(wait: "asyncio.Future[None] | None") -> None:
    if wait is not None and not wait.done():
        wait.set_result(None)


def _drop(entries: dict[str, T], identifier: str, own: T) -> None:
    """Take one's own entry away. By now there may be that of another with the same id."""
    if entries.get(identifier) is own:
        del entries[identifier]


def _live(state: SessionEmitter) -> LiveInput:
    if state.live is None:
        raise ValueError(f"emitter {state.id!r} plays a clip: only a live emitter takes samples")
    return state.live


def _mono(samples: npt.ArrayLike) -> npt.NDArray[np.float32]:
    mono = np.asarray(samples, np.float32)
    if mono.ndim != 1:
        raise ValueError(f"samples: a live emitter has one channel, so one axis, not {mono.ndim}")
    return mono


def _turned_away(url: str, exc: InvalidStatus) -> UnreachableError | RefusedError:
    """The error for an answer that opens no WebSocket."""
    response = exc.response
    error = refused(url, response.status_code, bytes(response.body or b""), response.headers.get("Retry-After"))
    # What the web server says where nothing of Nafir's is at the address.
    if response.status_code == 404 or (isinstance(error, RefusedError) and error.code == "handshake_refused"):
        return UnreachableError(url, str(exc), is_passing=False)
    return error


def _lost(url: str, exc: ConnectionClosed, error: RefusedError | None) -> ConnectionLostError:
    """The end of a connection, with the advice of the error before it."""
    code = None if exc.rcvd is None else exc.rcvd.code
    advised_s = None if error is None else error.retry_after_s
    return ConnectionLostError(url, str(exc) or "the connection is lost", close_code=code, retry_after_s=advised_s)
