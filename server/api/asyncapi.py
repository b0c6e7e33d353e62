"""The AsyncAPI 3 document of the stream at /v1/stream. It is generated from the code that parses and serialises the
messages: schemas and docstrings of the models, layouts of binary headers, and an example exchange.

The document takes the server's side: the application *receives* messages of clients and *sends* its own.
"""

import inspect
import json
import re
from collections.abc import Mapping
from functools import cache
from importlib.metadata import version
from typing import Any, Final, get_args

from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue, models_json_schema
from pydantic_core import core_schema

from server.api.inflow import MOVES_PER_S, POSES_PER_S
from server.api.settings import Settings
from server.protocol.blocks import AudioBlock, DryBlock
from server.protocol.client_messages import (
    PROTOCOL,
    AddEmitter,
    AddListener,
    Hello,
    ListenerPose,
    Ping,
    RemoveEmitter,
    RemoveListener,
    Resume,
    TextMessage,
)
from server.protocol.codecs.registry import CODECS, OPUS_MEANING
from server.protocol.codes import ACCESS_ENDED, CLOSE_CODES, ERROR_CODES, TAKEN_OVER
from server.protocol.exchange import EXCHANGE
from server.protocol.message import Message
from server.protocol.server_messages import (
    EmitterAdded,
    EmitterRemoved,
    Error,
    ListenerAdded,
    ListenerRemoved,
    Pong,
    ServerMessage,
    Welcome,
)
from server.streaming.stream import PAUSE_AFTER_S

Object = dict[str, Any]
_Binary = type[ListenerPose] | type[DryBlock] | type[AudioBlock]

_CLIENT: Final[tuple[type[Message], ...]] = get_args(TextMessage)
_SERVER: Final[tuple[type[Message], ...]] = get_args(ServerMessage)
_ANSWERS: Final[dict[type[Message], type[Message]]] = {
    Hello: Welcome,
    Resume: Welcome,
    AddEmitter: EmitterAdded,
    RemoveEmitter: EmitterRemoved,
    AddListener: ListenerAdded,
    RemoveListener: ListenerRemoved,
    Ping: Pong,
}
_CLIENT_BINARY: Final[dict[str, _Binary]] = {"listener_binary": ListenerPose, DryBlock.type: DryBlock}
_SERVER_BINARY: Final[dict[str, _Binary]] = {AudioBlock.type: AudioBlock}


def _default(setting: str) -> Any:
    return Settings.model_fields[setting].default


def _listed(meanings: Mapping[Any, str]) -> str:
    return "\n".join(f"- `{code}`: {meaning}" for code, meaning in meanings.items())


