"""What the Python client says is what the server reads, and the other way round. The package has no import of it."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest

import nafir_client
from nafir_client import wire
from nafir_client.pose import Pose
from nafir_client.session import Session
from server.acoustics.geometry import Quaternion
from server.api.settings import Settings
from server.protocol.blocks import AudioBlock, DryBlock
from server.protocol.client_messages import PROTOCOL, Acknowledge, AddEmitter, Hello, ListenerPose, parse_client_message
from server.protocol.codecs.registry import CODECS, NUMBERS
from server.scene.effects import EffectName

FLAGS = {"is_exchange": wire.EXCHANGE, "is_late": wire.LATE, "is_limited": wire.LIMITED}
PACKAGE = Path(nafir_client.__file__).parent


def test_the_package_imports_neither_the_server_nor_more_than_it_says():
    allowed = {"nafir_client", "numpy", "websockets", "soundfile", "soxr", "sounddevice", "rich"}
    for module in PACKAGE.glob("*.py"):
        named = set(re.findall(r"^\s*(?:from|import) (\w+)", module.read_text(), re.MULTILINE))
        foreign = {name for name in named if name not in allowed and name not in sys.stdlib_module_names}
        assert foreign == set(), module.name


def test_constants_of_the_wire_are_those_of_the_server():
    assert wire.PROTOCOL == PROTOCOL
    assert (wire.BLOCK.size, wire.POSE.size, wire.DRY.size) == (
        AudioBlock.LAYOUT.size,
        ListenerPose.LAYOUT.size,
        DryBlock.LAYOUT.size,
    )
    assert (wire.BLOCK_KIND, wire.POSE_KIND, wire.DRY_KIND) == (AudioBlock.KIND, ListenerPose.KIND, DryBlock.KIND)
    assert FLAGS.items() <= AudioBlock.FLAGS.items()
    assert tuple(CODECS)[: len(wire.ENCODINGS)] == wire.ENCODINGS
    assert NUMBERS["opus"] == wire.OPUS_NUMBER
    assert tuple(EffectName) == wire.EFFECTS


@pytest.mark.parametrize("encoding", wire.ENCODINGS)
@pytest.mark.parametrize("flag", FLAGS)
def test_a_block_of_the_server_is_read_as_it_was_sent(encoding, flag):
    samples = np.random.default_rng(1).uniform(-1, 1, (4, 128)).astype(np.float32)
    sent = AudioBlock(7, 2**40, 3, 2, samples, **{flag: True})
    block = wire.parse_block(sent.serialize(encoding), encoding, 1.5, clock_offset=256)
    assert (block.sequence, block.sample_clock, block.pose_id, block.reverberation_pose_id) == (7, 2**40 + 256, 3, 2)
    assert {name: getattr(block, name) for name in FLAGS} == {name: name == flag for name in FLAGS}
    np.testing.assert_array_equal(block.samples, AudioBlock.parse(sent.serialize(encoding), encoding).samples.T)


@pytest.mark.parametrize("length", [0, 1, 27, 28, 30, 100])
def test_a_block_that_is_cut_short_is_refused(length):
    data = AudioBlock(0, 0, 0, 0, np.ones((2, 128), np.float32)).serialize("f32")
    with pytest.raises(nafir_client.ProtocolError, match="an audio block"):
        wire.parse_block(data[:length], "f32", 0.0)


@pytest.mark.parametrize("encoding", wire.ENCODINGS)
@pytest.mark.parametrize("name", ["a", "four", "größe"])
def test_the_server_reads_dry_blocks(encoding, name):
    samples = np.array([0.5, -1.0, 0.25], np.float32)
    read = DryBlock.parse(wire.dry_bytes(name, 9, samples, encoding))
    assert (read.id, read.sequence) == (name, 9)
    np.testing.assert_allclose(read.samples, samples, atol=1 / 32767)


def test_samples_that_are_no_numbers_go_as_silence():
    samples = np.array([np.nan, 0.5, np.inf, -np.inf], np.float32)
    np.testing.assert_array_equal(DryBlock.parse(wire.dry_bytes("a", 0, samples, "f32")).samples, [0, 0.5, 0, 0])


def test_the_server_reads_poses_and_yaw_turns_as_there():
    pose = Pose.of((1.1, 2.2, 1.5), yaw=0.7)
    read = ListenerPose.parse_binary(wire.pose_bytes(pose, 5))
    assert (read.pose_id, read.position) == (5, pose.position)
    np.testing.assert_allclose(read.pose.orientation, Quaternion.from_angles(0.7, 0.0, 0.0), atol=1e-6)
    np.testing.assert_array_equal(np.float32(pose.position), pose.position)


@pytest.mark.parametrize(
    ("position", "turn", "complaint"),
    [
        ((1, 2), {}, "position: has to be 3 finite numbers"),
        ((1, 2, float("nan")), {}, "position: has to be 3 finite numbers"),
        ((1, 2, 3), {"orientation": (0, 0, 0)}, "orientation: has to be 4 finite numbers"),
        ((1, 2, 3), {"orientation": (0, 0, 0, 0)}, "orientation: a quaternion of zeros"),
        ((1, 2, 3), {"orientation": (0, 0, 0, 1), "yaw": 1.0}, "orientation: give orientation or yaw"),
    ],
)
def test_what_is_no_pose_is_refused_before_it_is_sent(position, turn, complaint):
    with pytest.raises(ValueError, match=complaint):
        Pose.of(position, **turn)


def test_the_server_reads_every_text_message_of_a_session():
    listener = Pose.of((1, 2, 1), yaw=1.0)
    session = Session("flat", {"block_size": 512, "effects": {"hrtf": True}, "listener": listener})
    talker = session.add_emitter({"id": "talker", "clip": "noise", "position": (1.0, 2.0, 1.0), "loop": True}, None)
    session.move_emitter(talker, (2.0, 2.0, 1.0), (0.0, 0.0, 0.0, 1.0), 0.0)
    session.set_gain(talker, -6.0, 0.5)
    session.set_level("auto")
    session.set_door("kitchen", 0.25)
    session.set_effects({"hrtf": None, "occlusion": False}, "mono")
    session.ping(0.0)
    session.stop_emitter(talker, 48_000, 0.5)
    session.remove_emitter(talker)
    messages = []
    while (message := session.outbox.take()) is not None:
        messages.append(parse_client_message(message))
    assert [each.type for each in messages] == [
        "add_emitter",
        "move_emitter",
        "set_gain",
        "set_level",
        "set_door",
        "set_effects",
        "ping",
        "stop_emitter",
        "remove_emitter",
    ]
    hello = parse_client_message(session.first_message())
    assert isinstance(hello, Hello)
    assert (hello.scene, hello.block_size, hello.output, hello.effects) == ("flat", 512, "mono", {"occlusion": False})
    assert hello.listener.position == (1.0, 2.0, 1.0)
    assert hello.doors == {"kitchen": 0.25}


def test_a_new_connection_asks_for_what_the_last_one_had():
    session = Session("flat", {})
    session.add_emitter({"id": "gone", "clip": "noise", "position": (1.0, 2.0, 1.0)}, None)
    talker = session.add_emitter({"id": "talker", "clip": "noise", "position": (1.0, 2.0, 1.0)}, None)
    session.move_emitter(talker, (2.0, 2.5, 1.0), (0.0, 0.0, 1.0, 0.0), 0.0)
    session.set_gain(talker, -6.0, 0.5)
    session.remove_emitter(session.emitters["gone"])
    session.move_listener(Pose.of((3, 3, 1)), 0.0)
    hello = parse_client_message(session.first_message())
    assert (hello.listener.position, hello.emitters) == ((3.0, 3.0, 1.0), 1)
    session.greet(WELCOME, 0.0)
    again = parse_client_message(session.outbox.take())
    assert isinstance(again, AddEmitter)
    assert (again.id, again.position, again.orientation, again.gain_db) == ("talker", (2, 2.5, 1), (0, 0, 1, 0), -6.0)
    assert session.outbox.take() is None


def test_a_door_that_the_scene_does_not_have_is_not_asked_for_by_a_new_connection():
    session = Session("flat", {})
    session.greet(json.dumps({**json.loads(WELCOME), "doors": {"kitchen": 0.0}}), 0.0)
    session.set_door("kitchen", 0.25)
    session.set_door("of another scene", 1.0)
    assert session.outbox.take() is not None
    assert session.outbox.take() is not None
    assert parse_client_message(session.first_message()).doors == {"kitchen": 0.25}


def test_acknowledgements_keep_the_window_open():
    session = Session("flat", {})
    session.greet(WELCOME, 0.0)
    window, unacknowledged = Settings().window_blocks, 0
    for sequence in range(100):
        block = AudioBlock(sequence, 256 * sequence, 0, 0, np.zeros((2, 256), np.float32))
        session.receive(block.serialize("f32"), 0.0)
        unacknowledged += 1
        while (message := session.outbox.take()) is not None:
            acknowledged = parse_client_message(message)
            assert isinstance(acknowledged, Acknowledge)
            unacknowledged = sequence - acknowledged.sequence
        assert unacknowledged < window / 2


WELCOME = (
    '{"type": "welcome", "sample_rate": 24000, "block_size": 256, "channels": 2, "encoding": "f32", "window": 40,'
    ' "buffer_blocks": 8, "ir_samples": 4000, "hrtf": "kemar", "level": "standard", "new_field": 1, "scene":'
    ' {"id": "flat", "name": "A flat", "sample_rate": 24000, "bounds": {"minimum": [0, 0, 0], "maximum": [8, 5, 3]},'
    ' "listener": {"position": [2, 2.5, 1.5], "yaw": 0}, "emitter": {"position": [6, 3, 1.5]}, "openings": []}}'
)
