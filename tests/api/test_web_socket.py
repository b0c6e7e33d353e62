"""The short way out of a connection, on a server of its own: it says what ASGI would, in the same order."""

import asyncio
import contextlib
import logging
import time
from contextlib import asynccontextmanager
from itertools import pairwise

import pytest
import uvicorn
from websockets.asyncio.client import connect
from websockets.client import ClientProtocol
from websockets.exceptions import InvalidStatus
from websockets.frames import CloseCode, Frame, Opcode
from websockets.uri import parse_uri

from server.api.inflow import Allowance
from server.api.web_socket import FastPath, fast_path, watched
from server.protocol.client_messages import ListenerPose

PROTOCOL = "server.api.web_socket:WebSocketProtocol"


@pytest.fixture
def warnings_told():
    """What the server logs from here on, but for mere information. The logger may be one that does not pass on what it
    gets, after another test has run a server with uvicorn's own configuration."""
    told: list[str] = []

    class Keeper(logging.Handler):
        def emit(self, record):
            told.append(record.getMessage())

    logger, keeper = logging.getLogger("uvicorn.error"), Keeper(logging.WARNING)
    logger.addHandler(keeper)
    yield told
    logger.removeHandler(keeper)


@asynccontextmanager
async def serving(application, ws=PROTOCOL, accepts=True, **more):
    """The address of a server that runs `application(scope, receive, send)` for every connection, which it `accepts` or
    leaves to the application."""

    async def accepted(scope, receive, send):
        await receive()
        await send({"type": "websocket.accept"})
        await application(scope, receive, send)

    # Without a level of its own, it would have that of the last server in this process.
    logs = {"log_config": None, "log_level": "warning"}
    options = {"port": 0, "ws": ws, "ws_per_message_deflate": False, "lifespan": "off", **logs, **more}
    asgi = accepted if accepts else application
    server = uvicorn.Server(uvicorn.Config(asgi, **options, timeout_graceful_shutdown=1))
    running = asyncio.create_task(server.serve())
    while not server.started:  # noqa: ASYNC110  it has no event for it
        await asyncio.sleep(0.01)
    port = server.servers[0].sockets[0].getsockname()[1]
    try:
        yield f"ws://127.0.0.1:{port}"
    finally:
        server.should_exit = True
        await running


def test_what_is_written_arrives_in_order_among_what_is_sent():
    async def speak(scope, _receive, send):
        write = fast_path(scope).write
        for number in range(50):
            if number % 3:
                assert write([bytes([number]) * 1000])
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
        write = fast_path(scope).write
        while write([len(written).to_bytes(4, "little") * 2_000]):
            written.append(len(written))
            await asyncio.sleep(0)
            assert len(written) < 100_000, "memory would grow without bound"
        await receive()  # the client says that it will read, and only then is there room
        await send({"type": "websocket.send", "bytes": b"room"})
        assert write([b"again"])
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
        outcome.append(fast_path(scope).write([b"too late"]))

    async def listen():
        async with serving(speak) as address, connect(address, compression=None) as client:
            return [message async for message in client]

    assert asyncio.run(listen()) == []
    assert outcome == [False]


def test_another_server_has_no_fast_path():
    found = []

    async def speak(scope, _receive, send):
        found.append(fast_path(scope))
        assert watched(scope, sent=found.append, received=found.append) is scope
        await send({"type": "websocket.close"})

    async def listen():
        async with serving(speak, ws="websockets-sansio") as address, connect(address) as client:
            return [message async for message in client]

    asyncio.run(listen())
    assert found == [None]


def test_a_watched_scope_reports_what_went_by_the_fast_path():
    sent, heard, taken, listeners = [], [], [], []

    def take(message):
        taken.append(message)
        return message not in (b"not now", [b"not now"])

    way = FastPath(write=take, listen=listeners.append)
    scope = {"extensions": {"nafir.direct": {"path": way}, "other": {}}}
    watched_way = fast_path(watched(scope, sent=sent.append, received=heard.append))
    assert [watched_way.write([b"one", b"two"]), watched_way.write([b"not now"])] == [True, False]
    watched_way.listen(take)
    (listener,) = listeners
    assert [listener("two"), listener(b"not now")] == [True, False]
    assert (taken, sent, heard) == ([[b"one", b"two"], [b"not now"], "two", b"not now"], [[b"one", b"two"]], ["two"])


