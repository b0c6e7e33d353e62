import json
import math
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from server.acoustics.geometry import Pose
from server.catalogue import describe_scene
from server.errors import RequestError
from server.protocol import (
    Acknowledge,
    AddEmitter,
    AudioBlock,
    Durations,
    EmitterAdded,
    EmitterRemoved,
    Error,
    Hello,
    ListenerPose,
    ListenerStart,
    MoveEmitter,
    Ping,
    Pong,
    RemoveEmitter,
    Status,
    Welcome,
    parse_client_message,
    parse_server_message,
)

CLIENT_MESSAGES = [
    Hello(protocol=1, scene="flat"),
    Hello(
        protocol=1,
        scene="flat",
        sample_rate=24_000,
        block_size=512,
        encoding="s16",
        listener=ListenerStart(position=(1, 2, 1.5), yaw=0.3),
        buffer_blocks=4,
    ),
    AddEmitter(id="talker", clip="speech", position=(1, 2, 3), gain_db=-6, loop=False),
    MoveEmitter(id="talker", position=(1, 2, 3), pose_id=2**32 - 1),
    RemoveEmitter(id="talker"),
    ListenerPose(pose_id=4, position=(1, 2, 3), yaw=-math.pi),
    ListenerPose(pose_id=4, position=(1, 2, 3), orientation=(0, 0, 1, 0)),
    Acknowledge(sequence=7),
    Ping(id=2**53 - 1),
]

SERVER_MESSAGES = [
    EmitterAdded(id="talker", sample_clock=512),
    EmitterRemoved(id="talker"),
    Status(
        sample_clock=24_000,
        blocks_sent=90,
        blocks_late=1,
        blocks_dropped=2,
        unacknowledged=3,
        buffer_ms=80.5,
        render_ms=Durations(p50=0.5, p99=1.5),
        ir_ms=Durations(p50=None, p99=None),
        ir_exchanges=4,
    ),
    Pong(id=3),
    Error(code="stale_pose", message="older than the newest", field="pose_id"),
]


@pytest.mark.parametrize("message", CLIENT_MESSAGES, ids=lambda m: m.type)
def test_client_messages_survive_the_wire(message):
    assert parse_client_message(message.serialize()) == message


@pytest.mark.parametrize("message", SERVER_MESSAGES, ids=lambda m: m.type)
def test_server_messages_survive_the_wire(message):
    assert parse_server_message(message.serialize()) == message


def test_a_welcome_with_its_scene_survives_the_wire(field):
    welcome = Welcome(
        session="5e",
        scene=describe_scene(field),
        sample_rate=24_000,
        block_size=256,
        channels=2,
        encoding="f32",
        buffer_blocks=8,
        window=40,
        ir_samples=4_000,
        level="standard",
    )
    assert parse_server_message(welcome.serialize()) == welcome


def test_hello_as_a_person_would_type_it():
    hello = parse_client_message(
        '{"type": "hello", "protocol": 1, "scene": "flat", "listener": {"position": [1, 2, 1.5]}}'
    )
    assert (hello.block_size, hello.encoding, hello.buffer_blocks) == (256, "f32", 8)
    assert hello.listener.pose == Pose((1, 2, 1.5))


@pytest.mark.parametrize(
    ("text", "code", "field"),
    [
        ("", "malformed_message", None),
        ("{", "malformed_message", None),
        ("[" * 5000, "malformed_message", None),
        ('{"type": "remove_emitter", "id": "\\ud800"}', "malformed_message", None),
        ("null", "malformed_message", None),
        ('"hello"', "malformed_message", None),
        ("{}", "unknown_message", "type"),
        ('{"type": "teleport"}', "unknown_message", "type"),
        ('{"type": ["listener"]}', "unknown_message", "type"),
        ('{"type": "ping"}', "malformed_message", "id"),
        ('{"type": "ping", "id": true}', "malformed_message", "id"),
        ('{"type": "ping", "id": -1}', "malformed_message", "id"),
        ('{"type": "ping", "id": 9007199254740992}', "malformed_message", "id"),
        ('{"type": "ping", "id": 1, "extra": 2}', "malformed_message", "extra"),
        ('{"type": "acknowledge", "sequence": -1}', "malformed_message", "sequence"),
        ('{"type": "listener", "pose_id": 4294967296, "position": [1,2,3]}', "malformed_message", "pose_id"),
        ('{"type": "listener", "pose_id": 1.5, "position": [1,2,3]}', "malformed_message", "pose_id"),
        ('{"type": "listener", "pose_id": 1}', "malformed_pose", "position"),
        ('{"type": "listener", "pose_id": 1, "position": [1,2]}', "malformed_pose", "position"),
        ('{"type": "listener", "pose_id": 1, "position": [1,2,"3"]}', "malformed_pose", "position"),
        ('{"type": "listener", "pose_id": 1, "position": [1,2,NaN]}', "malformed_pose", "position"),
        ('{"type": "listener", "pose_id": 1, "position": [1,2,Infinity]}', "malformed_pose", "position"),
        ('{"type": "listener", "pose_id": 1, "position": [1,2,1e999]}', "malformed_pose", "position"),
        ('{"type": "listener", "pose_id": 1, "position": [1,2,3], "yaw": NaN}', "malformed_pose", "yaw"),
        ('{"type": "listener", "pose_id": 1, "position": [1,2,3], "orientation": [0,0,0,0]}', "malformed_pose", None),
        (
            '{"type": "listener", "pose_id": 1, "position": [1,2,3], "orientation": [0,0,0,1], "yaw": 0}',
            "malformed_pose",
            None,
        ),
        (
            '{"type": "listener", "pose_id": 1, "position": [1,2,3], "orientation": [0,0,1]}',
            "malformed_pose",
            "orientation",
        ),
        (
            '{"type": "hello", "protocol": 1, "scene": "a", "listener": {"position": [1,2,-Infinity]}}',
            "malformed_pose",
            "listener.position",
        ),
        ('{"type": "hello", "protocol": 1, "scene": "a", "block_size": 100}', "malformed_message", "block_size"),
        ('{"type": "hello", "protocol": 1, "scene": "a", "encoding": "mp3"}', "malformed_message", "encoding"),
        ('{"type": "move_emitter", "id": "", "position": [1,2,3], "pose_id": 1}', "malformed_message", "id"),
        (
            '{"type": "add_emitter", "id": "a", "clip": "b", "position": [1,2,3], "gain_db": 400}',
            "malformed_message",
            "gain_db",
        ),
    ],
)
def test_bad_text_is_refused_with_a_code_and_the_field(text, code, field):
    with pytest.raises(RequestError) as refusal:
        parse_client_message(text)
    assert (refusal.value.code, refusal.value.field) == (code, field)
    assert str(refusal.value)


