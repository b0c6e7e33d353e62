"""Clients that come, listen for a few blocks, and leave, some without a goodbye."""

import asyncio
import json
import struct
from itertools import count
from typing import Any

from websockets.asyncio.client import connect

from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import PROTOCOL, Acknowledge, AddEmitter, Hello, ListenerPose

SCENE = "flat"
HELLO = Hello(protocol=PROTOCOL, scene=SCENE, buffer_blocks=2).serialize()
_SEQUENCE = struct.Struct("<I")
_SEQUENCE_AT = 4


async def visit(address: str, *, blocks: int, emitters: int, scene: str = SCENE, is_aborted: bool = False) -> None:
    """Hear so many blocks of so many emitters, walking; and leave with a goodbye, or drop the connection. Whoever is
    refused, or an emitter of theirs, comes back when told to."""
    while (wait_s := await _ask(address, blocks, emitters, scene, is_aborted)) is not None:  # noqa: ASYNC110  seconds told
        await asyncio.sleep(wait_s)


async def _ask(address: str, blocks: int, emitters: int, scene: str, is_aborted: bool) -> int | None:
    """One visit. Returns after how many seconds to come back, or None if it was let in."""
    hello = Hello(protocol=PROTOCOL, scene=scene, buffer_blocks=2)
    async with connect(f"ws://{address}/v1/stream", compression=None, max_queue=None) as socket:
        await socket.send(hello.serialize())
        welcome = json.loads(await socket.recv())
        if welcome["type"] == "error":
            return _wait_s(welcome)
        assert welcome["type"] == "welcome", welcome
        for number in range(emitters):
            place = (6.0, 3.0 - 0.3 * number, 1.5)
            await socket.send(AddEmitter(id=str(number), clip="woman-reading", position=place).serialize())
        heard = 0
        while heard < blocks:
            message = await socket.recv()
            if isinstance(message, str):
                told = json.loads(message)
                if told["type"] == "error":  # many begin at once: none of its emitters may be added just now
                    return _wait_s(told)
                continue
            assert message[0] == AudioBlock.KIND
            heard += 1
            (sequence,) = _SEQUENCE.unpack_from(message, _SEQUENCE_AT)
            await socket.send(Acknowledge(sequence=sequence).serialize())
            pose = ListenerPose(pose_id=heard, position=(2.0 + 0.1 * (heard % 20), 2.5, 1.5))
            await socket.send(pose.serialize_binary())
        if is_aborted:
            socket.transport.abort()
    return None


def _wait_s(refusal: dict[str, Any]) -> int:
    """After how many seconds to come back. No other refusal is expected."""
    assert refusal["code"] == "server_busy", refusal
    assert 1 <= refusal["retry_after_s"] <= 60
    return refusal["retry_after_s"]


async def churn(address: str, visits: int, *, at_once: int, blocks: int, emitters: int, scene: str = SCENE) -> None:
    """So many visits, `at_once` at a time; every third is aborted."""
    numbers = count()

    async def visitor() -> None:
        while (number := next(numbers)) < visits:
            await visit(address, blocks=blocks, emitters=emitters, scene=scene, is_aborted=number % 3 == 2)

    async with asyncio.TaskGroup() as group:
        for _ in range(at_once):
            group.create_task(visitor())
