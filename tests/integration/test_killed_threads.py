"""Audio threads that die or hang under a server whose clients listen over sockets."""

import asyncio
import json
import struct
import sys
import threading
import time
import urllib.error
import urllib.request

import pytest
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed

from server.api import app
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import Acknowledge, AddEmitter
from tests.integration.churn import HELLO
from tests.killing import kill, threads_may_die

WITHIN_S = 2.0
STREAMS = 4
_SLACK_S = 8.0
"""For what has no bound of its own, on a busy machine."""
_SEQUENCE = struct.Struct("<I")
_SEQUENCE_AT = 4


class Listener:
    """A client over a socket: the sequence numbers of the blocks it heard, and how it was sent away."""

    def __init__(self, address):
        self.sequences = []
        self.error = self.close_code = None
        self._address = address
        self.task = asyncio.create_task(self._listen())

    async def _listen(self):
        async with connect(f"ws://{self._address}/v1/stream", compression=None, max_queue=None) as socket:
            await socket.send(HELLO)
            assert json.loads(await socket.recv())["type"] == "welcome"
            emitter = AddEmitter(id="0", clip="woman-reading", position=(6.0, 3.0, 1.5))
            await socket.send(emitter.serialize())
            try:
                while True:
                    await self._take(socket, await socket.recv())
            except ConnectionClosed as closed:
                self.close_code = closed.rcvd.code

    async def _take(self, socket, message):
        if isinstance(message, str):
            said = json.loads(message)
            self.error = said["code"] if said["type"] == "error" else self.error
            return
        assert message[0] == AudioBlock.KIND
        (sequence,) = _SEQUENCE.unpack_from(message, _SEQUENCE_AT)
        self.sequences.append(sequence)
        await socket.send(Acknowledge(sequence=sequence).serialize())

    async def hear(self, more=20):
        """So many blocks from now on."""
        count = len(self.sequences) + more
        await until(lambda: len(self.sequences) >= count, _SLACK_S)


async def until(condition, within_s):
    until_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < until_s
        await asyncio.sleep(0.01)


def status_of_readiness(address):
    try:
        with urllib.request.urlopen(f"http://{address}/readyz", timeout=5) as answer:
            return answer.status
    except urllib.error.HTTPError as answer:
        with answer:
            return answer.code


async def readiness_is(address, status, within_s):
    until_s = time.monotonic() + within_s
    while await asyncio.to_thread(status_of_readiness, address) != status:
        assert time.monotonic() < until_s


@pytest.fixture
def engines(monkeypatch):
    """Those that servers make from now on, of two audio threads each."""
    made = []

    def make(*arguments, **named):
        made.append(kind(*arguments, **named))
        return made[-1]

    kind = app.AudioEngine
    monkeypatch.setattr(app, "AudioEngine", make)
    monkeypatch.setenv("NAFIR_AUDIO_THREADS", "2")
    return made


@pytest.fixture
def engine(engines, request):
    request.getfixturevalue("served_anew")
    return engines[-1]


async def listening(address):
    """Clients that hear something, as many as there are streams."""
    listeners = [Listener(address) for _ in range(STREAMS)]
    await asyncio.gather(*(listener.hear() for listener in listeners))
    return listeners


async def leave(listeners):
    """End their connections, and wait for that: to be cancelled once more at the loop's end leaves sockets open."""
    for listener in listeners:
        listener.task.cancel()
    await asyncio.gather(*(listener.task for listener in listeners), return_exceptions=True)


def die(*_):
    """No boundary between streams holds this back."""
    sys.exit()


@threads_may_die
def test_streams_of_a_thread_that_is_killed_between_two_ticks_go_on(engine, served_anew):
    async def scenario():
        listeners = await listening(served_anew)
        dead = engine.threads[0]
        dead.tick = lambda: 60.0  # so that it dies at rest
        await until(lambda: dead.work_number is None, _SLACK_S)
        kill(dead._thread)
        dead._wake.set()
        await until(lambda: dead not in engine.threads, WITHIN_S)
        await asyncio.gather(*(listener.hear(50) for listener in listeners))
        await readiness_is(served_anew, 200, WITHIN_S)
        for listener in listeners:
            assert listener.sequences == list(range(len(listener.sequences)))
            assert listener.error is None
        await leave(listeners)

    asyncio.run(scenario())


@threads_may_die
def test_streams_that_a_thread_is_killed_at_are_told_and_newcomers_are_served(engine, served_anew):
    async def scenario():
        listeners = await listening(served_anew)
        dead = engine.threads[0]
        dead.turns.deal = die
        await until(lambda: sum(listener.task.done() for listener in listeners) == STREAMS // 2, WITHIN_S)
        told = [listener for listener in listeners if listener.task.done()]
        assert [(each.error, each.close_code) for each in told] == [("internal_error", 1011)] * len(told)
        staying = [listener for listener in listeners if listener not in told]
        newcomers = await listening(served_anew)
        assert dead not in engine.threads
        for listener in (*staying, *newcomers):
            await listener.hear()
            assert listener.error is None
        await leave([*staying, *newcomers])

    asyncio.run(scenario())


@threads_may_die
def test_a_server_whose_threads_die_again_and_again_is_not_ready(engine, served_anew):
    async def scenario():
        for _ in range(3):
            listeners = await listening(served_anew)
            dead = engine.threads[0]
            dead.turns.deal = die
            await until(lambda dead=dead: dead not in engine.threads, WITHIN_S)
            await leave(listeners)
        await readiness_is(served_anew, 503, WITHIN_S)

    asyncio.run(scenario())


def test_a_server_with_a_thread_that_is_stuck_is_not_ready_until_it_goes_on(engine, served_anew):
    async def scenario():
        listeners = await listening(served_anew)
        stuck, release = engine.threads[0], threading.Event()
        deal = stuck.turns.deal
        stuck.turns.deal = lambda streams: (release.wait(30), deal(streams))
        try:
            await readiness_is(served_anew, 503, WITHIN_S)
        finally:
            stuck.turns.deal = deal
            release.set()
        await readiness_is(served_anew, 200, WITHIN_S)
        for listener in listeners:
            await listener.hear()
        await leave(listeners)

    asyncio.run(scenario())
