"""What the bench says of a field's levels."""

import pytest

from server.bench.field import measure_levels
from server.field.fields_by_level import FieldsByLevel
from server.field.node_responses import NODE_CACHE_BYTES
from server.scene.bundle import write_bundle
from server.scene.manifest import ARRAYS_FILE, NO_FIELD, Phase, QualityLevel, Reuse
from server.streaming.calibration import calibrate


@pytest.fixture(scope="module")
def levels(bundle, tmp_path_factory) -> FieldsByLevel:
    dear = QualityLevel(name="dear", field="arithmetic", phase=Phase(kind="griffin_lim", iterations=64))
    files = {name: (bundle.folder / name).read_bytes() for name in bundle.manifest.files}
    manifest = bundle.manifest.model_copy(update={"levels": (*bundle.manifest.levels, dear)})
    return FieldsByLevel.load(write_bundle(tmp_path_factory.mktemp("dear") / "scene", manifest, files))


@pytest.mark.timed
def test_the_dear_level_costs_more_and_it_is_decoding_that_costs(levels):
    measured = measure_levels(levels, rounds=3, poses=5)
    assert [level["name"] for level in measured["levels"]] == ["standard", "dear"]
    standard, dear = measured["levels"]
    assert dear["ms_p50"] > 2 * standard["ms_p50"]
    assert dear["decode_ms_p50"] > 2 * dear["graph_ms_p50"]
    for level in (standard, dear):
        assert 0 < level["graph_ms_p50"] <= level["ms_p50"] <= level["ms_p99"]
    assert measured["summary"][0]["value"] == standard["ms_p50"]


@pytest.mark.timed
def test_calibration_tells_them_apart_too(levels, filters):
    costs_ms = calibrate(levels, filters)
    assert costs_ms["dear"] > 2 * costs_ms["standard"]


def test_where_responses_are_kept_the_room_for_them_is_full(bundle, tmp_path):
    reusing = QualityLevel(name="reusing", field="arithmetic", reuse=Reuse(spacing_m=0.1, turn_deg=15))
    files = {name: (bundle.folder / name).read_bytes() for name in bundle.manifest.files}
    manifest = bundle.manifest.model_copy(update={"levels": (reusing,)})
    levels = FieldsByLevel.load(write_bundle(tmp_path / "scene", manifest, files))
    measure_levels(levels, rounds=1, poses=2)
    assert levels.node_cache.bytes > 0.9 * NODE_CACHE_BYTES


def test_a_scene_without_fields_spends_no_time_in_a_graph(bundle, tmp_path):
    nothing = QualityLevel(name="geometry", field=NO_FIELD)
    manifest = bundle.manifest.model_copy(update={"fields": {}, "levels": (nothing,), "image_order": 1})
    files = {ARRAYS_FILE: (bundle.folder / ARRAYS_FILE).read_bytes()}
    (level,) = measure_levels(FieldsByLevel.load(write_bundle(tmp_path / "scene", manifest, files)), rounds=1, poses=2)[
        "levels"
    ]
    assert level["graph_ms_p50"] == 0.0
    assert level["decode_ms_p50"] == level["ms_p50"] > 0.0
