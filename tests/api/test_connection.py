"""The driver of one connection, against a fake socket whose client reads when the test wants it to."""

import asyncio
import time
from contextlib import asynccontextmanager
from itertools import count

import pytest
from starlette.websockets import WebSocketDisconnect

from server.api import connection
from server.api.catalogue import open_clips
from server.api.connection import Connection, StreamHost
from server.api.inflow import LISTENER_COST
from server.api.response_cache import ResponseCache
from server.api.settings import Settings
from server.api.web_socket import FastPath
from server.field.fields_by_level import FieldsByLevel
from server.planning.places import place_of_field
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import (
    PROTOCOL,
    Acknowledge,
    AddEmitter,
    AddListener,
    Hello,
    Ping,
    RemoveEmitter,
    RemoveListener,
)
from server.protocol.server_messages import Error, ListenerAdded, ListenerRemoved, Status, parse_server_message
from server.runtime.drain import Drain
from server.runtime.readiness import Readiness
from server.runtime.thread_pool import ThreadPool
from server.runtime.workers import Workers
from server.streaming.audience import Audience
from server.streaming.audio_engine import AudioEngine
from server.streaming.quality_steps import Offer
from server.streaming.session import Session

HELLO = Hello(protocol=PROTOCOL, scene="flat")


class Socket:
    """The server's end of a WebSocket whose client may be slow: sends and closing wait until `reads` is set."""

    def __init__(self):
        self.incoming, self.sent, self.reads = asyncio.Queue(), [], asyncio.Event()
        self.has_sent, self.close_code = asyncio.Event(), None
        self.reads.set()
        self.scope = {"type": "websocket"}

    async def accept(self, subprotocol=None):
        pass

    async def receive(self):
        return await self.incoming.get()

    async def send_text(self, text):
        await self.reads.wait()
        self.sent.append(parse_server_message(text))
        self.has_sent.set()

    async def send_bytes(self, data):
        await self.reads.wait()
        self.sent.append(AudioBlock.parse(data, "f32"))

    async def close(self, code, _reason):
        await self.reads.wait()
        self.close_code = code
        self.incoming.put_nowait({"type": "websocket.disconnect", "code": code})

    def say(self, message):
        self.incoming.put_nowait({"type": "websocket.receive", "text": message.serialize()})


@asynccontextmanager
async def hosting(field, hrtfs, **settings):
    with Workers(1) as workers, ResponseCache(workers=1, waiting=1) as responses:
        audio = AudioEngine(asyncio.get_running_loop().call_soon_threadsafe, workers)
        host = StreamHost(
            scenes={"flat": FieldsByLevel([field])},
            clips=open_clips({"flat": FieldsByLevel([field])}, ()),
            hrtfs=hrtfs,
            audio=audio,
            settings=Settings(**settings),
            responses=responses,
            offers={"flat": Offer((field.level,), {field.level.name: 1.0})},
            places={"flat": place_of_field(field)},
            readiness=Readiness(Drain(8.0), warm_up="done"),
            encoders=ThreadPool(1, "encoder", patience_s=10.0),
        )
        audio.start()
        try:
            yield host
        finally:
            await asyncio.to_thread(audio.stop)
            await asyncio.to_thread(host.encoders.stop, 1.0)


async def stop_reading(socket, message):
    """Say hello, read the welcome and nothing more, and give the server a thousand occasions to answer."""
    socket.say(HELLO)
    await asyncio.wait_for(socket.has_sent.wait(), 5)
    socket.reads.clear()
    for _ in range(20):
        for _ in range(50):
            socket.say(message)
        await asyncio.sleep(0.015)  # a block: what the audio thread is to answer has to come slowly


async def listen_for_a_second(socket):
    """Acknowledge blocks until a status comes, and leave."""
    while not any(isinstance(message, Status) for message in socket.sent):
        for block in [message for message in socket.sent if isinstance(message, AudioBlock)][-1:]:
            socket.say(Acknowledge(sequence=block.sequence))
        await asyncio.sleep(0.01)
    await socket.close(1000, "")


