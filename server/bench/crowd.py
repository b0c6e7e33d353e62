"""Many clients of one server in one event loop. They walk in circles and read only the headers of audio blocks. Their
emitters stand, or move as often as the listeners.

The WebSocket client is minimal, so that it does not dominate the measured load. It needs a server that sends whole
messages without extensions over the loopback interface.
"""

import asyncio
import base64
import contextlib
import itertools
import json
import math
import re
import struct
import time
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from server.bench.gauge import BLOCK_LISTENER, POSE_IDS, Waits
from server.bench.places import Circle, Places
from server.bench.scene import CLIP
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import (
    PROTOCOL,
    Acknowledge,
    AddEmitter,
    AddListener,
    BlockSize,
    Hello,
    ListenerPose,
    MoveEmitter,
)

BLOCK_SIZE: BlockSize = 256
"""Samples of a block: what a hello asks for if it says nothing."""
_ACKNOWLEDGE_EVERY = 4
_TURN_S = 12.0
"""Seconds for a circle: half a metre a second on one of a metre."""
_GOLDEN = 0.618
"""Phase between the poses of successive walkers, as a share of the period. It spreads any number of them evenly."""
_PATIENCE_S = 10.0
_LOOK_EVERY_S = 0.005
_SEQUENCE = struct.Struct("<4xI")
_TEXT, _BINARY, _CLOSE, _PING, _PONG = 1, 2, 8, 9, 10
_WHOLE, _MASKED = 0x80, 0x80


def frame(opcode: int, payload: bytes) -> bytes:
    """A client's message of n < 65536 bytes. Its mask is zero, which leaves the bytes unchanged (RFC 6455, 5.3)."""
    short = len(payload) < 126
    length = bytes([_MASKED | len(payload)]) if short else struct.pack(">BH", _MASKED | 126, len(payload))
    return bytes([_WHOLE | opcode]) + length + bytes(4) + payload


class FrameReader:
    """Splits the bytes from a server into messages."""

    def __init__(self) -> None:
        self._data = bytearray()

    def feed(self, data: bytes) -> list[tuple[int, bytes]]:
        """Opcode and payload of every message that these bytes complete."""
        self._data += data
        messages = []
        start, end = 0, len(self._data)
        while end - start >= 2:
            opcode, length, at = self._data[start] & 0x0F, self._data[start + 1], start + 2
            if length == 126:
                if end - at < 2:
                    break
                (length,) = struct.unpack_from(">H", self._data, at)
                at += 2
            elif length == 127:
                if end - at < 8:
                    break
                (length,) = struct.unpack_from(">Q", self._data, at)
                at += 8
            if end - at < length:
                break
            messages.append((opcode, bytes(self._data[at : at + length])))
            start = at + length
        del self._data[:start]
        return messages