def test_what_is_heard_at_once_and_what_waits_stay_in_order():
    """Whoever listens takes some, and leaves others to ASGI: what comes after those waits with them."""
    heard, is_open = [], asyncio.Event()

    def hear(message):
        if message == "wait":
            return False
        heard.append((message, "at once"))
        return True

    async def listen(scope, receive, send):
        fast_path(scope).listen(hear)
        is_open.set()
        while len(heard) < 8:
            message = await receive()
            heard.append((message.get("text") or message.get("bytes"), "waited"))
            await asyncio.sleep(0.05)
        await send({"type": "websocket.close"})

    async def talk():
        async with serving(listen) as address, connect(address, compression=None) as client:
            await is_open.wait()
            for message in ("one", b"two", "wait", "three", b"four"):
                await client.send(message)
            await asyncio.sleep(0.3)
            for message in ("five", ["in ", "parts"], "six"):
                await client.send(message)
            await client.wait_closed()

    asyncio.run(talk())
    assert [message for message, _ in heard] == ["one", b"two", "wait", "three", b"four", "five", "in parts", "six"]
    assert dict(heard)["one"] == dict(heard)["five"] == "at once"
    assert dict(heard)["wait"] == dict(heard)["in parts"] == "waited"


def test_a_refusal_is_an_answer_and_no_error_of_the_application(warnings_told):
    async def refuse(_scope, receive, send):
        await receive()
        await send({"type": "websocket.http.response.start", "status": 503, "headers": []})
        await send({"type": "websocket.http.response.body", "body": b"full", "more_body": True})
        await send({"type": "websocket.http.response.body", "body": b" today"})

    async def ask():
        async with serving(refuse, accepts=False) as address:
            with pytest.raises(InvalidStatus) as refused:
                await connect(address)
            return refused.value.response

    response = asyncio.run(ask())
    assert (response.status_code, response.body) == (503, b"full today")
    assert not warnings_told


def test_text_that_is_none_closes_the_connection():
    """As it does without anybody who listens."""

    async def listen(scope, receive, _send):
        fast_path(scope).listen(lambda _: True)
        while (await receive())["type"] != "websocket.disconnect":
            pass

    async def talk():
        async with serving(listen) as address, connect(address, compression=None) as client:
            await asyncio.sleep(0.1)
            client.protocol.send_text(b"\xff\xfe")
            client.transport.writelines(client.protocol.data_to_send())
            await client.wait_closed()
            return client.close_code

    assert asyncio.run(talk()) == 1007


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


@pytest.mark.parametrize("hears", [True, False])
def test_a_message_that_is_too_long_closes_the_connection(hears):
    heard = []

    async def listen(scope, receive, _send):
        fast_path(scope).listen(lambda message: hears and not heard.append(len(message)))
        while (await receive())["type"] != "websocket.disconnect":
            pass

    async def talk():
        async with serving(listen, ws_max_size=1000) as address, connect(address, compression=None) as client:
            await asyncio.sleep(0.1)
            await client.send(bytes(1000))
            await client.send(bytes(1001))
            await client.wait_closed()
            return client.close_code

    assert asyncio.run(talk()) == 1009
    assert heard == [1000] * hears


def test_what_comes_after_a_breach_of_the_protocol_is_not_heard():
    """And the application is told of one end, not of one for each message."""
    heard, events = [], []

    async def listen(scope, receive, _send):
        fast_path(scope).listen(lambda message: not heard.append(message))
        await asyncio.sleep(0.5)
        queue = receive.__self__.queue
        events.extend(queue.get_nowait()["type"] for _ in range(queue.qsize()))

    async def talk():
        async with serving(listen) as address, connect(address, compression=None) as client:
            await asyncio.sleep(0.1)
            before, after = (Frame(Opcode.BINARY, data).serialize(mask=True) for data in (b"before", b"after"))
            client.transport.write(before + b"\x83" + after[1:] + 1000 * after)
            await client.wait_closed()

    asyncio.run(talk())
    assert heard == [b"before"]
    assert set(events) == {"websocket.disconnect"}
    assert len(events) <= 2, "one of the breach, and one of the connection that was lost for it"


