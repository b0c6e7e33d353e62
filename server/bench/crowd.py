"""Many clients of one server in one event loop. They walk in circles and read only the headers of audio blocks.

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

import numpy as np

from server.acoustics.geometry import Vector3
from server.bench.gauge import POSE_IDS, Waiting
from server.bench.scene import CLIP, SCENE
from server.core.durations import DurationHistogram
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import PROTOCOL, Acknowledge, AddEmitter, Hello, ListenerPose

_ACKNOWLEDGE_EVERY = 4
_CENTRE: Vector3 = (2.0, 2.0, 1.5)
_RADIUS_M = 1.0
_TURN_S = 12.0
_PLACES = (0.5, 0.5, 0.5), (7.5, 2.5, 2.3)
_GOLDEN = 0.618
"""Phase between the poses of successive walkers, as a share of the period. It spreads any number of them evenly."""
_PATIENCE_S = 10.0
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
    """One client. The future `sounds` is done when all its emitters are heard, and fails with ConnectionError if that
    becomes impossible."""

    def __init__(self, places: Sequence[Vector3], *, phase: float, poses_per_s: float) -> None:
        self.sounds: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self.poses = Waiting()
        self.blocks = 0
        self.errors: list[str] = []
        self._places = places
        self._silent = len(places)
        self._phase = phase
        self._poses_per_s = poses_per_s
        self._reader = FrameReader()
        self._reply: bytearray | None = bytearray()
        """Reply to the upgrade request as far as it has arrived; None once it is complete."""
        self._transport: asyncio.Transport | None = None
        self._next_pose: asyncio.TimerHandle | None = None
        self._pose_ids = itertools.count(1)
        self._is_closing = False
        self.is_lost = False
        self.retry_after_s: int | None = None
        """After how many seconds the server told it to come back; None if it was not refused in this way."""
        self.answered_s: float | None = None
        """When the server let it in or refused it, by `time.monotonic`."""

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
        """Whether all emitters are heard and the connection is open."""
        return self._silent == 0 and not self.is_lost

    def begin(self) -> None:
        """Reset counts and times."""
        self.poses.times = DurationHistogram()
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
        self._send(_TEXT, Hello(protocol=PROTOCOL, scene=SCENE, emitters=len(self._places)).serialize().encode())
        for number, place in enumerate(self._places):
            self._send(_TEXT, AddEmitter(id=str(number), clip=CLIP, position=place).serialize().encode())
        if self._poses_per_s > 0:
            self._next_pose = asyncio.get_running_loop().call_later(self._phase / self._poses_per_s, self._walk)

    def _receive_text(self, payload: bytes) -> None:
        message = json.loads(payload)
        if message["type"] == "emitter_added":
            self._silent -= 1
            if self._silent == 0 and not self.sounds.done():
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
        self.poses.leave(POSE_IDS.unpack_from(payload)[0], time.monotonic())
        if self.blocks % _ACKNOWLEDGE_EVERY == 0:
            (sequence,) = _SEQUENCE.unpack_from(payload)
            self._send(_TEXT, Acknowledge(sequence=sequence).serialize().encode())

    def _walk(self) -> None:
        loop = asyncio.get_running_loop()
        pose_id = next(self._pose_ids)
        # Scheduled from the previous due time, so that delays do not add up.
        assert self._next_pose is not None
        self._next_pose = loop.call_at(self._next_pose.when() + 1 / self._poses_per_s, self._walk)
        angle = 2 * math.pi * ((pose_id + self._phase) / self._poses_per_s / _TURN_S + self._phase)
        x, y, z = _CENTRE
        position = x + _RADIUS_M * math.cos(angle), y + _RADIUS_M * math.sin(angle), z
        pose = ListenerPose(pose_id=pose_id, position=position, yaw=math.remainder(angle, 2 * math.pi))
        self.poses.enter(pose_id, time.monotonic())
        self._send(_BINARY, pose.serialize_binary())

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


class Crowd:
    """The walkers at the server on `port`. Each has `emitters` emitters at places of its own. With no poses they stand
    still."""

    def __init__(self, port: int, *, emitters: int, poses_per_s: float) -> None:
        self._port = port
        self._emitters = emitters
        self._poses_per_s = poses_per_s
        self._rng = np.random.default_rng(0)
        self.walkers: list[Walker] = []

    async def resize(self, count: int) -> None:
        """Change to `count` walkers, and wait until all their emitters are heard. Raises ConnectionError or
        TimeoutError if that fails."""
        kept = [walker for walker in self.walkers if walker.hears_all][:count]
        for walker in self.walkers:
            if walker not in kept:
                walker.close()
        self.walkers = kept
        loop = asyncio.get_running_loop()
        for number in range(len(self.walkers), count):
            places = [tuple(place) for place in self._rng.uniform(*_PLACES, (self._emitters, 3)).tolist()]
            phase = number * _GOLDEN % 1
            make = partial(Walker, places, phase=phase, poses_per_s=self._poses_per_s)
            _, walker = await loop.create_connection(make, "127.0.0.1", self._port)
            self.walkers.append(walker)
            await asyncio.wait_for(walker.sounds, _PATIENCE_S)

    async def rush(self, count: int) -> list[Walker]:
        """Have `count` walkers ask at once, and keep those that hear all their emitters. Returns all of them once each
        hears or was refused, or after some seconds."""
        loop = asyncio.get_running_loop()

        async def ask(number: int) -> Walker:
            places = [tuple(place) for place in self._rng.uniform(*_PLACES, (self._emitters, 3)).tolist()]
            make = partial(Walker, places, phase=number * _GOLDEN % 1, poses_per_s=self._poses_per_s)
            _, walker = await loop.create_connection(make, "127.0.0.1", self._port)
            with contextlib.suppress(ConnectionError, TimeoutError):
                await asyncio.wait_for(asyncio.shield(walker.sounds), _PATIENCE_S)
            return walker

        walkers = await asyncio.gather(*(ask(number) for number in range(count)))
        self.walkers += [walker for walker in walkers if walker.hears_all]
        return walkers

    async def close(self) -> None:
        await self.resize(0)
