"""What a manifest says of a field that predicts directions."""

import pytest
from pydantic import ValidationError

from server.scene.manifest import FieldFile, Manifest
from tests.conftest import MANIFEST

DIRECTIONAL = FieldFile(file="arithmetic.onnx", architecture="arithmetic", predicts="directions", order=2)


def with_field(field: FieldFile, **changes: object) -> dict[str, object]:
    document = MANIFEST.model_dump(mode="json")
    document["codec"]["known_frames"] = 0
    document["image_order"] = 1
    return document | {"fields": {"arithmetic": field.model_dump(mode="json")}} | changes


def test_a_bundle_with_directions_has_format_3():
    manifest = Manifest.model_validate(with_field(DIRECTIONAL, format_version=3))
    assert manifest.fields["arithmetic"].order == 2
    with pytest.raises(ValidationError, match="format_version: is 2, but fields like these make it 3"):
        Manifest.model_validate(with_field(DIRECTIONAL))


def test_directions_are_of_what_follows_the_first_reflections():
    with pytest.raises(ValidationError, match="image_order: must be 1: fields of directions hold what follows"):
        Manifest.model_validate(with_field(DIRECTIONAL, format_version=3, image_order=0))


@pytest.mark.parametrize("choice", [{"predicts": "directions"}, {"predicts": "ears", "order": 1}, {"order": 0}])
def test_directions_have_an_order_and_ears_none(choice):
    with pytest.raises(ValidationError, match="order: a field that predicts directions has one"):
        FieldFile.model_validate({"file": "a.onnx", "architecture": "a"} | choice)


@pytest.mark.parametrize("order", [-1, 4])
def test_an_order_that_is_none_is_refused(order):
    with pytest.raises(ValidationError, match="order"):
        FieldFile(file="a.onnx", architecture="a", predicts="directions", order=order)


@pytest.mark.parametrize("changes", [{"channels": ["mono"], "direct_sound": "field"}, {"direct_sound": "field"}])
def test_directions_are_of_late_reverberation(changes):
    with pytest.raises(ValidationError, match="directions are those of late reverberation"):
        Manifest.model_validate(with_field(DIRECTIONAL, format_version=3, **changes))


def test_a_bundle_of_ears_is_written_as_version_2_knows_it():
    assert set(MANIFEST.model_dump(mode="json")["fields"]["arithmetic"]) == {"file", "architecture", "rank", "codec"}


def test_directions_have_no_known_phase():
    document = with_field(DIRECTIONAL, format_version=3)
    document["codec"]["known_frames"] = 4
    with pytest.raises(ValidationError, match="known_frames: must be 0, directions have no phase"):
        Manifest.model_validate(document)


@pytest.mark.parametrize(
    "level",
    [
        {"reuse": {"spacing_m": 1.0, "turn_deg": 120.0}},
        {"phase": {"kind": "integrated"}},
    ],
)
def test_directions_are_heard_anew_and_have_no_phase_to_integrate(level):
    levels = [{"name": "standard", "field": "arithmetic"} | level]
    with pytest.raises(ValidationError, match=r"levels\.standard: a field of directions is heard anew"):
        Manifest.model_validate(with_field(DIRECTIONAL, format_version=3, levels=levels))


def test_a_scene_without_fields_has_neither_bands_nor_directions():
    document = MANIFEST.model_dump(mode="json")
    document |= {"fields": {}, "levels": [{"name": "geometry", "field": "none"}]}
    Manifest.model_validate(document)
    document["levels"][0]["tail"] = "bands"
    with pytest.raises(ValidationError, match=r"levels\.geometry\.tail: bands are for fields of directions"):
        Manifest.model_validate(document)
    document["levels"] = [{"name": "geometry", "field": "none", "order": 1}]
    with pytest.raises(ValidationError, match=r"levels\.geometry\.order: a scene without fields has no directions"):
        Manifest.model_validate(document)


@pytest.mark.parametrize(
    ("field", "order", "told"),
    [(DIRECTIONAL, 3, "order 2"), (FieldFile(file="arithmetic.onnx", architecture="a"), 1, "no directions")],
)
def test_a_level_uses_no_more_harmonics_than_there_are(field, order, told):
    version = 3 if field is DIRECTIONAL else 2
    levels = [{"name": "standard", "field": "arithmetic", "order": order}]
    with pytest.raises(ValidationError, match=rf"levels.standard.order: is {order}, but field arithmetic has {told}"):
        Manifest.model_validate(with_field(field, format_version=version, levels=levels))


def test_bands_are_for_directions_alone():
    levels = [{"name": "standard", "field": "arithmetic", "tail": "bands"}]
    with pytest.raises(ValidationError, match="bands are for fields of directions"):
        Manifest.model_validate(MANIFEST.model_dump(mode="json") | {"levels": levels})
