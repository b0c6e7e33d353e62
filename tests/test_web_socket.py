"""The short way out of a connection, on a server of its own: it says what ASGI would, in the same order."""

import asyncio
from contextlib import asynccontextmanager

import pytest
import uvicorn
from websockets.asyncio.client import connect
from websockets.frames import Frame, Opcode

from server.web_socket import direct_write, header, watched

PROTOCOL = "server.web_socket:WebSocketProtocol"


@asynccontextmanager
async def serving(application, ws=PROTOCOL):
    """The address of a server that runs `application(scope, receive, send)` for every connection, once accepted."""

    async def accepted(scope, receive, send):
        await receive()
        await send({"type": "websocket.accept"})
        await application(scope, receive, send)

    options = {"port": 0, "ws": ws, "ws_per_message_deflate": False, "lifespan": "off", "log_level": "warning"}
    server = uvicorn.Server(uvicorn.Config(accepted, **options, timeout_graceful_shutdown=1))
    running = asyncio.create_task(server.serve())
    while not server.started:  # noqa: ASYNC110  it has no event for it
        await asyncio.sleep(0.01)
    port = server.servers[0].sockets[0].getsockname()[1]
    try:
        yield f"ws://127.0.0.1:{port}"
    finally:
        server.should_exit = True
        await running


@pytest.mark.parametrize("length", [0, 1, 125, 126, 2_080, 65_535, 65_536])
def test_headers_are_those_of_the_library(length):
    payload = bytes(length)
    assert header(length) + payload == Frame(Opcode.BINARY, payload).serialize(mask=False)


def test_what_is_written_arrives_in_order_among_what_is_sent():
    async def speak(scope, _receive, send):
        write = direct_write(scope)
        for number in range(50):
            if number % 3:
                assert write(bytes([number]) * 1000)
            else:
                await send({"type": "websocket.send", "text": str(number)})
        await send({"type": "websocket.close"})

    async def listen():
        async with serving(speak) as address, connect(address, compression=None) as client:
            return [message async for message in client]

    expected = [bytes([number]) * 1000 if number % 3 else str(number) for number in range(50)]
    assert asyncio.run(listen()) == expected


def test_a_client_that_does_not_read_is_not_written_to():
    """And loses nothing of what was."""
    written = []

    async def speak(scope, receive, send):
        write = direct_write(scope)
        while write(len(written).to_bytes(4, "little") * 2_000):
            written.append(len(written))
            await asyncio.sleep(0)
            assert len(written) < 100_000, "memory would grow without bound"
        await receive()  # the client says that it will read, and only then is there room
        await send({"type": "websocket.send", "bytes": b"room"})
        assert write(b"again")
        await send({"type": "websocket.close"})

    async def listen():
        async with serving(speak) as address, connect(address, compression=None, max_queue=1) as client:
            await asyncio.sleep(0.5)
            assert written
            await client.send("go on")
            return [message async for message in client]

    *blocks, room, again = asyncio.run(listen())
    assert [int.from_bytes(block[:4], "little") for block in blocks] == written
    assert (room, again) == (b"room", b"again")


def test_nothing_is_written_to_a_connection_that_closes():
    outcome = []

    async def speak(scope, _receive, send):
        await send({"type": "websocket.close"})
        outcome.append(direct_write(scope)(b"too late"))

    async def listen():
        async with serving(speak) as address, connect(address, compression=None) as client:
            return [message async for message in client]

    assert asyncio.run(listen()) == []
    assert outcome == [False]


def test_another_server_has_no_short_way():
    found = []

    async def speak(scope, _receive, send):
        found.append(direct_write(scope))
        assert watched(scope, found.append) is scope
        await send({"type": "websocket.close"})

    async def listen():
        async with serving(speak, ws="websockets-sansio") as address, connect(address) as client:
            return [message async for message in client]

    asyncio.run(listen())
    assert found == [None]


def test_who_watches_is_told_of_what_was_written():
    seen, taken = [], []

    def write(payload):
        taken.append(payload)
        return payload != b"no room"

    scope = {"extensions": {"nafir.direct": {"write": write}, "other": {}}}
    write_watched = direct_write(watched(scope, seen.append))
    assert [write_watched(b"one"), write_watched(b"no room")] == [True, False]
    assert (taken, seen) == ([b"one", b"no room"], [b"one"])


def test_messages_wait_in_bounded_number():
    """An application that does not listen is not sent more than a few: the rest stays with the client."""
    waiting = []

    async def idle(_scope, receive, send):
        await asyncio.sleep(0.5)
        waiting.append(receive.__self__.queue.qsize())
        for number in range(300):
            assert (await receive())["bytes"] == number.to_bytes(2, "little") * 8_000
        await send({"type": "websocket.close"})

    async def talk():
        async with serving(idle) as address, connect(address, compression=None) as client:
            for number in range(300):
                await client.send(number.to_bytes(2, "little") * 8_000)
            await client.wait_closed()

    asyncio.run(talk())
    assert 1 < waiting[0] <= 40
