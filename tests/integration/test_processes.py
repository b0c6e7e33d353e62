"""Servers that take their connections from another process; and a whole `nafir serve --processes`."""

import asyncio
import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from pathlib import Path

import pytest
import uvicorn
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from server.api import member_server
from server.api.app import create_app
from server.api.member_server import MemberServer
from server.api.process_peers import ProcessPeers
from server.api.processes import listening_privately
from server.api.serving import uvicorn_options
from server.api.settings import Settings
from server.field.fields_by_level import FieldsByLevel
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import PROTOCOL, AddEmitter, Hello
from server.runtime.drain import Drain

ROOT = Path(__file__).parents[2]


class Dispatcher:
    """The other end of a server's channel."""

    def __init__(self, channel, own):
        self.channel, self.own = channel, own
        self._unread = b""

    def report(self):
        """The next report."""
        while b"\n" not in self._unread:
            self._unread += self.channel.recv(4096)
        line, _, self._unread = self._unread.partition(b"\n")
        return json.loads(line)

    def wait_for(self, condition):
        while not condition(report := self.report()):
            pass
        return report

    def connection(self):
        """A connection, as a client has it, whose other end is handed to the server."""
        with socket.socket() as listener:
            listener.bind(("127.0.0.1", 0))
            listener.listen()
            client = socket.create_connection(listener.getsockname(), timeout=20)
            accepted, _ = listener.accept()
        with accepted:
            socket.send_fds(self.channel, [b"\0"], [accepted.fileno()])
        return client


@pytest.fixture
def handed(bundle, hrtfs, monkeypatch):
    """A server without a port of its own but that for the other processes, of which there is one that is dead."""
    ended = []
    monkeypatch.setattr(member_server.os, "kill", lambda _, number: ended.append(number))
    ours, theirs = socket.socketpair()
    dead = listening_privately()
    dead_port = dead.getsockname()[1]
    dead.close()
    own = listening_privately()
    peers = ProcessPeers(1, (dead_port, own.getsockname()[1]))
    settings, drain = Settings(port=0, audio_threads=2), Drain(8.0)
    app = create_app(settings, scenes={"flat": FieldsByLevel.load(bundle)}, hrtfs=hrtfs, drain=drain, peers=peers)
    server = MemberServer(uvicorn.Config(app, log_level="warning", **uvicorn_options(settings)), drain, theirs)
    thread = threading.Thread(target=server.run, args=([own],))
    thread.start()
    dispatcher = Dispatcher(ours, own)
    try:
        dispatcher.wait_for(lambda report: report["is_ready"])
        yield dispatcher
        ours.close()
        until_s = time.monotonic() + 10
        while not ended:
            assert time.monotonic() < until_s
            time.sleep(0.02)
        assert ended == [signal.SIGTERM], "without the other process there is nothing to serve"
    finally:
        server.should_exit = True
        thread.join()
        theirs.close()
        ours.close()


def ask(connection, path):
    connection.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n".encode())
    answer = b"".join(iter(lambda: connection.recv(65_536), b""))
    connection.close()
    head, _, body = answer.partition(b"\r\n\r\n")
    return int(head.split()[1]), body


def hear(websocket, blocks):
    """Blocks from now on."""
    heard = []
    while len(heard) < blocks:
        message = websocket.recv(timeout=20)
        if isinstance(message, bytes):
            heard.append(AudioBlock.parse(message, "f32"))
            websocket.send(json.dumps({"type": "acknowledge", "sequence": heard[-1].sequence}))
    return heard


def test_a_connection_that_was_handed_over_is_served_as_any_other(handed):
    assert ask(handed.connection(), "/readyz") == (200, b'{"status":"ready"}')
    assert handed.report()["load"] == 0
    with connect("ws://localhost/v1/stream", sock=handed.connection()) as websocket:
        websocket.send(Hello(protocol=PROTOCOL, scene="flat").serialize())
        heard = hear(websocket, 100)
        assert [block.sequence for block in heard] == list(range(100))
        assert handed.wait_for(lambda report: report["load"] > 0)["is_ready"]
    handed.wait_for(lambda report: report["load"] == 0)


