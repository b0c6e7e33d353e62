import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from server.acoustics.geometry import Quaternion, axes_of
from server.acoustics.metrics import spectral_loss
from server.field.field import AcousticField
from server.rendering.hrtf import KEMAR
from server.responses.full_response import FullResponse
from server.scene.bundle import Bundle, write_bundle
from server.scene.manifest import Accuracy, QualityLevel, Reuse
from training.baselines.held_out import EvaluationError, open_held_out, require_same_scene, tilted
from training.data.dataset import DatasetError
from training.data.importers.report import ImportReport
from training.data.responses import ImportedDataset, Measurement
from training.evaluation.evaluate import spectral_codec
from training.evaluation.fields import record_accuracy
from training.evaluation.methods import method_columns
from training.evaluation.run import evaluate_bundles
from training.simulation.references import References


@pytest.fixture(scope="module")
def references(dataset):
    return References(dataset)


@pytest.fixture(scope="module")
def held_out(dataset):
    with open_held_out(dataset.folder) as opened:
        yield opened


@pytest.fixture(scope="module")
def two_levels(tiny_bundle, tmp_path_factory) -> Bundle:
    """The tiny bundle with a second level, of its first frames only."""
    folder = tmp_path_factory.mktemp("levels") / "tiny"
    shutil.copytree(tiny_bundle.folder, folder)
    manifest = tiny_bundle.manifest
    short = QualityLevel(name="short", field=manifest.levels[0].field, frames=8)
    files = {name: (folder / name).read_bytes() for name in manifest.files}
    return write_bundle(folder, manifest.model_copy(update={"levels": (*manifest.levels, short)}), files)


@pytest.fixture(scope="module")
def figure(tmp_path_factory):
    return tmp_path_factory.mktemp("figure") / "errors.png"


@pytest.fixture(scope="module")
def evaluation(dataset, two_levels, figure):
    return evaluate_bundles([two_levels], dataset.folder, figure=figure)[0]


def test_references_are_the_held_out_pairs(held_out, dataset, references):
    pairs = dataset.pairs(held_out=True)
    assert len(held_out) == len(pairs)
    for index, (emitter, listener) in enumerate(pairs):
        np.testing.assert_array_equal(held_out.emitters[index], dataset.probes[emitter])
        np.testing.assert_array_equal(held_out.listeners[index], dataset.probes[listener])
        np.testing.assert_array_equal(held_out.reference(index), references[emitter * len(dataset.probes) + listener])


def test_the_nearest_answer_is_one_that_was_trained_on(held_out, dataset, references):
    pairs = dataset.pairs(held_out=False)
    known = [references[emitter * len(dataset.probes) + listener] for emitter, listener in pairs]
    (nearest,) = method_columns(["nearest"], held_out)
    for index in range(len(held_out)):
        answer = np.asarray(nearest.source(index, held_out.yaw_indices))
        assert any(np.array_equal(answer, response) for response in known)


def test_an_unknown_method_is_refused_with_those_there_are(held_out):
    with pytest.raises(EvaluationError, match="no 'farthest', but nearest"):
        method_columns(["farthest"], held_out)


def test_every_level_answers_as_the_server_does(evaluation, two_levels, held_out, dataset):
    assert [result.name for result in evaluation.results] == [
        "standard",
        "short",
        "nearest",
        "linear",
        "linear-aligned",
        "mean-spectrogram",
        "floor",
    ]
    codec = spectral_codec(dataset.sample_rate, dataset.samples)
    for level in ("standard", "short"):
        field = FullResponse.through_kemar(AcousticField.load(two_levels, level=level))
        losses = []
        for index in range(len(held_out)):
            shape = (len(dataset.yaws), 3)
            ends = (np.broadcast_to(end[index], shape) for end in (held_out.listeners, held_out.emitters))
            responses = (field.impulse_responses(*ends, dataset.yaws), held_out.reference(index))
            losses.append(spectral_loss(*(codec.log_magnitude(codec.transform(response)) for response in responses)))
        assert evaluation.of(level).summaries["spectral_loss"].mean == pytest.approx(np.mean(losses), rel=1e-4)


def test_the_floor_compares_two_takes_of_the_simulation(evaluation, held_out):
    codec = spectral_codec(held_out.sample_rate, held_out.samples)
    losses = []
    for index in range(len(held_out)):
        takes = held_out.reference(index), held_out.repeats[int(held_out.held_out[index])]
        assert not np.array_equal(*takes)
        losses.append(spectral_loss(*(codec.log_magnitude(codec.transform(take)) for take in takes)))
    assert evaluation.floor.summaries["spectral_loss"].mean == pytest.approx(np.mean(losses), rel=1e-4)


