import json
import math
import struct
from functools import reduce

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from server.acoustics.directivity import CARDIOID, Cardioid, PolarPattern
from server.acoustics.geometry import Pose
from server.api.catalogue import describe_scene
from server.core.errors import RequestError
from server.field.fields_by_level import FieldsByLevel
from server.protocol.blocks import DryBlock
from server.protocol.client_messages import (
    PROTOCOL,
    Acknowledge,
    AddEmitter,
    AddListener,
    DirectivityPattern,
    Hello,
    ListenerPose,
    ListenerStart,
    MoveEmitter,
    Ping,
    RemoveEmitter,
    RemoveListener,
    SetGain,
    SetLevel,
    StopEmitter,
    emitter_of,
    ids_named_by,
    listener_of,
    parse_client_message,
)
from server.protocol.opus import OpusOptions
from server.protocol.server_messages import (
    Durations,
    EmitterAdded,
    EmitterEnded,
    EmitterRemoved,
    Error,
    LevelChanged,
    LiveStatus,
    Pong,
    Status,
    UnknownMessage,
    Welcome,
    parse_server_message,
)

CLIENT_MESSAGES = [
    Hello(protocol=PROTOCOL, scene="flat"),
    Hello(
        protocol=PROTOCOL,
        scene="flat",
        sample_rate=24_000,
        block_size=512,
        encoding="s16",
        listener=ListenerStart(position=(1, 2, 1.5), yaw=0.3),
        hrtf="kemar",
        buffer_blocks=4,
    ),
    Hello(
        protocol=PROTOCOL,
        scene="flat",
        encoding="opus",
        opus=OpusOptions(frame_ms=20, bitrate=64_000, complexity=10, application="audio", signal="voice"),
    ),
    AddEmitter(id="talker", clip="speech", position=(1, 2, 3), gain_db=-6, loop=False),
    AddEmitter(id="talker", live=True, position=(1, 2, 3), yaw=2.0, directivity=DirectivityPattern(pattern="cardioid")),
    AddEmitter(
        id="talker",
        clip="speech",
        position=(1, 2, 3),
        orientation=(0, 0, 1, 0),
        directivity=DirectivityPattern(pattern="measured", angles_deg=(0, 180), gains_db=((0, -12),) * 7),
    ),
    MoveEmitter(id="talker", position=(1, 2, 3), pose_id=2**32 - 1),
    MoveEmitter(id="talker", position=(1, 2, 3), yaw=0.0, pose_id=1),
    AddEmitter(id="talker", clip="speech", position=(1, 2, 3), loop=False, start_at=2**53 - 1, remove_when_ended=True),
    AddEmitter(
        id="talker", clip="speech", position=(1, 2, 3), offset_s=0.5, loop_start_s=0.25, loop_end_s=1, stop_at=5
    ),
    StopEmitter(id="talker"),
    StopEmitter(id="talker", stop_at=48_000, fade_s=0.5),
    SetGain(id="talker", gain_db=-80),
    SetGain(id="talker", gain_db=6, ramp_s=2.5),
    SetLevel(level="fast"),
    RemoveEmitter(id="talker"),
    ListenerPose(pose_id=4, position=(1, 2, 3), yaw=-math.pi),
    ListenerPose(pose_id=4, position=(1, 2, 3), orientation=(0, 0, 1, 0)),
    Acknowledge(sequence=7),
    Ping(id=2**53 - 1),
]