def test_blocks_that_leave_after_their_deadline_are_flagged_and_counted(field, hrtfs):
    async def scenario():
        socket = Socket()
        async with hosting(field, hrtfs) as host:
            running = asyncio.create_task(Connection(socket, host, time_s=lambda: time.monotonic() + 1.0).run())
            socket.say(HELLO)
            await listen_for_a_second(socket)
            await running
        return socket.sent

    sent = asyncio.run(scenario())
    late = [message for message in sent if isinstance(message, AudioBlock)]
    (status,) = [message for message in sent if isinstance(message, Status)]
    assert all(block.is_late for block in late)
    assert status.blocks_late == pytest.approx(len(late), abs=12)


def test_blocks_that_go_the_short_way_and_the_long_one_stay_in_order(field, hrtfs):
    """Where the short way has no room, what comes waits for what waits; each block is late once, whichever way."""
    tries, written = count(1), []

    async def scenario():
        socket = Socket()

        def write(messages):
            if next(tries) % 5 in {0, 1}:
                return False
            blocks = [AudioBlock.parse(data, "f32") for data in messages]
            written.extend(block.sequence for block in blocks)
            socket.sent.extend(blocks)
            return True

        async with hosting(field, hrtfs) as host:
            way = FastPath(write=write, listen=lambda _: None)
            connection = Connection(socket, host, fast_path=way, time_s=lambda: time.monotonic() + 1.0)
            running = asyncio.create_task(connection.run())
            socket.say(HELLO)
            await listen_for_a_second(socket)
            await running
        return socket.sent

    sent = asyncio.run(scenario())
    blocks = [message for message in sent if isinstance(message, AudioBlock)]
    (status,) = [message for message in sent if isinstance(message, Status)]
    assert [block.sequence for block in blocks] == list(range(len(blocks)))
    assert 0 < len(written) < len(blocks)
    assert status.blocks_late == pytest.approx(len(blocks), abs=12)


def test_what_is_heard_at_once_waits_for_a_clip_that_is_being_read(field, hrtfs):
    """An emitter whose clip is decoded off the loop is there for whatever came after it."""

    async def scenario():
        socket, listening = Socket(), asyncio.get_running_loop().create_future()
        way = FastPath(write=lambda _: False, listen=listening.set_result)
        async with hosting(field, hrtfs) as host:
            running = asyncio.create_task(Connection(socket, host, fast_path=way).run())
            socket.say(HELLO)
            hear = await asyncio.wait_for(listening, 5)
            assert not hear(AddEmitter(id="a", clip="trumpet", position=(1.0, 2.0, 1.0)).serialize())
            assert hear(Ping(id=1).serialize())
            assert hear("nonsense")
            socket.say(AddEmitter(id="a", clip="trumpet", position=(1.0, 2.0, 1.0)))
            await asyncio.sleep(0)
            await asyncio.sleep(0)
            waited = not hear(RemoveEmitter(id="a").serialize())
            await asyncio.sleep(0.2)
            await socket.close(1000, "")
            await running
        return waited, [message for message in socket.sent if isinstance(message, Error)]

    waited, errors = asyncio.run(scenario())
    assert waited
    assert [error.code for error in errors] == ["malformed_message"]


@pytest.mark.parametrize("message", [Ping(id=1), RemoveEmitter(id="ghost")])
def test_a_client_that_never_reads_its_answers_is_cut_off(field, hrtfs, message):
    async def scenario():
        socket = Socket()
        async with hosting(field, hrtfs) as host:
            running = asyncio.create_task(Connection(socket, host).run())
            await stop_reading(socket, message)
            await asyncio.wait_for(running, 5)
            return host.streams

    assert asyncio.run(scenario()) == 0


def test_a_client_that_reads_too_late_learns_why_it_was_cut_off(field, hrtfs):
    async def scenario():
        socket = Socket()
        async with hosting(field, hrtfs) as host:
            running = asyncio.create_task(Connection(socket, host).run())
            await stop_reading(socket, Ping(id=1))
            socket.reads.set()
            await asyncio.wait_for(running, 5)
        return socket

    socket = asyncio.run(scenario())
    assert socket.close_code == 1008
    assert socket.sent[-1].code == "reads_too_slowly"


