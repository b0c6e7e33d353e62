"""Bundles of measured responses: what is served is what was measured, shaped."""

import dataclasses

import numpy as np
import pytest
from rich.progress import Progress
from typer.testing import CliRunner

from server.field.fields_by_level import FieldsByLevel
from server.responses.full_response import FullResponse
from server.scene.bundle import Bundle
from tests.training.measured_room import RATE, SAMPLES, Room
from training.baselines.held_out import open_held_out
from training.baselines.shaped import ShapedNearest
from training.bundling.export import SHAPED_NEAREST, ExportError, export
from training.cli.main import app
from training.data.dataset import Dataset, DatasetError
from training.data.responses import ImportedDataset
from training.evaluation.run import evaluate_bundles
from training.learning.train import train


def band_energy(signal):
    """Below 0.4 of the rate, where moving by fractions of samples is exact."""
    spectrum = np.abs(np.fft.rfft(signal)) ** 2
    return spectrum[: round(0.8 * len(spectrum))].sum()


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> ImportedDataset:
    return Room().write(tmp_path_factory.mktemp("measured") / "room")


@pytest.fixture(scope="module")
def trained(dataset, configuration, tmp_path_factory):
    run = tmp_path_factory.mktemp("measured") / "run"
    train(dataset, run, dataclasses.replace(configuration, epochs=40, batch=8), Progress(disable=True))
    return run


@pytest.fixture(scope="module")
def bundle(dataset, trained, tmp_path_factory):
    """As the command line makes it of the folder itself and a run on it."""
    folder = tmp_path_factory.mktemp("measured") / "bundle"
    done = CliRunner().invoke(app, ["export", str(dataset.folder), str(trained), "-o", str(folder)])
    assert done.exit_code == 0, done.output
    return Bundle.load(folder)


def test_the_manifest_says_what_can_be_known(bundle, dataset):
    manifest = bundle.manifest
    assert (manifest.id, manifest.name) == ("a-small-room", "A small room")
    assert manifest.geometry is None
    assert (manifest.channels, manifest.direct_sound) == (("mono",), "field")
    for positions in (dataset.listener, dataset.emitter):
        assert (positions >= manifest.bounds.minimum).all()
        assert (positions <= manifest.bounds.maximum).all()
    assert [field.architecture for field in manifest.fields.values()] == [SHAPED_NEAREST, "factorised"]


def test_the_server_answers_with_what_the_method_says(bundle, dataset):
    field = FullResponse.through_kemar(FieldsByLevel.load(bundle).default)
    with open_held_out(dataset.folder) as held_out:
        method = ShapedNearest(held_out.pairs, held_out.delays_s, RATE)
        errors = []
        for pair, listener, emitter in zip(held_out.held_out, held_out.listeners, held_out.emitters, strict=True):
            expected = method.response(int(pair))[0]
            found = field.impulse_responses([listener], [emitter], [0.0])[0]
            assert found.shape == (1, SAMPLES)
            arrival = round(held_out.delays_s[pair] * RATE)
            heard = np.s_[0, arrival - 8 : -64]
            errors.append(band_energy((found - expected)[heard]) / band_energy(expected[heard]))
    # Of two measured places that are equally near either may be taken.
    assert np.median(errors) < 1e-3


def test_both_fields_are_measured_beside_the_baselines(bundle, dataset):
    evaluation, _ = evaluate_bundles([bundle], dataset.folder, methods=["nearest"])
    ours = evaluation.of("standard").summaries
    assert ours["level"].mean < evaluation.of("nearest").summaries["level"].mean
    learned = next(name for name in bundle.manifest.fields if name.startswith("factorised"))
    assert evaluation.of(learned).summaries["level"].count == len(np.unique(dataset.pair[dataset.held_out]))


def test_a_simulated_dataset_is_no_field(dataset, tmp_path):
    (tmp_path / "pairs.h5").touch()
    with pytest.raises(ExportError, match="train a field on it"):
        export(dataset, [tmp_path], tmp_path / "bundle")


def test_responses_of_another_folder_are_refused(dataset, tmp_path):
    other = Room(tail=0.0).write(tmp_path / "other")
    with pytest.raises(ExportError, match="other responses"):
        export(dataset, [other.folder], tmp_path / "bundle")


def test_what_takes_a_simulated_scene_says_so(dataset):
    with pytest.raises(DatasetError, match="holds measured responses"):
        Dataset.open(dataset.folder)