def test_a_scene_without_hidden_pairs_has_a_figure(evaluation, figure):
    assert evaluation.visible_pairs == evaluation.pairs
    with Image.open(figure) as image:
        assert min(image.size) > 200


def test_bundles_stand_side_by_side_under_their_folders_names(two_levels, tiny_bundle, dataset):
    evaluation, _ = evaluate_bundles([two_levels, tiny_bundle], dataset.folder, methods=[], pairs=2, yaws=1)
    first, second = two_levels.folder.name, tiny_bundle.folder.name
    assert [result.name for result in evaluation.results] == [f"{first} standard", f"{first} short", second, "floor"]
    assert (evaluation.pairs, evaluation.held_out, evaluation.yaws) == (2, 4, 1)
    assert evaluation.of(f"{first} standard").summaries == evaluation.of(second).summaries


def test_another_scene_is_refused(dataset, tiny_bundle):
    scene = dataset.scene.model_copy(update={"geometry": dataset.scene.geometry.model_copy(update={"height_m": 2.6})})
    with pytest.raises(DatasetError, match="not of the scene"):
        require_same_scene(tiny_bundle, dataclasses.replace(dataset, place=scene))


def test_errors_of_every_level_are_recorded_and_the_bundle_still_loads(evaluation, two_levels, tmp_path):
    for path in two_levels.folder.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    record_accuracy(Bundle.load(Path(tmp_path)), evaluation)
    levels = Bundle.load(tmp_path).manifest.levels
    assert [level.name for level in levels] == ["standard", "short"]
    for level in levels:
        assert (level.accuracy.pairs, level.accuracy.yaws) == (evaluation.pairs, evaluation.yaws)
        for name, summary in evaluation.of(level.name).summaries.items():
            assert level.accuracy.errors.get(name) == summary.mean
            assert level.accuracy.floor.get(name) == evaluation.floor.summaries[name].mean


def test_what_the_frontier_found_of_steps_stays(evaluation, two_levels, tmp_path):
    standard, short = two_levels.manifest.levels
    found = Accuracy(pairs=7, yaws=2, errors={"t60": 9.0}, floor={"t60": 1.0}, steps={"level": 0.5})
    levels = (
        standard.model_copy(update={"accuracy": found}),
        short.model_copy(update={"accuracy": found, "reuse": Reuse(spacing_m=1, turn_deg=30)}),
    )
    files = {name: (two_levels.folder / name).read_bytes() for name in two_levels.manifest.files}
    bundle = write_bundle(tmp_path, two_levels.manifest.model_copy(update={"levels": levels}), files)
    for level in record_accuracy(bundle, evaluation).manifest.levels:
        assert (level.accuracy.pairs, level.accuracy.steps) == (evaluation.pairs, {"level": 0.5})
        assert level.accuracy.errors["t60"] == evaluation.of(level.name).summaries["t60"].mean


class TestMeasured:
    RATE = 16_000

    def measurements(self, channels=1, yaws=(0.0,), missing=()):
        random = np.random.default_rng(0)
        for emitter in range(2):
            for listener in range(6):
                for yaw in yaws:
                    if (emitter, listener, yaw) in missing:
                        continue
                    time_s = np.arange(4_000) / self.RATE
                    response = random.standard_normal((channels, 4_000)) * 10 ** (-3 * time_s / 0.2)
                    yield Measurement(
                        (float(listener), 1.0, 1.5),
                        (3.0, 4.0 + emitter, 1.5),
                        response.astype(np.float32),
                        self.RATE,
                        yaw,
                    )

    def write(self, folder, **options):
        return ImportedDataset.write(
            folder, self.measurements(**options), ImportReport(), layout="test", source="test", held_out_share=0.3
        )

    def test_methods_are_compared_on_what_was_measured(self, tmp_path):
        dataset = self.write(tmp_path)
        evaluation, published = evaluate_bundles([], tmp_path, methods=["nearest", "linear"])
        assert evaluation.pairs == dataset.held_out.sum()
        assert evaluation.floor is None
        assert evaluation.channels == 1
        assert "MeshRIR" in published.data
        for method in ("nearest", "linear"):
            assert evaluation.of(method).summaries["t60"].missing == 0
            assert evaluation.of(method).summaries["itd"].count == 0

    def test_responses_go_with_their_poses(self, tmp_path):
        dataset = self.write(tmp_path, channels=2, yaws=(0.0, np.pi))
        with open_held_out(tmp_path) as held_out:
            assert len(held_out.yaws) == 2
            for index in range(len(held_out)):
                for turn, yaw in enumerate(held_out.yaws):
                    row = np.flatnonzero(
                        (dataset.listener == held_out.listeners[index]).all(axis=1)
                        & (dataset.emitter == held_out.emitters[index]).all(axis=1)
                        & np.isclose(dataset.yaw, yaw)
                    )
                    np.testing.assert_array_equal(held_out.reference(index)[[turn]], dataset.read(row))

    def test_a_pair_without_an_orientation_is_left_out_and_counted(self, tmp_path):
        self.write(tmp_path, channels=2, yaws=(0.0, np.pi), missing=((0, 2, np.pi), (1, 4, 0.0)))
        with open_held_out(tmp_path) as held_out:
            assert held_out.left_out == 2
            assert len(held_out.pairs.training) == 10


