"""The document of the stream against the stream: what either says of the other is so."""

import ast
import json
import re
import struct
import time
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from jsonschema import Draft7Validator
from starlette.testclient import TestClient

from server.api import connection as streaming
from server.api.app import create_app
from server.api.asyncapi import document
from server.api.settings import Settings
from server.core.errors import RequestError
from server.field.fields_by_level import FieldsByLevel
from server.protocol.blocks import AudioBlock, DryBlock, DryPackets
from server.protocol.client_messages import (
    PROTOCOL,
    Acknowledge,
    AddEmitter,
    AddListener,
    Hello,
    ListenerPose,
    Ping,
    RemoveEmitter,
    RemoveListener,
    SetEffects,
    SetLevel,
    TextMessage,
    parse_client_message,
)
from server.protocol.codes import CLOSE_CODES, ERROR_CODES, LOST
from server.protocol.exchange import EXCHANGE
from server.protocol.server_messages import ServerMessage, parse_server_message
from server.scene.bundle import write_bundle
from server.scene.manifest import QualityLevel
from tests.api.test_stream import BAD_BYTES, BAD_TEXT
from tests.protocol.test_client_messages import CLIENT_MESSAGES, SERVER_MESSAGES

DOCUMENT = json.loads(document())
MESSAGES = DOCUMENT["components"]["messages"]
BINARY = {"listener_binary", "dry_block", "audio_block"}
OF_CLIENTS = {DryBlock.type} | {each.model_fields["type"].default for each in get_args(TextMessage)}
OF_SERVER = {each.model_fields["type"].default for each in get_args(ServerMessage)}
SERVER = Path(streaming.__file__).parents[1]
CODES = {"B": "u8", "H": "u16", "I": "u32", "Q": "u64", "f": "f32"}

# What the specification of AsyncAPI 3.0.0 lets the objects that are used here say.
MAY_SAY = {
    "root": "asyncapi id info servers defaultContentType channels operations components",
    "info": "title version description termsOfService contact license tags externalDocs",
    "server": "host protocol protocolVersion pathname description title summary variables security tags externalDocs "
    "bindings",
    "channel": "address messages title summary description servers parameters tags externalDocs bindings",
    "operation": "action channel title summary description security tags externalDocs bindings traits messages reply",
    "reply": "address channel messages",
    "message": "headers payload correlationId contentType name title summary description tags externalDocs bindings "
    "examples traits",
    "example": "headers payload name summary",
    "components": "schemas servers channels operations messages securitySchemes serverVariables parameters "
    "correlationIds replies replyAddresses externalDocs tags operationBindings channelBindings messageBindings "
    "serverBindings operationTraits messageTraits",
}


def validator(name):
    return Draft7Validator({**MESSAGES[name]["payload"], "components": DOCUMENT["components"]})


def check(said):
    """A JSON message of either side is as the document says."""
    validator(said["type"]).validate(said)


def references(node, path="#"):
    if isinstance(node, dict):
        if isinstance(node.get("$ref"), str):
            yield path, node["$ref"]
        for key, each in node.items():
            yield from references(each, f"{path}/{key}")
    elif isinstance(node, list):
        for index, each in enumerate(node):
            yield from references(each, f"{path}/{index}")


def follow(reference):
    node = DOCUMENT
    for part in reference.removeprefix("#/").split("/"):
        node = node[part]
    return node


def test_every_message_there_is_is_told_and_no_other():
    assert set(MESSAGES) == OF_CLIENTS | OF_SERVER | BINARY
    assert set(DOCUMENT["channels"]["stream"]["messages"]) == set(MESSAGES)
    for name, message in MESSAGES.items():
        assert message["name"] == name
        assert message["summary"]
        is_binary = name in BINARY
        assert message["contentType"] == ("application/octet-stream" if is_binary else "application/json")


def test_every_reference_leads_somewhere_and_every_component_is_referred_to():
    found = list(references(DOCUMENT))
    for _, reference in found:
        follow(reference)
    for kind, components in DOCUMENT["components"].items():
        for name in components:
            assert any(reference == f"#/components/{kind}/{name}" for _, reference in found), (kind, name)


def test_a_message_is_received_from_clients_or_sent_or_the_answer_to_one():
    received, sent, answers = set(), set(), set()
    for operation in DOCUMENT["operations"].values():
        assert operation["channel"] == {"$ref": "#/channels/stream"}
        names = {each["$ref"].removeprefix("#/channels/stream/messages/") for each in operation["messages"]}
        (received if operation["action"] == "receive" else sent).update(names)
        for each in operation.get("reply", {"messages": []})["messages"]:
            answers.add(each["$ref"].removeprefix("#/channels/stream/messages/"))
    assert received == OF_CLIENTS | {"listener_binary"}
    assert sent | answers == OF_SERVER | {"audio_block"}
    assert sent & answers == {"error"}


