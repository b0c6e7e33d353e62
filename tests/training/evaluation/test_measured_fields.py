import dataclasses

import numpy as np
import pytest
from rich.progress import Progress

from server.acoustics.codec import Codec
from server.acoustics.phase import FrozenNoise
from training.baselines.held_out import EvaluationError
from training.data.importers.report import ImportReport
from training.data.responses import ImportedDataset, Measurement
from training.evaluation.measured_fields import decoded, undo_alignment
from training.evaluation.published import SOUNDSPACES
from training.evaluation.report import markdown
from training.evaluation.run import evaluate_bundles
from training.learning.runs import Configuration, NafRecipe, configure, record_of
from training.learning.train import train
from training.models.frozen_noise import even_noise
from training.models.naf import NafShape
from training.models.targets import LEAD_SAMPLES, align

RATE = 16_000
SAMPLES = 4_000


@pytest.fixture(scope="module")
def codec():
    return Codec(RATE, 256, 64, SAMPLES, 1e-5)


@pytest.fixture(scope="module")
def noise(codec):
    return FrozenNoise.from_signal(codec, even_noise(codec, np.random.default_rng(99), iterations=5))


def decaying(channels, seed=0):
    time_s = np.arange(SAMPLES) / RATE
    return np.random.default_rng(seed).standard_normal((3, channels, SAMPLES)) * 10 ** (-3 * time_s / 0.15)


def answers(codec, responses, certainty):
    magnitude, frequency = (part.astype(np.float32) for part in codec.encode(responses))
    said = (magnitude, frequency, np.full_like(magnitude, certainty))
    if responses.shape[1] == 1:
        return said
    # The noise at the two ears is independent.
    return *said, np.zeros_like(magnitude)


@pytest.mark.parametrize("channels", [1, 2])
def test_what_is_known_for_certain_is_decoded_whole(codec, noise, channels):
    responses = decaying(channels)
    found = decoded(answers(codec, responses, 1.0), codec, noise)
    assert found.shape == responses.shape
    error = np.square(found - responses).sum() / np.square(responses).sum()
    assert error < 1e-3


@pytest.mark.parametrize("channels", [1, 2])
def test_phase_that_is_not_known_costs_no_energy(codec, noise, channels):
    responses = decaying(channels)
    found = decoded(answers(codec, responses, 0.0), codec, noise)
    assert np.corrcoef(found.ravel(), responses.ravel())[0, 1] < 0.2
    ratio = np.square(found).sum(axis=(0, 2)) / np.square(responses).sum(axis=(0, 2))
    np.testing.assert_allclose(10 * np.log10(ratio), 0, atol=2.0)


@pytest.mark.parametrize("channels", [1, 2])
def test_a_phase_that_is_predicted_is_heard_if_that_is_asked_for(codec, noise, channels):
    """However certain the field says that it is."""
    responses = decaying(channels)
    found = decoded(answers(codec, responses, 0.0), codec, noise, integrated=True)
    assert np.square(found - responses).sum() / np.square(responses).sum() < 1e-3


def test_a_response_in_the_time_domain_is_taken_as_it_is(codec, noise):
    responses = decaying(1).astype(np.float32)
    np.testing.assert_array_equal(decoded((responses,), codec, noise), responses)


@pytest.mark.parametrize("delay", [-40.3, 0.0, 217.6, 1500.25])
def test_moving_later_undoes_aligning(delay):
    """A pulse away from both ends, of a band that fractional delays can move."""
    at = np.arange(SAMPLES) - 1900.0
    pulse = (np.exp(-0.5 * (at / 12) ** 2) * np.cos(0.3 * at))[None, None]
    np.testing.assert_allclose(undo_alignment(align(pulse, delay).astype(np.float32), delay), pulse, atol=1e-5)


@pytest.fixture(scope="module")
def measured(tmp_path_factory) -> ImportedDataset:
    def rows():
        for listener in range(12):
            ends = (0.4 * listener, 1.0, 1.5), (2.0, 4.0, 1.5)
            onset = int(np.linalg.norm(np.subtract(*ends)) / 343.0 * RATE)
            response = np.zeros((1, SAMPLES), np.float32)
            response[0, onset:] = decaying(1, seed=listener)[0, 0, : SAMPLES - onset]
            yield Measurement(*ends, response, RATE)

    folder = tmp_path_factory.mktemp("measured") / "room"
    return ImportedDataset.write(folder, rows(), ImportReport(), layout="test", source="test", held_out_share=0.3)


def test_a_trained_field_is_measured_beside_the_baselines(measured, configuration, tmp_path):
    run = tmp_path / "field"
    train(measured, run, dataclasses.replace(configuration, epochs=50, batch=4), Progress(disable=True))
    evaluation, _ = evaluate_bundles([], measured.folder, runs=[run], methods=["nearest"])
    field = evaluation.of("field")
    assert field.kind == "field"
    assert field.storage_bytes > 1_000
    # The decays are all alike: a field that has learned anything has their level, and their sound arrives in time.
    assert field.summaries["level"].mean < 2.0
    assert field.summaries["onset"].mean < 0.5 + 1e3 * LEAD_SAMPLES / RATE


def test_the_papers_network_has_a_row_with_noise_and_one_with_its_own_phase(measured, tmp_path):
    configuration = Configuration.naf(NafShape(width=8, grid_features=4), NafRecipe(points=20), epochs=1, batch=4)
    train(measured, tmp_path / "naf", configuration, Progress(disable=True))
    evaluation, published = evaluate_bundles([], measured.folder, runs=[tmp_path / "naf"], methods=[])
    assert [result.name for result in evaluation.results] == ["naf", "naf-integrated"]
    assert {result.method for result in evaluation.results} == {"naf"}
    table = markdown(evaluation, published)
    assert f"naf: {record_of(tmp_path / 'naf').sentence()}." in table
    assert evaluation.to_json()["columns"]["naf"]["training"]["steps"] == record_of(tmp_path / "naf").steps


@pytest.mark.parametrize("field", ["naf-dual", "naf-no-grid", "naf-time-domain"])
def test_a_variant_of_a_network_does_not_stand_beside_the_figures_of_another(measured, tmp_path, field):
    usual = configure(field, epochs=1, batch=4, points=20)
    small = dataclasses.replace(usual, shape=dataclasses.replace(usual.shape, width=8, grid_features=4))
    train(measured, tmp_path / "run", small, Progress(disable=True))
    evaluation, published = evaluate_bundles([], measured.folder, runs=[tmp_path / "run"], methods=[])
    assert {result.method for result in evaluation.results} == {field}
    assert field not in published.errors
    assert field not in SOUNDSPACES.errors


def test_a_run_on_a_simulated_scene_is_to_be_exported(run, dataset):
    with pytest.raises(EvaluationError, match="export it"):
        evaluate_bundles([], dataset.folder, runs=[run], methods=[])
