"""Streams for programs without asyncio: a thread of its own does the network, and an audio callback reads.

    with nafir_client.threaded.connect("ws://127.0.0.1:8000", scene="apartment") as stream:
        voice = stream.add_emitter(clip="woman-reading")
        samples = stream.read(512)  # in the callback of a sound card

`read` never waits: where nothing has arrived in time it gives silence, and counts an underrun. Other listeners of the
stream (`add_listener`) are read for themselves.
"""

import asyncio
import contextlib
import threading
from collections.abc import Callable, Coroutine, Iterable, Mapping
from concurrent.futures import Future
from types import TracebackType
from typing import Any, Self, TypeVar, Unpack

import numpy as np
import numpy.typing as npt

from nafir_client import stream as in_asyncio
from nafir_client.backoff import Backoff
from nafir_client.client import Client
from nafir_client.errors import ClosedError, NafirClientError
from nafir_client.playout import Playout, require_ears
from nafir_client.pose import Pose
from nafir_client.scene import Scene, Welcome
from nafir_client.session import EmitterOptions, Message, StreamOptions
from nafir_client.stream_statistics import ListenerStatistics, StreamStatistics
from nafir_client.wire import Block, Samples

T = TypeVar("T")
_OPEN_S = 60.0
_CALL_S = 15.0
"""How long calls that wait for the server may take."""


def connect(
    url: str,
    *,
    scene: str,
    api_key: str | None = None,
    reconnect: Backoff | None = Backoff(),  # noqa: B008  frozen
    patience_s: float = 0.0,
    on_message: Callable[[Message], None] | None = None,
    on_block: Callable[[Block], None] | None = None,
    output_rate: int | None = None,
    head: str | None = None,
    **options: Unpack[StreamOptions],
) -> "ThreadedStream":
    """A stream of a scene, which opens in `with`. Options are those of `nafir_client.connect`, and

    - `output_rate`: the rate at which `read` is called, by default the stream's;
    - `head`: with the output `ambisonics`, the head by which two ears hear the channels. Turns of the listener are then
      heard with the next `read`, without a way over the network;
    - `on_block`: gets every block as it arrives, to record it, say.

    `on_message` and `on_block` are called in the stream's thread and have to be quick. Where `on_block` raises, nothing
    more is read, `failure` says why, and `close` raises the same.
    """
    stream = in_asyncio.connect(
        url,
        scene=scene,
        api_key=api_key,
        reconnect=reconnect,
        patience_s=patience_s,
        on_message=on_message,
        **options,
    )
    return ThreadedStream(stream, Client(url, api_key=api_key), on_block=on_block, output_rate=output_rate, head=head)


class ThreadedEmitter:
    """A source of sound in a stream. `ThreadedStream.add_emitter` makes it. No method waits for the server."""

    def __init__(self, stream: "ThreadedStream", emitter: in_asyncio.Emitter) -> None:
        self._stream = stream
        self._emitter = emitter

    @property
    def id(self) -> str:
        return self._emitter.id

    @property
    def start_clock(self) -> int:
        """The clock from which on it is heard."""
        return self._emitter.start_clock

    def move(
        self, position: Iterable[float], *, yaw: float | None = None, orientation: Iterable[float] | None = None
    ) -> "Future[int]":
        """Move it; without yaw and orientation its front keeps its direction. The future has the pose's id."""
        pose = Pose.of(position, yaw=yaw, orientation=orientation)
        turned = None if yaw is None and orientation is None else pose.orientation
        return self._stream.run_later(lambda: self._emitter.move(pose.position, orientation=turned))

    @property
    def has_ended(self) -> bool:
        """Whether all sound of its clip has been heard."""
        return self._emitter.has_ended

    def set_gain(self, gain_db: float, *, ramp_s: float = 0.0) -> None:
        """Change its gain, by a ramp of so many seconds."""
        self._stream.run_later(lambda: self._emitter.set_gain(gain_db, ramp_s=ramp_s))

    def stop(self, *, at: int | None = None, fade_s: float = 0.01) -> None:
        """Let its clip fade out, from the clock `at` on or at once."""
        self._stream.run_later(lambda: self._emitter.stop(at=at, fade_s=fade_s))

    def remove(self) -> None:
        self._stream.run_later(self._emitter.remove)

    def write(self, samples: npt.ArrayLike) -> None:
        """Play samples (n,) at the stream's rate, any number at once. Beyond a second of them, the oldest that wait
        are dropped. Raises ValueError for an emitter that plays a clip."""
        self._stream.offer(self._emitter, np.array(samples, np.float32))


