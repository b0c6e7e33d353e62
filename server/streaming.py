"""The asyncio driver of a WebSocket stream: moves bytes between the socket, the session and the audio thread.

One `Connection` per client, living on the event loop. A reader passes what the client says to the audio thread; a
sender passes on what the audio thread made. Nothing here grows without bound: messages to the audio thread are refused
beyond `MAX_WAITING_MESSAGES`, audio beyond the window is never made, and a client that reads so slowly that its answers
pile up is cut off, whether or not it ever reads again.
"""

import asyncio
import contextlib
import dataclasses
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial

from starlette.websockets import WebSocket, WebSocketDisconnect

from server.api.response_cache import ResponseCache
from server.audio_engine import AudioEngine
from server.blocks import Encoding
from server.catalogue import describe_scene
from server.clips import ClipLibrary, DecodeError
from server.errors import RequestError
from server.field.levels import Levels
from server.hrtfs import DEFAULT_HRTF, HrtfLibrary
from server.load import Offer, Rung
from server.places import place_of
from server.protocol import AddEmitter, ClientMessage, Hello, Ping, parse_client_message
from server.rendering.ingest import DryAudio
from server.replies import Error, Pong, ServerMessage, Welcome
from server.runtime.racing import StoppedError, run_until
from server.runtime.readiness import Readiness
from server.scene.planner import Costs
from server.scene.situation import Place
from server.session import Session
from server.settings import Settings
from server.stream import Outgoing, Stream, StreamFailed, TimedBlock
from server.telemetry import StreamTotals
from server.web_socket import DirectWay

NORMAL, POLICY_VIOLATION, INTERNAL_ERROR, SERVICE_RESTART, TRY_AGAIN_LATER = 1000, 1008, 1011, 1012, 1013
MAX_WAITING_ANSWERS = 256
_GOODBYE_S = 1.0
"""Even closing waits for room in the socket, and a client that does not read makes none."""


def load_clip(clips: ClipLibrary, name: str) -> DryAudio:
    """Raises RequestError unknown_clip, or undecodable_clip with the decoder's reason."""
    try:
        return clips.load(name)
    except DecodeError as exc:
        raise RequestError("undecodable_clip", str(exc), field="clip") from exc


def _first_blocks(outgoing: Iterable[Outgoing]) -> Iterator[TimedBlock]:
    """Those before which nothing else is."""
    for each in outgoing:
        if not isinstance(each, TimedBlock):
            return
        yield each


class ClosingError(Exception):
    """The connection ends with this code, after an error message where there is one."""

    def __init__(self, close_code: int, error: Error) -> None:
        super().__init__(error.message)
        self.close_code = close_code
        self.error = error


@dataclass
class StreamHost:
    """What all connections share: loaded scenes, their clips, heads, the audio engine, and how many streams there
    are. `offers` says what the quality levels of each scene cost here, once that was measured."""

    scenes: Mapping[str, Levels]
    clips: Mapping[str, ClipLibrary]
    """By scene, since every scene has its sample rate."""
    hrtfs: HrtfLibrary
    audio: AudioEngine
    settings: Settings
    responses: ResponseCache
    readiness: Readiness
    offers: dict[str, Offer] = dataclasses.field(default_factory=dict)
    places: dict[str, Place] = dataclasses.field(default_factory=dict)
    """What plans of effects are made for, by scene."""
    effect_costs: dict[str, Costs] = dataclasses.field(default_factory=dict)
    """By scene, once they were measured."""
    past: StreamTotals = dataclasses.field(default_factory=StreamTotals)
    """Of streams that have ended."""
    streams: int = 0