def told(socket, kind):
    return [message for message in socket.sent if isinstance(message, kind)]


def test_a_listener_costs_its_client_and_waits_for_work_of_those_who_left(field, hrtfs, monkeypatch):
    charged = []

    async def scenario():
        socket = Socket()
        way = FastPath(write=lambda _: False, listen=lambda _: None, charge=charged.append)
        async with hosting(field, hrtfs) as host:
            running = asyncio.create_task(Connection(socket, host, fast_path=way).run())
            socket.say(HELLO)
            with monkeypatch.context() as patched:
                patched.setattr(Audience, "departed_work", 4)
                socket.say(AddListener(id="guest", position=(1.0, 2.0, 1.0)))
                await until(lambda: told(socket, Error))
            assert charged == []
            assert next(iter(host.admission._places)).listeners == 1
            socket.say(AddListener(id="guest", position=(1.0, 2.0, 1.0)))
            await until(lambda: told(socket, ListenerAdded))
            await socket.close(1000, "")
            await running
        return told(socket, Error)

    (refusal,) = asyncio.run(scenario())
    assert (refusal.code, refusal.listener, refusal.retry_after_s) == ("server_busy", "guest", 1)
    assert charged == [LISTENER_COST]


def test_who_lets_listeners_go_while_it_reads_nothing_is_not_cut_off(field, hrtfs, monkeypatch):
    """Their blocks wait no longer, so that the room for them can go too."""
    monkeypatch.setattr(connection, "MAX_WAITING_ANSWERS", 20)
    window, guests = Settings().window_blocks + HELLO.buffer_blocks, ("a", "b")

    async def scenario():
        socket = Socket()
        async with hosting(field, hrtfs) as host:
            driver = Connection(socket, host)
            running = asyncio.create_task(driver.run())
            socket.say(HELLO)
            await asyncio.wait_for(socket.has_sent.wait(), 5)
            socket.reads.clear()
            for name in guests:
                socket.say(AddListener(id=name, position=(1.0, 2.0, 1.0)))
            await until(lambda: len(driver._outgoing) >= 3 * window - 5)
            for name in guests:
                socket.say(RemoveListener(id=name))
            (stream,) = host.audio.streams
            await until(lambda: len(stream.audience.members) == 1)
            await asyncio.sleep(0.1)  # some blocks more
            waiting = len(driver._outgoing)
            socket.reads.set()
            await until(lambda: len(told(socket, ListenerRemoved)) == 2 or running.done())
            await socket.close(1000, "")
            await running
        return socket, waiting

    socket, waiting = asyncio.run(scenario())
    assert codes(socket) == []
    assert waiting <= window + 20
    mine = [block.sequence for block in told(socket, AudioBlock) if block.listener == 0]
    assert mine == list(range(len(mine)))


def test_before_the_server_is_warm_a_client_is_told_to_come_back(field, hrtfs):
    async def scenario():
        socket = Socket()
        async with hosting(field, hrtfs) as host:
            host.readiness.warm_up = "under way"
            await Connection(socket, host).run()
        return socket

    socket = asyncio.run(scenario())
    assert [message.code for message in socket.sent] == ["not_ready"]
    assert socket.close_code == 1013


def test_a_client_may_leave_at_any_moment(field, hrtfs):
    class Gone(Socket):
        """Whose client left after the given number of sends."""

        def __init__(self, sends):
            super().__init__()
            self.sends = sends

        def _leave(self):
            self.sends -= 1
            if self.sends < 0:
                raise WebSocketDisconnect(1006)

        async def send_text(self, text):
            self._leave()
            await super().send_text(text)

        async def send_bytes(self, data):
            self._leave()
            await super().send_bytes(data)

    async def scenario(first, sends):
        socket = Gone(sends)
        async with hosting(field, hrtfs) as host:
            socket.say(first)
            await asyncio.wait_for(Connection(socket, host).run(), 5)
            return host.streams

    for first, sends in [(Ping(id=1), 0), (HELLO, 0), (HELLO, 1), (HELLO, 5)]:
        assert asyncio.run(scenario(first, sends)) == 0


