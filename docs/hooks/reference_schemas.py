"""Tables of the settings, of the bundle's manifest, and of any JSON schema."""

from collections.abc import Iterable, Mapping
from typing import Any, Final

from pydantic import BaseModel

from reference_text import code, default_text, number, paragraphs, sentence, table
from server.api.settings import Settings
from server.core.docstrings import attribute_docstrings
from server.scene import geometry
from server.scene import manifest as manifests

_OF_THE_HOST: Final = {
    "cores": "the processor cores that the process may use",
    "audio_threads": "the processor cores that the process may use",
    "ir_workers": "one less than `NAFIR_AUDIO_THREADS`, and at least 1",
}
"""Descriptions of defaults that differ between machines."""
_BOUNDS: Final = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}


def settings() -> str:
    """Return a table of every setting by its environment variable."""
    properties = Settings.model_json_schema()["properties"]
    meanings = attribute_docstrings(Settings)
    rows = []
    for name, field in Settings.model_fields.items():
        default = _OF_THE_HOST.get(name, "" if field.default == () else default_text(field.default))
        variable = code(f"NAFIR_{name.upper()}")
        rows.append((variable, type_name(properties[name]), default, sentence(meanings.get(name, ""))))
    return table(["variable", "type", "default", "meaning"], rows)


def manifest() -> str:
    """Return tables of `scene.json` and of every object in it, beginning with the whole."""
    schema = manifests.Manifest.model_json_schema()
    models = {**_models(geometry), **_models(manifests)}
    nested = [models[name] for name in schema["$defs"] if name in models]
    return "\n".join(_described(model) for model in (manifests.Manifest, *nested))


def _models(module: Any) -> dict[str, type[BaseModel]]:
    kinds = {name: kind for name, kind in vars(module).items() if isinstance(kind, type)}
    return {name: kind for name, kind in kinds.items() if issubclass(kind, BaseModel)}


def _described(model: type[BaseModel]) -> str:
    rows = schema_rows(model.model_json_schema(), attribute_docstrings(model))
    body = table(["field", "type", "default", "meaning"], rows)
    return f"### {model.__name__}\n\n{paragraphs(model.__doc__)}\n\n{body}"


def schema_rows(schema: Mapping[str, Any], meanings: Mapping[str, str]) -> Iterable[tuple[str, str, str, str]]:
    """Yield a row for each field of an object's schema: name, type, whether it is required, and meaning."""
    required = schema.get("required", ())
    for name, field in schema.get("properties", {}).items():
        default = "required" if name in required else default_text(field["default"]) if "default" in field else ""
        told = meanings.get(name, field.get("description", ""))
        yield code(name), type_name(field), "" if default == "`null`" else default, sentence(told)


def type_name(schema: Mapping[str, Any]) -> str:
    """Return the type of a schema in words, with its bounds."""
    if "$ref" in schema:
        return schema["$ref"].rsplit("/", 1)[-1]
    if "const" in schema:
        return code(schema["const"])
    if "enum" in schema:
        return ", ".join(map(code, schema["enum"]))
    for several in ("anyOf", "oneOf", "allOf"):
        if several in schema:
            return " or ".join(type_name(each) for each in schema[several] if each != {"type": "null"})
    kind = schema.get("type", "any")
    if kind == "array":
        return _array(schema)
    if kind == "object":
        of = schema.get("additionalProperties")
        return f"object of {type_name(of)}" if isinstance(of, Mapping) else "object"
    bounds = [f"{sign} {number(schema[bound])}" for bound, sign in _BOUNDS.items() if bound in schema]
    return " ".join([kind, " and ".join(bounds)]).strip().replace(" ", "\u00a0")


def _array(schema: Mapping[str, Any]) -> str:
    items = schema.get("prefixItems") or (schema.get("items") if isinstance(schema.get("items"), list) else None)
    if items:
        kinds = {type_name(each) for each in items}
        return f"{len(items)} × {kinds.pop()}" if len(kinds) == 1 else f"[{', '.join(map(type_name, items))}]"
    return f"list of {type_name(schema.get('items', {}))}"