def test_objects_say_nothing_that_asyncapi_does_not_know():
    channel, operations = DOCUMENT["channels"]["stream"], DOCUMENT["operations"].values()
    objects = [
        ("root", DOCUMENT),
        ("info", DOCUMENT["info"]),
        ("channel", channel),
        ("components", DOCUMENT["components"]),
        *(("server", each) for each in DOCUMENT["servers"].values()),
        *(("operation", each) for each in operations),
        *(("reply", each["reply"]) for each in operations if "reply" in each),
        *(("message", each) for each in MESSAGES.values()),
        *(("example", example) for each in MESSAGES.values() for example in each["examples"]),
    ]
    for kind, each in objects:
        assert {key for key in each if not key.startswith("x-")} <= set(MAY_SAY[kind].split()), kind
    assert DOCUMENT["asyncapi"] == "3.0.0"
    assert channel["address"] == "/v1/stream"
    assert set(re.findall(r"{(\w+)}", DOCUMENT["servers"]["nafir"]["host"])) == set(
        DOCUMENT["servers"]["nafir"]["variables"]
    )


@pytest.mark.parametrize("name", MESSAGES)
def test_schemas_are_of_draft_7_and_refuse_what_has_no_type(name):
    Draft7Validator.check_schema(MESSAGES[name]["payload"])
    if name not in BINARY:
        schema = follow(MESSAGES[name]["payload"]["$ref"])
        Draft7Validator.check_schema(schema)
        assert "prefixItems" not in json.dumps(schema)
        assert schema["properties"]["type"]["const"] == name
        assert "type" in schema["required"]


@pytest.mark.parametrize("name", MESSAGES)
def test_every_message_has_examples_that_either_end_takes(name):
    assert MESSAGES[name]["examples"]
    for example in MESSAGES[name]["examples"]:
        payload = example["payload"]
        validator(name).validate(payload)
        if name == "audio_block":
            assert AudioBlock.parse(bytes.fromhex(payload), "f32").samples.any()
        elif name in BINARY:
            assert parse_client_message(bytes.fromhex(payload)).type == name.removesuffix("_binary")
        elif name in OF_CLIENTS:
            assert parse_client_message(json.dumps(payload)).type == name
        else:
            assert parse_server_message(json.dumps(payload)).type == name


def test_the_exchange_is_told_in_its_order():
    told = re.findall(r"^1\. (client|server), `(\w+)`: (.+)$", DOCUMENT["info"]["description"], re.MULTILINE)
    assert [meaning for _, _, meaning in told] == [step.meaning for step in EXCHANGE]
    assert all((speaker == "client") == (name in OF_CLIENTS | {"listener_binary"}) for speaker, name, _ in told)
    assert [name for _, name, _ in told[:2]] == ["hello", "welcome"]


@pytest.mark.parametrize("message", [*CLIENT_MESSAGES, *SERVER_MESSAGES], ids=lambda message: message.type)
def test_what_the_code_writes_is_as_told(message):
    check(json.loads(message.serialize()))


ODD = [None, True, 0, -1, 1.5, 5_000_000_000, "", "x", "é" * 300, [], [1, 2, 3], [0, 0, 0, 1], {}, {"hrtf": True}]
TEXT = [(name, each["payload"]) for name in sorted(OF_CLIENTS - BINARY) for each in MESSAGES[name]["examples"]]


def refusal(said):
    try:
        parse_client_message(json.dumps(said))
    except RequestError as refusal:
        return refusal
    return None


@pytest.mark.parametrize(("name", "said"), TEXT, ids=[name for name, _ in TEXT])
def test_schemas_refuse_what_the_server_refuses_and_nothing_else(name, said):
    """Each field of an example left out, or with values it should not have; but for what fields say together."""
    fields = follow(MESSAGES[name]["payload"]["$ref"])["properties"]
    changed = [{key: value for key, value in said.items() if key != field} for field in said]
    changed += [said | {field: value} for field in (*fields, "unheard_of") for value in ODD]
    takes, refused = validator(name).is_valid, 0
    for each in changed:
        problem = refusal(each)
        is_of_several_fields = problem is not None and (
            problem.field in {None, "listener", "directivity", "opus"} or "belongs to a" in str(problem)
        )
        if takes(each):
            assert problem is None or is_of_several_fields, (each, str(problem))
        else:
            assert problem is not None, each
            refused += 1
    assert refused > len(ODD)