def test_a_stream_that_fails_is_closed_with_an_internal_error(field, hrtfs, monkeypatch):
    async def scenario():
        socket = Socket()
        async with hosting(field, hrtfs) as host:
            running = asyncio.create_task(Connection(socket, host).run())
            # Stands for a defect of our own.
            monkeypatch.setattr(Session, "accept", lambda *_: 1 / 0)
            socket.say(HELLO)
            socket.say(AddEmitter(id="a", clip="trumpet", position=(1.0, 2.0, 1.0)))
            await asyncio.wait_for(running, 5)
        return socket

    socket = asyncio.run(scenario())
    assert socket.close_code == 1011
    assert [message.code for message in socket.sent if isinstance(message, Error)] == ["internal_error"]


async def until(condition):
    async with asyncio.timeout(5):
        while not condition():  # noqa: ASYNC110  there is no event for it
            await asyncio.sleep(0.005)


def codes(socket):
    return [message.code for message in socket.sent if isinstance(message, Error)]


def test_who_says_nothing_takes_no_stream(field, hrtfs):
    async def scenario():
        silent, speaking = [Socket() for _ in range(5)], Socket()
        async with hosting(field, hrtfs, max_streams=1) as host:
            running = [asyncio.create_task(Connection(socket, host).run()) for socket in (*silent, speaking)]
            await until(lambda: len(host.silent) == 6)
            assert host.streams == 0
            speaking.say(HELLO)
            await listen_for_a_second(speaking)
            for socket in silent:
                await socket.close(1000, "")
            await asyncio.gather(*running)
            assert (host.streams, host.silent) == (0, {})
        return speaking

    assert codes(asyncio.run(scenario())) == []


def test_no_more_streams_are_opened_at_once_than_there_may_be(field, hrtfs):
    """Opening a session takes a while, in which others say hello."""

    async def scenario():
        sockets = [Socket() for _ in range(5)]
        async with hosting(field, hrtfs, max_streams=2) as host:
            running = [asyncio.create_task(Connection(socket, host).run()) for socket in sockets]
            await until(lambda: len(host.silent) == 5)
            for socket in sockets:
                socket.say(HELLO)
            await until(lambda: sum(socket.close_code is not None for socket in sockets) == 3)
            await until(lambda: sum(not codes(socket) and bool(socket.sent) for socket in sockets) == 2)
            assert host.streams == 2
            for socket in sockets:
                await socket.close(1000, "")
            await asyncio.gather(*running)
            assert host.streams == 0
        return sockets

    sockets = asyncio.run(scenario())
    assert sorted(codes(socket) for socket in sockets) == [[], [], ["server_busy"], ["server_busy"], ["server_busy"]]


@pytest.mark.parametrize("refused", [{"scene": "moon"}, {"protocol": 1}])
def test_a_hello_that_is_refused_takes_no_stream(field, hrtfs, refused):
    async def scenario():
        refusing, speaking = Socket(), Socket()
        async with hosting(field, hrtfs, max_streams=1) as host:
            refusing.say(HELLO.model_copy(update=refused))
            await Connection(refusing, host).run()
            assert host.streams == 0
            running = asyncio.create_task(Connection(speaking, host).run())
            speaking.say(HELLO)
            await listen_for_a_second(speaking)
            await running
        return refusing, speaking

    refusing, speaking = asyncio.run(scenario())
    assert refusing.close_code == 1008
    assert codes(speaking) == []


def test_of_too_many_who_say_nothing_the_first_is_sent_away(field, hrtfs):
    async def scenario():
        sockets = [Socket() for _ in range(4)]
        async with hosting(field, hrtfs, max_silent=3) as host:
            running = []
            for socket in sockets:
                running.append(asyncio.create_task(Connection(socket, host).run()))
                await asyncio.sleep(0.01)
            await asyncio.wait_for(running[0], 5)
            assert len(host.silent) == 3
            sockets[3].say(HELLO)
            await asyncio.wait_for(sockets[3].has_sent.wait(), 5)
            for socket in sockets:
                await socket.close(1000, "")
            await asyncio.gather(*running)
        return sockets

    sockets = asyncio.run(scenario())
    assert [codes(socket) for socket in sockets] == [["hello_expected"], [], [], []]


