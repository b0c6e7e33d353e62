"""Over a real socket: what only a real server shows."""

import json
import socket
import time

import pytest
from websockets.exceptions import ConnectionClosedError
from websockets.sync.client import connect

from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import PROTOCOL, Acknowledge, Hello

HELLO = Hello(protocol=PROTOCOL, scene="flat").serialize()


def blocks_for(client, duration_s):
    """Blocks that arrive meanwhile, acknowledged."""
    blocks, end_s = [], time.monotonic() + duration_s
    while time.monotonic() < end_s:
        message = client.recv(timeout=5)
        if isinstance(message, bytes):
            blocks.append(AudioBlock.parse(message, "f32"))
            client.send(Acknowledge(sequence=blocks[-1].sequence).serialize())
    return blocks


def send_and_listen(client, message):
    """Until the server closes the connection, be it while this still sends."""
    client.send(message)
    for _ in range(10_000):
        client.recv(timeout=5)


def test_a_message_far_too_long_closes_its_own_connection_only(served):
    url = f"ws://{served}/v1/stream"
    with connect(url) as good, connect(url) as bad:
        good.send(HELLO)
        bad.send(HELLO)
        with pytest.raises(ConnectionClosedError) as closed:
            send_and_listen(bad, "x" * (2 * 1024 * 1024))
        assert closed.value.rcvd.code == 1009
        blocks = blocks_for(good, 0.5)
        assert [block.sequence for block in blocks] == list(range(len(blocks)))
        assert len(blocks) > 30


def test_audio_is_not_compressed_on_the_way(served):
    with connect(f"ws://{served}/v1/stream") as client:
        assert "permessage-deflate" not in str(client.response.headers.get("Sec-WebSocket-Extensions", ""))


def test_sound_arrives_at_the_pace_of_time(served):
    with connect(f"ws://{served}/v1/stream") as client:
        client.send(HELLO)
        assert json.loads(client.recv())["type"] == "welcome"
        started_s = time.monotonic()
        count = len(blocks_for(client, 2.0))
        heard_s = count * 256 / 24_000
        # Never further ahead than the eight blocks asked for, whatever the machine does; behind only by what it stalls.
        assert heard_s <= time.monotonic() - started_s + 10 * 256 / 24_000
        assert heard_s > 1.5


def test_a_client_that_vanishes_leaves_no_stream_behind(served):
    welcomes = 0
    until_s = time.monotonic() + 30
    while welcomes < 70:  # more than the server has streams
        with connect(f"ws://{served}/v1/stream") as client:
            client.send(HELLO)
            said = json.loads(client.recv(timeout=5))
            if said["type"] == "welcome":
                welcomes += 1
                client.socket.shutdown(socket.SHUT_RDWR)
                continue
        # A machine that is busy for a moment lets fewer begin at once.
        assert "too many streams begin just now" in said["message"], said
        assert time.monotonic() < until_s, said
        time.sleep(0.1)
