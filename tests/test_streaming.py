import asyncio
import json
import math
import struct
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager

import numpy as np
import pytest
import soundfile
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

from server.answers import Answers
from server.app import create_app
from server.audio_thread import AudioThread
from server.catalogue import open_clips
from server.protocol import (
    Acknowledge,
    AddEmitter,
    AudioBlock,
    EmitterAdded,
    EmitterRemoved,
    Error,
    Hello,
    ListenerPose,
    Ping,
    Pong,
    RemoveEmitter,
    Status,
    Welcome,
    parse_server_message,
)
from server.settings import Settings
from server.streaming import Connection, StreamHost

HELLO = Hello(protocol=1, scene="flat")
TALKER = AddEmitter(id="talker", clip="tone", position=(6.0, 3.0, 1.5))


@pytest.fixture
def clip_files(tmp_path):
    tone = tmp_path / "tone.wav"
    soundfile.write(tone, np.sin(np.arange(24_000) * 0.1) / 4, 24_000)
    broken = tmp_path / "broken.wav"
    broken.write_bytes(b"RIFF but not really")
    return tone, broken


@pytest.fixture
def client(field, clip_files):
    settings = Settings(clips=clip_files, hello_timeout_s=0.5, max_streams=2)
    with TestClient(create_app(settings, fields={"flat": field})) as client:
        for _ in range(200):
            if client.get("/readyz").status_code == 200:
                break
            time.sleep(0.05)
        yield client


class Ears:
    """A client that says hello, acknowledges every block, and can wait for what it wants to hear."""

    def __init__(self, socket, hello=HELLO):
        self.socket, self.encoding = socket, hello.encoding
        self.send(hello)
        self.welcome = self.until(Welcome)

    def send(self, message):
        self.socket.send_text(message if isinstance(message, str) else message.serialize())

    def receive(self):
        message = self.socket.receive()
        if message["type"] == "websocket.close":
            raise WebSocketDisconnect(message["code"], message.get("reason"))
        if message.get("text") is not None:
            return parse_server_message(message["text"])
        block = AudioBlock.parse(message["bytes"], self.encoding)
        self.send(Acknowledge(sequence=block.sequence))
        return block

    def until(self, kind, condition=lambda _: True):
        for _ in range(2_000):
            message = self.receive()
            if isinstance(message, kind) and condition(message):
                return message
        raise AssertionError(f"no {kind.__name__} came")

    def until_sound(self):
        return self.until(AudioBlock, lambda block: block.samples.any())


@pytest.fixture
def ears(client):
    with client.websocket_connect("/v1/stream") as socket:
        yield Ears(socket)


def test_from_hello_to_sound(ears):
    assert (ears.welcome.sample_rate, ears.welcome.block_size, ears.welcome.channels) == (24_000, 256, 2)
    assert ears.welcome.scene.id == "flat"
    first = ears.until(AudioBlock)
    assert (first.sequence, first.sample_clock, first.samples.shape) == (0, 0, (2, 256))
    ears.send(TALKER)
    added = ears.until(EmitterAdded)
    assert ears.until_sound().sample_clock == added.sample_clock
    ears.send(RemoveEmitter(id="talker"))
    assert ears.until(EmitterRemoved).id == "talker"
    ears.until(AudioBlock, lambda block: not block.samples.any())


def test_turning_the_head_swaps_the_louder_ear(ears):
    ears.send(TALKER)

    def louder_ear(yaw, pose_id):
        ears.send(ListenerPose(pose_id=pose_id, position=(6.0, 1.0, 1.5), yaw=yaw))
        ears.until(AudioBlock, lambda block: block.pose_id == pose_id and not block.is_exchange)
        energy = sum(np.sum(ears.until(AudioBlock).samples ** 2, axis=1) for _ in range(40))
        return int(np.argmax(energy))

    # The talker stands to the north; who looks east has it on the left.
    assert (louder_ear(0.0, 1), louder_ear(math.pi, 2)) == (0, 1)


def test_integer_samples_and_other_block_sizes_are_negotiated(client):
    hello = Hello(protocol=1, scene="flat", encoding="s16", block_size=512, sample_rate=24_000, buffer_blocks=2)
    with client.websocket_connect("/v1/stream") as socket:
        ears = Ears(socket, hello)
        assert ears.until(AudioBlock).samples.shape == (2, 512)
        ears.send(TALKER)
        assert 0.001 < np.abs(ears.until_sound().samples).max() <= 1


def test_binary_poses_are_heard(ears):
    ears.send(TALKER)
    ears.until(EmitterAdded)
    ears.socket.send_bytes(ListenerPose(pose_id=5, position=(3.0, 2.0, 1.5)).serialize_binary())
    assert ears.until(AudioBlock, lambda block: block.pose_id == 5).is_exchange


def test_pings_and_status(ears):
    ears.send(Ping(id=77))
    assert ears.until(Pong) == Pong(id=77)
    status = ears.until(Status)
    assert status.sample_clock >= 24_000
    assert status.blocks_dropped == 0