def _description() -> str:
    exchange = "\n".join(
        f"1. {'client' if step.is_of_client else 'server'}, `{step.name}`: {step.meaning}" for step in EXCHANGE
    )
    meanings = {name: codec.meaning for name, codec in CODECS.items()} | {"opus": OPUS_MEANING}
    encodings = ", ".join(f"{name} is {meaning}" for name, meaning in meanings.items())
    return f"""Live audio from a scene in which a listener and emitters move. Protocol version {PROTOCOL}.

Control messages are JSON text, one object with a `type` each. Audio is sent in binary messages, and listener poses may
be; their first byte is the kind. Binary is little endian. Units are metres, radians, decibels and samples at the
stream's rate; x is east, y north, z up, and yaw counter-clockwise from +x. {encodings}.

**Unknown fields and messages.** The server refuses fields and messages that this version does not have, and names them.
Otherwise a misspelt field would be ignored without notice. Clients ignore unknown fields, messages and kinds of binary
messages, since a server may add some within a version. Whole numbers may have a fraction of zero (`1.0`). The version
in a `hello` is read first; another version is answered `unsupported_protocol`, whatever else the hello contains.

**Hello first.** The first message is a `hello`, or a `resume`, within {_default("hello_timeout_s"):g} s. The server
answers with a `welcome`, after which audio flows, or with an `error`, after which the connection ends. A message has at
most {_default("max_message_bytes")} bytes, and one of more than {_default("max_frame_bytes")} ends the connection.
These are defaults; an operator may set other limits.

**Keys.** Where the server asks for a key, the handshake carries it as `Authorization: Bearer KEY` or, from a browser,
as one of the subprotocols: `nafir.key.` and the key in base64url, beside `nafir.v{PROTOCOL}`, which the server chooses.
A key that the browser has asked its user for (`Authorization: Basic`, as the password) will do, too.
Without one it is refused with 401 or 403 and a problem document. A stream ends when its key or token does
(`key_expired`, `key_revoked`, close code {ACCESS_ENDED}).

**Time.** Blocks are sent when they are due, `buffer_blocks` ahead of real time. `sample_clock` counts samples since the
start of the stream, sent or skipped. A message with a `sample_clock` takes effect in the block that begins there. Pose
0 is where the listener starts. Later poses, of the listener and of emitters, have rising ids. Each block names the
newest pose of its direct sound and that of its reflected field, so that a client can measure both latencies.

**Several listeners.** A stream begins with one listener, who has no id and the number 0. `add_listener` adds others, up
to {_default("max_listeners")} in all: players at a split screen, or spectators. All hear the same emitters at the same
`sample_clock`; each has a pose, a head, blocks, effects and statistics of its own. Blocks carry the listener's number
in their headers, so a client that adds none gets the bytes it always got. Poses name a listener by its id or, in
binary, by its number. Each listener has a `sequence` and a window of its own, so `acknowledge` names it too; messages
about it carry its id as `listener`. Output, encoding, sample rate, block size, level and switched effects are those of
the stream. An emitter that is added while there are several listeners begins for all with the same block. A pose of a
listener has to be newer than its own and than those of emitters; one of an emitter newer than all. A `listeners` in the
`hello` keeps room for them, and the `welcome` then has `max_listeners`. A listener that would break somebody's sound is
refused (`server_busy`). A resumed stream has its listeners again (`resumed.listeners`), all from the same `sequence`.

**Ambisonics.** With `"output": "ambisonics"` in the `hello`, blocks have the channels of AmbiX (ACN order, SN3D norm)
of the `order` in the `hello`: 4, 9 or 16, as `welcome` says. They are in the axes of the scene, at the place of the
listener's head: W is what an omnidirectional microphone hears there. The client turns them by the inverse of its
listener's orientation and decodes them. So a turn is heard as soon as the client likes, changes nothing in the blocks
and asks for no response; positions count as ever. Only scenes and levels whose fields predict directions can do it, and
scenes without a field: others refuse the `hello` (`no_directions`).

**Opus.** With `"encoding": "opus"` blocks hold packets of Opus in place of samples, and `opus` in the `hello` may say
how to encode. `GET /v1/encodings` says whether a server has Opus, and at which sample rates; others refuse the `hello`
(`unsupported_encoding`). The `welcome` has `opus`: the `streams`, each of two channels or of one (ambisonics take one
for each pair of channels), the samples of a packet, and the `look_ahead`. A packet lasts 5, 10 or 20 ms and a block as
long as it likes, so a block holds the packets that its samples have completed: for each, the packet of every stream in
turn, and none if its samples complete none. Keep a decoder for each stream, give it its packets in order, and begin
anew with every block that has `is_restart`: new decoders, whose first `look_ahead` samples are dropped. What remains is
heard from `sample_clock` on, and there are `frames` of it; so samples of an Opus stream and of another have the same
clock. Live input may be in Opus too, whatever the encoding of the stream.

**Resuming.** If the connection is lost (not closed by the client with 1000, 1001 or no code), the server keeps the
state of the stream for {_default("resume_s"):g} s: emitters, clips, gains, level, effects, poses and clock. The client
opens a new connection and begins with a `resume` in place of a `hello`. The `welcome` then has `resumed`: where
`sample_clock` and `sequence` go on, and what had arrived, so that the client sends again what had not. The clock goes
on during the gap as if the stream had been heard, and clips with it: they fade in where they would be by now. Each
`welcome` has another `resume_token`; the former one is good until the first `acknowledge`. If the server still believes
in the old connection, it is taken over and closed with {TAKEN_OVER}. What live emitters had sent before is gone; they
go on with the next `dry_block`. Statistics and the window begin anew. A `resume` is refused like a `hello` while the
server has no room (`server_busy`), and may be tried again.

**Snapshots.** Where the operator has set a secret, a message `snapshot` has the whole state, signed: before a shutdown,
and every few seconds if the `hello` asks for `snapshots`. A `resume` with the newest one goes on at any server that has
the same scenes and the same secret, within {_default("snapshot_lifetime_s"):g} s, whatever has become of the first.

**Flow control by acknowledgement.** At most `window` blocks (see `welcome`) are sent without an `acknowledge`. One
`acknowledge` stands for all earlier blocks, so every fourth block or so is enough. While the window is full, blocks are
rendered but not sent: `sequence` has no gap then, and `sample_clock` jumps. Once the window has been full for
{PAUSE_AFTER_S:g} s, the stream and its clock stand still until an `acknowledge` makes room, and then go on from there.
After {_default("stall_timeout_s"):g} s the connection is closed (`stalled`). A client that does not read is cut off
once too many messages wait for it.

**Flow control of client messages.** A client may send, each second, live blocks of 128 samples for all its emitters,
{POSES_PER_S:,} poses, an acknowledgement of every block, and {MOVES_PER_S} moves of each emitter. Beyond that the
server reads more slowly: nothing is lost and nothing is closed, but the rest waits at the client. If several listener
poses come directly after one another, the server may read only the newest.

**Errors.** A refused message changes nothing, and the stream goes on, unless it was the hello. An `error` that ends the
connection is followed by a close frame whose reason is the error's code. A server that shuts down sends every stream
a `snapshot`, if it gives any, and the error `server_draining` with the seconds until it has ended (`retry_after_s`;
without them another server takes the stream at once), and closes it with 1012; the client may resume or open it again,
there or elsewhere.

**An exchange**

{exchange}
"""


