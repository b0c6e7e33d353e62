"""The small WebSocket client, against the library's own parser and serialiser."""

import asyncio
import itertools
import time

import numpy as np
import pytest
from websockets.frames import Frame, Opcode
from websockets.streams import StreamReader

from server.bench.crowd import Crowd, FrameReader, Walker, frame
from server.bench.gauge import BLOCK_LISTENER, POSE_ID, POSE_IDS, POSE_LISTENER
from server.bench.places import Places
from server.bench.scene import bundle_of
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import (
    Acknowledge,
    AddEmitter,
    AddListener,
    Hello,
    ListenerPose,
    MoveEmitter,
    parse_client_message,
)

LENGTHS = (0, 1, 125, 126, 127, 2_076, 65_535)


@pytest.mark.parametrize(
    ("opcode", "length"),
    [(Opcode.PONG, 4), *itertools.product((Opcode.TEXT, Opcode.BINARY), LENGTHS)],
)
def test_what_a_client_sends_is_read_by_a_server(opcode, length):
    payload = bytes(number % 251 for number in range(length))
    reader = StreamReader()
    reader.feed_data(frame(opcode, payload))
    parsing = Frame.parse(reader.read_exact, mask=True)
    with pytest.raises(StopIteration) as parsed:
        next(parsing)
    assert parsed.value.value == Frame(opcode, payload)


@pytest.mark.parametrize("piece", [1, 2, 3, 7, 1_000, 10**6])
def test_what_a_server_sends_is_cut_into_messages_however_it_comes(piece):
    sent = [
        (opcode, bytes([length % 256]) * length)
        for opcode, length in itertools.product((Opcode.TEXT, Opcode.BINARY), (*LENGTHS[:-1], 70_000))
    ]
    stream = b"".join(Frame(opcode, payload).serialize(mask=False) for opcode, payload in sent)
    reader = FrameReader()
    heard = [message for at in range(0, len(stream), piece) for message in reader.feed(stream[at : at + piece])]
    assert heard == [(int(opcode), payload) for opcode, payload in sent]


def test_pose_ids_stand_where_they_are_looked_for():
    block = AudioBlock(
        sequence=1, sample_clock=2, pose_id=3, reverberation_pose_id=4, samples=np.zeros((2, 8), np.float32), listener=6
    )
    assert POSE_IDS.unpack_from(block.serialize("f32")) == (3, 4)
    assert block.serialize("f32")[BLOCK_LISTENER] == 6
    pose = ListenerPose(pose_id=5, position=(1.0, 2.0, 3.0), index=7)
    assert POSE_ID.unpack_from(pose.serialize_binary()) == (5,)
    assert pose.serialize_binary()[POSE_LISTENER] == 7


class Transport:
    """Keeps what a client sends, as a server reads it."""

    def __init__(self):
        self.messages = []

    def is_closing(self):
        return False

    def write(self, data):
        reader = StreamReader()
        reader.feed_data(data)
        parsing = Frame.parse(reader.read_exact, mask=True)
        with pytest.raises(StopIteration) as parsed:
            next(parsing)
        read = parsed.value.value
        text = read.data.decode() if read.opcode is Opcode.TEXT else read.data
        self.messages.append(parse_client_message(text))

    def abort(self):
        pass


@pytest.mark.parametrize("sways", [False, True])
def test_emitters_move_with_their_listener_if_they_are_to(sways):
    places = Places.of(bundle_of("apartment"))
    emitters = places.emitters(3, np.random.default_rng(0))

    async def scenario():
        walker = Walker(places, emitters, phase=0.25, poses_per_s=30.0, sways=sways, block_size=128)
        walker._transport = transport = Transport()
        walker._begin()
        for _ in range(4):
            walker._next_pose.cancel()  # not when it would be time
            walker._walk()
        walker.close()
        waits = walker.waits
        return transport.messages, waits.direct[0].unanswered_s(0.0), waits.reverberation[0].unanswered_s(0.0)

    messages, direct, reverberation = asyncio.run(scenario())
    hello, *adds = messages[:4]
    assert isinstance(hello, Hello)
    assert (hello.scene, hello.block_size) == ("apartment", 128)
    assert [isinstance(message, AddEmitter) for message in adds] == [True] * 3
    moved = messages[4:]
    expected = [*[MoveEmitter] * 3 * sways, ListenerPose] * 4
    assert [type(message) for message in moved] == expected
    ids = [message.pose_id for message in moved]
    assert ids == sorted(set(ids))
    assert len(direct) == len(reverberation) == 4  # a wait for each pose of the listener
    for message in (*adds, *moved):
        places.bundle.require_inside(message.position, "position")
    assert len({message.position for message in moved}) > 4 * sways