def test_a_client_that_has_gone_before_it_is_served_does_no_harm(handed):
    for _ in range(5):
        handed.connection().close()
    assert ask(handed.connection(), "/livez")[0] == 200


def test_a_process_answers_with_the_metrics_of_all(handed):
    status, body = ask(handed.connection(), "/metrics")
    text = body.decode()
    assert status == 200
    assert 'nafir_process_up{process="0"} 0.0' in text
    assert 'nafir_process_up{process="1"} 1.0' in text
    assert 'nafir_ready{process="1"} 1.0' in text
    assert "nafir_ready 1.0" in ask(handed.connection(), "/metrics/process")[1].decode()


def _metric(port, name):
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=20) as answer:
        lines = answer.read().decode().splitlines()
    return {line.split()[0]: float(line.split()[1]) for line in lines if line.startswith(name)}


def _wait_until(condition, within_s=300.0):
    until_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < until_s
        time.sleep(0.2)


def _are_up(port, count):
    with contextlib.suppress(OSError):
        ready = _metric(port, "nafir_ready{")
        return len(ready) == count and all(ready.values())
    return False


def _rest(stream):
    """What still comes until the stream ends."""
    with contextlib.suppress(ConnectionClosed):
        while True:
            yield stream.recv(timeout=20)


@pytest.mark.long
@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two cores")
def test_streams_are_spread_over_processes_one_that_dies_takes_only_its_own_and_a_signal_drains_all():
    command = [sys.executable, "-m", "server", "serve", "--port", "0", "--processes", "2"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as server:
        try:
            announced = server.stdout.readline()
            assert "with 2 processes" in announced
            port = int(re.search(r":(\d+)", announced).group(1))
            threading.Thread(target=server.stderr.read, daemon=True).start()
            _wait_until(lambda: _are_up(port, 2))
            with contextlib.ExitStack() as opened:
                streams = []
                for _ in range(6):
                    stream = opened.enter_context(connect(f"ws://127.0.0.1:{port}/v1/stream", max_size=None))
                    stream.send(Hello(protocol=PROTOCOL, scene="apartment").serialize())
                    stream.send(AddEmitter(id="a", clip="woman-reading", position=(6.0, 3.0, 1.5)).serialize())
                    streams.append(stream)
                    hear(stream, 5)
                counts = _metric(port, "nafir_audio_thread_streams")
                assert [sum(n for key, n in counts.items() if f'process="{k}"' in key) for k in range(2)] == [3, 3]
                pids = subprocess.run(["pgrep", "-P", str(server.pid)], capture_output=True, text=True, check=True)
                os.kill(int(pids.stdout.split()[-1]), signal.SIGKILL)
                left = []
                for stream in streams:
                    with contextlib.suppress(ConnectionClosed):
                        sequences = [block.sequence for block in hear(stream, 200)]
                        assert sequences == list(range(sequences[0], sequences[0] + 200))
                        left.append(stream)
                assert len(left) == 3
                server.send_signal(signal.SIGTERM)
                for stream in left:
                    assert any("server_draining" in message for message in _rest(stream) if isinstance(message, str))
                assert server.wait(20) == 0
        finally:
            server.kill()


async def durations_of_asking(ports):
    """How long process 0 waits for a stream of process 1; how long 60 of its clients wait together; and how long other
    work waits meanwhile."""
    one, other = (ProcessPeers(number, ports, "a key") for number in range(2))

    async def duration(work):
        began_s = time.monotonic()
        await work
        return time.monotonic() - began_s

    async def take():
        assert await one.take(other.new_token(), None, 1) is None

    alone = await duration(take())
    in_thread = asyncio.to_thread(time.sleep, 0.01)
    return alone, *await asyncio.gather(duration(asyncio.gather(*(take() for _ in range(60)))), duration(in_thread))


def test_who_waits_for_a_process_that_is_being_started_keeps_nobody_else_waiting():
    """Its socket accepts connections before anybody answers."""
    with listening_privately() as starting:
        alone, together, in_thread = asyncio.run(durations_of_asking((0, starting.getsockname()[1])))
    assert together < 2 * alone
    assert in_thread < alone / 2
