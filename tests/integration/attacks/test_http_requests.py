"""HTTP requests that never end, at full speed, harm nobody but who sends them."""

import contextlib
import socket
import threading
import time

import pytest

pytestmark = pytest.mark.attack

ENVIRONMENT = {"NAFIR_REQUEST_TIMEOUT_S": "2", "NAFIR_RESPONSE_TIMEOUT_S": "2"}
MEBIBYTE = 1024 * 1024
MOST_BYTES = 60 * MEBIBYTE
UPGRADE = (
    b"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
)


def connected(address):
    host, _, port = address.rpartition(":")
    return socket.create_connection((host, int(port)), timeout=10)


def pour(address, begin, piece):
    """Send without end, at most 60 MiB. What the server says meanwhile, and how much it took."""
    heard = bytearray()
    with connected(address) as client:

        def hear():
            with contextlib.suppress(OSError):
                while data := client.recv(65536):
                    heard.extend(data)

        hearing = threading.Thread(target=hear)
        hearing.start()
        sent = 0
        with contextlib.suppress(OSError):
            client.sendall(begin)
            while sent < MOST_BYTES:
                client.sendall(piece)
                sent += len(piece)
        with contextlib.suppress(OSError):
            client.shutdown(socket.SHUT_RDWR)
        hearing.join()
    return bytes(heard), sent


def status_of(heard):
    return int(heard.split(maxsplit=2)[1])


HEAD = b"GET /livez HTTP/1.1\r\nHost: localhost\r\n"
CHUNK = b"10000\r\n" + b"x" * 65536 + b"\r\n"


@pytest.mark.parametrize(
    ("begin", "piece", "status"),
    [
        (b"GET /", b"a" * MEBIBYTE, 414),
        (HEAD + b"name: ", b"a" * MEBIBYTE, 431),
        (HEAD, b"name: value\r\n" * 80_000, 431),
        (b"POST /v1/clips HTTP/1.1\r\nHost: localhost\r\nContent-Length: 99999999\r\n\r\n", b"x" * MEBIBYTE, 413),
        (b"POST /v1/clips HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n", CHUNK * 16, 413),
        (b"GET /v1/stream HTTP/1.1\r\nHost: localhost\r\n" + UPGRADE + b"name: ", b"a" * MEBIBYTE, 431),
        (b"GET /v1/stream HTTP/1.1\r\nHost: localhost\r\n" + UPGRADE, b"name: value\r\n" * 80_000, 431),
        (b"GET /v1/stream?" + b"a" * 4000, b"a" * MEBIBYTE, 414),
    ],
    ids=["line", "header", "headers", "body", "chunks", "upgrade-header", "upgrade-headers", "upgrade-line"],
)
def test_requests_without_an_end(address, endures, begin, piece, status):
    """Twelve, four at a time."""

    def attack():
        outcomes = []

        def again():
            outcomes.extend(pour(address, begin, piece) for _ in range(3))

        senders = [threading.Thread(target=again) for _ in range(4)]
        for sender in senders:
            sender.start()
        for sender in senders:
            sender.join()
        return outcomes

    outcomes = endures(attack)
    # This server takes no uploads: those of unknown length may be told so before they are too large.
    assert {status_of(heard) for heard, _ in outcomes if heard} <= {status, 403 if status == 413 else status}
    assert sum(bool(heard) for heard, _ in outcomes) >= 0.8 * len(outcomes)
    assert max(sent for _, sent in outcomes) < MOST_BYTES


def drained(clients, until_s):
    """How many the server has closed by then."""
    closed = set()
    while time.monotonic() < until_s and len(closed) < len(clients):
        for client in clients:
            with contextlib.suppress(BlockingIOError):
                try:
                    while client.recv(65536):
                        pass
                    closed.add(client)
                except ConnectionError:
                    closed.add(client)
        time.sleep(0.1)
    return len(closed)


@pytest.mark.parametrize(
    "begin",
    [
        b"",
        b"GET /livez HT",
        HEAD,
        b"POST /v1/clips HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1000\r\n\r\nabc",
        b"GET /v1/stream HTTP/1.1\r\nHost: localhost\r\n" + UPGRADE,
    ],
    ids=["silent", "line", "headers", "body", "upgrade"],
)
def test_half_sent_requests_are_closed(address, endures, begin):
    """Two hundred at once; two seconds of patience, two of lingering, and what a busy host adds."""

    def attack():
        with contextlib.ExitStack() as opened:
            clients = [opened.enter_context(connected(address)) for _ in range(200)]
            for client in clients:
                client.sendall(begin)
                client.setblocking(False)
            return drained(clients, time.monotonic() + 8.0)

    assert endures(attack) == 200


def test_a_thousand_silent_sockets(address, endures):
    """Those of one address push each other out; others come in, and streams keep their slots."""

    def attack():
        with contextlib.ExitStack() as opened:
            clients = [opened.enter_context(connected(address)) for _ in range(1_000)]
            time.sleep(1.0)
            with connected(address) as late:
                late.sendall(HEAD + b"Connection: close\r\n\r\n")
                answer = late.recv(65536)
            for client in clients:
                client.setblocking(False)
            still_open = 1_000 - drained(clients, time.monotonic() + 1.0)
            return answer, still_open

    answer, still_open = endures(attack)
    assert status_of(answer) == 200
    assert still_open <= 256


def test_silent_web_sockets(address, endures):
    """Three hundred that open and never say anything."""

    def attack():
        with contextlib.ExitStack() as opened:
            answers = []
            for _ in range(300):
                client = opened.enter_context(connected(address))
                client.sendall(b"GET /v1/stream HTTP/1.1\r\nHost: localhost\r\n" + UPGRADE + b"\r\n")
                answers.append(client.recv(12))
            time.sleep(1.0)
            return answers

    assert set(endures(attack)) == {b"HTTP/1.1 101"}


def test_slow_readers(address, endures):
    """Fifty that ask for megabytes, over and over, and take a byte now and then."""
    response = b"GET /v1/scenes/apartment/impulse-response?listener=1,2,1.5&emitter=6,3,1.5&format=json HTTP/1.1\r\n"
    request = (response + b"Host: localhost\r\n\r\n") * 20

    def attack():
        with contextlib.ExitStack() as opened:
            clients = []
            for _ in range(50):
                host, _, port = address.rpartition(":")
                client = opened.enter_context(socket.socket())
                client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
                client.connect((host, int(port)))
                client.sendall(request)
                client.setblocking(False)
                clients.append(client)
            closed = set()
            until_s = time.monotonic() + 10.0
            while time.monotonic() < until_s and len(closed) < len(clients):
                time.sleep(0.2)
                for client in clients:
                    # A reset is met with by `recv` only behind all that came before it.
                    if client.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
                        closed.add(client)
                    with contextlib.suppress(BlockingIOError, ConnectionError):
                        client.recv(1)
            return len(closed)

    assert endures(attack) == 50


def test_a_flood_of_requests(address, endures):
    """Two hundred connections with two hundred requests each: streams and health checks come between them."""
    request = b"GET /openapi.json HTTP/1.1\r\nHost: localhost\r\n\r\n" * 200

    def attack():
        with contextlib.ExitStack() as opened:
            for _ in range(200):
                opened.enter_context(connected(address)).sendall(request)
            time.sleep(5.0)

    endures(attack)