class _Draft7(GenerateJsonSchema):
    """Generates schemas of JSON Schema draft 7, which AsyncAPI's schemas are a superset of."""

    def tuple_schema(self, schema: core_schema.TupleSchema) -> JsonSchemaValue:
        generated = super().tuple_schema(schema)
        if "prefixItems" in generated:
            generated["items"] = generated.pop("prefixItems")
        return generated

    def field_is_required(self, field: Any, total: bool) -> bool:
        # The server sends every field of a message, but for those that a condition leaves out.
        is_sent = self.mode == "serialization" and "serialization_exclude_if" not in field
        return is_sent or super().field_is_required(field, total)

    def field_title_should_be_set(self, schema: Any) -> bool:  # noqa: ARG002  no titles that repeat a field's name
        return False


def _schemas() -> Object:
    """Schemas by the models' names. `type` is required, although it has a default in the models."""
    _, generated = models_json_schema(
        [*((each, "validation") for each in _CLIENT), *((each, "serialization") for each in _SERVER)],
        ref_template="#/components/schemas/{model}",
        schema_generator=_Draft7,
    )
    schemas: Object = generated["$defs"]
    _, of_clients = models_json_schema([(each, "validation") for each in _CLIENT], schema_generator=_Draft7)
    for name in schemas.keys() - of_clients["$defs"].keys():
        # A client has to ignore unknown fields.
        schemas[name].pop("additionalProperties", None)
    for each in _CLIENT:
        schema = schemas[each.__name__]
        schema["required"] = ["type", *schema.get("required", [])]
    schemas[Error.__name__]["properties"]["code"] = {"type": "string", "enum": list(ERROR_CODES)}
    return schemas


def _type(model: type[Message]) -> str:
    return str(model.model_fields["type"].default)


