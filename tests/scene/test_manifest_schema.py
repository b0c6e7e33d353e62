"""The published schema of manifests takes what the loader takes, and refuses much of what the loader refuses."""

import copy
import json

import jsonschema
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from server.scene.bundle import bundled_scenes
from server.scene.manifest import Manifest
from server.scene.manifest_schema import manifest_schema
from tests.conftest import MANIFEST
from tests.directional_flat import write_directional

SCHEMA = manifest_schema()
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)
DOCUMENT = MANIFEST.model_dump(mode="json")


def loads(document):
    try:
        Manifest.model_validate_json(json.dumps(document))
    except ValidationError:
        return False
    return True


def changed(place, value):
    """The manifest with another value at a place; `...` removes it."""
    document = copy.deepcopy(DOCUMENT)
    inside = document
    for key in place[:-1]:
        inside = inside[key]
    if value is ...:
        del inside[place[-1]]
    else:
        inside[place[-1]] = value
    return document


def places(value, place=()):
    yield place
    pairs = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inside in pairs:
        yield from places(inside, (*place, key))


def test_it_is_a_schema():
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    assert SCHEMA["properties"]["image_order"]["description"].startswith("Order of the reflections")


@pytest.mark.parametrize("folder", bundled_scenes(), ids=lambda folder: folder.name)
def test_bundled_manifests_are_valid(folder):
    VALIDATOR.validate(json.loads((folder / "scene.json").read_text()))


def test_manifests_of_directions_are_valid(tmp_path):
    folder = write_directional(tmp_path / "flat").folder
    VALIDATOR.validate(json.loads((folder / "scene.json").read_text()))


def test_what_the_loader_fills_in_may_be_missing():
    cost = {"ms_p50": 1.0, "ms_p99": 2.0, "storage_mb": 1.0, "memory_mb": 1.0, "host": "a machine"}
    document = changed(("levels", 0, "cost"), cost)
    assert loads(document)
    VALIDATOR.validate(document)


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("format_version",), 4),
        (("format_version",), 1),
        (("air",), {"relative_humidity": 50}),
        (("speed_of_sound",), -1),
        (("surprise",), 1),
        (("bounds",), ...),
        (("bounds", "minimum"), [0, 0]),
        (("id",), "A flat"),
        (("levels",), []),
        (("levels", 0, "name"), "../x"),
        (("levels", 0, "phase"), {"kind": "griffin_lim"}),
        (("levels", 0, "phase"), {"kind": "frozen", "iterations": 3}),
        (("levels", 0, "phase"), {"warm": True}),
        (("codec", "frame_cells"), [0, 66]),
        (("codec", "sample_rate"), 24_000.5),
        (("fields", "arithmetic", "file"), "../arithmetic.onnx"),
        (("fields", "arithmetic", "predicts"), "directions"),
        (("fields", "arithmetic", "order"), 1),
        (("files", "arrays.npz"), "0" * 63),
        (("files", "../arrays.npz"), "0" * 64),
        (("effects",), {"echo": True}),
        (("geometry", "materials", "walls", "absorption"), [0.2] * 6),
    ],
)
def test_what_the_loader_refuses_is_not_valid(place, value):
    document = changed(place, value)
    assert not loads(document)
    assert not VALIDATOR.is_valid(document)


@given(
    st.sampled_from([place for place in places(DOCUMENT) if place]),
    st.sampled_from([..., None, {}, [], "x", -1, 1e300]),
)
def test_what_the_loader_takes_is_valid(place, value):
    document = changed(place, value)
    if loads(document):
        VALIDATOR.validate(document)
