"""A connection meets its limits: the right answers, and an end, on a server of its own with short times."""

import asyncio
import contextlib
import json
import time
from contextlib import asynccontextmanager

import pytest
import uvicorn

from server.api.connection_limits import ConnectionLimits
from server.api.http_protocol import limited_http
from server.api.settings import Settings

CHUNK = b"x" * 65536
SETTINGS = {
    "request_timeout_s": 1.0,
    "response_timeout_s": 1.0,
    "max_headers_bytes": 4096,
    "max_body_bytes": 1000,
    "max_connections": 8,
    "max_connections_per_address": 8,
}
WITHIN_S = 4.0
"""Beyond a second of patience, two of lingering, and a look twice a second: what a busy host may add."""


async def application(scope, receive, send):
    """`/slow` waits for a while, `/large` has 64 MiB, `/body` and `/v1/clips` wait for the body, all others answer
    their path."""
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.accept"})
        await receive()
        return
    path = scope["path"]
    if path == "/slow":
        await asyncio.sleep(0.5)
    if path in {"/body", "/v1/clips"}:
        while (await receive()).get("more_body"):
            pass
    pieces = [CHUNK] * 1024 if path == "/large" else [path.encode()]
    length = str(sum(map(len, pieces))).encode()
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", length)]})
    for piece in pieces:
        await send({"type": "http.response.body", "body": piece, "more_body": True})
    await send({"type": "http.response.body", "body": b""})


@asynccontextmanager
async def serving(**settings):
    """Opens a connection to a server of `application`."""
    limits = ConnectionLimits.of(Settings(**{**SETTINGS, **settings}))
    config = uvicorn.Config(
        application,
        port=0,
        http=limited_http(limits),
        ws="server.api.web_socket:WebSocketProtocol",
        ws_per_message_deflate=False,
        lifespan="off",
        log_level="critical",
        timeout_keep_alive=1,
        timeout_graceful_shutdown=1,
    )
    server = uvicorn.Server(config)
    running = asyncio.create_task(server.serve())
    while not server.started:  # noqa: ASYNC110  it has no event for it
        await asyncio.sleep(0.01)
    port = server.servers[0].sockets[0].getsockname()[1]
    opened = []

    async def connect():
        opened.append(await asyncio.open_connection("127.0.0.1", port))
        return opened[-1]

    try:
        yield connect
    finally:
        for _, writer in opened:
            writer.transport.abort()
        server.should_exit = True
        await running


def talk(*pieces, pause_s=0.0, **settings):
    """All that comes until the server hangs up, and after how long it did."""

    async def run():
        async with serving(**settings) as connect:
            begin_s = time.monotonic()  # before the server can know of the connection, whose patience then begins
            reader, writer = await connect()

            async def speak():
                with contextlib.suppress(ConnectionError):
                    for piece in pieces:
                        writer.write(piece)
                        await writer.drain()
                        await asyncio.sleep(pause_s)

            speaking = asyncio.create_task(speak())
            heard = b""
            with contextlib.suppress(ConnectionError):
                while data := await asyncio.wait_for(reader.read(65536), 10):
                    heard += data
            speaking.cancel()
            return heard, time.monotonic() - begin_s

    return asyncio.run(run())


def problem_of(heard):
    """Status and code of the one answer."""
    head, _, body = heard.partition(b"\r\n\r\n")
    assert b"content-type: application/problem+json" in head
    assert b"connection: close" in head
    document = json.loads(body)
    assert int(head.split()[1]) == document["status"]
    return document["status"], document["code"]


def get(path="/", *more, method="GET"):
    return b"\r\n".join([f"{method} {path} HTTP/1.1".encode(), b"Host: localhost", *more, b"", b""])


UPGRADE = [
    b"Upgrade: websocket",
    b"Connection: Upgrade",
    b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==",
    b"Sec-WebSocket-Version: 13",
]
CLOSE = b"Connection: close"


@pytest.mark.parametrize("more", [[], UPGRADE], ids=["request", "upgrade"])
@pytest.mark.parametrize(
    ("begin", "piece", "expected"),
    [
        (b"GET /", CHUNK, (414, "request_line_too_long")),
        (get("/")[:-2] + b"name: ", CHUNK, (431, "header_too_long")),
        (get("/")[:-2], b"a: b\r\n" * 1000, (431, "too_many_headers")),
        (get("/")[:-2], b"a: " + b"x" * 1000 + b"\r\n", (431, "headers_too_long")),
    ],
)
def test_a_head_that_never_ends_is_refused_and_the_client_sees_why(begin, piece, expected, more):
    begin = begin.replace(b"Host: localhost\r\n", b"\r\n".join([b"Host: localhost", *more, b""]))
    heard, took_s = talk(begin, *[piece] * 200)
    assert problem_of(heard) == expected
    assert took_s < 2 + WITHIN_S


