import json

import numpy as np
import pytest
from rich.progress import Progress

from server.field.levels import Levels
from server.scene.bundle import Bundle, write_bundle
from server.scene.manifest import Phase
from training.frontier import sweep as sweep_module
from training.frontier.accuracy import HeldOutSample
from training.frontier.candidates import candidates
from training.frontier.figure import draw_frontier
from training.frontier.sweep import Effort, offered_levels, sweep, with_levels

EFFORT = Effort(pairs=3, yaws=2, rounds=4)


@pytest.fixture(scope="module")
def chosen(tiny_bundle):
    wanted = {Phase(), Phase(kind="griffin_lim", iterations=1)}
    return [level for level in candidates(tiny_bundle) if level.phase in wanted]


@pytest.fixture(scope="module")
def frontier(tiny_bundle, dataset, chosen, tmp_path_factory):
    return sweep(tiny_bundle, dataset, chosen, tmp_path_factory.mktemp("frontier"), EFFORT, Progress(disable=True))


@pytest.fixture(scope="module")
def sample(tiny_bundle, dataset) -> HeldOutSample:
    return HeldOutSample(dataset, tiny_bundle.manifest.codec.codec, pairs=3, yaws=2, seed=0)


def test_candidates_differ_in_what_they_are_and_not_only_in_name(tiny_bundle) -> None:
    levels = candidates(tiny_bundle)
    assert len({level.name for level in levels}) == len(levels)
    assert len({level.model_copy(update={"name": "x"}).model_dump_json() for level in levels}) == len(levels)
    assert all(level.phase == Phase() for level in candidates(tiny_bundle, []))


def test_a_reference_has_no_error_and_its_twin_has_the_floors(sample) -> None:
    exact = sample.errors_of(lambda entry: entry.reference)
    assert max(exact.errors.values()) == pytest.approx(0, abs=1e-9)
    floor = sample.floor()
    assert min(floor.audible.values()) > 0
    assert floor.errors.keys() == exact.errors.keys()


def test_the_reference_without_its_direct_sound_is_what_the_dataset_holds(sample) -> None:
    for entry in sample.entries:
        direct = entry.reference - entry.reflected
        assert (np.abs(direct).max() > 0) == entry.visible


def test_the_true_phase_bounds_what_phase_can_do(frontier) -> None:
    bounds = [point for point in frontier.points if point.bound]
    assert len(bounds) == 1
    others = [point for point in frontier.points if not point.bound]
    assert bounds[0].accuracy.errors["spectral_loss"] < min(p.accuracy.errors["spectral_loss"] for p in others)
    assert bounds[0] not in frontier.best


def test_costs_are_measured_in_one_run(frontier) -> None:
    for point in frontier.points:
        assert 0 < point.cost.ms_p50 <= point.cost.ms_p99
        assert point.cost.storage_mb > 0
    assert frontier.default in frontier.best


def test_what_was_measured_is_not_measured_again(tiny_bundle, dataset, chosen, tmp_path, monkeypatch) -> None:
    first = sweep(tiny_bundle, dataset, chosen[:1], tmp_path, EFFORT, Progress(disable=True))
    kept = json.loads((tmp_path / "accuracy.json").read_text())
    monkeypatch.setattr(sweep_module._Estimate, "__call__", lambda *_: pytest.fail("measured again"))
    again = sweep(tiny_bundle, dataset, chosen[:1], tmp_path, EFFORT, Progress(disable=True))
    assert again.best[0].accuracy == first.best[0].accuracy
    assert json.loads((tmp_path / "accuracy.json").read_text()) == kept


def test_a_bundle_offers_the_optimal_levels_and_keeps_what_was_measured(frontier, tiny_bundle, tmp_path) -> None:
    levels = offered_levels(frontier)
    with_levels(tiny_bundle, levels, tmp_path)
    loaded = Levels.load(Bundle.load(tmp_path))
    assert list(loaded) == [level.name for level in levels]
    assert loaded.default.level == frontier.default.level
    assert loaded.default.level.cost is not None
    assert loaded.default.level.accuracy is not None


def test_the_document_names_every_point_and_the_picture_is_drawn(frontier, tmp_path) -> None:
    document = json.loads(json.dumps(frontier.to_json()))
    assert {entry["name"] for entry in document["points"]} == {point.level.name for point in frontier.points}
    assert sum(entry["is_pareto_optimal"] for entry in document["points"]) == len(frontier.best)
    draw_frontier(frontier, tmp_path / "frontier.png")
    assert (tmp_path / "frontier.png").read_bytes().startswith(b"\x89PNG")


def test_fields_that_no_level_needs_leave_the_folder(tiny_bundle, tmp_path) -> None:
    manifest = tiny_bundle.manifest
    (name, field), *_ = manifest.fields.items()
    other = field.model_copy(update={"file": "other.onnx"})
    files = {each: (tiny_bundle.folder / each).read_bytes() for each in manifest.files}
    files["other.onnx"] = files[field.file]
    both = manifest.model_copy(
        update={"fields": {name: field, "other": other}, "files": dict.fromkeys(files, "0" * 64)}
    )
    bundle = write_bundle(tmp_path, both, files)
    assert (tmp_path / "other.onnx").exists()
    with_levels(bundle, manifest.levels, tmp_path)
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"scene.json", *Bundle.load(tmp_path).manifest.files}
    assert "other.onnx" not in left