@given(st.text())
def test_any_text_parses_or_is_refused(text):
    with pytest.raises(RequestError):
        parse_client_message(text)


@given(st.binary(max_size=64))
def test_any_bytes_parse_or_are_refused(data):
    try:
        message = parse_client_message(data)
    except RequestError:
        return
    assert isinstance(message, ListenerPose)


def test_a_binary_pose_has_the_documented_layout():
    data = struct.pack("<BBHI", 2, 0, 0, 9) + np.array([1, 2, 1.5, 0, 0, 1, 1], "<f4").tobytes()
    message = parse_client_message(data)
    assert (message.pose_id, message.pose.position) == (9, (1.0, 2.0, 1.5))
    assert math.isclose(message.pose.yaw, math.pi / 2)
    assert parse_client_message(message.serialize_binary()).pose.position == message.pose.position


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (b"", "unknown_message"),
        (b"\x09" + bytes(35), "unknown_message"),
        (b"\x02" + bytes(34), "malformed_pose"),
        (b"\x02" + bytes(36), "malformed_pose"),
        (struct.pack("<BBHI7f", 2, 0, 0, 1, math.nan, 0, 0, 0, 0, 0, 1), "malformed_pose"),
        (struct.pack("<BBHI7f", 2, 0, 0, 1, 1, 1, 1, 0, 0, 0, 0), "malformed_pose"),
    ],
)
def test_bad_binary_is_refused_with_a_code(data, code):
    with pytest.raises(RequestError) as refusal:
        parse_client_message(data)
    assert refusal.value.code == code


def test_an_audio_block_has_the_documented_layout():
    block = AudioBlock(3, 768, 12, np.array([[0.25, 0.5], [-0.25, -0.5]], np.float32), is_exchange=True, is_late=True)
    header = bytes([1, 3]) + struct.pack("<HIQII", 2, 3, 768, 12, 2)
    assert len(header) == AudioBlock.HEADER_BYTES == 24
    assert block.serialize("f32") == header + np.array([0.25, -0.25, 0.5, -0.5], "<f4").tobytes()


@given(
    st.integers(0, 2**32 - 1),
    st.integers(0, 2**64 - 1),
    st.integers(0, 2**32 - 1),
    st.booleans(),
    st.booleans(),
    st.integers(0, 9),
)
def test_float_blocks_survive_the_wire_exactly(sequence, clock, pose_id, is_exchange, is_late, seed):
    samples = np.random.default_rng(seed).standard_normal((2, 16), dtype=np.float32)
    block = AudioBlock(sequence, clock, pose_id, samples, is_exchange, is_late)
    back = AudioBlock.parse(block.serialize("f32"), "f32")
    assert_array_equal(back.samples, samples)
    assert (back.sequence, back.sample_clock, back.pose_id) == (sequence, clock, pose_id)
    assert (back.is_exchange, back.is_late) == (is_exchange, is_late)


def test_integer_blocks_keep_half_a_step_and_clip_instead_of_wrapping():
    samples = np.array([np.linspace(-1, 1, 101), np.linspace(-3, 3, 101)], np.float32)
    back = AudioBlock.parse(AudioBlock(0, 0, 0, samples).serialize("s16"), "s16").samples
    assert_allclose(back, np.clip(samples, -1, 1), atol=0.5 / 32767 + 1e-7)


@pytest.mark.parametrize(
    "data", [b"", b"\x02" * 40, AudioBlock(0, 0, 0, np.zeros((2, 4), np.float32)).serialize("f32")[:-8]]
)
def test_a_partial_block_is_not_a_block(data):
    with pytest.raises(ValueError):
        AudioBlock.parse(data, "f32")


def test_messages_are_plain_json():
    assert json.loads(Error(code="a", message="b").serialize()) == {
        "type": "error",
        "code": "a",
        "message": "b",
        "field": None,
    }