@pytest.mark.parametrize(
    "pieces",
    [
        [get("/body", b"Content-Length: 1001", method="POST")],
        [get("/body", b"Transfer-Encoding: chunked", method="POST"), *[b"64\r\n" + b"x" * 100 + b"\r\n"] * 11],
        [get("/body", b"Transfer-Encoding: chunked", method="POST"), b"1;" + b"x" * 1000],
        [get("/body", b"Transfer-Encoding: chunked", method="POST"), b"0\r\n", *[b"trailer: value\r\n"] * 100],
    ],
    ids=["length", "chunks", "chunk extension", "trailers"],
)
def test_a_body_too_large_is_refused(pieces):
    assert problem_of(talk(*pieces)[0]) == (413, "body_too_large")


UPLOADS = {"clips_folder": "/nowhere", "max_clip_bytes": 100_000}


def post(path, size, *, is_chunked=False):
    """A request with a body of so many bytes."""
    if is_chunked:
        head = get(path, b"Transfer-Encoding: chunked", CLOSE, method="POST")
        return head + b"%x\r\n" % size + b"x" * size + b"\r\n0\r\n\r\n"
    return get(path, b"Content-Length: %d" % size, CLOSE, method="POST") + b"x" * size


@pytest.mark.parametrize("is_chunked", [False, True])
def test_an_upload_may_be_longer_than_other_bodies(is_chunked):
    for path in ("/v1/clips", "/v1/clips?title=x"):
        heard, _ = talk(post(path, 99_000, is_chunked=is_chunked), **UPLOADS)
        assert heard.startswith(b"HTTP/1.1 200")
        assert problem_of(talk(post(path, 100_001, is_chunked=is_chunked), **UPLOADS)[0]) == (413, "body_too_large")
        assert problem_of(talk(post(path, 1_001, is_chunked=is_chunked))[0]) == (413, "body_too_large"), "no uploads"
    for path in ("/v1/clips/x", "/v1/scenes", "/body"):
        assert problem_of(talk(post(path, 1_001, is_chunked=is_chunked), **UPLOADS)[0]) == (413, "body_too_large")


def test_an_upload_has_its_own_time():
    slow = [get("/body", b"Content-Length: 20", CLOSE, method="POST"), *[b"x"] * 20]
    upload = [get("/v1/clips", b"Content-Length: 20", CLOSE, method="POST"), *[b"x"] * 20]
    assert problem_of(talk(*slow, pause_s=0.1, **UPLOADS)[0]) == (408, "request_timeout")
    heard, _ = talk(*upload, pause_s=0.1, upload_timeout_s=5.0, **UPLOADS)
    assert heard.startswith(b"HTTP/1.1 200")
    heard, _ = talk(*upload, pause_s=0.1, upload_timeout_s=0.5, **UPLOADS)
    assert problem_of(heard) == (408, "request_timeout")


def test_a_body_that_grows_too_large_after_the_answer_gets_no_second_one():
    heard, took_s = talk(
        get("/", b"Transfer-Encoding: chunked"), *[b"64\r\n" + b"x" * 100 + b"\r\n"] * 11, pause_s=0.05
    )
    assert heard.count(b"HTTP/1.1 ") == 1
    assert heard.startswith(b"HTTP/1.1 200 ")
    assert took_s < 3.5 + WITHIN_S


def test_a_body_at_the_limit_is_taken():
    heard, _ = talk(get("/body", b"Content-Length: 1000", CLOSE, method="POST"), b"x" * 1000)
    assert heard.startswith(b"HTTP/1.1 200 ")


@pytest.mark.parametrize("begin", [b"G", b"GET / HTTP/1.1\r\nHost: loc"])
def test_half_a_request_is_answered_and_closed(begin):
    heard, took_s = talk(begin)
    assert problem_of(heard) == (408, "request_timeout")
    assert 1.0 < took_s < 3.5 + WITHIN_S


def test_bytes_that_trickle_in_do_not_prolong_it():
    heard, took_s = talk(*[bytes([byte]) for byte in get("/" + "a" * 200)], pause_s=0.1)
    assert problem_of(heard) == (408, "request_timeout")
    assert took_s < 3.5 + WITHIN_S


def test_half_a_body_is_answered_and_closed():
    heard, took_s = talk(get("/body", b"Content-Length: 100", method="POST"), *[b"x"] * 50, pause_s=0.1)
    assert problem_of(heard) == (408, "request_timeout")
    assert took_s < 3.5 + WITHIN_S


@pytest.mark.parametrize("first", [b"", get("/"), get("/") + get("/again")], ids=["never", "once", "twice"])
def test_silence_closes_the_connection_without_a_word(first):
    heard, took_s = talk(first)
    assert heard.count(b"HTTP/1.1 200 ") == first.count(b"GET")
    assert b"problem" not in heard
    assert 1.0 < took_s < 2 + WITHIN_S


