"""The small WebSocket client, against the library's own parser and serialiser."""

import itertools

import numpy as np
import pytest
from websockets.frames import Frame, Opcode
from websockets.streams import StreamReader

from server.bench.crowd import FrameReader, frame
from server.bench.gauge import POSE_ID, POSE_IDS
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import ListenerPose

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
        sequence=1, sample_clock=2, pose_id=3, reverberation_pose_id=4, samples=np.zeros((2, 8), np.float32)
    )
    assert POSE_IDS.unpack_from(block.serialize("f32")) == (3, 4)
    pose = ListenerPose(pose_id=5, position=(1.0, 2.0, 3.0))
    assert POSE_ID.unpack_from(pose.serialize_binary()) == (5,)