def read(name, data):
    """A binary header as the document says, and what follows it."""
    layout = MESSAGES[name]["x-layout"]
    assert layout["endianness"] == "little"
    types, values, end = {type_name: code for code, type_name in CODES.items()}, {}, 0
    for field in layout["header"]:
        assert field["offset"] == end
        code = f"<{field['length']}{types[field['type']]}"
        numbers = struct.unpack_from(code, data, end)
        values[field["name"]] = numbers if field["length"] > 1 else numbers[0]
        end += struct.calcsize(code)
    assert end == layout["bytes"]
    return values, data[end:]


@pytest.mark.parametrize("flag", ["is_exchange", "is_late", "is_limited", "is_restart"])
def test_an_audio_block_is_read_by_the_document(flag):
    samples = np.array([[0.5, 0.25, 0.0], [-0.5, -0.25, 1.0]], np.float32)
    block = AudioBlock(2, 2**40 + 3, 5, 4, samples, **{flag: True})
    header, rest = read("audio_block", block.serialize("f32"))
    flags = next(field for field in MESSAGES["audio_block"]["x-layout"]["header"] if field["name"] == "flags")
    assert f"{header.pop('flags')} {flag}" in flags["meaning"]
    assert header.pop("kind") == 1
    assert (header.pop("channels"), header.pop("frames")) == samples.shape
    assert header == {name: getattr(block, name) for name in header}
    assert len(header) == 5
    assert np.frombuffer(rest, "<f4").reshape(3, 2).T.tolist() == samples.tolist()
    assert f"`{flag}`" in MESSAGES["audio_block"]["description"]


def test_a_pose_is_read_by_the_document():
    pose = ListenerPose(pose_id=9, position=(1.0, 2.0, 1.5), orientation=(0.0, 0.0, 1.0, 0.0))
    header, rest = read("listener_binary", pose.serialize_binary())
    assert header == {
        "kind": 2,
        "listener": 0,
        "zeros": (0, 0),
        "pose_id": 9,
        "position": pose.position,
        "orientation": pose.orientation,
    }
    assert rest == b""


def test_a_dry_block_is_read_by_the_document():
    header, rest = read("dry_block", DryBlock("voice", 7, np.array([0.5, -0.5], np.float32)).serialize("s16"))
    assert header == {"kind": 3, "encoding": 1, "id_bytes": 5, "sequence": 7, "frames": 2}
    assert rest == b"voice\0\0\0" + struct.pack("<2h", 16384, -16384)
    encodings = MESSAGES["dry_block"]["x-layout"]["header"][1]["meaning"]
    assert "0 f32" in encodings
    assert "1 s16" in encodings
    assert "2 opus" in encodings


def test_a_dry_block_in_opus_is_read_by_the_document():
    header, rest = read("dry_block", DryPackets("voice", 7, 480, (b"one", b"second")).serialize())
    assert header == {"kind": 3, "encoding": 2, "id_bytes": 5, "sequence": 7, "frames": 480}
    assert rest == b"voice\0\0\0" + struct.pack("<H", 3) + b"one" + struct.pack("<H", 6) + b"second"
    assert "each after its length in bytes (u16)" in MESSAGES["dry_block"]["x-layout"]["then"]


# Where requests are refused that are no messages of a stream; what `errors` names is a field_failure in one.
ELSEWHERE = {
    "ambisonic_response.py",
    "clip_store.py",
    "decoder_file.py",
    "errors.py",
    "impulse_response.py",
    "main.py",
    "plan_query.py",
    "problems.py",
    "request_log.py",
    "response_batch.py",
    "routes.py",
    "upload_decoder.py",
    "uploads.py",
}


def codes_refused_with():
    """Every code that a module of the stream gives an error, as it is written there."""
    for path in SERVER.rglob("*.py"):
        if path.name in ELSEWHERE or path.parent.name == "listening":  # which has no stream
            continue
        for node in ast.walk(ast.parse(path.read_bytes())):
            match node:
                case ast.Call(func=ast.Name(id="RequestError"), args=[code, *_]):
                    yield code
                case ast.ClassDef(bases=[ast.Name(id="RequestError")]):
                    calls = [each for each in ast.walk(node) if isinstance(each, ast.Call)]
                    yield from (each.args[0] for each in calls if ast.unparse(each.func) == "super().__init__")
                case ast.Call(func=ast.Name(id="Error"), keywords=keywords):
                    yield from (each.value for each in keywords if each.arg == "code")
                case ast.Assign(targets=[ast.Name(id="code")], value=code):
                    yield code
                case ast.Assign(targets=[ast.Tuple(elts=[ast.Name(id="code"), *_])], value=ast.Tuple(elts=[code, *_])):
                    yield code


