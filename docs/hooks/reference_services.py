"""Reference of HTTP, of the stream and of the metrics, from the server's own documents and its source."""

import ast
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Final

from reference_schemas import schema_rows, type_name
from reference_text import code, default_text, sentence, table
from server.api import asyncapi, telemetry
from server.api.app import create_app
from server.api.problem_codes import PROBLEM_CODES
from server.api.settings import Settings
from server.protocol.codes import CLOSE_CODES, ERROR_CODES

_HEADING: Final = ["field", "type", "default", "meaning"]
_PATTERNED: Final = {
    "listener": "x,y,z",
    "emitter": "x,y,z",
    "orientation": "x,y,z,w",
    "effect": "NAME=on or NAME=off",
}
"""Short forms of parameters that the schema describes by long patterns."""


def http() -> str:
    """Return the reference of every route of /openapi.json."""
    document = create_app(Settings()).openapi()
    routes = {
        f"{method.upper()} {path}": operation
        for path, operations in document["paths"].items()
        for method, operation in operations.items()
    }
    always = set.intersection(*(_refusals(operation) for operation in routes.values()))
    described = next(iter(routes.values()))["responses"]
    rows = ((status, described[status]["description"]) for status in sorted(always))
    parts = [f"Whatever the route, a request may be refused:\n\n{table(['status', 'meaning'], rows)}"]
    parts += [_operation(name, operation, always) for name, operation in routes.items()]
    parts += ["## Objects in requests and answers\n"]
    for name, schema in document["components"]["schemas"].items():
        if "properties" in schema:
            prose = "\n\n".join(" ".join(each.split()) for each in schema.get("description", "").split("\n\n"))
            body = schema_rows(schema, {"code": "Every code is listed on the page of error codes"})
            parts.append(f"### {name}\n\n{prose}\n\n{table(_HEADING, body)}")
    return "\n".join(parts)


def _refusals(operation: Mapping[str, Any]) -> set[str]:
    return {status for status in operation["responses"] if status >= "400"}


def _operation(name: str, operation: Mapping[str, Any], always: set[str]) -> str:
    rows = []
    for parameter in operation.get("parameters", ()):
        schema = parameter["schema"]
        default = default_text(schema["default"]) if "default" in schema else ""
        if parameter.get("required"):
            default = "required"
        kind = _PATTERNED.get(parameter["name"]) or type_name(schema)
        rows.append((code(parameter["name"]), kind, default, sentence(parameter.get("description", ""))))
    answers = operation["responses"].get("200", {}).get("content", {})
    told = [f"Answers {', '.join(map(code, sorted(answers)))}."] if answers else []
    told += [
        f"{status}: {operation['responses'][status]['description']}" for status in sorted(_refusals(operation) - always)
    ]
    head = f"### `{name}`\n\n{operation.get('description', '')}\n\n{' '.join(told)}\n"
    return f"{head}\n{table(['parameter', 'type', 'default', 'meaning'], rows)}" if rows else head


def stream() -> str:
    """Return the reference of every message of /asyncapi.json."""
    document = _asyncapi()
    operations = document["operations"].values()
    said = {_last(each): operation["action"] for operation in operations for each in operation["messages"]}
    replies = {_last(each) for operation in operations for each in operation.get("reply", {}).get("messages", ())}
    messages = document["components"]["messages"]
    of_client = [name for name in messages if said.get(name) == "receive"]
    of_server = [name for name in messages if said.get(name) == "send" or name in replies]
    schemas = document["components"]["schemas"]
    parts = [_prose(document["info"]["description"]), "## What clients send\n"]
    parts += [_message(messages[name], schemas) for name in of_client]
    parts.append("## What the server sends\n")
    parts += [_message(messages[name], schemas) for name in of_server]
    told = {messages[name]["payload"]["$ref"] for name in messages if "$ref" in messages[name]["payload"]}
    parts.append("## Objects in messages\n")
    for name, schema in schemas.items():
        if f"#/components/schemas/{name}" not in told and "properties" in schema:
            body = table(_HEADING, schema_rows(schema, {}))
            parts.append(f"### {name}\n\n{_prose(schema.get('description', ''))}\n\n{body}")
    return "\n".join(parts)


def _last(reference: Mapping[str, str]) -> str:
    return reference["$ref"].rsplit("/", 1)[-1]


def _prose(text: str) -> str:
    return re.sub(r"^\*\*An exchange\*\*$", "## An exchange", text, flags=re.MULTILINE)


def _message(message: Mapping[str, Any], schemas: Mapping[str, Any]) -> str:
    description = message["description"].split("\n\n- `")[0]
    parts = [f"### `{message['name']}`\n\n{description}\n"]
    if "$ref" in message["payload"]:
        parts.append(table(_HEADING, _fields(message["name"], schemas[_last(message["payload"])])))
    for example in message["examples"][:1]:
        payload = example["payload"]
        language, text = ("text", _wrapped(payload)) if isinstance(payload, str) else ("json", _json(payload))
        parts.append(f"Example ({example['summary']}):\n\n```{language}\n{text}\n```\n")
    return "\n".join(parts)


def _fields(message: str, schema: Mapping[str, Any]) -> Iterator[Sequence[str]]:
    for name, kind, default, meaning in schema_rows(schema, {}):
        if (message, name) == ("error", "`code`"):
            yield name, "string", default, "One of the codes on the page of error codes."
        else:
            yield name, kind, default, meaning


def _wrapped(text: str, width: int = 96) -> str:
    """Wrap hexadecimal digits into lines."""
    return "\n".join(text[start : start + width] for start in range(0, len(text), width))


def _json(payload: Mapping[str, Any]) -> str:
    """Return JSON in one line if it is short, else with one line per field."""
    text = json.dumps(payload, ensure_ascii=False)
    if len(text) <= 90:
        return text
    fields = (f"  {json.dumps(key)}: {json.dumps(value, ensure_ascii=False)}" for key, value in payload.items())
    return "{\n" + ",\n".join(fields) + "\n}"


@cache
def _asyncapi() -> Any:
    return asyncapi.describe()


def problem_codes() -> str:
    rows = [(code(name), *_split(meaning)) for name, meaning in PROBLEM_CODES.items()]
    return table(["code", "status", "meaning"], rows)


def _split(meaning: str) -> tuple[str, str]:
    status, _, rest = meaning.partition(": ")
    return status, sentence(rest)


def stream_codes() -> str:
    errors = table(["code", "meaning"], ((code(name), sentence(meaning)) for name, meaning in ERROR_CODES.items()))
    closes = table(["close code", "meaning"], ((code(number), sentence(said)) for number, said in CLOSE_CODES.items()))
    return f"{errors}\n## Close codes of a stream\n\n{closes}"


def metrics() -> str:
    """Return a table of every metric family of the collector."""
    tree = ast.parse(Path(telemetry.__file__).read_text(encoding="utf-8"))
    return table(["metric", "kind", "meaning"], sorted(_families(tree)))


def _families(tree: ast.AST) -> Iterator[tuple[str, str, str]]:
    for call in ast.walk(tree):
        if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and len(call.args) >= 2):
            continue
        name, meaning = call.args[:2]
        kind = {"_histogram": "histogram"}.get(call.func.id, call.func.id.removesuffix("MetricFamily").lower())
        if (
            isinstance(name, ast.Constant)
            and str(name.value).startswith("nafir_")
            and isinstance(meaning, ast.Constant)
        ):
            ending = {"counter": "_total", "info": "_info"}.get(kind, "")
            yield code(f"{name.value}{ending}"), kind, sentence(str(meaning.value))