SERVER_MESSAGES = [
    EmitterAdded(id="talker", sample_clock=512),
    EmitterEnded(id="talker", sample_clock=1_024, removed=True),
    EmitterRemoved(id="talker"),
    LevelChanged(level="fast", reason="load", ir_rate_hz=5.0, shared_tail=True, sample_clock=512),
    Status(
        sample_clock=24_000,
        blocks_sent=90,
        blocks_late=1,
        blocks_dropped=2,
        unacknowledged=3,
        buffer_ms=80.5,
        render_ms=Durations(p50=0.5, p99=1.5, p99_9=2.5),
        lateness_ms=Durations(p50=0.6, p99=1.6, p99_9=2.6),
        ir_ms=Durations(p50=None, p99=None, p99_9=None),
        pose_ms=Durations(p50=None, p99=None, p99_9=None),
        reverberation_ms=Durations(p50=None, p99=None, p99_9=None),
        level="standard",
        ir_rate_hz=12.0,
        ir_exchanges=4,
        blocks_limited=0,
        live=(LiveStatus(id="talker", samples_queued=1, samples_dropped=2, samples_gated=3, underruns=4),),
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
        scene=describe_scene(FieldsByLevel([field])),
        sample_rate=24_000,
        block_size=256,
        channels=2,
        encoding="f32",
        buffer_blocks=8,
        window=40,
        ir_samples=4_000,
        hrtf="kemar",
        level="standard",
        max_emitters=16,
    )
    assert parse_server_message(welcome.serialize()) == welcome


def test_a_welcome_of_a_server_that_does_not_tell_how_many_emitters_it_takes_is_understood(field):
    welcome = Welcome(
        session="5e",
        scene=describe_scene(FieldsByLevel([field])),
        sample_rate=24_000,
        block_size=256,
        channels=2,
        encoding="f32",
        buffer_blocks=8,
        window=40,
        ir_samples=4_000,
        hrtf="kemar",
        level="standard",
    )
    said = json.loads(welcome.serialize())
    del said["max_emitters"]
    assert parse_server_message(json.dumps(said)) == welcome


def test_hello_as_a_person_would_type_it():
    hello = parse_client_message(
        '{"type": "hello", "protocol": 3, "scene": "flat", "listener": {"position": [1, 2, 1.5]}}'
    )
    assert (hello.block_size, hello.encoding, hello.buffer_blocks, hello.level) == (256, "f32", 8, "auto")
    assert hello.listener.pose == Pose((1, 2, 1.5))


def directive(pattern):
    return f'{{"type": "add_emitter", "id": "a", "clip": "b", "position": [1, 2, 3], "directivity": {pattern}}}'


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
            '{"type": "hello", "protocol": 3, "scene": "a", "listener": {"position": [1,2,-Infinity]}}',
            "malformed_pose",
            "listener.position",
        ),
        ('{"type": "hello", "protocol": 3, "scene": "a", "block_size": 100}', "malformed_message", "block_size"),
        ('{"type": "hello", "protocol": 3, "scene": "a", "encoding": "mp3"}', "malformed_message", "encoding"),
        ('{"type": "move_emitter", "id": "", "position": [1,2,3], "pose_id": 1}', "malformed_message", "id"),
        (
            '{"type": "add_emitter", "id": "a", "clip": "b", "position": [1,2,3], "gain_db": 400}',
            "malformed_message",
            "gain_db",
        ),
        ('{"type": "set_gain", "id": "a", "gain_db": 25}', "malformed_message", "gain_db"),
        ('{"type": "add_emitter", "id": "a", "position": [1,2,3]}', "malformed_message", None),
        (
            '{"type": "add_emitter", "id": "a", "clip": "b", "live": true, "position": [1,2,3]}',
            "malformed_message",
            None,
        ),
        (
            '{"type": "add_emitter", "id": "a", "clip": "b", "position": [1,2,3], "orientation": [0,0,0,0]}',
            "malformed_pose",
            None,
        ),
        (directive('{"pattern": "shotgun"}'), "malformed_directivity", "directivity.pattern"),
        (directive('{"order": 2}'), "malformed_directivity", "directivity.pattern"),
        (directive('{"pattern": "cardioid", "order": NaN}'), "malformed_directivity", "directivity.order"),
        (directive('{"pattern": "cardioid", "order": 0}'), "malformed_directivity", "directivity"),
        (directive('{"pattern": "cardioid", "angles_deg": [0, 180]}'), "malformed_directivity", "directivity"),
        (directive('{"pattern": "measured", "angles_deg": [0, 180]}'), "malformed_directivity", "directivity"),
        (
            directive('{"pattern": "measured", "angles_deg": [0, "x"], "gains_db": []}'),
            "malformed_directivity",
            "directivity.angles_deg",
        ),
        (
            directive('{"pattern": "measured", "angles_deg": [0, 90], "gains_db": [[0, 0]]}'),
            "malformed_directivity",
            "directivity",
        ),
    ],
)
def test_bad_text_is_refused_with_a_code_and_the_field(text, code, field):
    with pytest.raises(RequestError) as refusal:
        parse_client_message(text)
    assert (refusal.value.code, refusal.value.field) == (code, field)
    assert str(refusal.value)


@pytest.mark.parametrize("version", ["2", "1", "2.0", "-3", "0", "1e300", "9" * 5_000, "2.5e1"])
@pytest.mark.parametrize("rest", ['"scene": "a", "spatial": {"order": 7}', '"block_size": "any"', '"scene": 1'])
def test_a_hello_of_another_version_is_told_which_is_spoken_whatever_else_it_says(version, rest):
    with pytest.raises(RequestError) as refusal:
        parse_client_message(f'{{"type": "hello", {rest}, "protocol": {version}}}')
    assert (refusal.value.code, refusal.value.field) == ("unsupported_protocol", "protocol")
    assert "speaks protocol 3, not " in str(refusal.value)
    assert len(str(refusal.value)) < 100


