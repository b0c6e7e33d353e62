import dataclasses

import numpy as np
import pytest
import torch
from rich.progress import Progress

from training.data.importers.report import ImportReport
from training.data.responses import ImportedDataset, Measurement
from training.learning.distillation import distillation_targets
from training.learning.factorised import FactorisedLearner
from training.learning.pairs import split
from training.learning.runs import Configuration, FactorisedRecipe, NafRecipe, RecipeError, configure
from training.learning.train import load_learner, train
from training.models.encoders import FieldShape
from training.models.factorised import ExportedField
from training.models.naf import NafShape
from training.models.targets import LEAD_SAMPLES, align, delay_samples, flat_targets
from training.simulation.responses import SimulatedResponses

SILENT = Progress(disable=True)
RATE, SAMPLES = 16_000, 2_000


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """A click that travels and loses level with distance, and noise that dies away alike everywhere: one microphone,
    and emitters at several heights."""
    rng = np.random.default_rng(0)

    def responses():
        for emitter in rng.uniform((0, 0, 0.5), (3, 3, 2), (6, 3)):
            for listener in rng.uniform((0, 0, 1), (3, 3, 1), (12, 3)):
                distance = float(np.linalg.norm(emitter - listener)) + 0.1
                response = 0.02 * rng.standard_normal((1, SAMPLES)) * np.exp(-np.arange(SAMPLES) / 300)
                click = align(np.eye(1, SAMPLES), -(distance - 0.1) / 343 * RATE)
                yield Measurement(
                    tuple(listener), tuple(emitter), (response + click / distance).astype(np.float32), RATE
                )

    return ImportedDataset.write(
        tmp_path_factory.mktemp("measured") / "data", responses(), ImportReport(), layout="made up", source="here"
    )


@pytest.fixture(scope="module")
def mono_run(measured, tmp_path_factory):
    folder = tmp_path_factory.mktemp("mono") / "run"
    shape = FieldShape(rank=16, width=32, depth=2, grid_spacing_m=1.0, grid_features=4)
    recipe = FactorisedRecipe(swap=True)
    train(measured, folder, Configuration(epochs=40, batch=8, shape=shape, recipe=recipe), SILENT)
    return folder


def test_what_a_microphone_heard_is_learned(measured, mono_run):
    """On pairs it never saw: the click's level by distance, and its phase."""
    learner = load_learner(measured, mono_run)
    rows = np.flatnonzero(measured.held_out)
    field = ExportedField(learner.field, learner.cells).eval()
    paths = learner.site.paths(measured.listener[rows], measured.emitter[rows])
    given = (measured.listener[rows], measured.emitter[rows], measured.yaw[rows], paths)
    poses = (torch.from_numpy(part.astype(np.float32)) for part in given)
    with torch.no_grad():
        log_magnitude, frequency, certainty = (output.numpy() for output in field.forward_all_frames(*poses))
    codec = learner.cells.codec
    assert log_magnitude.shape == (len(rows), 1, codec.bins, codec.frames)
    # Two frames whose windows have the click near their middle.
    frames = np.argsort(np.abs(codec.frame_times_s * RATE - LEAD_SAMPLES))[:2]
    distance = np.linalg.norm(measured.emitter[rows] - measured.listener[rows], axis=1) + 0.1
    found = log_magnitude[:, 0, 20:100][..., frames].mean(axis=(1, 2))
    assert np.corrcoef(found, -np.log(distance))[0, 1] > 0.9
    assert certainty[..., frames].mean() > 0.8
    assert frequency.shape[-1] == learner.cells.known_frames > 1


def test_a_microphone_has_no_interaural_head(measured, mono_run):
    assert set(load_learner(measured, mono_run).field.heads.shapes) == {"fine", "late", "phasor"}


def test_the_papers_network_hears_through_a_microphone_too(measured, tmp_path):
    configuration = Configuration.naf(NafShape(width=16, grid_features=4), NafRecipe(points=60), epochs=2, batch=8)
    train(measured, tmp_path, configuration, SILENT)
    field = load_learner(measured, tmp_path).field
    # Listeners are all at one height, emitters are not.
    assert field._moving == ((0, 1), (0, 1, 2))
    assert field.ears.shape[1] == 1


def test_swapping_shows_every_response_with_its_ends_exchanged_half_of_the_time(measured, mono_run):
    learner = FactorisedLearner(measured, Configuration.read(mono_run))
    learner.prepare(SILENT)
    rows = np.arange(len(learner.targets.yaw))
    (listener, emitter, *_), (flat, _) = learner.batch(rows, np.random.default_rng(0))
    swapped = np.array([not np.allclose(a, b) for a, b in zip(listener, learner.targets.listener[rows], strict=True)])
    assert 0.3 < swapped.mean() < 0.7
    np.testing.assert_allclose(emitter[swapped], learner.targets.listener[rows][swapped])
    np.testing.assert_array_equal(flat, learner.targets.flat[rows])