def test_error_codes_are_those_in_the_code():
    refused_with = set()
    for code in codes_refused_with():
        match code:
            case ast.Constant(value=str(text)):
                refused_with.add(text)
            case ast.JoinedStr():  # only what begins a stream gets as far as this
                assert ast.unparse(code) == "f'unexpected_{message.type}'"
                refused_with |= {"unexpected_hello", "unexpected_resume"}
            case _:
                assert ast.unparse(code) in {"code", "refusal.code"}
    assert refused_with == set(ERROR_CODES)
    assert follow("#/components/schemas/Error/properties/code/enum") == list(ERROR_CODES)
    for code, meaning in ERROR_CODES.items():
        assert f"- `{code}`: {meaning}" in MESSAGES["error"]["description"]


def test_close_codes_are_those_in_the_code():
    own = {value for value in vars(streaming).values() if isinstance(value, int) and 1000 <= value < 5000} - {LOST}
    assert len(own) == 7
    assert own <= set(CLOSE_CODES)
    for code, meaning in CLOSE_CODES.items():
        assert f"- `{code}`: {meaning}" in DOCUMENT["channels"]["stream"]["description"]
        assert DOCUMENT["channels"]["stream"]["x-close-codes"][str(code)] == meaning


def test_limits_are_those_of_the_settings():
    settings, text = Settings(), " ".join(DOCUMENT["info"]["description"].split())
    assert f"within {settings.hello_timeout_s:g} s" in text
    assert f"at most {settings.max_message_bytes} bytes" in text
    assert f"more than {settings.max_frame_bytes} ends" in text


@pytest.fixture
def client(bundle, hrtfs, tmp_path):
    """A server of a scene with two levels."""
    rough = QualityLevel(name="rough", field="arithmetic", ir_rate_hz=5.0)
    files = {name: (bundle.folder / name).read_bytes() for name in bundle.manifest.files}
    manifest = bundle.manifest.model_copy(update={"levels": (*bundle.manifest.levels, rough)})
    levels = FieldsByLevel.load(write_bundle(tmp_path / "scene", manifest, files))
    with TestClient(create_app(Settings(), scenes={"flat": levels}, hrtfs=hrtfs)) as client:
        for _ in range(3_600):  # the first time ever, everything is compiled
            if client.get("/readyz").status_code == 200:
                break
            time.sleep(0.05)
        yield client


def test_the_document_is_served_beside_that_of_the_rest(client):
    answer = client.get("/asyncapi.json")
    assert answer.headers["content-type"] == "application/json"
    assert answer.json() == DOCUMENT
    openapi = client.get("/openapi.json").json()
    assert DOCUMENT["info"]["version"] == openapi["info"]["version"]
    assert "/asyncapi.json" in openapi["info"]["description"]


def test_what_a_running_stream_sends_is_as_told(client):
    said = [
        AddEmitter(id="talker", clip="trumpet", position=(6.0, 3.0, 1.5)),
        AddEmitter(id="voice", live=True, position=(2.0, 3.5, 1.5)),
        AddEmitter(id="shot", clip="trumpet", position=(6.0, 3.0, 1.5), stop_at=2_000),
        ListenerPose(pose_id=1, position=(2.0, 2.0, 1.5), yaw=0.5),
        SetLevel(level="rough"),
        SetEffects(effects={"hrtf": False}),
        AddListener(id="p2", position=(2.0, 3.0, 1.5)),
        ListenerPose(pose_id=2, position=(2.0, 3.5, 1.5), listener="p2"),
        Ping(id=5),
    ]
    # For these they need clips that are not here.
    errors = {code for _, code in (*BAD_TEXT, *BAD_BYTES)} - {"duplicate_emitter", "undecodable_clip"}
    of_server = OF_SERVER - {"snapshot"}  # which a server without a secret never sends
    heard, codes, blocks = set(), set(), 0
    with client.websocket_connect("/v1/stream") as socket:
        socket.send_text(Hello(protocol=PROTOCOL, scene="flat").serialize())
        for _ in range(3_000):
            message = socket.receive()
            if message.get("text") is None:
                header, rest = read("audio_block", message["bytes"])
                assert len(rest) == 4 * header["channels"] * header["frames"]
                if header["listener"]:
                    continue
                assert header["sequence"] == blocks
                blocks += 1
                socket.send_text(Acknowledge(sequence=header["sequence"]).serialize())
            else:
                event = json.loads(message["text"])
                check(event)
                heard.add(event["type"])
                codes.add(event.get("code"))
            if blocks == 1 and said:
                for each in said:
                    check(json.loads(each.serialize()))
                    socket.send_text(each.serialize())
                for bad in (*BAD_TEXT, *BAD_BYTES):
                    (socket.send_bytes if isinstance(bad[0], bytes) else socket.send_text)(bad[0])
                said.clear()
            if blocks == 40:
                socket.send_text(RemoveEmitter(id="talker").serialize())
                socket.send_text(RemoveListener(id="p2").serialize())
            if heard == of_server and blocks > 40 and errors <= codes:
                break
    assert heard == of_server
    assert errors <= codes
    assert blocks > 40
