"""Quality levels side by side."""

import pytest
from numpy.testing import assert_array_equal

from server.core.errors import RequestError
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.scene.bundle import Bundle, write_bundle
from server.scene.manifest import Cost, QualityLevel

POSE = ([(2.0, 2.5, 1.5)], [(4.0, 4.0, 1.5)], [0.5])


def _levels(*costs_ms):
    def cost(ms):
        return None if ms is None else Cost(ms_p50=ms, ms_p99=ms, storage_mb=1, memory_mb=1, host="this")

    return tuple(QualityLevel(name=f"level{n}", field="arithmetic", cost=cost(ms)) for n, ms in enumerate(costs_ms))


def _with(bundle: Bundle, folder, **changes) -> Bundle:
    files = {name: (bundle.folder / name).read_bytes() for name in bundle.manifest.files}
    return write_bundle(folder, bundle.manifest.model_copy(update=changes), files)


def test_levels_of_a_bundle_are_its_manifests(bundle):
    levels = FieldsByLevel.load(bundle)
    assert list(levels) == [level.name for level in bundle.manifest.levels]
    assert levels.default.level == bundle.manifest.levels[0]
    assert_array_equal(levels.default.impulse_responses(*POSE), AcousticField.load(bundle).impulse_responses(*POSE))


def test_one_session_serves_all_levels_of_a_file(bundle, tmp_path, monkeypatch):
    from server.field import graph

    opened = []
    original = graph.open_session
    monkeypatch.setattr(graph, "open_session", lambda *a, **k: opened.append(a) or original(*a, **k))
    assert len(FieldsByLevel.load(_with(bundle, tmp_path / "three", levels=_levels(None, None, None)))) == 3
    assert len(opened) == 1


@pytest.mark.parametrize(
    ("costs", "expected"),
    [((0.5, 2.0, 0.1), "201"), ((None, None, None), "210"), ((0.5, None, 0.1), "210")],
)
def test_names_go_from_cheap_to_dear(bundle, tmp_path, costs, expected):
    levels = FieldsByLevel.load(_with(bundle, tmp_path / "three", levels=_levels(*costs)))
    assert levels.names == tuple(f"level{number}" for number in expected)
    assert levels.default.level.name == "level0"


def test_unknown_level_is_refused_with_the_names_there_are(bundle):
    levels = FieldsByLevel.load(bundle)
    assert levels.choose(None) is levels.default
    assert levels.choose("standard") is levels["standard"]
    with pytest.raises(RequestError, match="standard") as refusal:
        levels.choose("luxurious")
    assert (refusal.value.code, refusal.value.field) == ("unknown_level", "level")