BAD_TEXT = [
    ("{", "malformed_message"),
    ('{"type": "levitate"}', "unknown_message"),
    ('{"type": "listener", "pose_id": 1, "position": [1, NaN, 1]}', "malformed_pose"),
    ('{"type": "listener", "pose_id": 1, "position": [1, 2]}', "malformed_pose"),
    ('{"type": "listener", "pose_id": 1, "position": [1, 2, 1], "orientation": [0, 0, 0, 0]}', "malformed_pose"),
    ('{"type": "listener", "pose_id": 1, "position": [100, 2, 1]}', "position_out_of_bounds"),
    ('{"type": "listener", "pose_id": 0, "position": [1, 2, 1]}', "stale_pose"),
    ('{"type": "add_emitter", "id": "x", "clip": "kazoo", "position": [1, 2, 1]}', "unknown_clip"),
    ('{"type": "add_emitter", "id": "x", "clip": "broken", "position": [1, 2, 1]}', "undecodable_clip"),
    ('{"type": "add_emitter", "id": "x", "clip": "tone", "position": [1, 2, 10]}', "position_out_of_bounds"),
    ('{"type": "add_emitter", "id": "talker", "clip": "tone", "position": [1, 2, 1]}', "duplicate_emitter"),
    ('{"type": "move_emitter", "id": "ghost", "position": [1, 2, 1], "pose_id": 1}', "unknown_emitter"),
    ('{"type": "remove_emitter", "id": "ghost"}', "unknown_emitter"),
    ('{"type": "acknowledge", "sequence": 4000000000}', "unknown_sequence"),
    ('{"type": "hello", "protocol": 1, "scene": "flat"}', "unexpected_hello"),
    (json.dumps({"type": "ping", "id": 1, "padding": "x" * 70_000}), "message_too_large"),
]
BAD_BYTES = [
    (b"", "unknown_message"),
    (b"\xff" * 36, "unknown_message"),
    (b"\x02" * 35, "malformed_pose"),
    (struct.pack("<BBHI7f", 2, 0, 0, 1, math.inf, 0, 0, 0, 0, 0, 1), "malformed_pose"),
    (bytes(70_000), "message_too_large"),
]


def test_every_bad_message_gets_its_code_and_the_stream_goes_on(ears):
    ears.send(TALKER)
    ears.until_sound()
    for bad, code in BAD_TEXT + BAD_BYTES:
        ears.socket.send_bytes(bad) if isinstance(bad, bytes) else ears.socket.send_text(bad)
        error = ears.until(Error)
        assert error.code == code
        assert error.message
    before = ears.until(AudioBlock)
    after = ears.until(AudioBlock, lambda block: block.sequence == before.sequence + 20)
    assert after.sample_clock == before.sample_clock + 20 * 256
    ears.send(ListenerPose(pose_id=1, position=(2.0, 2.0, 1.5)))
    ears.until(AudioBlock, lambda block: block.pose_id == 1)


def test_a_clip_that_cannot_be_decoded_says_why(ears):
    ears.send(AddEmitter(id="x", clip="broken", position=(1.0, 2.0, 1.0)))
    error = ears.until(Error)
    assert error.field == "clip"
    assert "broken.wav" in error.message
    assert len(error.message) > len("broken.wav: ")


@pytest.mark.parametrize(
    ("first", "code"),
    [
        (Ping(id=1).serialize(), "hello_expected"),
        ("?", "malformed_message"),
        (Hello(protocol=9, scene="flat").serialize(), "unsupported_protocol"),
        (Hello(protocol=1, scene="moon").serialize(), "unknown_scene"),
        (Hello(protocol=1, scene="flat", sample_rate=48_000).serialize(), "unsupported_sample_rate"),
        (
            '{"type": "hello", "protocol": 1, "scene": "flat", "listener": {"position": [99, 1, 1]}}',
            "position_out_of_bounds",
        ),
        (None, "hello_expected"),
    ],
)
def test_a_bad_hello_is_answered_and_ends_the_connection(client, first, code):
    with client.websocket_connect("/v1/stream") as socket:
        if first is not None:
            socket.send_text(first)
        assert parse_server_message(socket.receive_text()).code == code
        with pytest.raises(WebSocketDisconnect) as closed:
            socket.receive_text()
        assert (closed.value.code, closed.value.reason) == (1008, code)


def test_a_full_server_says_so_and_has_room_again_when_someone_leaves(client):
    with client.websocket_connect("/v1/stream") as first, client.websocket_connect("/v1/stream") as second:
        Ears(first), Ears(second)
        with client.websocket_connect("/v1/stream") as third:
            assert parse_server_message(third.receive_text()).code == "server_busy"
            with pytest.raises(WebSocketDisconnect) as closed:
                third.receive_text()
            assert closed.value.code == 1013
        second.close()
        for _ in range(100):
            with client.websocket_connect("/v1/stream") as socket:
                socket.send_text(HELLO.serialize())
                if parse_server_message(socket.receive_text()).type == "welcome":
                    return
            time.sleep(0.02)
    raise AssertionError("no room for a new stream")


