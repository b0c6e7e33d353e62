"""How `nafir serve` ends: everybody is told, nothing fails, and it takes no longer than was stated."""

import asyncio
import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request

import pytest
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed

from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import PROTOCOL, Acknowledge, Hello
from server.protocol.server_messages import parse_server_message

DRAIN_S = 5.0
_READY_S = 300.0
"""The first time ever, everything is compiled."""
_SLACK_S = 1.5
"""The process has to be found ended, on a busy machine."""
_SLOW = "/v1/scenes/apartment/loudness?emitter={x},2,1.5&spacing_m=0.15"


class Ended:
    """A server's process that has ended: its exit code, what it said, and how long it took."""

    def __init__(self, code, said, took_s):
        self.code, self.said, self.took_s = code, said, took_s


class Server:
    def __init__(self, process, port, log):
        self.process, self.port, self._log = process, port, log
        self.told_s = self._ended_s = 0.0
        # Apart, since who asks may be busy when it ends.
        self._watch = threading.Thread(target=self._await_end)
        self._watch.start()

    def _await_end(self):
        self.process.wait()
        self._ended_s = time.monotonic()

    def tell(self, number):
        self.told_s = time.monotonic()
        self.process.send_signal(number)

    def end(self):
        self._watch.join(4 * DRAIN_S)
        assert self._ended_s, "it never ended"
        return Ended(self.process.returncode, self._log.read_text(), self._ended_s - self.told_s)


@contextlib.contextmanager
def serving(tmp_path, *, until_ready=True):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    log = tmp_path / "log"
    command = [sys.executable, "-c", "from server.cli.main import main; main()", "serve", "--port", str(port)]
    with log.open("wb") as output:
        # Twenty come at once, and all are to be there at the end.
        environment = {**os.environ, "NAFIR_DRAIN_S": str(DRAIN_S), "NAFIR_ADMISSION": "false"}
        process = subprocess.Popen(command, stdout=output, stderr=output, env=environment)
    try:
        path = "readyz" if until_ready else "livez"
        until_s = time.monotonic() + _READY_S
        while time.monotonic() < until_s:
            try:
                urllib.request.urlopen(f"http://127.0.0.1:{port}/{path}", timeout=5).close()
                break
            except urllib.error.HTTPError as answer:
                answer.close()
            except OSError:
                pass
            assert process.poll() is None, log.read_text()
            time.sleep(0.1)
        yield Server(process, port, log)
    finally:
        process.kill()
        process.wait()


async def listen(port, hears):
    """Code and reason of the close frame, and the last message before it. Sets `hears` with the first block."""
    last = None
    async with connect(f"ws://127.0.0.1:{port}/v1/stream", compression=None) as websocket:

        async def say(message):
            with contextlib.suppress(ConnectionClosed):  # what came before that is read all the same
                await websocket.send(message.serialize())

        await say(Hello(protocol=PROTOCOL, scene="apartment"))
        with contextlib.suppress(ConnectionClosed):
            while True:
                message = await websocket.recv()
                if isinstance(message, str):
                    last = parse_server_message(message)
                    continue
                await say(Acknowledge(sequence=AudioBlock.parse(message, "f32").sequence))
                hears.set()
        return websocket.close_code, websocket.close_reason, last


async def ask(port, path):
    """Status, headers and body."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    try:
        writer.write(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode())
        head = (await reader.readuntil(b"\r\n\r\n")).decode().split("\r\n")
        headers = {name.lower(): value for name, _, value in (line.partition(": ") for line in head[1:])}
        body = await reader.readexactly(int(headers["content-length"]))
        return int(head[0].split()[1]), headers, body
    finally:
        writer.close()


@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.long)])
def test_twenty_streams_and_five_requests_are_told_and_the_server_ends_in_time(tmp_path, number):
    async def scenario(server):
        hear = [asyncio.Event() for _ in range(20)]
        streams = [asyncio.create_task(listen(server.port, hears)) for hears in hear]
        await asyncio.gather(*(hears.wait() for hears in hear))
        requests = [asyncio.create_task(ask(server.port, _SLOW.format(x=1 + 0.1 * each))) for each in range(5)]
        await asyncio.sleep(0.3)
        server.tell(number)
        while (ready := await ask(server.port, "/readyz"))[0] == 200:
            assert time.monotonic() - server.told_s < 2
        server.told_s = time.monotonic()  # it cannot count from before it has heard
        late = await ask(server.port, "/v1/scenes"), await listen(server.port, asyncio.Event())
        return ready, late, await asyncio.gather(*requests), await asyncio.gather(*streams)

    with serving(tmp_path) as server:
        ready, (late_request, late_stream), requests, streams = asyncio.run(scenario(server))
        ended = server.end()
    for code, reason, last in (*streams, late_stream):
        assert (code, reason, last.code) == (1012, "server_draining", "server_draining")
    assert {status for status, *_ in requests} <= {200, 503}
    for status, headers, body in (ready, late_request, *requests):
        if status == 503:
            assert json.loads(body)["code"] == "server_draining"
            assert int(headers["retry-after"]) >= 1
    assert (ready[0], late_request[0]) == (503, 503)
    assert ended.took_s < DRAIN_S + _SLACK_S
    assert ended.code == 0, ended.said
    assert "Traceback" not in ended.said


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_with_nothing_in_flight_it_ends_at_once_even_in_the_midst_of_its_warm_up(tmp_path, number):
    with serving(tmp_path, until_ready=False) as server:
        server.tell(number)
        ended = server.end()
    assert ended.code == 0, ended.said
    assert ended.took_s < DRAIN_S / 2 + _SLACK_S
    assert "Traceback" not in ended.said


def test_told_a_second_time_it_ends_at_once(tmp_path):
    async def scenario(server):
        asking = asyncio.create_task(ask(server.port, _SLOW.format(x=1)))
        await asyncio.sleep(0.3)
        server.tell(signal.SIGTERM)
        assert (await ask(server.port, "/readyz"))[0] == 503
        assert not asking.done()
        server.tell(signal.SIGTERM)
        with contextlib.suppress(OSError, EOFError):
            await asking

    with serving(tmp_path) as server:
        asyncio.run(scenario(server))
        ended = server.end()
    assert ended.code == 128 + signal.SIGTERM
    assert ended.took_s < _SLACK_S
