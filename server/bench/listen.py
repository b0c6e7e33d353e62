"""Measurement of one stream of a running server from the client's side: late blocks and pose-to-sound latency."""

import math
import statistics
import time
from typing import Any

import numpy as np
from websockets.asyncio.client import connect

from server.acoustics.geometry import Vector3
from server.assets.clips import ClipLibrary
from server.core.errors import NafirError
from server.protocol.client_messages import PROTOCOL, Acknowledge, AddEmitter, Hello, ListenerPose
from server.protocol.packets import BlockReader
from server.protocol.server_messages import Error, Welcome, parse_server_message

_TURN_S = 12.0
_ACKNOWLEDGE_EVERY = 4


class _Waits:
    """Latencies in milliseconds from sending a pose to the first block that has it or a newer one."""

    def __init__(self) -> None:
        self._sent_s: dict[int, float] = {}
        self.waits_ms: list[float] = []

    def send(self, pose_id: int, now_s: float) -> None:
        self._sent_s[pose_id] = now_s

    def receive(self, pose_id: int, now_s: float) -> None:
        reached = [number for number in self._sent_s if number <= pose_id]
        self.waits_ms += [(now_s - self._sent_s.pop(number)) * 1000 for number in reached]

    def summary(self, name: str) -> dict[str, float | None]:
        waits_ms = self.waits_ms
        return {
            f"{name}_median_ms": statistics.median(waits_ms) if waits_ms else None,
            f"{name}_p99_ms": float(np.percentile(waits_ms, 99)) if waits_ms else None,
        }


async def listen(url: str, scene: str, emitters: int, duration_s: float, poses_per_second: float) -> dict[str, Any]:
    """Listen to a stream and return the measurements. Raises NafirError if the server refuses the stream, and OSError
    or WebSocketException if it cannot be reached."""
    async with connect(url, compression=None) as socket:
        await socket.send(Hello(protocol=PROTOCOL, scene=scene).serialize())
        answer = parse_server_message(str(await socket.recv()))
        if not isinstance(answer, Welcome):
            raise NafirError(f"{url} does not serve {scene}: {answer.serialize()}")
        reader = BlockReader(answer)
        for emitter in _sounding(answer, emitters):
            await socket.send(emitter.serialize())
        blocks = blocks_skipped = exchanges = pose_id = next_clock = 0
        late_at_s: list[float] = []
        to_block, to_reverberation = _Waits(), _Waits()
        errors: list[str] = []
        started_s = now_s = time.monotonic()
        while now_s - started_s < duration_s:
            message = await socket.recv()
            now_s = time.monotonic()
            if isinstance(message, str):
                event = parse_server_message(message)
                errors += [event.code] if isinstance(event, Error) else []
                continue
            block = reader.read(message)
            blocks += 1
            blocks_skipped += (block.sample_clock - next_clock) // answer.block_size
            next_clock = block.sample_clock + answer.block_size
            late_at_s += [round(now_s - started_s, 1)] if block.is_late else []
            exchanges += block.is_exchange
            to_block.receive(block.pose_id, now_s)
            to_reverberation.receive(block.reverberation_pose_id, now_s)
            if blocks % _ACKNOWLEDGE_EVERY == 0:
                await socket.send(Acknowledge(sequence=block.sequence).serialize())
            if now_s - started_s > pose_id / poses_per_second:
                pose_id += 1
                to_block.send(pose_id, now_s)
                to_reverberation.send(pose_id, now_s)
                await socket.send(
                    _walking(pose_id, answer.scene.listener.position, now_s - started_s).serialize_binary()
                )
    return {
        "emitters": emitters,
        "duration_s": round(now_s - started_s, 1),
        "blocks": blocks,
        "blocks_skipped": blocks_skipped,
        "blocks_late": len(late_at_s),
        "late_at_s": late_at_s,
        "ir_exchanges": exchanges,
        "poses": pose_id,
        **to_block.summary("pose_to_block"),
        **to_reverberation.summary("pose_to_reverberation"),
        "errors": errors,
    }


def _sounding(welcome: Welcome, count: int) -> list[AddEmitter]:
    """`count` emitters. They use the clips in turn, and alternate between the scene's places of emitter and
    listener."""
    clips = ClipLibrary(welcome.sample_rate).names
    places = welcome.scene.emitter.position, welcome.scene.listener.position
    return [
        AddEmitter(id=str(number), clip=clips[number % len(clips)], position=places[number % len(places)])
        for number in range(count)
    ]


def _walking(pose_id: int, centre: Vector3, time_s: float) -> ListenerPose:
    """A pose on a circle of half a metre around `centre`; the head turns once per round."""
    angle = 2 * math.pi * time_s / _TURN_S
    position = (centre[0] + 0.5 * math.cos(angle), centre[1] + 0.5 * math.sin(angle), centre[2])
    return ListenerPose(pose_id=pose_id, position=position, yaw=math.remainder(angle, 2 * math.pi))