def test_without_level_correction_the_field_stays_as_regressed(dataset, configuration, tmp_path):
    recipe = FactorisedRecipe(level_correction=False)
    train(SimulatedResponses(dataset), tmp_path, dataclasses.replace(configuration, epochs=1, recipe=recipe), SILENT)
    assert not load_learner(SimulatedResponses(dataset), tmp_path).field.level_correction.any()


@pytest.fixture(scope="module")
def teacher(dataset, tmp_path_factory):
    folder = tmp_path_factory.mktemp("teacher") / "run"
    shape = NafShape(width=16, grid_features=4)
    configuration = Configuration.naf(shape, NafRecipe(points=60), epochs=1, batch=4)
    train(SimulatedResponses(dataset), folder, configuration, SILENT)
    return folder


def test_distillation_targets_are_what_the_teacher_predicts_inside_the_room(dataset, configuration, teacher):
    responses = SimulatedResponses(dataset)
    naf = load_learner(responses, teacher)
    learner = FactorisedLearner(responses, configuration)
    targets = distillation_targets(naf, learner.cells, 12, seed=0)
    assert all(dataset.plan.contains(point) for point in (*targets.listener, *targets.emitter))
    seen = {tuple(np.round(end, 3)) for end in responses.listener.astype(np.float32)}
    assert not all(tuple(np.round(end, 3)) in seen for end in targets.listener)
    # An untrained network says the mean of the training set everywhere, more or less: so do its targets.
    learner.prepare(SILENT)
    part = learner.field.heads.slices["late"]
    drawn = learner.targets.flat[:, part].astype(float).mean()
    assert abs(targets.flat[:, part].astype(float).mean() - drawn) < 0.7


def test_distillation_targets_count_for_levels_only(dataset, configuration, teacher):
    responses = SimulatedResponses(dataset)
    recipe = FactorisedRecipe(teacher=str(teacher), distilled_poses=6)
    learner = FactorisedLearner(responses, dataclasses.replace(configuration, recipe=recipe))
    learner.prepare(SILENT)
    rows, _ = split(responses, share=1.0, seed=0)
    order = learner.epoch(rows, np.random.default_rng(0))
    assert len(order) == len(rows) + 6
    count = len(learner.targets.yaw)
    inputs, targets = learner.batch(np.array([count + 1, 3, count]), None)
    assert targets[1].tolist() == [True, False, False]
    wrong = (targets[0].float() + 1 - learner.field.mean) / learner.field.spread
    parts = learner.losses(wrong, targets)
    for name, share in (("fine", 1), ("late", 1), ("phasor", 2 / 3), ("interaural", 10 / 3)):
        assert parts[name] == pytest.approx(share, rel=1e-3), name
    assert learner.field(*inputs).shape == targets[0].shape


def test_only_a_spectrogram_of_the_paper_teaches(dataset, run, configuration, tmp_path):
    """And none of what geometry adds, the direct sound."""
    for field in ("naf-time-domain", "naf-whole"):
        (tmp_path / field).mkdir()
        configure(field).write(tmp_path / field)
    for teacher in (run, tmp_path / "naf-time-domain", tmp_path / "naf-whole"):
        taught = dataclasses.replace(configuration, recipe=FactorisedRecipe(teacher=str(teacher)))
        with pytest.raises(RecipeError, match=f"teacher: {teacher} holds"):
            train(SimulatedResponses(dataset), tmp_path / "taught" / teacher.name, taught, SILENT)


def test_measured_responses_are_whole_as_they_are(measured, tmp_path):
    with pytest.raises(RecipeError, match="train naf in place of naf-whole"):
        train(measured, tmp_path, configure("naf-whole"), SILENT)


def test_measured_responses_are_learned_as_they_are(measured, mono_run):
    """Whatever the recipe says: nothing is known of them but themselves."""
    configuration = Configuration.read(mono_run)
    assert isinstance(configuration.recipe, FactorisedRecipe)
    assert configuration.recipe.expected
    learner = FactorisedLearner(measured, configuration)
    learner.prepare(SILENT)
    (row, *_) = np.flatnonzero(~measured.held_out)
    aligned = align(measured.read([row]), delay_samples(measured, row))
    np.testing.assert_array_equal(learner.targets.flat[0], flat_targets(aligned, learner.cells)[0])
