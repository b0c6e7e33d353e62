"""JSON schema of `scene.json`, for editors and for programs in other languages.

Every manifest that the server takes is valid by it, as long as numbers are written as numbers. What the schema cannot
say, the server still checks: that names refer to what exists, that places lie within the room, that counts fit
together, and the files themselves.
"""

from typing import Any, Final

from server.core.docstrings import attribute_docstrings
from server.scene.manifest import DIRECTIONS_FORMAT, EARS_FORMAT, MESH_FORMAT, FieldFile, Manifest, Phase

_DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"
_WHERE: Final = {
    FieldFile.__name__: {
        "if": {"properties": {"predicts": {"const": "directions"}}, "required": ["predicts"]},
        "then": {"properties": {"order": {"type": "integer"}}, "required": ["order"]},
        "else": {"properties": {"order": {"type": "null"}}},
    },
    Phase.__name__: {
        "if": {"properties": {"kind": {"const": "griffin_lim"}}, "required": ["kind"]},
        "then": {"properties": {"iterations": {"minimum": 1}}, "required": ["iterations"]},
        "else": {"properties": {"iterations": {"const": 0}, "warm": {"const": False}}},
    },
}
"""What one field of an object asks of another, by the object's name."""
_FORMATS: Final = {
    "if": {"properties": {"mesh": {"type": "object"}}, "required": ["mesh"]},
    "then": {"properties": {"format_version": {"const": MESH_FORMAT}}, "required": ["format_version"]},
    "else": {"properties": {"format_version": {"enum": [EARS_FORMAT, DIRECTIONS_FORMAT]}}},
}


def manifest_schema() -> dict[str, Any]:
    """Return the schema (draft 2020-12)."""
    schema = Manifest.model_json_schema()
    told = attribute_docstrings(Manifest)
    for field, described in schema["properties"].items():
        if field in told:
            described["description"] = told[field]
    schema["properties"]["files"]["additionalProperties"] = False  # pydantic gives the pattern of names alone
    for name, condition in _WHERE.items():
        schema["$defs"][name] |= condition
    return {"$schema": _DIALECT, **schema, **_FORMATS, "title": "Scene bundle of Nafir: scene.json"}