class ThreadedListener:
    """A listener of a stream beside its first, with a buffer of its own. `ThreadedStream.add_listener` makes it. Only
    `read` is for one thread at a time, and no method waits for the server."""

    def __init__(self, stream: "ThreadedStream", listener: in_asyncio.Listener, playout: Playout) -> None:
        self._stream = stream
        self._listener = listener
        self._playout = playout

    @property
    def id(self) -> str:
        return self._listener.id

    @property
    def pose(self) -> Pose:
        """Its newest pose."""
        return self._listener.pose

    @property
    def start_clock(self) -> int:
        """The clock of its first block."""
        return self._listener.start_clock

    @property
    def level(self) -> str:
        return self._listener.level

    @property
    def output_rate(self) -> int:
        """The rate of samples that are read."""
        return self._playout.output_rate

    @property
    def channels(self) -> int:
        """Those of samples that are read."""
        return self._playout.channels

    @property
    def delay_s(self) -> float:
        """How long sound waits before it is read."""
        return self._playout.delay_s

    @property
    def statistics(self) -> ListenerStatistics:
        self._listener.statistics.underruns = self._playout.underruns
        return self._listener.statistics

    @property
    def failure(self) -> NafirClientError | None:
        """Why nothing more will come; None while it is there."""
        return self._listener.failure

    def read(self, frames: int) -> Samples:
        """(frame, channel) the next frames to play. Silence where nothing has arrived, and after it was removed."""
        return self._playout.read(frames)

    def move(
        self, position: Iterable[float], *, yaw: float | None = None, orientation: Iterable[float] | None = None
    ) -> "Future[int]":
        """Move it, as often as you like: the newest pose counts. The future has the pose's id."""
        pose = Pose.of(position, yaw=yaw, orientation=orientation)
        self._playout.orientation = pose.orientation
        return self._stream.run_later(lambda: self._listener.move(pose.position, orientation=pose.orientation))

    def remove(self) -> None:
        """Take it out of the stream."""
        self._stream.run_later(self._listener.remove)


