"""Every kind of message in both directions as it lies on the wire, written down by hand, and cut short everywhere.

A client may write just this, and no version 3 of the protocol reads it differently or stops writing it.
"""

import json
import struct
from typing import get_args

import numpy as np
import pytest
from pydantic import ValidationError

from server.core.errors import RequestError
from server.protocol.blocks import AudioBlock, DryBlock, DryPackets
from server.protocol.client_messages import ListenerPose, TextMessage, parse_client_message
from server.protocol.server_messages import ServerMessage, parse_server_message

OF_CLIENTS = [
    '{"type": "hello", "protocol": 3, "scene": "flat"}',
    '{"type": "hello", "protocol": 3, "scene": "flat", "sample_rate": 48000, "block_size": 512, "encoding": "s16",'
    ' "listener": {"position": [1, 2, 1.5], "yaw": 0.5}, "hrtf": "kemar", "level": "fast", "output": "mono",'
    ' "effects": {"diffraction": false}, "emitters": 2, "buffer_blocks": 4, "snapshots": true}',
    '{"type": "hello", "protocol": 3, "scene": "flat", "output": "ambisonics", "order": 3, "encoding": "opus",'
    ' "opus": {"frame_ms": 20, "bitrate": 96000, "complexity": 10, "application": "audio", "signal": "music"}}',
    '{"type": "resume", "protocol": 3, "token": "6f1a", "sequence": 7, "sample_clock": 2048}',
    '{"type": "resume", "protocol": 3, "snapshot": "c3RhdGU="}',
    '{"type": "add_emitter", "id": "a", "clip": "speech", "position": [6, 3, 1.5], "yaw": 3.0, "gain_db": -6.0,'
    ' "loop": false, "directivity": {"pattern": "cardioid", "order": 2}}',
    '{"type": "add_emitter", "id": "a", "live": true, "position": [6, 3, 1.5], "orientation": [0, 0, 0, 1],'
    ' "jitter_ms": 40.0}',
    '{"type": "add_emitter", "id": "a", "clip": "speech", "position": [6, 3, 1.5],'
    ' "directivity": {"pattern": "measured", "angles_deg": [0, 180],'
    ' "gains_db": [[0, -1], [0, -2], [0, -3], [0, -4], [0, -6], [0, -9], [0, -12]]}}',
    '{"type": "add_emitter", "id": "a", "clip": "speech", "position": [6, 3, 1.5], "start_at": 4800, "stop_at": 9600,'
    ' "offset_s": 0.5, "loop_start_s": 0.25, "loop_end_s": 0.75, "remove_when_ended": true}',
    '{"type": "stop_emitter", "id": "a", "stop_at": 9600, "fade_s": 0.25}',
    '{"type": "move_emitter", "id": "a", "position": [1, 1, 1], "pose_id": 7}',
    '{"type": "move_emitter", "id": "a", "position": [1, 1, 1], "orientation": [0, 0, 1, 0], "pose_id": 4294967295}',
    '{"type": "set_gain", "id": "a", "gain_db": 3.5, "ramp_s": 0.5}',
    '{"type": "set_door", "door": "kitchen", "openness": 0.25}',
    '{"type": "hello", "protocol": 3, "scene": "flat", "doors": {"kitchen": 1.0, "hall": 0}}',
    '{"type": "set_level", "level": "auto"}',
    '{"type": "set_effects", "effects": {"air_absorption": true, "diffraction": null}, "output": "headphones"}',
    '{"type": "remove_emitter", "id": "a"}',
    '{"type": "listener", "position": [2, 2, 1.5], "yaw": -1.25, "pose_id": 9}',
    '{"type": "listener", "position": [2, 2, 1.5], "orientation": [0, 0.6, 0, 0.8], "pose_id": 10}',
    '{"type": "acknowledge", "sequence": 12}',
    '{"type": "hello", "protocol": 3, "scene": "flat", "listeners": 4}',
    '{"type": "add_listener", "id": "p2", "position": [2, 2, 1.5], "yaw": 0.5, "hrtf": "kemar"}',
    '{"type": "add_listener", "id": "p2", "position": [2, 2, 1.5], "orientation": [0, 0, 0, 1]}',
    '{"type": "remove_listener", "id": "p2"}',
    '{"type": "listener", "position": [2, 2, 1.5], "yaw": -1.25, "pose_id": 9, "listener": "p2"}',
    '{"type": "listener", "position": [2, 2, 1.5], "pose_id": 9, "index": 1}',
    '{"type": "acknowledge", "sequence": 12, "listener": "p2"}',
    '{"type": "ping", "id": 5}',
]
_SCENE = (
    '{"id": "flat", "name": "Flat", "description": "", "sample_rate": 24000,'
    ' "sample_rates": [24000, 44100, 48000, 96000], "ir_samples": 6000, "channels": ["left", "right"],'
    ' "speed_of_sound": 343.0,'
    ' "bounds": {"minimum": [0.3, 0.3, 0.5], "maximum": [7.7, 4.7, 2.3]}, "walls_known": true,'
    ' "corners": [[0, 0], [8, 0], [8, 5], [0, 5]], "height_m": 2.6,'
    ' "openings": [{"name": "door", "start": [5, 1], "end": [5, 2]}],'
    ' "listener": {"position": [2, 2, 1.5], "yaw": 0.5}, "emitter": {"position": [6, 3, 1.5], "yaw": 0.0},'
    ' "level": "fine", "levels": [{"name": "fine", "field": "rank16"}], "directional_levels": ["fine"],'
    ' "accepted_laws": [{"law": "decay", "reason": "a flutter echo"}]}'
)
_WELCOME = (
    '{"type": "welcome", "protocol": 3, "session": "5e", "scene": ' + _SCENE + ', "sample_rate": 24000,'
    ' "block_size": 256, "channels": 2, "encoding": "f32", "buffer_blocks": 8, "window": 40, "ir_samples": 6000,'
    ' "hrtf": "kemar", "level": "fine", "max_emitters": 16}'
)
_TIMES = '{"p50": 1.5, "p99": 2.5, "p99_9": null}'
_DOOR = (
    '{"name": "kitchen", "kind": "swing", "pivot": [5, 1, 0], "angle_deg": 90.0, "slide_m": [0, 1, 0], "openness": 1.0,'
    ' "footprint": [[5, 1], [5, 2]], "bottom_m": 0.0, "top_m": 2.0}'
)
OF_THE_SERVER = [
    _WELCOME,
    _WELCOME.replace(
        '"listener": {',
        '"is_mesh": true, "storeys": [{"floor_m": 0, "top_m": 2.6}], "doors": [' + _DOOR + '], "listener": {',
    )[:-1]
    + ', "doors": {"kitchen": 0.5}}',
    _WELCOME.replace('"channels": 2, "encoding": "f32"', '"channels": 9, "encoding": "opus"')[:-1]
    + ', "order": 2, "opus": {"frame_samples": 240, "look_ahead": 60, "streams": [2, 2, 2, 2, 1]}}',
    _WELCOME[:-1] + ', "resume_token": "6f1a", "resume_s": 30.0, "resumed": {"sample_clock": 4096, "sequence": 8,'
    ' "pose_id": 3, "handled": 2}}',
    '{"type": "snapshot", "snapshot": "c3RhdGU=", "pose_id": 3, "handled": 2, "expires_s": 120.0}',
    '{"type": "emitter_added", "id": "a", "sample_clock": 6144}',
    '{"type": "emitter_ended", "id": "a", "sample_clock": 9600, "removed": true}',
    '{"type": "emitter_removed", "id": "a"}',
    '{"type": "level_changed", "level": "fast", "reason": "load", "ir_rate_hz": 5.0, "shared_tail": true,'
    ' "sample_clock": 512}',
    '{"type": "plan_changed", "decisions": [{"name": "diffraction", "emitter": null, "called_for": true,'
    ' "change_jnd": 1.5, "parameter": "level", "cost_us": 0.5, "memory_bytes": null, "reason": "a corner",'
    ' "overridden": false}], "cost_us": 40.5, "saved_us": 0.0, "sample_clock": 768}',
    '{"type": "status", "sample_clock": 24000, "blocks_sent": 90, "blocks_late": 1, "blocks_dropped": 2,'
    f' "unacknowledged": 3, "buffer_ms": 80.5, "render_ms": {_TIMES}, "lateness_ms": {_TIMES}, "ir_ms": {_TIMES},'
    f' "pose_ms": {_TIMES}, "reverberation_ms": {_TIMES}, "ir_exchanges": 4, "blocks_limited": 5, "level": "fine",'
    ' "ir_rate_hz": null, "live": [{"id": "a", "samples_queued": 1, "samples_dropped": 2, "samples_gated": 3,'
    ' "samples_concealed": 4, "underruns": 5, "blocks_lost": 6, "samples_awaited": 7}]}',
    '{"type": "pong", "id": 3}',
    _WELCOME[:-1] + ', "max_listeners": 8, "resumed": {"sample_clock": 4096, "sequence": 8, "pose_id": 3, "handled": 2,'
    ' "listeners": [{"id": "p2", "index": 1}]}}',
    '{"type": "listener_added", "id": "p2", "index": 1, "hrtf": "kemar", "sample_clock": 6144}',
    '{"type": "listener_removed", "id": "p2", "index": 1}',
    '{"type": "level_changed", "level": "fast", "reason": "load", "ir_rate_hz": 5.0, "shared_tail": true,'
    ' "sample_clock": 512, "listener": "p2"}',
    '{"type": "error", "code": "unknown_listener", "message": "no", "field": "listener", "listener": "p2"}',
    '{"type": "error", "code": "server_busy", "message": "no room", "field": null, "retry_after_s": 9,'
    ' "level": "fast"}',
    '{"type": "error", "code": "stale_pose", "message": "older than the newest", "field": "pose_id", "emitter": "a"}',
]