@pytest.mark.parametrize("hears", [True, False])
@pytest.mark.parametrize(("breach", "reason"), [(b"too long" * 200_000, 1009), (b"no text \xff", 1007)])
def test_a_client_that_is_still_sending_learns_why_the_connection_closes(breach, reason, hears, warnings_told):
    """What it sends on is neither heard nor answered by a reset, which would take the reason with it; nor does an
    application fail that sends to it."""
    heard = []

    async def listen(scope, receive, send):
        if hears:
            fast_path(scope).listen(lambda message: not heard.append(message))
        while (event := await receive())["type"] != "websocket.disconnect":
            heard.append(event)
        await send({"type": "websocket.send", "bytes": b"too late"})

    async def talk():
        client = ClientProtocol(parse_uri("ws://127.0.0.1"))
        client.send_request(client.connect())
        async with serving(listen, ws_max_size=1000) as address:
            reader, writer = await asyncio.open_connection(port=address.rpartition(":")[2], host="127.0.0.1")
            writer.writelines(client.data_to_send())
            client.receive_data(await reader.readuntil(b"\r\n\r\n"))
            frames = ((Opcode.TEXT, breach), (Opcode.PING, b""), (Opcode.TEXT, b"on"))
            first, ping, then = (Frame(*frame).serialize(mask=True) for frame in frames)
            for part in (first[:400_000], first[400_000:] + ping, ping + then, ping, 100 * then):
                writer.write(part)
                await writer.drain()
                await asyncio.sleep(0.1)
            client.receive_data(await reader.read())
            writer.close()
            return client.close_rcvd

    assert asyncio.run(talk()).code == reason
    assert not heard
    is_no_text = reason == CloseCode.INVALID_DATA
    assert warnings_told == (["Invalid UTF-8 sequence received from client."] if is_no_text else [])


def _binary_pose(number):
    return ListenerPose(pose_id=number, position=(1.0, 2.0, 1.5)).serialize_binary()


def _frames(*messages):
    """As a client sends them, in one piece."""
    return b"".join(
        Frame(
            Opcode.BINARY if isinstance(each, bytes) else Opcode.TEXT,
            each if isinstance(each, bytes) else each.encode(),
        ).serialize(mask=True)
        for each in messages
    )


def hear_all(*messages, until, **options):
    """What an application hears of messages that come in one piece, `until` the last of them."""
    heard, is_open, is_over = [], asyncio.Event(), asyncio.Event()

    async def listen(scope, _receive, send):
        def hear(message):
            heard.append(message)
            if message == until:
                is_over.set()
            return True

        fast_path(scope).listen(hear)
        is_open.set()
        await is_over.wait()
        await send({"type": "websocket.close"})

    async def talk():
        async with serving(listen, **options) as address, connect(address, compression=None) as client:
            await is_open.wait()
            client.transport.write(_frames(*messages))
            await asyncio.wait_for(client.wait_closed(), 10)

    asyncio.run(talk())
    return heard


def test_a_pose_that_a_newer_one_follows_directly_is_not_heard():
    poses = [_binary_pose(number) for number in range(1, 8)]
    assert hear_all(*poses[:3], "a", *poses[3:5], b"\x03", poses[5], "end", until="end") == [
        poses[2],
        "a",
        poses[4],
        b"\x03",
        poses[5],
        "end",
    ]


def test_a_pose_that_an_older_one_follows_is_heard_and_so_is_that():
    newer, older = _binary_pose(9), _binary_pose(8)
    assert hear_all(newer, older, "end", until="end") == [newer, older, "end"]


def test_however_much_comes_at_once_all_of_it_is_heard_in_order():
    messages = [str(number) for number in range(3_000)]
    assert hear_all(*messages, until="2999") == messages


def test_the_last_that_waits_is_heard_before_what_comes_behind_it():
    """A hundred come in one piece. The first is left to ASGI, and with it those that were cut together with it."""
    heard, is_open = [], asyncio.Event()

    def hear(message):
        if message == "0":
            return False
        heard.append(message)
        return True

    async def listen(scope, receive, send):
        fast_path(scope).listen(hear)
        is_open.set()
        while len(heard) < 100:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(0.1):
                    heard.append((await receive())["text"])
            if heard[-1] == "0":  # by now all that was cut together waits
                await asyncio.sleep(0.05)
        await send({"type": "websocket.close"})

    async def talk():
        async with serving(listen) as address, connect(address, compression=None) as client:
            await is_open.wait()
            client.transport.write(_frames(*map(str, range(100))))
            await asyncio.wait_for(client.wait_closed(), 10)

    asyncio.run(talk())
    assert heard == list(map(str, range(100)))


