import io
import itertools
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from rich.progress import Progress

from server.core.bounded_cache import BoundedCache
from server.core.errors import BundleError
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.field.node_responses import NODE_CACHE_BYTES
from server.rendering.hrtf import kemar
from server.scene.bundle import Bundle, write_bundle
from server.scene.manifest import ARRAYS_FILE, Phase, QualityLevel, Reuse
from server.streaming.calibration import Listener
from tests.directional_flat import write_directional
from training.frontier.accuracy import Estimate, SampledPairs
from training.frontier.candidates import candidates
from training.frontier.figure import draw_frontier
from training.frontier.sweep import Effort, record, sweep, with_levels
from training.frontier.walk import POSES_PER_S, SPEED_M_PER_S, walk

EFFORT = Effort(pairs=4, yaws=4, walk_s=12.0)
WITH_A_SHORT_WALK = replace(EFFORT, yaws=2, walk_s=2.0)
"""For tests that look at accuracy alone."""


@pytest.fixture(scope="module")
def chosen(tiny_bundle):
    wanted = {Phase(), Phase(kind="griffin_lim", iterations=1)}
    (field,) = tiny_bundle.manifest.fields
    levels = [level for level in candidates(tiny_bundle, reuse_of=[field]) if level.phase in wanted]
    lattices = {Reuse(spacing_m=0.1, turn_deg=15), Reuse(spacing_m=5, turn_deg=360, first_reflections="node")}
    return [level for level in levels if level.reuse is None or level.reuse in lattices]


@pytest.fixture(scope="module")
def frontier(tiny_bundle, dataset, chosen, tmp_path_factory):
    return sweep(tiny_bundle, dataset, chosen, tmp_path_factory.mktemp("frontier"), EFFORT, Progress(disable=True))


@pytest.fixture(scope="module")
def sample(tiny_bundle, dataset) -> SampledPairs:
    return SampledPairs(dataset, tiny_bundle.manifest.codec.codec, pairs=3, yaws=2, seed=0)


def test_candidates_differ_in_what_they_are_and_not_only_in_name(tiny_bundle) -> None:
    levels = candidates(tiny_bundle, reuse_of=tiny_bundle.manifest.fields)
    assert len({level.name for level in levels}) == len(levels)
    assert len({level.model_copy(update={"name": "x"}).model_dump_json() for level in levels}) == len(levels)
    assert all(level.phase == Phase() and level.reuse is None for level in candidates(tiny_bundle, ["none"]))
    with pytest.raises(BundleError, match="there is no 'other', only"):
        candidates(tiny_bundle, reuse_of=["other"])


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


def test_levels_are_chosen_by_one_half_and_reported_on_the_other(tiny_bundle, dataset, chosen, tmp_path, monkeypatch):
    taken: dict[frozenset, list] = {}
    errors_of = SampledPairs.errors_of

    def told(self, estimate):
        pairs = frozenset((*entry.emitter, *entry.listener) for entry in self.entries)
        taken.setdefault(pairs, []).append(errors_of(self, estimate))
        return taken[pairs][-1]

    monkeypatch.setattr(SampledPairs, "errors_of", told)
    found = sweep(tiny_bundle, dataset, chosen[:1], tmp_path, WITH_A_SHORT_WALK, Progress(disable=True))
    assert len(taken) == 2  # no more samples than halves
    probes = {half: dataset.probes[dataset.held_out_half(half)].reshape(-1, 6) for half in ("choice", "report")}
    for half, is_reported in (("choice", False), ("report", True)):
        (pairs,) = [pairs for pairs in taken if pairs <= {tuple(ends) for ends in probes[half].tolist()}]
        of_level = [errors.errors for errors in taken[pairs]]
        assert (found.best[0].accuracy.errors in of_level) == is_reported
        assert (found.floor.errors in of_level) == is_reported


def test_costs_are_measured_in_one_run(frontier) -> None:
    for point in frontier.points:
        assert 0 < point.cost.ms_p50 <= point.cost.ms_p99
        assert min(point.cost.ms_mean, point.cost.ms_miss, point.cost.storage_mb) > 0
    assert frontier.default in frontier.best


def test_what_was_measured_is_not_measured_again(tiny_bundle, dataset, chosen, tmp_path, monkeypatch) -> None:
    first = sweep(tiny_bundle, dataset, chosen[:1], tmp_path, WITH_A_SHORT_WALK, Progress(disable=True))
    kept = json.loads((tmp_path / "accuracy.json").read_text())
    monkeypatch.setattr(Estimate, "__call__", lambda *_: pytest.fail("measured again"))
    again = sweep(tiny_bundle, dataset, chosen[:1], tmp_path, WITH_A_SHORT_WALK, Progress(disable=True))
    assert again.best[0].accuracy == first.best[0].accuracy
    assert json.loads((tmp_path / "accuracy.json").read_text()) == kept


def test_with_another_noise_it_is_measured_again(tiny_bundle, dataset, chosen, tmp_path) -> None:
    first = sweep(tiny_bundle, dataset, chosen[:1], tmp_path / "frontier", WITH_A_SHORT_WALK, Progress(disable=True))
    arrays = io.BytesIO()
    np.savez(arrays, frozen_noise=0.5 * tiny_bundle.frozen_noise)
    files = {name: (tiny_bundle.folder / name).read_bytes() for name in tiny_bundle.manifest.files}
    other = write_bundle(tmp_path / "bundle", tiny_bundle.manifest, {**files, ARRAYS_FILE: arrays.getvalue()})
    again = sweep(other, dataset, chosen[:1], tmp_path / "frontier", WITH_A_SHORT_WALK, Progress(disable=True))
    assert again.best[0].accuracy.errors["level"] != first.best[0].accuracy.errors["level"]


