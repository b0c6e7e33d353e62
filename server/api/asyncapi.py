"""The AsyncAPI 3 document of the stream at /v1/stream, made of what parses and serialises its messages: the models'
schemas and docstrings, the layouts of binary headers, and an exchange of messages as the code writes them.

It is told from the server's side: the application *receives* what clients say and *sends* what they hear.
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
from server.protocol.client_messages import PROTOCOL, AddEmitter, Hello, ListenerPose, Ping, RemoveEmitter, TextMessage
from server.protocol.codecs.registry import CODECS
from server.protocol.codes import CLOSE_CODES, ERROR_CODES
from server.protocol.exchange import EXCHANGE
from server.protocol.message import Message
from server.protocol.server_messages import EmitterAdded, EmitterRemoved, Error, Pong, ServerMessage, Welcome
from server.streaming.stream import PAUSE_AFTER_S

Object = dict[str, Any]
_Binary = type[ListenerPose] | type[DryBlock] | type[AudioBlock]

_CLIENT: Final[tuple[type[Message], ...]] = get_args(TextMessage)
_SERVER: Final[tuple[type[Message], ...]] = get_args(ServerMessage)
_ANSWERS: Final[dict[type[Message], type[Message]]] = {
    Hello: Welcome,
    AddEmitter: EmitterAdded,
    RemoveEmitter: EmitterRemoved,
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
    encodings = ", ".join(f"{name} is {codec.meaning}" for name, codec in CODECS.items())
    return f"""Live audio from a place, while a listener and emitters move in it. Protocol version {PROTOCOL}.

Control travels as JSON text, one object with a `type` per message; audio, and listener poses where wished, as binary
messages whose first byte is their kind. Binary is little endian. Metres, radians, decibels, samples of the scene's
rate; x east, y north, z up, yaw counter-clockwise from +x. {encodings}.

**What either side does not know.** The server refuses fields and messages that this version does not have, by their
name: ignored, a misspelt field would be a wish that nobody hears. Clients ignore unknown fields, messages and kinds of
binary messages: a server may say more within a version. Whole numbers may be written with a fraction of zero (`1.0`).
Of a `hello` the version is read first: another is answered `unsupported_protocol`, whatever else it says.

**Hello first.** The first message is a `hello`, within {_default("hello_timeout_s"):g} s. A `welcome` answers it, and
sound flows from then on; or an `error`, and the connection ends. A message has at most
{_default("max_message_bytes")} bytes, and one of more than {_default("max_frame_bytes")} ends the connection. (So by
default; an operator may set it otherwise.)

**Time.** Blocks are sent when they are due, `buffer_blocks` ahead of real time. `sample_clock` counts samples since the
start of the stream, whether sent or skipped: what has one takes effect in the block that begins there. Pose 0 is where
the listener starts; the poses that follow, of the listener and of emitters, have ids that rise. Each block names the
newest pose of its direct sound and that of its reverberation, so that a client can measure how long they take.

**Flow control by acknowledgement.** At most `window` blocks (of the `welcome`) are sent that no `acknowledge` has told
to have arrived; one stands for all blocks before it, so that every fourth block or so is enough. While the window is
full, blocks are rendered and not sent: `sequence` has no gap then, and `sample_clock` jumps. Once it has been full for
{PAUSE_AFTER_S:g} s, the stream stands still, its clock included, until an `acknowledge` makes room: it goes on where it
was. After {_default("stall_timeout_s"):g} s the connection is closed (`stalled`). A client whose answers pile up, since
it does not read, is cut off.

**Flow control of what clients say.** A client may say as much as a live block of 128 samples of each of its emitters,
{POSES_PER_S:,} poses a second, an acknowledgement of every block and {MOVES_PER_S} moves a second of each emitter come
to. Beyond that the server reads more slowly: nothing is lost, nothing is closed, and the rest waits with the client. Of
poses of the listener that follow one another directly, only the newest may be read.

**Errors.** A message that is refused changes nothing, and the stream goes on, unless it was the hello. An `error` that
ends the connection is followed by a close frame whose reason is the error's code. A server that is told to stop sends
every stream the error `server_draining` and closes it with 1012: the client opens it again, there or elsewhere.

**An exchange**

{exchange}
"""


class _Draft7(GenerateJsonSchema):
    """What AsyncAPI's own schemas are a superset of."""

    def tuple_schema(self, schema: core_schema.TupleSchema) -> JsonSchemaValue:
        generated = super().tuple_schema(schema)
        if "prefixItems" in generated:
            generated["items"] = generated.pop("prefixItems")
        return generated

    def field_is_required(self, field: Any, total: bool) -> bool:
        # What the server sends, it sends whole.
        return self.mode == "serialization" or super().field_is_required(field, total)

    def field_title_should_be_set(self, schema: Any) -> bool:  # noqa: ARG002  no titles that repeat a field's name
        return False


def _schemas() -> Object:
    """By the models' names. A `type` has a default in the models and has to be sent all the same."""
    _, generated = models_json_schema(
        [*((each, "validation") for each in _CLIENT), *((each, "serialization") for each in _SERVER)],
        ref_template="#/components/schemas/{model}",
        schema_generator=_Draft7,
    )
    schemas: Object = generated["$defs"]
    _, of_clients = models_json_schema([(each, "validation") for each in _CLIENT], schema_generator=_Draft7)
    for name in schemas.keys() - of_clients["$defs"].keys():
        # A client has to ignore what it does not know.
        schemas[name].pop("additionalProperties", None)
    for each in _CLIENT:
        schema = schemas[each.__name__]
        schema["required"] = ["type", *schema.get("required", [])]
    schemas[Error.__name__]["properties"]["code"] = {"type": "string", "enum": list(ERROR_CODES)}
    return schemas


def _type(model: type[Message]) -> str:
    return str(model.model_fields["type"].default)


def _message(name: str, told: type, **rest: Any) -> Object:
    """`told` is what the docstring of says what it means."""
    paragraphs = (inspect.getdoc(told) or "").split("\n\n")
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


def _binary_message(name: str, told: _Binary) -> Object:
    """The layout twice: as a table for people, and in `x-layout` for programs."""
    payload = {"type": "string", "format": "binary"}
    message = _message(name, told, payload=payload, contentType="application/octet-stream")
    message["description"] += f"\n\nLittle endian, without gaps:\n\n{told.LAYOUT.to_markdown()}"
    for example in message["examples"]:
        example["summary"] += ", in hexadecimal digits"
    return message | {"x-layout": told.LAYOUT.to_json()}


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
    """The document. The same from every server of this version: only defaults of settings are told."""
    messages = {_type(each): _text_message(each) for each in (*_CLIENT, *_SERVER)}
    binary = {**_CLIENT_BINARY, **_SERVER_BINARY}
    messages |= {name: _binary_message(name, told) for name, told in binary.items()}
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
                "title": "One listener in one scene",
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
    """As JSON."""
    return json.dumps(describe(), indent=2, ensure_ascii=False)