class Walker(asyncio.Protocol):
    """One client. The future `sounds` is done when its listeners are there and all its emitters are heard, and fails
    with ConnectionError if that becomes impossible. With `sways` its emitters move on their circles."""

    def __init__(
        self,
        places: Places,
        emitters: Sequence[Circle],
        *,
        phase: float,
        poses_per_s: float,
        sways: bool,
        block_size: BlockSize = BLOCK_SIZE,
        listeners: int = 1,
    ) -> None:
        self.sounds: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self.waits = Waits()
        self.blocks = 0
        self.errors: list[str] = []
        self._places = places
        self._emitters = emitters
        self._sways = sways
        self._block_size = block_size
        self._missing = len(emitters) + listeners - 1
        """Emitters and further listeners of which the server has not said that they are there."""
        self._listeners = listeners
        self._ids: dict[int, str | None] = {0: None}
        """Those of the listeners that are there, by number."""
        self._phase = phase
        self._poses_per_s = poses_per_s
        self._reader = FrameReader()
        self._reply: bytearray | None = bytearray()
        """Reply to the upgrade request as far as it has arrived; None once it is complete."""
        self._transport: asyncio.Transport | None = None
        self._next_pose: asyncio.TimerHandle | None = None
        self._pose_ids, self._steps = itertools.count(1), itertools.count(1)
        self._is_closing = False
        self.is_lost = False
        self.retry_after_s: int | None = None
        """After how many seconds the server told it to come back; None if it was not refused in this way."""
        self.asked_s = 0.0
        """When it began to connect, by `time.monotonic`."""
        self.answered_s: float | None = None
        """When the server let it in or refused it."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        key = base64.b64encode(bytes(16)).decode()
        transport.write(
            f"GET /v1/stream HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
        )

    def data_received(self, data: bytes) -> None:
        if self._reply is not None:
            self._reply += data
            head, end, data = bytes(self._reply).partition(b"\r\n\r\n")
            if not end:
                return
            if b" 101 " not in head.partition(b"\r\n")[0]:
                self._refuse(head.decode(errors="replace"))
                return
            self._reply = None
            self._begin()
        for opcode, payload in self._reader.feed(data):
            if opcode == _BINARY:
                self._receive_audio(payload)
            elif opcode == _TEXT:
                self._receive_text(payload)
            elif opcode == _PING:
                self._send(_PONG, payload)
            elif opcode == _CLOSE:
                self._fail(f"the server closed the stream: {payload[2:].decode(errors='replace')}")

    def connection_lost(self, exc: Exception | None) -> None:
        if not self._is_closing:
            self._fail(f"the connection was lost: {exc}")

    @property
    def hears_all(self) -> bool:
        """Whether all listeners hear all emitters and the connection is open."""
        return self._missing == 0 and not self.is_lost

    def begin(self) -> None:
        """Reset counts and times."""
        self.waits.begin()
        self.blocks = 0
        self.errors = []

    def close(self) -> None:
        self._is_closing = True
        self.sounds.cancel()
        if self._next_pose is not None:
            self._next_pose.cancel()
        if self._transport is not None:
            self._transport.abort()

    def _begin(self) -> None:
        hello = Hello(
            protocol=PROTOCOL,
            scene=self._places.bundle.id,
            emitters=len(self._emitters),
            listeners=None if self._listeners == 1 else self._listeners,
            block_size=self._block_size,
        )
        self._send(_TEXT, hello.serialize().encode())
        for number in range(1, self._listeners):
            position = self._places.walk.at(self._angle(0.0, number))
            self._send(_TEXT, AddListener(id=f"listener-{number}", position=position).serialize().encode())
        for number, circle in enumerate(self._emitters):
            position = circle.at(0.0) if self._sways else circle.centre
            self._send(_TEXT, AddEmitter(id=str(number), clip=CLIP, position=position).serialize().encode())
        if self._poses_per_s > 0:
            self._next_pose = asyncio.get_running_loop().call_later(self._phase / self._poses_per_s, self._walk)

    def _receive_text(self, payload: bytes) -> None:
        message = json.loads(payload)
        if message["type"] in {"emitter_added", "listener_added"}:
            if "index" in message:
                self._ids[message["index"]] = message["id"]
            self._missing -= 1
            if self._missing == 0 and not self.sounds.done():
                self.sounds.set_result(None)
        elif message["type"] == "welcome":
            self.answered_s = time.monotonic()
        elif message["type"] == "error":
            self.errors.append(message["code"])
            if self.answered_s is None:
                self.answered_s, self.retry_after_s = time.monotonic(), message.get("retry_after_s")

    def _receive_audio(self, payload: bytes) -> None:
        if payload[0] != AudioBlock.KIND:
            return
        self.blocks += 1
        listener = payload[BLOCK_LISTENER]
        self.waits.leave(listener, POSE_IDS.unpack_from(payload), time.monotonic())
        (sequence,) = _SEQUENCE.unpack_from(payload)
        if sequence % _ACKNOWLEDGE_EVERY == 0:
            acknowledged = Acknowledge(sequence=sequence, listener=self._ids[listener])
            self._send(_TEXT, acknowledged.serialize().encode())

    def _walk(self) -> None:
        loop = asyncio.get_running_loop()
        step = next(self._steps)
        # Scheduled from the previous due time, so that delays do not add up.
        assert self._next_pose is not None
        self._next_pose = loop.call_at(self._next_pose.when() + 1 / self._poses_per_s, self._walk)
        passed_s = (step + self._phase) / self._poses_per_s
        if self._sways:
            angle = self._angle(passed_s, 0)
            for number, circle in enumerate(self._emitters):
                moved = MoveEmitter(id=str(number), pose_id=next(self._pose_ids), position=circle.at(angle))
                self._send(_TEXT, moved.serialize().encode())
        for number in tuple(self._ids):
            angle, pose_id = self._angle(passed_s, number), next(self._pose_ids)
            yaw = math.remainder(angle, 2 * math.pi)
            position = self._places.walk.at(angle)
            pose = ListenerPose(pose_id=pose_id, position=position, yaw=yaw, index=number or None)
            self.waits.enter(number, pose_id, time.monotonic())
            self._send(_BINARY, pose.serialize_binary())

    def _angle(self, passed_s: float, listener: int) -> float:
        """Where on its circle a listener is after some seconds: those of one stream are spread evenly."""
        return 2 * math.pi * (passed_s / _TURN_S + self._phase + listener / self._listeners)

    def _send(self, opcode: int, payload: bytes) -> None:
        if self._transport is not None and not self._transport.is_closing():
            self._transport.write(frame(opcode, payload))

    def _refuse(self, head: str) -> None:
        """Note an answer in place of the upgrade."""
        self.answered_s = time.monotonic()
        told = re.search(r"^retry-after: *(\d+)", head, re.IGNORECASE | re.MULTILINE)
        self.retry_after_s = None if told is None else int(told[1])
        self._fail(head)

    def _fail(self, reason: str) -> None:
        self.errors.append(reason)
        self.is_lost = True
        if self._next_pose is not None:
            self._next_pose.cancel()
        if not self.sounds.done():
            self.sounds.set_exception(ConnectionError(reason))


class Rush(NamedTuple):
    """Walkers that have asked at once. `stall_s` is the longest time for which none of them got to read, since they
    share a thread, and `load` their CPU time divided by wall time."""

    walkers: list[Walker]
    stall_s: float
    load: float


class Crowd:
    """The walkers at the server on `port`. Each has `emitters` emitters at places of its own, which move as often as
    the walker with `sways`, and `listeners` listeners in its stream. With no poses all stand still."""

    def __init__(
        self,
        port: int,
        places: Places,
        *,
        emitters: int,
        poses_per_s: float,
        sways: bool = False,
        block_size: BlockSize = BLOCK_SIZE,
        listeners: int = 1,
    ) -> None:
        self._port = port
        self._places = places
        self.emitters = emitters
        self.listeners = listeners
        self.poses_per_s = poses_per_s
        self._sways = sways
        self._block_size = block_size
        self._rng = np.random.default_rng(0)
        self.walkers: list[Walker] = []

    @property
    def scene(self) -> str:
        return self._places.bundle.id

    @property
    def blocks_per_s(self) -> float:
        """Blocks that each walker should get per second, for all its listeners."""
        return self.listeners * self._places.bundle.manifest.codec.sample_rate / self._block_size

    async def resize(self, count: int) -> None:
        """Change to `count` walkers, and wait until all their emitters are heard. Raises ConnectionError or
        TimeoutError if that fails."""
        kept = [walker for walker in self.walkers if walker.hears_all][:count]
        for walker in self.walkers:
            if walker not in kept:
                walker.close()
        self.walkers = kept
        for number in range(len(self.walkers), count):
            walker = await self._connect(number, self._choose_emitters())
            self.walkers.append(walker)
            await asyncio.wait_for(walker.sounds, _PATIENCE_S)

    async def rush(self, count: int) -> Rush:
        """Have `count` walkers ask at once, and keep those that hear all their emitters. Returns once each of them
        hears or was refused, or after some seconds."""
        # Half a millisecond an emitter: chosen one by one, they would keep the first who asks from hearing the answer.
        chosen = [self._choose_emitters() for _ in range(count)]

        async def ask(number: int) -> Walker:
            walker = await self._connect(number, chosen[number])
            walker.sounds.add_done_callback(_heed)  # it may fail after its time is over
            with contextlib.suppress(ConnectionError, TimeoutError):
                await asyncio.wait_for(asyncio.shield(walker.sounds), _PATIENCE_S)
            return walker

        began_s, began_cpu_s = time.monotonic(), time.process_time()
        watching = asyncio.create_task(_longest_stall_s(is_over := asyncio.Event()))
        walkers = await asyncio.gather(*(ask(number) for number in range(count)))
        load = (time.process_time() - began_cpu_s) / (time.monotonic() - began_s)
        is_over.set()
        self.walkers += [walker for walker in walkers if walker.hears_all]
        return Rush(walkers, await watching, load)

    async def come_back(self, refused: Sequence[Walker], for_s: float) -> int:
        """Have those who were refused ask again when they were told to, as often as they are refused again, for so many
        seconds; keep those that come to hear all their emitters. Returns how often they asked."""
        until_s, asked = time.monotonic() + for_s, 0

        async def ask_again(number: int, walker: Walker) -> None:
            nonlocal asked
            while (wait_s := walker.retry_after_s) is not None and time.monotonic() + wait_s < until_s:
                await asyncio.sleep(wait_s)
                asked += 1
                walker.close()
                walker = await self._connect(number, self._choose_emitters())
                walker.sounds.add_done_callback(_heed)
                with contextlib.suppress(ConnectionError, TimeoutError):
                    await asyncio.wait_for(asyncio.shield(walker.sounds), _PATIENCE_S)
                if walker.hears_all:
                    self.walkers.append(walker)
                    return

        first = len(self.walkers)
        async with asyncio.timeout(for_s + _PATIENCE_S):
            await asyncio.gather(*(ask_again(first + number, walker) for number, walker in enumerate(refused)))
        await asyncio.sleep(max(0.0, until_s - time.monotonic()))
        return asked

    def _choose_emitters(self) -> list[Circle]:
        return self._places.emitters(self.emitters, self._rng)

    async def _connect(self, number: int, emitters: Sequence[Circle]) -> Walker:
        pace = {"phase": number * _GOLDEN % 1, "poses_per_s": self.poses_per_s}
        make = partial(
            Walker,
            self._places,
            emitters,
            **pace,
            sways=self._sways,
            block_size=self._block_size,
            listeners=self.listeners,
        )
        asked_s = time.monotonic()
        _, walker = await asyncio.get_running_loop().create_connection(make, "127.0.0.1", self._port)
        walker.asked_s = asked_s
        return walker

    async def close(self) -> None:
        await self.resize(0)


def _heed(sounds: asyncio.Future[None]) -> None:
    """Take note of a failure, of which asyncio would complain otherwise."""
    if not sounds.cancelled():
        sounds.exception()


async def _longest_stall_s(is_over: asyncio.Event) -> float:
    """The longest time for which the event loop was kept from its work, until it `is_over`."""
    longest_s = 0.0
    while not is_over.is_set():
        before_s = time.monotonic()
        await asyncio.sleep(_LOOK_EVERY_S)
        longest_s = max(longest_s, time.monotonic() - before_s - _LOOK_EVERY_S)
    return longest_s