def test_requests_behind_each_other_are_answered_in_turn():
    heard, _ = talk(b"".join(get(path) for path in ("/slow", "/b", "/c")) + get("/d", CLOSE) + get("/never"))
    bodies = [answer.rpartition(b"\r\n\r\n")[2] for answer in heard.split(b"HTTP/1.1 200 OK")[1:]]
    assert [body.strip() for body in bodies] == [b"/slow", b"/b", b"/c", b"/d"]


def test_more_requests_at_once_than_may_wait_end_the_connection_after_the_first():
    heard, took_s = talk(get("/slow"), *[get("/behind") * 1000] * 40)
    assert heard.count(b"HTTP/1.1 200 ") <= 1
    assert took_s < 2 + WITHIN_S


def test_a_request_behind_a_body_is_read_from_its_first_byte():
    heard, _ = talk(get("/body", b"Content-Length: 3", method="POST") + b"abc" + get("/next", CLOSE))
    assert heard.count(b"HTTP/1.1 200 ") == 2
    assert heard.endswith(b"/next")


def test_nothing_is_heard_behind_a_chunked_body():
    """Where it ends is the parser's to say, so that nobody smuggles a request past what measures them."""
    heard, _ = talk(get("/body", b"Transfer-Encoding: chunked", method="POST") + b"1\r\na\r\n0\r\n\r\n" + get("/next"))
    assert heard.count(b"HTTP/1.1 ") == 1
    assert b"connection: close" in heard


def test_what_is_no_http_is_told_so():
    assert problem_of(talk(b"\x16\x03\x01\x02\x00\x01\x00")[0]) == (400, "malformed_request")


def test_an_upgrade_with_a_body_is_refused():
    assert problem_of(talk(get("/", *UPGRADE, b"Content-Length: 1") + b"x")[0]) == (400, "malformed_request")


def test_an_upgrade_that_is_none_is_told_so_in_a_problem_document():
    heard, _ = talk(get("/", b"Upgrade: websocket", b"Connection: Upgrade"))
    head, _, body = heard.partition(b"\r\n\r\n")
    assert head.split()[1] in {b"400", b"426"}
    assert json.loads(body)["status"] == int(head.split()[1])


async def answer_of(connect, path="/"):
    """Of a connection of its own."""
    reader, writer = await connect()
    writer.write(get(path, CLOSE))
    return await asyncio.wait_for(reader.read(), 5)


def test_a_client_that_does_not_take_its_response_is_cut_off():
    async def run():
        async with serving(max_connections=1, max_connections_per_address=1) as connect:
            reader, writer = await connect()
            writer.transport.pause_reading()
            writer.write(get("/large"))
            await asyncio.sleep(3.0)
            writer.transport.resume_reading()
            heard = 0
            with contextlib.suppress(ConnectionError):
                while data := await asyncio.wait_for(reader.read(65536), 5):
                    heard += len(data)
            return heard

    assert asyncio.run(run()) < 64 * 1024 * 1024


def test_silent_connections_take_nothing_from_others():
    async def run():
        async with serving(request_timeout_s=30) as connect:
            silent = [await connect() for _ in range(100)]
            answers = [await answer_of(connect) for _ in range(20)]
            await asyncio.sleep(0.1)
            still_open = sum(not reader.at_eof() for reader, _ in silent)
            return answers, still_open

    answers, still_open = asyncio.run(run())
    assert all(answer.startswith(b"HTTP/1.1 200 ") for answer in answers)
    assert still_open <= 8


def test_silent_web_sockets_take_nothing_from_others():
    async def run():
        async with serving() as connect:
            for _ in range(30):
                reader, writer = await connect()
                writer.write(get("/", *UPGRADE))
                assert b" 101 " in await reader.readline()
            return await answer_of(connect)

    assert asyncio.run(run()).startswith(b"HTTP/1.1 200 ")


def test_health_alone_is_answered_where_every_connection_is_in_use():
    async def run():
        async with serving(max_connections=2, max_connections_per_address=2) as connect:
            busy = [asyncio.create_task(answer_of(connect, "/slow")) for _ in range(2)]
            await asyncio.sleep(0.2)
            during = [await answer_of(connect, path) for path in ("/livez", "/readyz?a=b", "/other")]
            await asyncio.gather(*busy)
            return during, await answer_of(connect, "/other")

    (livez, readyz, other), afterwards = asyncio.run(run())
    assert livez.endswith(b"/livez")
    assert readyz.endswith(b"/readyz")
    assert problem_of(other) == (503, "too_many_connections")
    assert b"retry-after: " in other
    assert afterwards.endswith(b"/other")
