"""One client that says as much as it can, in every way there is; the bystander hears nothing of it."""

import itertools
import os
import socket
import struct
import time

import numpy as np
import pytest
from websockets.client import ClientProtocol
from websockets.frames import Frame, Opcode
from websockets.http11 import Response
from websockets.uri import parse_uri

from server.protocol.blocks import AudioBlock, DryBlock
from server.protocol.client_messages import PROTOCOL, Acknowledge, AddEmitter, Hello, ListenerPose, Ping, SetGain
from server.protocol.server_messages import parse_server_message

pytestmark = pytest.mark.attack

FLOOD_S = 5.0
AT_ONCE = 500


def frame(message):
    opcode = Opcode.BINARY if isinstance(message, bytes) else Opcode.TEXT
    data = message if isinstance(message, bytes) else message.encode()
    return Frame(opcode, data).serialize(mask=True)


class Client:
    """Valid, and as fast as its socket: what it reads it throws away."""

    def __init__(self, address):
        self.said_bytes = 0
        host, port = address.split(":")
        self.socket = socket.create_connection((host, int(port)), timeout=10)
        self._protocol = ClientProtocol(parse_uri(f"ws://{address}/v1/stream"))
        self._protocol.send_request(self._protocol.connect())
        self.socket.sendall(b"".join(self._protocol.data_to_send()))
        while True:
            self._protocol.receive_data(self.socket.recv(65_536))
            for event in self._protocol.events_received():
                if isinstance(event, Response):
                    self.socket.sendall(frame(Hello(protocol=PROTOCOL, scene="apartment").serialize()))
                if isinstance(event, Frame) and event.opcode is Opcode.TEXT:
                    self.welcome = parse_server_message(event.data.decode())
                    assert self.welcome.type == "welcome", self.welcome
                    self.socket.setblocking(False)
                    return

    def say(self, data, until_s):
        """As much of it as goes until then; whether that was all."""
        left = memoryview(data)
        while left and time.monotonic() < until_s:
            try:
                sent = self.socket.send(left)
                self.said_bytes += sent
                left = left[sent:]
            except BlockingIOError:
                time.sleep(0.001)
            self.listen()
        return not left

    def listen(self):
        try:
            while self.socket.recv(1 << 20):
                pass
        except BlockingIOError:
            return
        raise AssertionError("the server closed the connection of a client that breaks no rule")


def poses(binary):
    place = (1.5, 2.0, 1.5)
    for number in itertools.count(1):
        pose = ListenerPose(pose_id=number % 2**32, position=place, yaw=None if binary else 0.1 * (number % 60))
        yield pose.serialize_binary() if binary else pose.serialize()


def alternating():
    for number, pose in enumerate(poses(binary=True)):
        yield pose
        yield SetGain(id="nobody", gain_db=-float(number % 60)).serialize()


FLOODS = {
    "binary poses": lambda: map(frame, poses(binary=True)),
    "poses": lambda: map(frame, poses(binary=False)),
    "poses among other messages": lambda: map(frame, alternating()),
    "pings": lambda: (frame(Ping(id=number).serialize()) for number in itertools.count()),
    "acknowledgements": lambda: itertools.repeat(frame(Acknowledge(sequence=0).serialize())),
    "nonsense": lambda: itertools.repeat(frame("?")),
    "empty messages": lambda: itertools.repeat(frame(b"")),
    "control frames": lambda: (
        Frame(Opcode.PING, struct.pack("<Q", number) * 15).serialize(mask=True) for number in itertools.count()
    ),
    "fragments": lambda: itertools.chain(
        [Frame(Opcode.TEXT, b"{", fin=False).serialize(mask=True)],
        itertools.repeat(Frame(Opcode.CONT, b" ", fin=False).serialize(mask=True)),
    ),
    "live blocks of one sample": lambda: (
        frame(DryBlock("live", number, np.zeros(1, np.float32)).serialize("f32")) for number in itertools.count()
    ),
    "long messages": lambda: itertools.repeat(frame(bytes(60_000))),
}
PREPARED = 40_000


