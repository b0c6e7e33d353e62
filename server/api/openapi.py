"""The OpenAPI document, with what all routes have in common: refusals and entity tags."""

import json
from functools import cache
from typing import Any, Final

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from starlette.requests import Request
from starlette.responses import Response

from server.api.access_gate import scopes_for
from server.api.api_keys import SCOPES
from server.api.connection_limits import HEALTH_PATHS, LIVENESS_PATH
from server.api.openapi_examples import answer_examples, parameter_example
from server.api.problem_codes import PROBLEM_CODES
from server.responses.response_batch import ResponseBatch

Object = dict[str, Any]

_REFUSED: Final[dict[str, str]] = {
    "400": "The request is malformed; `code` says how.",
    "403": "The request comes from another site, or the server refuses it.",
    "413": "The body is longer than the server takes.",
    "414": "The URL is longer than the server takes.",
    "421": "The server does not answer for this host name.",
    "422": "A parameter is malformed, unknown, missing or given twice; `field` names it.",
    "429": "One address or one key has more requests, streams or uploads than it may.",
    "431": "The headers are longer than the server takes.",
    "500": "The server failed to answer.",
    "503": "The server is warming up, busy or shutting down.",
}
"""Refusals that every route has."""
_OF_A_SCENE: Final = {"404": "There is no such scene, or the scene has no such place or level; `code` says which."}
_OF_A_CLIP: Final = {"404": "There is no such clip, or it has expired."}
_OF_A_FIXED_CLIP: Final = {"409": "The clip was not uploaded, so it stays."}
_OF_A_STORE: Final = {"507": "The server has no room for the clip; `code` says which."}
_OF_A_HEAD: Final = {"404": "There is no such head, or no scene has this sample rate; `code` says which."}
_OF_A_COMPUTATION: Final = {
    "409": "The request asks for more than this scene allows, or its settings contradict each other."
}
_PROBLEM: Final[Object] = {
    "description": "A problem document (RFC 9457). `code` is for programs and does not change, `field` is at fault.",
    "example": {
        "type": "about:blank",
        "title": "Not Found",
        "status": 404,
        "detail": "there is no scene 'moon'",
        "code": "unknown_scene",
        "field": "scene",
    },
    "type": "object",
    "required": ["type", "title", "status", "detail", "code", "field"],
    "properties": {
        "type": {"type": "string"},
        "title": {"type": "string"},
        "status": {"type": "integer"},
        "detail": {"type": "string"},
        "code": {
            "type": "string",
            "description": "\n".join(f"- `{code}`: {meaning}" for code, meaning in PROBLEM_CODES.items()),
        },
        "field": {"anyOf": [{"type": "string"}, {"type": "null"}]},
    },
}
_OF_A_BODY: Final = {"415": "The body is of another type than the route reads."}
_COMPUTED: Final = ("/impulse-response", "/impulse-responses", "/loudness", "/plan", "/ambisonic-noises")
_ENTITY_TAG: Final[Object] = {
    "description": "For `If-None-Match`. Weak if the answer is compressed.",
    "schema": {"type": "string"},
}
_RANGED: Final = ("/bundle/{file}", "/audio")
_OF_A_RANGE: Final = {"416": "The file ends before the range that is asked for."}
_PART: Final = {"206": {"description": "The part that `Range` asks for."}}


_NO_KEY: Final[Object] = {
    "401": "The request has no key, or one that is not valid now. Only where the server asks for keys.",
    "403": "The key has not the scope for this, the request comes from another site, or the server refuses it.",
}
_KEY: Final[Object] = {
    "type": "http",
    "scheme": "bearer",
    "description": "An API key, or a JSON Web Token with the scope in `scope`.",
}
_PASSWORD: Final[Object] = {
    "type": "http",
    "scheme": "basic",
    "description": "The same as a password, with any name: so browsers send it by themselves.",
}