def test_a_client_that_never_acknowledges_gets_a_window_and_then_nothing(client):
    with client.websocket_connect("/v1/stream") as socket:
        socket.send_text(HELLO.serialize())
        window = parse_server_message(socket.receive_text()).window
        sequences = []
        while True:
            message = socket.receive()
            if message.get("text") is not None:
                status = parse_server_message(message["text"])
                if status.sample_clock >= 24_000:
                    break
            else:
                sequences.append(AudioBlock.parse(message["bytes"], "f32").sequence)
        assert sequences == list(range(window))
        assert status.unacknowledged == window
        assert status.blocks_dropped == pytest.approx(94 - window, abs=3)


class Socket:
    """The server's end of a WebSocket whose client may be slow: sends wait until `reads` is set."""

    def __init__(self):
        self.incoming, self.sent, self.reads = asyncio.Queue(), [], asyncio.Event()
        self.has_sent, self.close_code = asyncio.Event(), None
        self.reads.set()

    async def accept(self):
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
        self.close_code = code
        self.incoming.put_nowait({"type": "websocket.disconnect", "code": code})

    def say(self, message):
        self.incoming.put_nowait({"type": "websocket.receive", "text": message.serialize()})


@asynccontextmanager
async def hosting(field, **settings):
    with ThreadPoolExecutor(1) as workers:
        audio = AudioThread(asyncio.get_running_loop().call_soon_threadsafe, workers)
        host = StreamHost(
            fields={"flat": field},
            clips=open_clips({"flat": field}, ()),
            audio=audio,
            settings=Settings(**settings),
            answers=Answers(workers=1, waiting=1),
            is_ready=True,
        )
        audio.start()
        try:
            yield host
        finally:
            await asyncio.to_thread(audio.stop)


def test_blocks_that_leave_after_their_deadline_are_flagged_and_counted(field):
    async def scenario():
        socket = Socket()
        async with hosting(field) as host:
            running = asyncio.create_task(Connection(socket, host, time_s=lambda: time.monotonic() + 1.0).run())
            socket.say(HELLO)
            while not any(isinstance(message, Status) for message in socket.sent):
                for block in [message for message in socket.sent if isinstance(message, AudioBlock)][-1:]:
                    socket.say(Acknowledge(sequence=block.sequence))
                await asyncio.sleep(0.01)
            await socket.close(1000, "")
            await running
        return socket.sent

    sent = asyncio.run(scenario())
    late = [message for message in sent if isinstance(message, AudioBlock)]
    (status,) = [message for message in sent if isinstance(message, Status)]
    assert all(block.is_late for block in late)
    assert status.blocks_late == pytest.approx(len(late), abs=12)


def test_a_client_that_does_not_read_its_answers_is_cut_off(field):
    async def scenario():
        socket = Socket()
        async with hosting(field) as host:
            running = asyncio.create_task(Connection(socket, host).run())
            socket.say(HELLO)
            await asyncio.wait_for(socket.has_sent.wait(), 5)
            socket.reads.clear()
            for number in range(1_000):
                socket.say(Ping(id=number))
            await asyncio.sleep(0.05)
            socket.reads.set()
            await running
            return socket.close_code, host.streams

    assert asyncio.run(scenario()) == (1008, 0)


def test_before_the_server_is_warm_a_client_is_told_to_come_back(field):
    async def scenario():
        socket = Socket()
        async with hosting(field) as host:
            host.is_ready = False
            await Connection(socket, host).run()
        return socket

    socket = asyncio.run(scenario())
    assert [message.code for message in socket.sent] == ["not_ready"]
    assert socket.close_code == 1013


def test_a_client_may_leave_at_any_moment(field):
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
        async with hosting(field) as host:
            socket.say(first)
            await asyncio.wait_for(Connection(socket, host).run(), 5)
            return host.streams

    for first, sends in [(Ping(id=1), 0), (HELLO, 0), (HELLO, 1), (HELLO, 5)]:
        assert asyncio.run(scenario(first, sends)) == 0


def test_a_stream_that_fails_is_closed_with_an_internal_error(field):
    async def scenario():
        socket = Socket()
        async with hosting(field) as host:
            running = asyncio.create_task(Connection(socket, host).run())
            # Not a shape that any bundle could have: stands for a defect of our own.
            field.impulse_responses = lambda *_: np.zeros((1, 2, 100), np.float32)
            socket.say(HELLO)
            socket.say(AddEmitter(id="a", clip="trumpet", position=(1.0, 2.0, 1.0)))
            socket.say(AddEmitter(id="b", clip="trumpet", position=(1.0, 2.0, 1.0)))
            await asyncio.wait_for(running, 5)
        return socket

    socket = asyncio.run(scenario())
    assert socket.close_code == 1011
    assert [message.code for message in socket.sent if isinstance(message, Error)] == ["internal_error"]