_ID = b"oboe"
POSE = (
    bytes([2, 0, 0, 0])
    + struct.pack("<I", 9)
    + struct.pack("<3f", 2.0, 2.5, 1.5)
    + struct.pack("<4f", 0.0, 0.0, 0.0, 1.0)
)
DRY_F32 = bytes([3, 0]) + struct.pack("<HII", 4, 7, 2) + _ID + struct.pack("<2f", 0.5, -1.0)
DRY_S16 = bytes([3, 1]) + struct.pack("<HII", 3, 7, 2) + b"tin\0" + struct.pack("<2h", 32767, -32767)
DRY_OPUS = bytes([3, 2]) + struct.pack("<HII", 4, 7, 480) + _ID + struct.pack("<H", 3) + b"abc"
_CLOCKS = struct.pack("<HIQIII", 2, 5, 2**40, 12, 9, 2)  # channels, sequence, clock, poses, frames
AUDIO_F32 = bytes([1, 1 + 4]) + _CLOCKS + struct.pack("<4f", 0.5, -0.5, 0.25, -0.25)
AUDIO_S16 = bytes([1, 2]) + _CLOCKS + struct.pack("<4h", 32767, -32767, 0, 0)
AUDIO_OPUS = bytes([1, 8]) + _CLOCKS + struct.pack("<H", 3) + b"abc" + struct.pack("<H", 1) + b"d"