@pytest.mark.parametrize(
    "protocol", ["", '"protocol": "3",', '"protocol": true,', '"protocol": null,', '"protocol": 2.5,']
)
def test_a_hello_without_a_version_is_told_so_before_all_else(protocol):
    with pytest.raises(RequestError) as refusal:
        parse_client_message(f'{{"type": "hello", {protocol} "scene": 1, "spatial": true}}')
    assert (refusal.value.code, refusal.value.field) == ("malformed_message", "protocol")
    assert "speaks 3" in str(refusal.value)


def test_an_unknown_field_of_this_version_is_refused_with_the_nearest_name():
    with pytest.raises(RequestError, match=r"orientaton: unknown field; did you mean 'orientation'\?") as refusal:
        parse_client_message('{"type": "listener", "pose_id": 1, "position": [1, 2, 3], "orientaton": [0, 0, 0, 1]}')
    assert refusal.value.code == "malformed_message"
    with pytest.raises(RequestError, match=r"scen: unknown field; did you mean 'scene'\?"):
        parse_client_message('{"type": "hello", "protocol": 3, "scene": "a", "scen": "b"}')


def integers(schema, whole):
    """Where `whole`, the schema of everything, has integers, as the names that lead there."""
    schema = whole["$defs"][schema["$ref"].rsplit("/", 1)[-1]] if "$ref" in schema else schema
    for name, each in schema.get("properties", {}).items():
        kinds = [each, *each.get("anyOf", ())]
        if any(kind.get("type") == "integer" or 128 in kind.get("enum", ()) for kind in kinds):
            yield (name,)
        yield from ((name, *rest) for kind in kinds for rest in integers(kind, whole))


@pytest.mark.parametrize("message", CLIENT_MESSAGES, ids=lambda m: m.type)
def test_every_integer_may_be_written_with_a_fraction_of_zero(message):
    schema = type(message).model_json_schema()
    said = json.loads(message.serialize())
    for *above, name in integers(schema, schema):
        inner = reduce(lambda document, key: document and document[key], above, said)
        value = inner and inner[name]
        if value is not None:
            inner[name] = float(value)
            assert parse_client_message(json.dumps(said)) == message
            for wrong in (value + 0.5, str(value), True):
                inner[name] = wrong
                with pytest.raises(RequestError):
                    parse_client_message(json.dumps(said))
            inner[name] = value


@pytest.mark.parametrize("message", SERVER_MESSAGES, ids=lambda m: m.type)
def test_a_client_ignores_fields_that_a_newer_server_adds(message):
    said = json.loads(message.serialize())
    said |= {"unheard_of": {"a": 1}}
    for each in said.values():
        if isinstance(each, dict):
            each["unheard_of"] = 1
    assert parse_server_message(json.dumps(said)) == message


def test_a_client_ignores_messages_that_a_newer_server_adds():
    assert parse_server_message('{"type": "weather", "wind_m_s": 3}') == UnknownMessage(type="weather")
    for broken in ("{}", '{"type": 1}', "?", '{"type": "pong"}'):
        with pytest.raises(ValidationError):
            parse_server_message(broken)


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
    assert isinstance(message, ListenerPose | DryBlock)


def test_a_dry_block_is_a_client_message():
    message = parse_client_message(DryBlock("voice", 3, np.ones(5, np.float32)).serialize("s16"))
    assert (message.id, message.sequence, message.samples.tolist()) == ("voice", 3, [1.0] * 5)


ROWS = [[0.0, -3.0 - band, -6.0] for band in range(7)]


@pytest.mark.parametrize(
    ("pattern", "expected"),
    [
        ('{"pattern": "omnidirectional"}', Cardioid(1.0)),
        ('{"pattern": "cardioid"}', CARDIOID),
        ('{"pattern": "cardioid", "order": 2.5}', Cardioid(0.5, 2.5)),
        ('{"pattern": "figure_of_eight"}', Cardioid(0.0)),
        (
            json.dumps({"pattern": "measured", "angles_deg": [0, 60, 180], "gains_db": ROWS}),
            PolarPattern((0, 60, 180), tuple(tuple(row) for row in ROWS)),
        ),
    ],
)
def test_patterns_are_those_of_the_acoustics(pattern, expected):
    assert parse_client_message(directive(pattern)).directivity.directivity == expected


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


