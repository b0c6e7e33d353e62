import dataclasses
from pathlib import Path

import h5py
import numpy as np
import pytest
from PIL import Image

from server.acoustics.metrics import SPECTRAL_LOSS, spectral_loss
from server.field.field import AcousticField
from server.scene.bundle import Bundle
from server.whole_field import WholeField
from training.dataset import DatasetError
from training.evaluation.held_out import HeldOut, evaluate_bundle, record_accuracy
from training.simulation.references import References


@pytest.fixture(scope="module")
def file(dataset):
    with h5py.File(dataset.folder / "pairs.h5", "r") as opened:
        yield opened


@pytest.fixture
def references(dataset, file):
    return References(dataset, file)


@pytest.fixture
def held_out(dataset, tiny_bundle, file):
    return HeldOut(dataset, WholeField.through_kemar(AcousticField.load(tiny_bundle)), file)


@pytest.fixture(scope="module")
def figure(tmp_path_factory):
    return tmp_path_factory.mktemp("figure") / "errors.png"


@pytest.fixture(scope="module")
def evaluation(dataset, tiny_bundle, figure):
    return evaluate_bundle(tiny_bundle, dataset, figure=figure)


def test_references_are_the_held_out_pairs(held_out, dataset, references):
    pairs = dataset.pairs(held_out=True)
    assert len(held_out.flat) == len(pairs)
    emitters, listeners = held_out.ends
    for index, (emitter, listener) in enumerate(pairs):
        np.testing.assert_array_equal(emitters[index], dataset.probes[emitter])
        np.testing.assert_array_equal(listeners[index], dataset.probes[listener])
        np.testing.assert_array_equal(held_out.reference(index), references[emitter * len(dataset.probes) + listener])
        assert not np.array_equal(held_out.repeat(index), held_out.reference(index))


def test_the_nearest_answer_is_one_that_was_trained_on(held_out, dataset, references):
    pairs = dataset.pairs(held_out=False)
    known = [references[emitter * len(dataset.probes) + listener] for emitter, listener in pairs]
    for index in range(len(held_out.flat)):
        answer = np.asarray(held_out.nearest(index))
        assert any(np.array_equal(answer, response) for response in known)


def test_every_method_answers_all_orientations(held_out, dataset):
    shape = (len(dataset.yaws), 2, dataset.samples)
    for method in (held_out.predicted, held_out.nearest, held_out.linear, held_out.linear_aligned):
        answer = np.asarray(method(0))
        assert answer.shape == shape
        assert np.isfinite(answer).all()


def test_the_floor_compares_two_takes_of_the_simulation(evaluation, held_out, tiny_bundle):
    codec = tiny_bundle.manifest.codec.codec
    pairs = range(len(held_out.flat))
    takes = (np.stack([take(pair) for pair in pairs]) for take in (held_out.reference, held_out.repeat))
    expected = np.mean(spectral_loss(*(codec.log_magnitude(codec.transform(take)) for take in takes)))
    loss = next(row for row in evaluation.rows if row.name == SPECTRAL_LOSS.name)
    assert loss.columns["floor"].mean == pytest.approx(expected, rel=1e-4)


def test_a_scene_without_hidden_pairs_has_a_figure(evaluation, figure):
    assert evaluation.visible_pairs == evaluation.pairs
    with Image.open(figure) as image:
        assert min(image.size) > 200


def test_another_scene_is_refused(dataset, tiny_bundle):
    scene = dataset.scene.model_copy(update={"geometry": dataset.scene.geometry.model_copy(update={"height_m": 2.6})})
    with pytest.raises(DatasetError, match="not of the scene"):
        evaluate_bundle(tiny_bundle, dataclasses.replace(dataset, scene=scene))


def test_recorded_errors_are_in_the_manifest_and_the_bundle_still_loads(evaluation, tiny_bundle, tmp_path):
    for path in tiny_bundle.folder.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    record_accuracy(Bundle.load(Path(tmp_path)), evaluation)
    accuracy = Bundle.load(tmp_path).manifest.levels[0].accuracy
    assert (accuracy.pairs, accuracy.yaws) == (evaluation.pairs, evaluation.yaws)
    for row in evaluation.rows:
        assert accuracy.errors.get(row.name) == row.columns["field"].mean
        assert accuracy.floor.get(row.name) == row.columns["floor"].mean