def test_a_client_that_acknowledges_nothing_is_closed_after_the_time_stated(field, hrtfs):
    """It reads all it is sent, and asks."""

    async def scenario():
        socket = Socket()
        async with hosting(field, hrtfs, stall_timeout_s=0.5) as host:
            began_s = time.monotonic()
            running = asyncio.create_task(Connection(socket, host).run())
            socket.say(HELLO)
            while not running.done():
                socket.say(Ping(id=1))
                await asyncio.sleep(0.05)
            await running
            assert host.streams == 0
        return socket, time.monotonic() - began_s

    socket, lasted_s = asyncio.run(scenario())
    assert codes(socket) == ["stalled"]
    assert socket.close_code == 1008
    window_s = 40 * 256 / 24_000
    assert 0.5 + window_s - 0.1 < lasted_s < 3.0


def test_a_client_that_acknowledges_in_time_is_not_closed(field, hrtfs):
    async def scenario():
        socket = Socket()
        async with hosting(field, hrtfs, stall_timeout_s=0.3) as host:
            running = asyncio.create_task(Connection(socket, host).run())
            socket.say(HELLO)
            await listen_for_a_second(socket)
            await running
        return socket

    assert codes(asyncio.run(scenario())) == []


def test_a_stream_is_told_when_the_server_ends_and_so_is_who_has_not_said_hello_and_who_comes_later(field, hrtfs):
    async def scenario():
        playing, silent, late = Socket(), Socket(), Socket()
        async with hosting(field, hrtfs) as host:
            running = [asyncio.create_task(Connection(socket, host).run()) for socket in (playing, silent)]
            playing.say(HELLO)
            await asyncio.wait_for(playing.has_sent.wait(), 5)
            await asyncio.sleep(0.1)
            await asyncio.wait_for(host.readiness.drain.settle(), 5)
            assert all(task.done() for task in running)
            assert not host.audio.streams
            assert host.streams == 0
            await asyncio.wait_for(Connection(late, host).run(), 5)
        return playing, silent, late

    for socket in asyncio.run(scenario()):
        assert socket.close_code == 1012
        assert socket.sent[-1].code == "server_draining"


def test_where_others_take_its_streams_a_server_plays_each_until_its_turn_and_opens_no_more(field, hrtfs):
    async def scenario():
        first, second, late = Socket(), Socket(), Socket()
        async with hosting(field, hrtfs) as host:
            host.readiness.drain = Drain(60.0, in_turn=True)
            running = [asyncio.create_task(Connection(socket, host).run()) for socket in (first, second, late)]
            for socket in (first, second):
                socket.say(HELLO)
                await asyncio.wait_for(socket.has_sent.wait(), 5)
            host.readiness.drain.begin()
            await asyncio.wait_for(running[0], 5)
            late.say(HELLO)
            await asyncio.wait_for(running[2], 5)
            assert not running[1].done()
            assert len(host.audio.streams) == 1
            running[1].cancel()
            await asyncio.wait({running[1]})
        return first, late

    for socket in asyncio.run(scenario()):
        assert socket.close_code == 1012
        error = socket.sent[-1]
        assert (error.code, error.retry_after_s) == ("server_draining", None)
        assert "another takes it now" in error.message


def test_streams_are_let_in_by_the_cores_of_the_settings(field, hrtfs):
    async def scenario():
        async with hosting(field, hrtfs, cores=3) as host:
            return host.admission.load().cores

    assert asyncio.run(scenario()) == 3


def test_a_client_that_does_not_read_keeps_the_server_from_ending_for_a_moment_only(field, hrtfs):
    async def scenario():
        socket = Socket()
        async with hosting(field, hrtfs) as host:
            running = asyncio.create_task(Connection(socket, host).run())
            socket.say(HELLO)
            await asyncio.wait_for(socket.has_sent.wait(), 5)
            socket.reads.clear()
            began_s = time.monotonic()
            await host.readiness.drain.settle()
            assert running.done()
            return time.monotonic() - began_s

    assert asyncio.run(scenario()) < 4