def test_messages_are_plain_json():
    assert json.loads(Error(code="a", message="b").serialize()) == {
        "type": "error",
        "code": "a",
        "message": "b",
        "field": None,
    }


DOUBLED = {
    "a value twice": ('{"type": "ping", "id": 1, "id": 2}', "id"),
    "the same value twice": ('{"type": "ping", "id": 1, "id": 1}', "id"),
    "a type twice": ('{"type": "ping", "type": "ping", "id": 1}', "type"),
    "by an escape": ('{"type": "ping", "id": 1, "\\u0069d": 2}', "id"),
    "blanks before the colon": ('{"type": "ping", "id" : 1, "id"\n: 2}', "id"),
    "within": ('{"type": "set_effects", "effects": {"hrtf": true, "hrtf": false}}', "hrtf"),
}


@pytest.mark.parametrize(("text", "key"), DOUBLED.values(), ids=DOUBLED)
def test_a_key_that_is_there_twice_is_refused_by_name(text, key):
    with pytest.raises(RequestError, match=f"^{key} is there twice") as refusal:
        parse_client_message(text)
    assert (refusal.value.code, refusal.value.field) == ("malformed_message", key)


def test_colons_and_keys_in_values_are_no_doubled_keys():
    text = '{"type": "add_emitter", "id": "a:b \\"id\\": 1", "clip": "x:y", "position": [1, 2, 3]}'
    assert parse_client_message(text).id == 'a:b "id": 1'
    effects = '{"type": "set_effects", "effects": {"hrtf": true, "air_absorption": false}}'
    assert parse_client_message(effects).effects == {"hrtf": True, "air_absorption": False}


def test_a_message_without_doubled_keys_is_read_once(monkeypatch):
    """What poses cost: `JSON` a second time would nearly double it."""
    monkeypatch.setattr(
        "server.protocol.client_messages.require_distinct_keys", lambda _: pytest.fail("it is read twice")
    )
    pose = ListenerPose(pose_id=1, position=(1, 2, 3), orientation=(0, 0, 0, 1))
    assert parse_client_message(pose.model_dump_json(exclude_none=True)) == pose


LONGEST = "x" * 64


@pytest.mark.parametrize(
    ("data", "named"),
    [
        ('{"type": "add_listener", "id": "p2", "position": [null, 1, 1]}', (None, "p2")),
        (f'{{"type": "add_listener", "id": "{LONGEST}", "hrtf": 2}}', (None, LONGEST)),
        ('{"type": "remove_listener", "id": "p2", "more": 1}', (None, "p2")),
        ('{"type": "listener", "listener": "p2", "pose_id": 1, "position": [1, NaN, 1]}', (None, "p2")),
        ('{"type": "listener", "pose_id": -1, "position": [1, 1, 1]}', (None, None)),
        ('{"type": "acknowledge", "listener": "p2", "sequence": 1.5}', (None, "p2")),
        (f'{{"type": "add_emitter", "id": "e", "clip": {"9" * 5_000}}}', ("e", None)),
        ('{"type": "set_gain", "id": "e", "gain_db": 900}', ("e", None)),
        (f'{{"type": "add_listener", "id": "{LONGEST}x"}}', (None, None)),
        ('{"type": "add_listener", "id": ""}', (None, None)),
        ('{"type": "add_listener", "id": 2}', (None, None)),
        ('{"type": "add_listener", "id": "\\ud800"}', (None, None)),
        ('{"type": "add_listener", "id": ["p2"]}', (None, None)),
        ('{"type": ["add_listener"], "id": "p2"}', (None, None)),
        ('{"type": "set_effects", "id": "p2", "effects": 1}', (None, None)),
        ('{"type": "add_listener", "id": "p2"', (None, None)),
        ("[" * 5_000, (None, None)),
        ("null", (None, None)),
        (b"\x02" * 35, (None, None)),
    ],
)
def test_a_message_that_cannot_be_read_still_names_whom_it_is_about(data, named):
    with pytest.raises(RequestError):
        parse_client_message(data)
    assert ids_named_by(data) == named


@pytest.mark.parametrize(
    "message",
    [
        *CLIENT_MESSAGES,
        AddListener(id="p2", position=(1, 1, 1)),
        RemoveListener(id="p2"),
        ListenerPose(pose_id=1, listener="p2", position=(1, 1, 1)),
        Acknowledge(sequence=1, listener="p2"),
    ],
    ids=lambda message: message.type,
)
def test_the_same_ids_are_named_whether_a_message_can_be_read_or_not(message):
    assert ids_named_by(message.serialize()) == (emitter_of(message), listener_of(message))