class Connection:
    """One client from its hello to its goodbye. `way` is the short one in and out, where there is one."""

    def __init__(
        self,
        websocket: WebSocket,
        host: StreamHost,
        *,
        way: DirectWay | None = None,
        time_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._websocket = websocket
        self._way = way
        self._host = host
        self._time_s = time_s
        self._outgoing: deque[Outgoing] = deque()
        self._has_outgoing = asyncio.Event()
        self._is_sending = self._is_taking_in = False
        self._capacity = MAX_WAITING_ANSWERS
        self._is_overfull = asyncio.Event()
        self._stream: Stream | None = None
        self._encoding: Encoding = "f32"

    async def run(self) -> None:
        """Serve the client until either side ends it."""
        with contextlib.suppress(WebSocketDisconnect), self._host.readiness.drain.in_flight():
            await self._websocket.accept()
            try:
                await self._serve_until_drained()
            except ClosingError as closing:
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(_GOODBYE_S):
                        await self._send_message(closing.error)
                        await self._websocket.close(closing.close_code, closing.error.code)

    async def _serve_until_drained(self) -> None:
        readiness = self._host.readiness
        try:
            if not readiness.drain.has_begun:
                await run_until(self._serve(), readiness.drain.begun())
                return
        except StoppedError:
            pass
        raise ClosingError(SERVICE_RESTART, Error(code="server_draining", message="the server is shutting down"))

    async def _serve(self) -> None:
        host = self._host
        if (obstacle := host.readiness.obstacle) is not None:
            raise ClosingError(TRY_AGAIN_LATER, Error(code="not_ready", message=obstacle.message))
        if host.streams >= host.settings.max_streams:
            raise ClosingError(TRY_AGAIN_LATER, Error(code="server_busy", message="the server has no free stream"))
        host.streams += 1
        try:
            hello = await self._receive_hello()
            stream = await self._open(hello)
            await self._pump(stream, hello)
        finally:
            host.streams -= 1

    async def _receive_hello(self) -> Hello:
        try:
            async with asyncio.timeout(self._host.settings.hello_timeout_s):
                message = self._parse(await self._receive())
        except TimeoutError as exc:
            raise ClosingError(POLICY_VIOLATION, Error(code="hello_expected", message="no hello came")) from exc
        except RequestError as refusal:
            raise ClosingError(POLICY_VIOLATION, Error.from_refusal(refusal)) from refusal
        if not isinstance(message, Hello):
            error = Error(code="hello_expected", message=f"the first message is a hello, not {message.type}")
            raise ClosingError(POLICY_VIOLATION, error)
        return message

    async def _open(self, hello: Hello) -> Stream:
        settings = self._host.settings
        levels = self._host.scenes.get(hello.scene)
        hrtf = DEFAULT_HRTF if hello.hrtf is None else hello.hrtf
        window = settings.window_blocks + hello.buffer_blocks
        self._capacity = window + MAX_WAITING_ANSWERS
        try:
            if levels is None:
                raise RequestError("unknown_scene", f"there is no scene {hello.scene!r}", field="scene", status=404)
            field = levels.default
            block_s = hello.block_size / field.sample_rate
            offer = self._host.offers[hello.scene]
            ladder = offer.ladder(hello.level, block_s=block_s)
            session = await asyncio.to_thread(self._open_session, hello, levels, hrtf, ladder.rung, window)
        except RequestError as refusal:
            raise ClosingError(POLICY_VIOLATION, Error.from_refusal(refusal)) from refusal
        await self._send_message(
            Welcome(
                session=uuid.uuid4().hex,
                scene=describe_scene(levels),
                sample_rate=field.sample_rate,
                block_size=hello.block_size,
                channels=session.renderer.outputs,
                encoding=hello.encoding,
                buffer_blocks=hello.buffer_blocks,
                window=window,
                ir_samples=field.ir_samples,
                hrtf=hrtf,
                level=ladder.rung.level,
            )
        )
        return Stream(
            session,
            levels,
            offer=offer,
            ladder=ladder,
            block_s=block_s,
            lead=hello.buffer_blocks,
            deliver=self._deliver,
        )

    def _open_session(self, hello: Hello, levels: Levels, hrtf: str, rung: Rung, window: int) -> Session:
        host, field = self._host, levels.default
        return Session(
            hello,
            levels,
            host.hrtfs.filters(hrtf, field.sample_rate),
            lambda name: load_clip(host.clips[hello.scene], name),
            rung=rung,
            max_emitters=host.settings.max_emitters,
            shared_tail=host.settings.shared_tail,
            window=window,
            place=place_of(levels.bundle, host.places[hello.scene].reverberations, block_size=hello.block_size),
            costs=lambda: host.effect_costs.get(hello.scene, {}),
        )

    async def _pump(self, stream: Stream, hello: Hello) -> None:
        """Read and send until either ends or fails, or too much waits to be sent."""
        self._stream, self._encoding = stream, hello.encoding
        self._host.audio.open(stream)
        tasks = [
            asyncio.create_task(self._read_incoming(stream, hello)),
            asyncio.create_task(self._send_outgoing()),
            asyncio.create_task(self._refuse_overflow()),
        ]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            self._host.audio.close(stream)
            self._host.past.add(stream)
            for task in tasks:
                task.cancel()
            await asyncio.wait(tasks)
        for task in done:
            task.result()

    async def _read_incoming(self, stream: Stream, hello: Hello) -> None:
        if self._way is not None:
            self._way.listen(partial(self._hear, stream))
        while True:
            data = await self._receive()
            self._is_taking_in = True
            await self._take_in(data, stream, hello)
            self._is_taking_in = False

    def _hear(self, stream: Stream, data: str | bytes) -> bool:
        """Take in what needs nothing but the audio thread, unless something that came before is not yet."""
        if self._is_taking_in:
            return False
        try:
            message = self._parse(data)
            if isinstance(message, AddEmitter):
                return False
            self._pass_on(message, stream)
        except RequestError as refusal:
            self._enqueue([Error.from_refusal(refusal)])
        return True

    async def _take_in(self, data: str | bytes, stream: Stream, hello: Hello) -> None:
        try:
            message = self._parse(data)
            if isinstance(message, AddEmitter) and message.clip is not None:
                # Decoded once, here and off the loop, so that the audio thread finds it ready.
                await asyncio.to_thread(load_clip, self._host.clips[hello.scene], message.clip)
            self._pass_on(message, stream)
        except RequestError as refusal:
            self._enqueue([Error.from_refusal(refusal)])

    def _pass_on(self, message: ClientMessage, stream: Stream) -> None:
        """Raises RequestError too_many_messages."""
        if isinstance(message, Ping):
            self._enqueue([Pong(id=message.id)])
        elif not stream.offer(message):
            raise RequestError("too_many_messages", "too many messages in one block: this one was not heeded")

    async def _receive(self) -> str | bytes:
        event = await self._websocket.receive()
        if event["type"] == "websocket.disconnect":
            raise WebSocketDisconnect(event.get("code", NORMAL))
        text: str | None = event.get("text")
        return event["bytes"] if text is None else text

    def _parse(self, data: str | bytes) -> ClientMessage:
        limit = self._host.settings.max_message_bytes
        size = len(data.encode() if isinstance(data, str) else data)
        if size > limit:
            raise RequestError("message_too_large", f"a message has at most {limit} bytes, not {size}", status=413)
        return parse_client_message(data)

    def _deliver(self, outgoing: list[Outgoing]) -> None:
        """Send blocks at once where there is a short way and nothing waits to go before them."""
        blocks: list[bytes] = []
        if self._way is not None and not (self._outgoing or self._is_sending):
            now_s = self._time_s()
            blocks = [self._serialize(block, now_s) for block in _first_blocks(outgoing)]
            if blocks and not self._way.write(blocks):
                blocks = []
        if len(blocks) < len(outgoing):
            self._enqueue(outgoing[len(blocks) :])

    def _enqueue(self, outgoing: list[Outgoing]) -> None:
        """Where there is no room, what comes is lost, and the connection ends."""
        if len(self._outgoing) + len(outgoing) > self._capacity:
            self._is_overfull.set()
            return
        self._outgoing += outgoing
        self._has_outgoing.set()

    async def _refuse_overflow(self) -> None:
        """Apart from the sender, which may be waiting for the very client that does not read."""
        await self._is_overfull.wait()
        raise ClosingError(POLICY_VIOLATION, Error(code="reads_too_slowly", message="the client reads too slowly"))

    async def _send_outgoing(self) -> None:
        """Send until cancelled, or until the stream cannot go on and the socket was closed for it."""
        while True:
            await self._has_outgoing.wait()
            self._has_outgoing.clear()
            self._is_sending = True
            while self._outgoing:
                match self._outgoing.popleft():
                    case TimedBlock() as timed:
                        await self._websocket.send_bytes(self._serialize(timed, self._time_s()))
                    case StreamFailed():
                        await self._send_message(Error(code="internal_error", message="the stream failed"))
                        await self._websocket.close(INTERNAL_ERROR, "internal_error")
                        return
                    case message:
                        await self._send_message(message)
            self._is_sending = False

    def _serialize(self, timed: TimedBlock, now_s: float) -> bytes:
        block = timed.block
        if not block.is_late and now_s > timed.deadline_s:
            assert self._stream is not None
            self._stream.blocks_late += 1
            block.is_late = True
        return block.serialize(self._encoding)

    async def _send_message(self, message: ServerMessage) -> None:
        await self._websocket.send_text(message.serialize())