class ThreadedStream:
    """One scene and its first listener. Methods may be called from any thread, `read` from one at a time."""

    def __init__(
        self,
        stream: in_asyncio.Stream,
        client: Client,
        *,
        on_block: Callable[[Block], None] | None,
        output_rate: int | None,
        head: str | None,
    ) -> None:
        self._stream = stream
        self._client = client
        self._on_block = on_block
        self._output_rate = output_rate
        self._head = head
        self._playout: Playout | None = None
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="nafir-client", daemon=True)
        self._playing: set[Future[None]] = set()
        """What hands the blocks of each listener on."""
        self._tasks: set[asyncio.Task[Any]] = set()

    def __enter__(self) -> Self:
        self._thread.start()
        try:
            self._run(self._stream.__aenter__(), _OPEN_S + self._stream.patience_s)
            playout = self._new_playout(self._output_rate, self._head)
        except BaseException:
            self.close()
            raise
        playout.orientation = self._stream.listener.orientation
        self._playout = playout
        self._play(self._stream, playout, self._on_block)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the stream and its thread. Raises what an `on_block` has raised."""
        if not self._thread.is_alive():
            return
        try:
            self._run(self._stream.close(), _CALL_S)
            for playing in tuple(self._playing):
                playing.result(_CALL_S)
        finally:
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join(_CALL_S)
            if not self._thread.is_alive():  # else a callback does not return
                self._loop.close()

    @property
    def welcome(self) -> Welcome:
        return self._stream.welcome

    @property
    def scene(self) -> Scene:
        return self._stream.scene

    @property
    def sample_rate(self) -> int:
        """That of the stream: of samples that are written, and of clocks."""
        return self._stream.sample_rate

    @property
    def output_rate(self) -> int:
        """That of samples that are read."""
        return self._output_rate or self._stream.sample_rate

    @property
    def channels(self) -> int:
        """Those of samples that are read."""
        return self._stream.channels if self._playout is None else self._playout.channels

    @property
    def listener(self) -> Pose:
        """The newest pose of the first listener."""
        return self._stream.listener

    @property
    def level(self) -> str:
        return self._stream.level

    @property
    def failure(self) -> NafirClientError | None:
        """Why nothing more will come; None while the stream is open."""
        return self._stream.failure

    @property
    def delay_s(self) -> float:
        """How long sound waits before it is read."""
        return 0.0 if self._playout is None else self._playout.delay_s

    @property
    def statistics(self) -> StreamStatistics:
        if self._playout is not None:
            self._stream.statistics.underruns = self._playout.underruns
        return self._stream.statistics

    def read(self, frames: int) -> Samples:
        """(frame, channel) the next frames to play. Silence where nothing has arrived, and before and after the
        stream."""
        return np.zeros((frames, 2), np.float32) if self._playout is None else self._playout.read(frames)

    def move_listener(
        self, position: Iterable[float], *, yaw: float | None = None, orientation: Iterable[float] | None = None
    ) -> "Future[int]":
        """Move the first listener, as often as you like: the newest pose counts. The future has the pose's id."""
        pose = Pose.of(position, yaw=yaw, orientation=orientation)
        if self._playout is not None:
            self._playout.orientation = pose.orientation
        return self.run_later(lambda: self._stream.move_listener(pose.position, orientation=pose.orientation))

    def add_emitter(self, **options: Unpack[EmitterOptions]) -> ThreadedEmitter:
        """Add an emitter and wait until it is heard, some milliseconds. Raises RefusedError, another NafirClientError
        if the stream ends first, or TimeoutError."""
        return self._run(self._add(options), _CALL_S)

    def add_emitter_later(self, **options: Unpack[EmitterOptions]) -> "Future[ThreadedEmitter]":
        """The same without waiting."""
        return self.run_later(lambda: self._add(options))

    def add_listener(
        self,
        position: Iterable[float] | None = None,
        *,
        yaw: float | None = None,
        orientation: Iterable[float] | None = None,
        id: str | None = None,  # noqa: A002  the protocol's word, as for emitters
        hrtf: str | None = None,
        head: str | None = None,
        output_rate: int | None = None,
        on_block: Callable[[Block], None] | None = None,
    ) -> ThreadedListener:
        """Add a listener who hears the same emitters, and wait until it is there, some milliseconds.

        Options are those of `nafir_client.Stream.add_listener`, and `head`, `output_rate` and `on_block` as `connect`
        has them for the first listener: of ambisonics one may hear through a head of its own, and another have the
        channels as they come. Raises RefusedError if the server does not take it, after which the stream goes on as it
        was, another NafirClientError if the stream ends first, TimeoutError, and ValueError.
        """
        playout = self._new_playout(output_rate, head)
        adding = self._stream.add_listener(position, yaw=yaw, orientation=orientation, id=id, hrtf=hrtf)
        listener = self._run(adding, _CALL_S)
        playout.orientation = listener.pose.orientation
        self._play(listener, playout, on_block)
        return ThreadedListener(self, listener, playout)

    def set_level(self, level: str) -> None:
        """Choose a quality level, or `auto`."""
        self.run_later(lambda: self._stream.set_level(level))

    def set_door(self, door: str, openness: float) -> None:
        """Open a door of the scene so far, from 0, shut, to 1."""
        self.run_later(lambda: self._stream.set_door(door, openness))

    def set_effects(self, effects: Mapping[str, bool | None], *, output: str | None = None) -> None:
        """Switch effects on or off; None leaves one to the server's plan."""
        self.run_later(lambda: self._stream.set_effects(effects, output=output))

    def run_later(self, begin: Callable[[], Coroutine[Any, Any, T]]) -> "Future[T]":
        """Have the stream's thread do something. The future has the result, or the error if the stream has ended."""
        later: Future[T] = Future()

        def start() -> None:
            task = self._loop.create_task(begin())
            self._tasks.add(task)  # a task that nobody refers to could be collected while it runs
            task.add_done_callback(lambda done: self._settle(done, later))

        self._call_soon(start, later)
        return later

    def offer(self, emitter: in_asyncio.Emitter, samples: Samples) -> None:
        emitter.require_live()
        self._call_soon(lambda: emitter.offer(samples), None)

    def _call_soon(self, call: Callable[[], None], later: "Future[T] | None") -> None:
        try:
            self._loop.call_soon_threadsafe(call)
        except RuntimeError:  # the loop is closed
            if later is not None:
                later.set_exception(ClosedError("the stream is closed"))

    def _settle(self, task: "asyncio.Task[T]", later: "Future[T]") -> None:
        self._tasks.discard(task)
        if task.cancelled():
            later.cancel()
        elif (error := task.exception()) is not None:
            later.set_exception(error)
        else:
            later.set_result(task.result())

    async def _add(self, options: EmitterOptions) -> ThreadedEmitter:
        return ThreadedEmitter(self, await self._stream.add_emitter(**options))

    def _run(self, coroutine: Coroutine[Any, Any, T], timeout_s: float) -> T:
        """The result of a coroutine in the stream's thread. Raises TimeoutError, after which it is cancelled."""
        running = asyncio.run_coroutine_threadsafe(coroutine, self._loop)
        try:
            return running.result(timeout_s)
        except TimeoutError:
            running.cancel()
            raise

    def _new_playout(self, output_rate: int | None, head: str | None) -> Playout:
        """What plays blocks. Gets the filters of a head, if there is to be one."""
        welcome, filters = self._stream.welcome, None
        if head is not None:
            order = require_ears(welcome, output_rate or welcome.sample_rate)
            filters = self._client.head_filters(head, order=order, sample_rate=welcome.sample_rate)
        return Playout(welcome, output_rate=output_rate, filters=filters)

    def _play(
        self,
        listener: in_asyncio.Stream | in_asyncio.Listener,
        playout: Playout,
        on_block: Callable[[Block], None] | None,
    ) -> None:
        """Have the stream's thread hand the blocks of a listener on as they arrive."""

        async def play() -> None:
            with contextlib.suppress(NafirClientError):  # which is the `failure`
                async for block in listener:
                    playout.push(block)
                    if on_block is None:
                        continue
                    try:
                        on_block(block)
                    except Exception as exc:
                        failure = NafirClientError(f"on_block failed: {exc!r}")
                        failure.__cause__ = exc
                        await listener.fail(failure)
                        raise

        playing = asyncio.run_coroutine_threadsafe(play(), self._loop)
        self._playing.add(playing)
        playing.add_done_callback(self._played)

    def _played(self, playing: "Future[None]") -> None:
        if playing.exception() is None:  # else `close` raises it
            self._playing.discard(playing)