def holds(whole, part):
    """Whether a document has all that a part of it has, and as it has it."""
    if isinstance(part, dict):
        return isinstance(whole, dict) and all(key in whole and holds(whole[key], part[key]) for key in part)
    if isinstance(part, list):
        return len(whole) == len(part) and all(map(holds, whole, part))
    return whole == part


def types_of(messages):
    return {each.model_fields["type"].default for each in messages}


def test_every_type_of_message_is_here():
    assert {json.loads(text)["type"] for text in OF_CLIENTS} == types_of(get_args(TextMessage))
    assert {json.loads(text)["type"] for text in OF_THE_SERVER} == types_of(get_args(ServerMessage))


@pytest.mark.parametrize("text", OF_CLIENTS, ids=lambda text: json.loads(text)["type"])
def test_a_message_of_a_client_is_read_in_full_and_written_again(text):
    message = parse_client_message(text)
    assert message.model_fields_set == set(json.loads(text))
    assert holds(json.loads(message.serialize()), json.loads(text))


@pytest.mark.parametrize("text", OF_THE_SERVER, ids=lambda text: json.loads(text)["type"])
def test_a_message_of_the_server_is_read_in_full_and_written_again(text):
    message = parse_server_message(text)
    assert message.model_fields_set == set(json.loads(text))
    assert holds(json.loads(message.serialize()), json.loads(text))


@pytest.mark.parametrize("text", OF_CLIENTS, ids=lambda text: json.loads(text)["type"])
def test_a_message_of_a_client_cut_short_anywhere_is_refused_by_code(text):
    for length in range(len(text)):
        with pytest.raises(RequestError) as caught:
            parse_client_message(text[:length])
        assert caught.value.code == "malformed_message"


@pytest.mark.parametrize("text", OF_THE_SERVER, ids=lambda text: json.loads(text)["type"])
def test_a_message_of_the_server_cut_short_anywhere_is_none(text):
    for length in range(len(text)):
        with pytest.raises(ValidationError):
            parse_server_message(text[:length])


def test_a_binary_pose_is_read_and_written_again():
    pose = parse_client_message(POSE)
    assert pose == ListenerPose(pose_id=9, position=(2.0, 2.5, 1.5), orientation=(0.0, 0.0, 0.0, 1.0))
    assert pose.serialize_binary() == POSE