def prepared(flood):
    """Batches of frames, made beforehand: what the client takes to make them is not to hold it up."""
    pieces = flood()
    size = len(next(flood()))
    count = max(AT_ONCE, min(PREPARED, 8_000_000 // max(1, size)))
    return [b"".join(itertools.islice(pieces, AT_ONCE)) for _ in range(count // AT_ONCE)]


def attack(address, batches):
    """Repeats the batches; says how many bytes went, of which some are still in the sockets' buffers."""
    client = Client(address)
    try:
        until_s = time.monotonic() + FLOOD_S
        add = AddEmitter(id="live", live=True, position=client.welcome.scene.emitter.position)
        client.say(frame(add.serialize()), until_s)
        for batch in itertools.cycle(batches):
            if not client.say(batch, until_s):
                return client.said_bytes
    finally:
        client.socket.close()


@pytest.mark.parametrize("flood", FLOODS.values(), ids=FLOODS)
def test_a_flood_makes_nobody_else_late(address, endures, flood):
    batches = prepared(flood)
    assert endures(lambda: attack(address, batches)) > 100_000


def test_many_tiny_pieces_make_nobody_else_late(address, endures):
    """Single bytes of poses, each in a segment of its own."""
    data = b"".join(itertools.islice(map(frame, poses(binary=True)), 5_000))

    def drip():
        client = Client(address)
        client.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        until_s = time.monotonic() + FLOOD_S
        try:
            for at in itertools.takewhile(lambda _: time.monotonic() < until_s, range(len(data))):
                client.say(data[at : at + 1], until_s)
            return at
        finally:
            client.socket.close()

    assert endures(drip) > 1_000


def test_a_client_that_reads_nothing_costs_no_memory(address, server_pid, endures):
    """It asks for pongs of the protocol and of WebSocket, and takes none."""
    batch = b"".join(Frame(Opcode.PING, os.urandom(125)).serialize(mask=True) for _ in range(AT_ONCE))

    def ask():
        client = Client(address)
        client.listen = lambda: None
        until_s = time.monotonic() + FLOOD_S
        while client.say(batch, until_s):
            pass
        client.socket.close()
        with open(f"/proc/{server_pid}/statm") as statm:  # noqa: PTH123  not a file
            return int(statm.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    before = ask()
    assert endures(ask) - before < 20_000_000


def test_the_most_talkative_player_is_not_held_up(address):
    """Sixteen live emitters in blocks of 128 samples, a pose a millisecond, an acknowledgement of every block: nothing
    that it says waits, is refused or is lost."""
    client = Client(address)
    rate, block = client.welcome.sample_rate, 128
    place = client.welcome.scene.emitter.position
    client.socket.setblocking(True)
    names = [f"live-{number}" for number in range(16)]
    for name in names:
        client.socket.sendall(frame(AddEmitter(id=name, live=True, position=place).serialize()))
    samples, newest = np.zeros(block, np.float32), -1
    heard, errors, worst_s, stall_s = [], [], 0.0, 0.0
    client.socket.settimeout(0.0005)
    began_s, sent, pose_id = time.monotonic(), 0, 0
    pose_sent = {}
    last_status = None
    while (now_s := time.monotonic()) - began_s < 4.0:
        due = int((now_s - began_s) * rate / block)
        due_poses = int((now_s - began_s) * 1_000)
        out = []
        for sequence in range(sent, due):
            out += [frame(DryBlock(name, sequence, samples).serialize("f32")) for name in names]
        for number in range(pose_id + 1, due_poses + 1):
            out.append(frame(ListenerPose(pose_id=number, position=(*place[:2], 1.5)).serialize_binary()))
            pose_sent[number] = now_s
        sent, pose_id = due, max(pose_id, due_poses)
        if out:
            client.socket.settimeout(5)
            client.socket.sendall(b"".join(out))
            stall_s = max(stall_s, time.monotonic() - now_s)
            client.socket.settimeout(0.0005)
        try:
            client._protocol.receive_data(client.socket.recv(1 << 20))
        except TimeoutError:
            continue
        for event in client._protocol.events_received():
            if not isinstance(event, Frame):
                continue
            if event.opcode is Opcode.TEXT:
                message = parse_server_message(event.data.decode())
                if message.type == "error":
                    errors.append(message)
                elif message.type == "status":
                    last_status = message
            elif event.opcode is Opcode.BINARY:
                audio = AudioBlock.parse(bytes(event.data), client.welcome.encoding)
                heard.append(audio.sequence)
                newest = audio.pose_id
                if newest in pose_sent and now_s - began_s > 2.0:
                    worst_s = max(worst_s, time.monotonic() - pose_sent[newest])
                client.socket.settimeout(5)
                client.socket.sendall(frame(Acknowledge(sequence=audio.sequence).serialize()))
                client.socket.settimeout(0.0005)
    client.socket.close()
    assert errors == []
    assert heard == list(range(len(heard)))
    assert last_status is not None
    assert sum(live.samples_dropped for live in last_status.live) == 0
    assert stall_s < 0.25
    assert worst_s < 0.5