def install_openapi(app: FastAPI, *, max_poses: int, is_protected: bool = False) -> None:
    """Answer /openapi.json by the document from `describe`, which is written once: FastAPI would write its 90 KB anew
    for each request, three milliseconds of the event loop."""

    def openapi() -> Object:
        if app.openapi_schema is None:
            app.openapi_schema = describe(app, max_poses=max_poses, is_protected=is_protected)
        return app.openapi_schema

    @cache
    def written(root_path: str) -> bytes:
        # A proxy may serve everything below a path of its own.
        servers = {"servers": [{"url": root_path}]} if root_path else {}
        return json.dumps(openapi() | servers, ensure_ascii=False, separators=(",", ":")).encode()

    async def answer(request: Request) -> Response:
        return Response(written(request.scope.get("root_path", "").rstrip("/")), media_type="application/json")

    app.openapi = openapi  # type: ignore[method-assign]  # as FastAPI's documentation has it
    app.add_route("/openapi.json", answer, include_in_schema=False)


def describe(app: FastAPI, *, max_poses: int, is_protected: bool = False) -> Object:
    """The document of a server that takes batches of at most so many poses. With `is_protected` it says which
    operations need a key, and of what scopes one."""
    document: Object = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
    schemas = document.setdefault("components", {}).setdefault("schemas", {})
    for unused in ("HTTPValidationError", "ValidationError"):
        schemas.pop(unused, None)
    schemas["Problem"] = _PROBLEM
    batch = ResponseBatch.model_json_schema(ref_template="#/components/schemas/{model}")
    batch["properties"]["poses"]["maxItems"] = max_poses
    schemas |= batch.pop("$defs")
    schemas[ResponseBatch.__name__] = batch
    if is_protected:
        document["components"]["securitySchemes"] = {"key": _KEY, "password": _PASSWORD}
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            if is_protected and path != LIVENESS_PATH:
                needed = scopes_for(method.upper(), path)
                operation["security"] = [
                    {scheme: [scope]} for scope in SCOPES if scope in needed for scheme in ("key", "password")
                ]
            for parameter in operation.get("parameters", ()):
                parameter["schema"] = _without_null(parameter["schema"])
                example = parameter_example(parameter["name"], parameter["schema"])
                # Swagger UI fills in every `example`, and some optional parameters contradict each other.
                if example is None:
                    continue
                if parameter.get("required"):
                    parameter["example"] = example
                else:
                    parameter["schema"]["examples"] = [example]
            operation["responses"] |= _refusals(
                path, has_body="requestBody" in operation, changes=method in {"post", "delete"}
            )
            if "security" in operation:
                operation["responses"] |= _described(_NO_KEY)
            for kind, content in operation["responses"].get("200", {}).get("content", {}).items():
                route = path if method == "get" else f"{method.upper()} {path}"
                if kind == "application/json" and route in answer_examples():
                    content["example"] = answer_examples()[route]
            if path.endswith(_RANGED):
                operation["responses"] |= _PART
            if method == "get" and path not in HEALTH_PATHS:
                operation["responses"]["304"] = {"description": "The client has it already, by its `If-None-Match`."}
                operation["responses"]["200"].setdefault("headers", {})["ETag"] = _ENTITY_TAG
    return document


def _refusals(path: str, *, has_body: bool, changes: bool) -> Object:
    refused = dict(_REFUSED)
    if has_body:
        refused |= _OF_A_BODY
    if "{scene}" in path:
        refused |= _OF_A_SCENE
    if "{hrtf}" in path:
        refused |= _OF_A_HEAD
    if "{clip}" in path:
        refused |= _OF_A_CLIP
    if "/clips" in path and changes:
        refused |= _OF_A_STORE
    if "{clip}" in path and changes:
        refused |= _OF_A_FIXED_CLIP
    if path.endswith(_COMPUTED):
        refused |= _OF_A_COMPUTATION
    if path.endswith(_RANGED):
        refused |= _OF_A_RANGE
    responses = _described(refused)
    responses["503"] |= {"headers": {"Retry-After": {"description": "Seconds.", "schema": {"type": "string"}}}}
    return responses


def _described(refused: Object) -> Object:
    content = {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}}
    return {status: {"description": text, "content": content} for status, text in sorted(refused.items())}


def _without_null(schema: Object) -> Object:
    """The schema without null, which a query parameter cannot have; it is left out instead."""
    (*others,) = (each for each in schema.get("anyOf", ()) if each != {"type": "null"})
    if len(others) != 1:
        return schema
    return {**{key: value for key, value in schema.items() if key != "anyOf"}, **others[0]}