@pytest.mark.parametrize(("data", "encoding", "name"), [(DRY_F32, "f32", "oboe"), (DRY_S16, "s16", "tin")])
def test_a_dry_block_is_read_and_written_again(data, encoding, name):
    block = parse_client_message(data)
    assert (block.id, block.sequence) == (name, 7)
    assert block.samples.tolist() == ([0.5, -1.0] if encoding == "f32" else [1.0, -1.0])
    assert block.serialize(encoding) == data


def test_a_dry_block_in_opus_is_read_and_written_again():
    block = parse_client_message(DRY_OPUS)
    assert block == DryPackets("oboe", 7, 480, (b"abc",))
    assert block.serialize() == DRY_OPUS


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (POSE, "malformed_pose"),
        (DRY_F32, "malformed_block"),
        (DRY_S16, "malformed_block"),
        (DRY_OPUS, "malformed_block"),
    ],
)
def test_a_binary_message_of_a_client_cut_short_anywhere_is_refused_by_code(data, code):
    for length in range(1, len(data)):
        with pytest.raises(RequestError) as caught:
            parse_client_message(data[:length])
        assert caught.value.code == code


@pytest.mark.parametrize(
    ("data", "encoding", "flags"),
    [(AUDIO_F32, "f32", {"is_exchange", "is_limited"}), (AUDIO_S16, "s16", {"is_late"})],
)
def test_an_audio_block_is_read_and_written_again(data, encoding, flags):
    block = AudioBlock.parse(data, encoding)
    assert (block.sequence, block.sample_clock, block.pose_id, block.reverberation_pose_id) == (5, 2**40, 12, 9)
    assert {name for name in AudioBlock.FLAGS if getattr(block, name)} == flags
    assert block.samples.tolist() == ([[0.5, 0.25], [-0.5, -0.25]] if encoding == "f32" else [[1.0, 0.0], [-1.0, 0.0]])
    assert block.serialize(encoding) == data
    for length in range(len(data)):
        with pytest.raises(ValueError):
            AudioBlock.parse(data[:length], encoding)


def test_an_audio_block_in_opus_is_read():
    block, packets = AudioBlock.parse_packets(AUDIO_OPUS)
    assert (block.sample_clock, block.samples.shape, block.is_restart) == (2**40, (2, 2), True)
    assert packets == (b"abc", b"d")
    between = {AudioBlock.HEADER_BYTES, len(AUDIO_OPUS) - 3}
    for length in set(range(len(AUDIO_OPUS))) - between:
        with pytest.raises(ValueError):
            AudioBlock.parse_packets(AUDIO_OPUS[:length])


def test_a_pose_and_a_block_of_another_listener_differ_in_one_byte():
    theirs = POSE[:1] + bytes([7]) + POSE[2:]
    pose = parse_client_message(theirs)
    assert (pose.index, pose.pose_id, pose.listener) == (7, 9, None)
    assert pose.serialize_binary() == theirs
    theirs = AUDIO_F32[:3] + bytes([7]) + AUDIO_F32[4:]
    block = AudioBlock.parse(theirs, "f32")
    assert (block.listener, block.samples.shape, block.sequence) == (7, (2, 2), 5)
    assert block.serialize("f32") == theirs
    assert AudioBlock.parse(AUDIO_F32, "f32").listener == 0


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ('{"type": "listener", "position": [2, 2, 1], "pose_id": 9, "listener": "a", "index": 1}', "malformed_message"),
        ('{"type": "listener", "position": [2, 2, 1], "pose_id": 9, "listener": 7}', "malformed_message"),
        ('{"type": "listener", "position": [2, 2, 1], "pose_id": 9, "index": 256}', "malformed_message"),
        ('{"type": "acknowledge", "sequence": 1, "listener": ""}', "malformed_message"),
        ('{"type": "add_listener", "id": "p2", "position": [2, 2]}', "malformed_pose"),
        ('{"type": "hello", "protocol": 3, "scene": "flat", "listeners": 0}', "malformed_message"),
    ],
)
def test_what_says_no_listener_is_refused_by_code(text, code):
    with pytest.raises(RequestError) as caught:
        parse_client_message(text)
    assert caught.value.code == code


def test_the_blocks_here_are_of_every_kind():
    kinds = {DryBlock.KIND, AudioBlock.KIND, ListenerPose.KIND}
    assert {data[0] for data in (POSE, DRY_F32, AUDIO_F32)} == kinds
    assert np.frombuffer(POSE[8:20], "<f4").tolist() == [2.0, 2.5, 1.5]