def test_between_a_few_messages_others_have_their_turn():
    """A thousand that came at once are not heard in one go."""
    heard, turns, is_open = [], [], asyncio.Event()

    async def listen(scope, _receive, send):
        fast_path(scope).listen(lambda message: not heard.append(message))
        is_open.set()
        while len(heard) < 1_000:
            turns.append(len(heard))
            await asyncio.sleep(0)
        await send({"type": "websocket.close"})

    async def talk():
        async with serving(listen) as address, connect(address, compression=None) as client:
            await is_open.wait()
            client.transport.write(_frames(*map(str, range(1_000))))
            await asyncio.wait_for(client.wait_closed(), 10)

    asyncio.run(talk())
    assert max(later - earlier for earlier, later in pairwise(turns)) <= 64


def test_who_has_spent_its_budget_is_read_no_more_for_a_while_and_loses_nothing():
    heard, is_open = [], asyncio.Event()
    allowance = Allowance(messages_per_s=400, bytes_per_s=1e6)

    async def listen(scope, _receive, send):
        way = fast_path(scope)
        way.allow(allowance)
        way.listen(lambda message: not heard.append((time.monotonic(), message)))
        is_open.set()
        while len(heard) < 500:  # noqa: ASYNC110
            await asyncio.sleep(0.01)
        await send({"type": "websocket.close"})

    async def talk():
        async with serving(listen) as address, connect(address, compression=None) as client:
            await is_open.wait()
            for number in range(500):
                await client.send(str(number))
            await asyncio.wait_for(client.wait_closed(), 10)

    asyncio.run(talk())
    assert [message for _, message in heard] == list(map(str, range(500)))
    lasted_s = heard[-1][0] - heard[0][0]
    # Beyond the first 100, which a full budget holds, 400 a second; and reads cost too.
    assert 0.8 < lasted_s < 3.0


def test_who_was_charged_for_a_dear_message_is_read_no_more_for_a_while():
    heard, is_open, has_heard = [], asyncio.Event(), asyncio.Event()

    async def listen(scope, _receive, send):
        way = fast_path(scope)
        way.allow(Allowance(messages_per_s=400, bytes_per_s=1e6))

        def hear(message):
            heard.append((time.monotonic(), message))
            if message == "0":
                way.charge(300.0)  # of the 100 that a full budget holds
                has_heard.set()
            return True

        way.listen(hear)
        is_open.set()
        while len(heard) < 5:  # noqa: ASYNC110
            await asyncio.sleep(0.01)
        await send({"type": "websocket.close"})

    async def talk():
        async with serving(listen) as address, connect(address, compression=None) as client:
            await is_open.wait()
            await client.send("0")
            await has_heard.wait()
            for number in range(1, 5):
                await client.send(str(number))
            await asyncio.wait_for(client.wait_closed(), 10)

    asyncio.run(talk())
    assert [message for _, message in heard] == list(map(str, range(5)))
    assert 0.4 < heard[1][0] - heard[0][0] < 3.0


def test_of_pings_that_come_together_the_newest_is_answered():
    """With what the standard has for it, and the connection goes on."""
    pongs, is_open = [], asyncio.Event()

    async def listen(_scope, receive, send):
        is_open.set()
        assert (await receive())["text"] == "end"
        await send({"type": "websocket.send", "text": "end"})
        await send({"type": "websocket.close"})

    async def talk():
        client = ClientProtocol(parse_uri("ws://127.0.0.1"))
        client.send_request(client.connect())
        async with serving(listen) as address:
            reader, writer = await asyncio.open_connection(port=address.rpartition(":")[2], host="127.0.0.1")
            writer.writelines(client.data_to_send())
            client.receive_data(await reader.readuntil(b"\r\n\r\n"))
            await is_open.wait()
            pings = [Frame(Opcode.PING, bytes([number])).serialize(mask=True) for number in range(20)]
            writer.write(b"".join(pings) + _frames("end"))
            while data := await reader.read(65_536):
                client.receive_data(data)
                writer.writelines(client.data_to_send())  # the answer to the close, for which the server would wait
            writer.close()
        pongs.extend(event.data for event in client.events_received() if getattr(event, "opcode", None) is Opcode.PONG)

    asyncio.run(talk())
    assert pongs == [bytes([19])]