def _message(name: str, documented: type, **rest: Any) -> Object:
    """The description of a message, whose text is the docstring of `documented`."""
    paragraphs = (inspect.getdoc(documented) or "").split("\n\n")
    description = "\n\n".join(" ".join(each.split()) for each in paragraphs)
    summary, *_ = re.split(r"\.(?=\s|$)", description)
    examples = [{"summary": step.meaning, "payload": step.payload} for step in EXCHANGE if step.name == name]
    return {"name": name, "summary": summary, "description": description, "examples": examples, **rest}


def _text_message(model: type[Message]) -> Object:
    about = {"payload": {"$ref": f"#/components/schemas/{model.__name__}"}, "contentType": "application/json"}
    if "id" in model.model_fields and model in {*_ANSWERS, *_ANSWERS.values()}:
        about["correlationId"] = {"$ref": "#/components/correlationIds/id"}
    message = _message(_type(model), model, **about)
    if model is Error:
        message["description"] += f"\n\n{_listed(ERROR_CODES)}"
    return message


def _binary_message(name: str, model: _Binary) -> Object:
    """The description of a binary message. Its layout is a table for people, and in `x-layout` for programs."""
    payload = {"type": "string", "format": "binary"}
    message = _message(name, model, payload=payload, contentType="application/octet-stream")
    message["description"] += f"\n\nLittle endian, without gaps:\n\n{model.LAYOUT.to_markdown()}"
    for example in message["examples"]:
        example["summary"] += ", in hexadecimal digits"
    return message | {"x-layout": model.LAYOUT.to_json()}


def _operations() -> Object:
    channel = {"$ref": "#/channels/stream"}

    def refer(*names: str) -> list[Object]:
        return [{"$ref": f"#/channels/stream/messages/{name}"} for name in names]

    def operation(action: str, name: str) -> Object:
        return {"action": action, "channel": channel, "messages": refer(name)}

    received = [*map(_type, _CLIENT), *_CLIENT_BINARY]
    sent = [*(_type(each) for each in _SERVER if each not in _ANSWERS.values()), *_SERVER_BINARY]
    operations = {f"receive_{name}": operation("receive", name) for name in received}
    for asked, answer in _ANSWERS.items():
        reply = {"channel": channel, "messages": refer(_type(answer), _type(Error))}
        operations[f"receive_{_type(asked)}"]["reply"] = reply
    return operations | {f"send_{name}": operation("send", name) for name in sent}


def describe() -> Object:
    """The document. It is the same for every server of this version, since it states only defaults of settings."""
    messages = {_type(each): _text_message(each) for each in (*_CLIENT, *_SERVER)}
    binary = {**_CLIENT_BINARY, **_SERVER_BINARY}
    messages |= {name: _binary_message(name, model) for name, model in binary.items()}
    host = {"default": f"{_default('host')}:{_default('port')}", "description": "Where `nafir serve` listens."}
    return {
        "asyncapi": "3.0.0",
        "id": "urn:nafir:stream",
        "info": {
            "title": "Nafir",
            "version": version("nafir"),
            "description": _description(),
            "license": {"name": "MIT"},
        },
        "defaultContentType": "application/json",
        "servers": {"nafir": {"host": "{host}", "protocol": "ws", "variables": {"host": host}}},
        "channels": {
            "stream": {
                "address": "/v1/stream",
                "title": "Listeners in one scene",
                "description": f"The connection is closed with\n\n{_listed(CLOSE_CODES)}",
                "messages": {name: {"$ref": f"#/components/messages/{name}"} for name in messages},
                "bindings": {"ws": {"method": "GET", "bindingVersion": "0.1.0"}},
                "x-close-codes": {str(code): meaning for code, meaning in CLOSE_CODES.items()},
            }
        },
        "operations": _operations(),
        "components": {
            "messages": messages,
            "schemas": _schemas(),
            "correlationIds": {
                "id": {"description": "An answer has the id of what it answers.", "location": "$message.payload#/id"}
            },
        },
    }


@cache
def document() -> str:
    """The document as JSON."""
    return json.dumps(describe(), indent=2, ensure_ascii=False)
