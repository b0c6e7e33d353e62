"""Streams for programs without asyncio: a thread of its own does the network, and an audio callback reads.

    with nafir_client.threaded.connect("ws://127.0.0.1:8000", scene="apartment") as stream:
        voice = stream.add_emitter(clip="woman-reading")
        samples = stream.read(512)  # in the callback of a sound card

`read` never waits: where nothing has arrived in time it gives silence, and counts an underrun.
"""

import asyncio
import threading
from collections.abc import Callable, Coroutine, Iterable, Mapping
from concurrent.futures import Future
from types import TracebackType
from typing import Any, Self, TypeVar, Unpack

import numpy as np
import numpy.typing as npt

from nafir_client import stream as in_asyncio
from nafir_client.ambisonics import Ears
from nafir_client.backoff import Backoff
from nafir_client.client import Client
from nafir_client.errors import ClosedError, NafirClientError
from nafir_client.jitter_buffer import JitterBuffer
from nafir_client.pose import FORWARD, Orientation, Pose
from nafir_client.scene import Scene, Welcome
from nafir_client.session import EmitterOptions, Message, StreamOptions
from nafir_client.stream_statistics import StreamStatistics
from nafir_client.wire import Block, Samples

T = TypeVar("T")
_OPEN_S = 60.0
_LONGEST_S = 0.5
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

    `on_message` and `on_block` are called in the stream's thread and have to be quick.
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


class ThreadedStream:
    """One listener in one scene. Methods may be called from any thread, `read` from one at a time."""

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
        self._orientation: Orientation = FORWARD
        self._ears: Ears | None = None
        self._buffer: JitterBuffer | None = None
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="nafir-client", daemon=True)
        self._receiving: Future[None] | None = None
        self._tasks: set[asyncio.Task[Any]] = set()
        self.failure: NafirClientError | None = None
        """Why nothing more will come; None while the stream is open."""

    def __enter__(self) -> Self:
        self._thread.start()
        try:
            self._run(self._stream.__aenter__(), _OPEN_S + self._stream.patience_s)
            self._prepare()
        except BaseException:
            self.close()
            raise
        self._receiving = asyncio.run_coroutine_threadsafe(self._receive(), self._loop)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the stream and its thread."""
        if not self._thread.is_alive():
            return
        self._run(self._stream.close(), _CALL_S)
        if self._receiving is not None:
            self._receiving.result(_CALL_S)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
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
        return self._stream.channels if self._ears is None else 2

    @property
    def listener(self) -> Pose:
        """The newest pose of the listener."""
        return self._stream.listener

    @property
    def level(self) -> str:
        return self._stream.level

    @property
    def delay_s(self) -> float:
        """How long sound waits before it is read."""
        return 0.0 if self._buffer is None else self._buffer.delay_s

    @property
    def statistics(self) -> StreamStatistics:
        if self._buffer is not None:
            self._stream.statistics.underruns = self._buffer.underruns
        return self._stream.statistics

    def read(self, frames: int) -> Samples:
        """(frame, channel) the next frames to play. Silence where nothing has arrived, and before and after the
        stream."""
        if self._buffer is None:
            return np.zeros((frames, 2), np.float32)
        samples = self._buffer.read(frames)
        return samples if self._ears is None else self._ears.process(samples, self._orientation)

    def move_listener(
        self, position: Iterable[float], *, yaw: float | None = None, orientation: Iterable[float] | None = None
    ) -> "Future[int]":
        """Move the listener, as often as you like: the newest pose counts. The future has the pose's id."""
        pose = Pose.of(position, yaw=yaw, orientation=orientation)
        self._orientation = pose.orientation
        return self.run_later(lambda: self._stream.move_listener(pose.position, orientation=pose.orientation))

    def add_emitter(self, **options: Unpack[EmitterOptions]) -> ThreadedEmitter:
        """Add an emitter and wait until it is heard, some milliseconds. Raises RefusedError, another NafirClientError
        if the stream ends first, or TimeoutError."""
        return self._run(self._add(options), _CALL_S)

    def add_emitter_later(self, **options: Unpack[EmitterOptions]) -> "Future[ThreadedEmitter]":
        """The same without waiting."""
        return self.run_later(lambda: self._add(options))

    def set_level(self, level: str) -> None:
        """Choose a quality level, or `auto`."""
        self.run_later(lambda: self._stream.set_level(level))

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

    def _prepare(self) -> None:
        welcome = self._stream.welcome
        if self._head is not None:
            if welcome.order is None:
                raise ValueError("head: belongs to the output ambisonics; other outputs have `hrtf`")
            if self.output_rate != welcome.sample_rate:
                raise ValueError(f"output_rate: a head hears the stream's own rate, {welcome.sample_rate} Hz")
            self._ears = Ears(
                self._client.head_filters(self._head, order=welcome.order, sample_rate=welcome.sample_rate)
            )
        self._orientation = self._stream.listener.orientation
        ahead_s = welcome.buffer_blocks * welcome.block_size / welcome.sample_rate
        self._buffer = JitterBuffer(
            welcome.sample_rate,
            welcome.channels,
            output_rate=self._output_rate,
            longest_s=max(_LONGEST_S, 2 * ahead_s),  # what the server sends ahead has room
        )

    async def _receive(self) -> None:
        assert self._buffer is not None
        try:
            async for block in self._stream:
                self._buffer.push(block)
                if self._on_block is not None:
                    self._on_block(block)
        except NafirClientError as exc:
            self.failure = exc
        else:
            self.failure = ClosedError("the stream is closed")