def test_a_bundle_offers_the_optimal_levels_and_keeps_what_was_measured(frontier, tiny_bundle, tmp_path) -> None:
    record(tiny_bundle, frontier, tmp_path)
    loaded = FieldsByLevel.load(Bundle.load(tmp_path))
    assert list(loaded) == [point.level.name for point in frontier.offered]
    measured = {point.level.name for point in loaded.bundle.manifest.frontier}
    assert measured == {point.level.name for point in frontier.best} - set(loaded)
    assert loaded.default.level == frontier.default.level
    assert loaded.default.level.cost is not None
    assert loaded.default.level.accuracy is not None


@pytest.mark.parametrize(("bus", "kept"), [(1, ["bus"]), (2, [])])
def test_what_clients_hear_that_render_the_scene_is_kept_though_it_is_not_optimal(frontier, tmp_path, bus, kept):
    bundle = write_directional(tmp_path / "flat", order=2)
    # Which point is the default follows from times. A field of directions takes no level with reuse or another phase.
    level = frontier.default.level.model_copy(update={"field": "directional", "reuse": None, "phase": Phase()})
    default = replace(frontier.default, level=level)
    by_bus = replace(default, level=level.model_copy(update={"name": "bus", "bus": bus}))
    measured = replace(frontier, points=(default, by_bus), best=(default,), default=default, offered=(default,))
    written = record(bundle, measured, tmp_path / "written")
    assert [point.level.name for point in written.manifest.frontier] == kept


def test_the_document_names_every_point_and_the_picture_is_drawn(frontier, tmp_path) -> None:
    document = json.loads(json.dumps(frontier.to_json()))
    assert {entry["name"] for entry in document["points"]} == {point.level.name for point in frontier.points}
    assert sum(entry["is_pareto_optimal"] for entry in document["points"]) == len(frontier.best)
    draw_frontier(frontier, tmp_path / "frontier.png")
    assert (tmp_path / "frontier.png").read_bytes().startswith(b"\x89PNG")


def test_one_response_for_all_poses_costs_next_to_nothing_and_is_worse_and_jumps(frontier) -> None:
    points = {point.level.reuse: point for point in frontier.points if point.level.phase == Phase() and not point.bound}
    exact = points[None]
    fine, coarse = sorted((point for reuse, point in points.items() if reuse), key=lambda p: p.level.reuse.spacing_m)
    assert coarse.cost.ms_mean < 0.2 * exact.cost.ms_mean
    assert coarse.cost.ms_p50 < 0.05 * exact.cost.ms_p50
    assert coarse.cost.ms_miss > 0.5 * exact.cost.ms_miss
    # Reflections of another place, beside a direct sound of its own.
    assert coarse.accuracy.errors["drr"] > 1.5 * exact.accuracy.errors["drr"]
    assert coarse.accuracy.errors["c50"] > 1.1 * exact.accuracy.errors["c50"]  # of the half that is reported: two pairs
    assert coarse.accuracy.errors["itd"] < 1.2 * exact.accuracy.errors["itd"] + 10  # us
    assert max(exact.accuracy.steps.values()) < max(coarse.accuracy.steps.values())
    assert fine.cost.memory_mb > exact.cost.memory_mb  # what it keeps is memory too


def test_a_walk_is_at_the_speed_of_walking_through_the_room_and_looks_about(tiny_bundle) -> None:
    poses = walk(tiny_bundle, duration_s=30, seed=3)
    places = np.array([pose.position for pose in poses])
    assert len(poses) == 30 * POSES_PER_S
    assert tiny_bundle.floor_plan.contains(places).all()
    steps_m = np.linalg.norm(np.diff(places, axis=0), axis=-1)
    assert np.median(steps_m) == pytest.approx(SPEED_M_PER_S / POSES_PER_S)
    assert steps_m.max() < 1.01 * SPEED_M_PER_S / POSES_PER_S
    turns = np.array([math.remainder(b.yaw - a.yaw, math.tau) for a, b in itertools.pairwise(poses)])
    assert 0.01 < np.abs(turns).max() * POSES_PER_S < 1.5 * math.pi
    assert walk(tiny_bundle, duration_s=30, seed=3) == poses != walk(tiny_bundle, duration_s=30, seed=4)


def test_a_listener_that_forgot_pays_again_and_one_that_stands_still_pays_once(tiny_bundle) -> None:
    (field,) = tiny_bundle.manifest.fields
    level = QualityLevel(name="kept", field=field, reuse=Reuse(spacing_m=2, turn_deg=90, first_reflections="node"))
    graph = AcousticField.load(tiny_bundle).graph
    kept = BoundedCache(NODE_CACHE_BYTES)
    field_at_nodes = AcousticField(tiny_bundle, level, graph, node_cache=kept)
    listener = Listener(field_at_nodes, kemar(field_at_nodes.sample_rate), node_cache=kept)
    pose = walk(tiny_bundle, duration_s=1, seed=0)[0]
    first = listener.time_ms(pose)
    again = min(listener.time_ms(pose) for _ in range(20))
    assert listener.kept_bytes > 0
    listener.forget()
    assert listener.kept_bytes == 0
    assert again < 0.1 * min(first, listener.time_ms(pose))


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
