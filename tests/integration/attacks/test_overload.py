"""More streams than a server can bear, and more requests for impulse responses: nobody who listens hears of either."""

import asyncio
import contextlib
import itertools
import time

import pytest
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import PROTOCOL, Acknowledge, AddEmitter, Hello
from server.protocol.server_messages import Error, Welcome, parse_server_message

pytestmark = pytest.mark.attack

ENVIRONMENT = {"NAFIR_MAX_STREAMS": "1000", "NAFIR_MAX_SILENT": "1000"}
AT_ONCE, EMITTERS = 72, 16
"""Three times what two cores bear, with every emitter."""
OPENING_S, ATTACK_S = 5.0, 6.0
MOST_ANSWER_S = 1.0
FLOOD, STREAMS = 64, 9
_PATIENCE_S = 60.0


async def come_back_until_let_in(address, until_s, *, emitters):
    """Ask for a stream, and ask again when told to, until it is let in; listen to it until then."""
    while True:
        _, is_in, retry_s = await listen(address, until_s, emitters=emitters)
        if is_in or time.monotonic() + retry_s > until_s:
            return is_in
        await asyncio.sleep(retry_s)


async def listen(address, until_s, *, emitters):
    """Ask for a stream and listen to it until then. Returns the seconds to its answer, whether it was let in, and after
    how many seconds to come back."""
    began_s, came_s = time.monotonic(), None
    try:
        async with connect(f"ws://{address}/v1/stream", compression=None, open_timeout=_PATIENCE_S) as socket:
            await socket.send(Hello(protocol=PROTOCOL, scene="apartment", emitters=emitters).serialize())
            welcome = parse_server_message(str(await socket.recv()))
            came_s = time.monotonic() - began_s
            if isinstance(welcome, Error):
                return came_s, False, welcome.retry_after_s
            assert isinstance(welcome, Welcome)
            for number in range(emitters):
                place = welcome.scene.emitter.position
                await socket.send(AddEmitter(id=str(number), clip="man-reading", position=place).serialize())
            while time.monotonic() < until_s:
                message = await socket.recv()
                if isinstance(message, bytes) and (block := AudioBlock.parse(message, "f32")).sequence % 4 == 3:
                    await socket.send(Acknowledge(sequence=block.sequence).serialize())
    except InvalidStatus as exc:
        came_s = time.monotonic() - began_s
        retry_s = int(exc.response.headers["Retry-After"]) if exc.response.status_code == 503 else None
        return came_s, False, retry_s
    return came_s, True, None


def test_three_times_as_many_streams_as_there_is_room_for(address, endures):
    def attack():
        async def rush():
            until_s = time.monotonic() + ATTACK_S
            return await asyncio.gather(*(listen(address, until_s, emitters=EMITTERS) for _ in range(AT_ONCE)))

        return asyncio.run(rush())

    outcomes = endures(attack)
    refused = [(came_s, retry_s) for came_s, is_in, retry_s in outcomes if not is_in]
    assert len(refused) > AT_ONCE / 2
    assert all(retry_s is not None and 1 <= retry_s <= 60 for _, retry_s in refused)
    assert sum(came_s > MOST_ANSWER_S for came_s, _ in refused) == 0
    assert any(is_in for _, is_in, _ in outcomes)


async def ask(address, path):
    """The status of an answer, and its Retry-After; None if there is no answer."""
    host, _, port = address.rpartition(":")
    with contextlib.suppress(OSError, asyncio.TimeoutError):
        async with asyncio.timeout(_PATIENCE_S):
            reader, writer = await asyncio.open_connection(host, int(port))
            writer.write(f"GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n".encode())
            head = (await reader.readuntil(b"\r\n\r\n")).decode().lower()
            await reader.read()
            writer.close()
            return int(head.split()[1]), "retry-after:" in head
    return None


def test_a_flood_of_impulse_responses_beside_ten_streams(address, endures):
    """Sixty-four clients ask for one response after another, each at another place."""
    numbers = itertools.count()

    async def pester(until_s):
        answers = []
        while time.monotonic() < until_s:
            x = 0.8 + 0.0007 * (next(numbers) % 2_000)
            path = f"/v1/scenes/apartment/impulse-response?listener={x:.4f},2,1.5&emitter=6,3,1.5"
            answers.append(await ask(address, path))
        return answers

    def attack():
        async def flood():
            until_s = time.monotonic() + OPENING_S + ATTACK_S
            streams = [
                asyncio.create_task(come_back_until_let_in(address, until_s, emitters=1)) for _ in range(STREAMS)
            ]
            await asyncio.sleep(OPENING_S)
            floods = await asyncio.gather(*(pester(until_s) for _ in range(FLOOD)))
            return list(itertools.chain(*floods)), await asyncio.gather(*streams)

        return asyncio.run(flood())

    answers, streams = endures(attack)
    assert all(answer is not None for answer in answers)
    assert {status for status, _ in answers} <= {200, 503}
    assert all(has_time for status, has_time in answers if status == 503)
    assert sum(status == 200 for status, _ in answers) > 0
    assert all(streams)