@pytest.mark.parametrize(
    ("number", "axis", "towards"),
    [
        (0, (1, 0, 0), (0.8, 0, 0.6)),
        (1, (1, 0, 0), (0.8, 0, -0.6)),
        (2, (0, 1, 0), (0, 0.8, -0.6)),
        (3, (0, 1, 0), (0, 0.8, 0.6)),
    ],
    ids=["up", "down", "to the left", "to the right"],
)
def test_heads_are_tilted_up_down_left_and_right(number, axis, towards):
    """Where the head's nose or its left ear points, in the axes of the untilted head."""
    yaws = np.array([0.3, 1.0, -2.0, 3.0])
    orientation = tilted(yaws, np.arcsin(0.6))[number]
    level = axes_of(Quaternion.from_yaw(yaws[number]))
    np.testing.assert_allclose(level @ axes_of(orientation).T @ axis, towards, atol=1e-12)


def test_an_evaluation_is_heard_with_the_head_tilted_or_through_another(tiny_bundle, dataset):
    found = {
        name: evaluate_bundles([tiny_bundle], dataset.folder, methods=["nearest"], pairs=2, yaws=2, **options)[0]
        for name, options in {"tilted": {"tilt_deg": 30.0}, "other": {"hrtf": KEMAR}}.items()
    }
    assert "tilted by 30 degrees" in found["tilted"].data
    assert f"through {KEMAR.stem}" in found["other"].data
    for evaluation in found.values():
        errors = {result.name: result.summaries["level"].mean for result in evaluation.results}
        assert all(np.isfinite(error) for error in errors.values()), errors
        assert errors["floor"] < errors["nearest"]


@pytest.mark.parametrize("options", [{"methods": ["image-sources"]}, {"draws": 2}])
def test_what_knows_the_data_s_own_head_alone_is_not_tilted(tiny_bundle, dataset, options):
    with pytest.raises(EvaluationError, match="own head"):
        evaluate_bundles([tiny_bundle], dataset.folder, tilt_deg=30.0, **options)


def test_measured_responses_are_not_heard_through_another_head(tmp_path):
    TestMeasured().write(tmp_path)
    with open_held_out(tmp_path) as opened, pytest.raises(EvaluationError, match="a measurement knows one head"):
        opened.reheard(None, tilt_deg=30.0)


def test_evaluated_heads_are_tilted_in_turn_however_many_there_are(dataset):
    with open_held_out(dataset.folder) as everything:
        held_out = everything.sample(pairs=1, yaws=2, seed=0).reheard(None, tilt_deg=30.0)
        expected = tilted(everything.yaws[held_out.yaw_indices], np.radians(30.0))
        np.testing.assert_array_equal(held_out.yaws[held_out.yaw_indices], expected)


def test_halves_are_those_by_which_levels_are_chosen_and_reported(dataset, make_held_out):
    with open_held_out(dataset.folder) as everything:
        choice, report = (everything.of_half(half) for half in ("choice", "report"))
        assert sorted([*choice.held_out, *report.held_out]) == everything.held_out.tolist()
        for half, name in ((choice, "choice"), (report, "report")):
            ends = [divmod(int(pair), len(dataset.probes)) for pair in half.held_out]
            assert ends == [tuple(pair) for pair in dataset.held_out_half(name).tolist()]
            kept = np.isin(everything.held_out, half.held_out)
            np.testing.assert_array_equal(half.visible, everything.visible[kept])
    with pytest.raises(EvaluationError, match="no levels are chosen by measured responses"):
        make_held_out(lambda _: np.zeros((1, 2, 4_000))).of_half("report")