def test_each_listener_of_a_stream_walks_acknowledges_and_waits_for_itself():
    places = Places.of(bundle_of("apartment"))

    async def scenario():
        emitters = places.emitters(1, np.random.default_rng(0))
        walker = Walker(places, emitters, phase=0.25, poses_per_s=30.0, sways=False, listeners=3)
        walker._transport = transport = Transport()
        walker._begin()
        begun = transport.messages[:]
        for number in (1, 2):
            told = f'{{"type": "listener_added", "id": "listener-{number}", "index": {number}, "sample_clock": 0}}'
            walker._receive_text(told.encode())
        assert not walker.hears_all
        walker._receive_text(b'{"type": "emitter_added", "id": "0", "sample_clock": 0}')
        assert walker.hears_all
        transport.messages.clear()
        walker._next_pose.cancel()
        walker._walk()
        poses = transport.messages[:]
        transport.messages.clear()
        silence = np.zeros((2, 8), np.float32)
        for sequence in range(5):
            newest = poses[-1].pose_id
            walker._receive_audio(AudioBlock(sequence, 0, newest, newest, silence, listener=2).serialize("f32"))
        waiting = {number: len(walker.waits.direct[number].unanswered_s(0.0)) for number in range(3)}
        walker.close()
        return begun, poses, transport.messages, waiting, walker.blocks

    (hello, *added, emitter), poses, acknowledged, waiting, blocks = asyncio.run(scenario())
    assert (hello.listeners, hello.emitters) == (3, 1)
    assert [each.id for each in added] == ["listener-1", "listener-2"]
    assert all(isinstance(each, AddListener) for each in added)
    assert isinstance(emitter, AddEmitter)
    assert [each.index for each in poses] == [None, 1, 2]
    assert len({each.position for each in poses}) == 3
    assert sorted(each.pose_id for each in poses) == [each.pose_id for each in poses]
    assert acknowledged == [Acknowledge(sequence=number, listener="listener-2") for number in (0, 4)]
    assert waiting == {0: 1, 1: 1, 2: 0}
    assert blocks == 5


async def refusing(retry_after_s, when_asked):
    """A server that tells everybody to come back after so many seconds."""

    async def refuse(reader, writer):
        when_asked()
        await reader.readuntil(b"\r\n\r\n")
        writer.write(
            f"HTTP/1.1 503 Service Unavailable\r\nRetry-After: {retry_after_s}\r\nContent-Length: 0\r\n\r\n".encode()
        )
        writer.close()
        await writer.wait_closed()

    return await asyncio.start_server(refuse, "127.0.0.1", 0)


def test_a_rush_asks_at_once_and_its_preparation_is_nobodys_wait():
    """Where emitters are is chosen before the first connects, and a wait begins when its client connects."""
    told: list[str] = []
    places = Places.of(bundle_of("apartment"))

    class Chosen:
        bundle, walk = places.bundle, places.walk

        def emitters(self, count, _):
            told.append("chosen")
            return [self.walk] * count

    async def run():
        async with await refusing(7, lambda: told.append("asked")) as server:
            crowd = Crowd(server.sockets[0].getsockname()[1], Chosen(), emitters=2, poses_per_s=0.0)
            before_s = time.monotonic()
            rush = await crowd.rush(5)
            assert not crowd.walkers
            for walker in rush.walkers:
                walker.close()
            return before_s, rush

    before_s, rush = asyncio.run(run())
    assert told == ["chosen"] * 5 + ["asked"] * 5
    assert [walker.retry_after_s for walker in rush.walkers] == [7] * 5
    assert all(before_s < walker.asked_s < walker.answered_s for walker in rush.walkers)
    assert 0.0 <= rush.stall_s < 60.0
    assert rush.load > 0.0


def test_those_who_were_refused_come_back_no_sooner_than_they_were_told_until_time_is_over():
    asked_s: list[float] = []
    places = Places.of(bundle_of("apartment"))

    async def run():
        async with await refusing(1, lambda: asked_s.append(time.monotonic())) as server:
            crowd = Crowd(server.sockets[0].getsockname()[1], places, emitters=1, poses_per_s=0.0)
            rush = await crowd.rush(3)
            again = await crowd.come_back(rush.walkers, 1.5)
            assert not crowd.walkers
            return again, await crowd.come_back(rush.walkers, 0.5)

    assert asyncio.run(run()) == (3, 0)
    assert min(asked_s[3:]) - max(asked_s[:3]) > 0.9
