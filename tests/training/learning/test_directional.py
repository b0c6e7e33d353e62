import dataclasses

import numpy as np
import pytest
import torch
from rich.progress import Progress

from training.data.importers.report import ImportReport
from training.data.responses import ImportedDataset, Measurement
from training.learning.directional import DirectionalLearner
from training.learning.pairs import split
from training.learning.runs import CHECKPOINT, Configuration, DirectionalRecipe, RecipeError, RunError, configure
from training.learning.train import load_learner, train
from training.models.directional import ExportedDirections
from training.simulation.responses import SimulatedResponses

SILENT = Progress(disable=True)


@pytest.fixture(scope="module")
def directional(configuration):
    return Configuration.directional(configuration.shape, epochs=60, batch=8)


@pytest.fixture(scope="module")
def learned(dataset, directional, tmp_path_factory):
    folder = tmp_path_factory.mktemp("directional") / "run"
    train(SimulatedResponses(dataset), folder, directional, SILENT)
    return folder


def test_an_epoch_visits_each_pair_once(dataset, directional):
    responses = SimulatedResponses(dataset)
    learner = DirectionalLearner(responses, directional)
    rows, validation = split(responses, share=1.0, seed=0)
    order = learner.epoch(rows, np.random.default_rng(0))
    pairs = responses.pair[~responses.held_out]
    assert sorted(pairs[order]) == sorted(set(pairs[rows]))
    assert set(order) <= set(rows)
    assert sorted(pairs[learner.validation(validation)]) == sorted(set(pairs[validation]))
    assert not np.array_equal(order, learner.epoch(rows, np.random.default_rng(1)))


def test_rows_have_the_places_and_target_of_their_pair(dataset, directional):
    responses = SimulatedResponses(dataset)
    learner = DirectionalLearner(responses, directional)
    learner.prepare(SILENT)
    rows = np.flatnonzero(~responses.held_out)
    chosen = np.array([7, 2, len(rows) - 1])
    (listener, emitter, path), (flat, _) = learner.batch(chosen, None)
    np.testing.assert_allclose(listener, responses.listener[rows[chosen]], atol=1e-5)
    np.testing.assert_allclose(emitter, responses.emitter[rows[chosen]], atol=1e-5)
    np.testing.assert_array_equal(path, learner.site.paths(listener.numpy(), emitter.numpy()))
    assert flat.shape == (3, learner.field.heads.size)
    per_pair = len(dataset.yaws)
    shares = learner.field.heads.slices["directions"]
    stored = learner.targets.flat[chosen // per_pair]
    np.testing.assert_array_equal(flat[:, shares], stored[:, shares])


def test_levels_are_those_of_both_ways_between_two_places(dataset, directional):
    """Only where both are trained on; else those of the pair."""
    responses = SimulatedResponses(dataset)
    rows, validation = split(responses, share=1.0, seed=0)
    learners = []
    for reciprocal in (True, False):
        recipe = DirectionalRecipe(reciprocal=reciprocal)
        learner = DirectionalLearner(responses, dataclasses.replace(directional, recipe=recipe))
        learner.prepare(SILENT)
        learners.append(learner)
    both, alone = learners
    trainable = np.flatnonzero(~responses.held_out)
    by_ends = {responses.ends(trainable[row]): row for row in rows}
    levels = both.field.heads.levels
    for row in rows[:: 7 * len(dataset.yaws)]:
        emitter, listener = responses.ends(trainable[row])
        _, (flat, _) = alone.batch(np.array([row, by_ends[listener, emitter]]), None)
        _, (mean, _) = both.batch(np.array([row]), None)
        power = torch.exp(2 * flat[:, levels]).mean(dim=0)
        torch.testing.assert_close(torch.exp(2 * mean[0, levels]), power, rtol=1e-4, atol=1e-9)
    (ours, _), (stored, _) = (each.batch(validation, None)[1] for each in learners)
    torch.testing.assert_close(ours, stored, rtol=0, atol=1e-6)


def test_without_doors_pairs_are_learned_as_they_are(dataset, directional):
    """Also those whose reverse is not used, as with a share of the pairs."""
    responses = SimulatedResponses(dataset)
    recipe = dataclasses.replace(directional.recipe, noise_m=0.0)
    learner = DirectionalLearner(responses, dataclasses.replace(directional, recipe=recipe, share=0.5))
    learner.prepare(SILENT)
    rows, _ = split(responses, share=0.5, seed=0)
    (listener, emitter, _), (_, knows_directions) = learner.batch(rows, np.random.default_rng(0))
    trained = np.flatnonzero(~responses.held_out)[rows]
    np.testing.assert_allclose(listener, responses.listener[trained], atol=1e-5)
    np.testing.assert_allclose(emitter, responses.emitter[trained], atol=1e-5)
    assert knows_directions.all()


def trained_pairs(dataset, learned):
    """The learner of a finished run, and the poses and flat targets of the pairs that it trained on."""
    learner = load_learner(SimulatedResponses(dataset), learned)
    learner.prepare(SILENT)
    rows, _ = split(learner.responses, share=1.0, seed=0)
    poses, (flat, _) = learner.batch(learner.validation(rows), None)
    return learner, poses, flat


@torch.no_grad()
def powers_of_pairs(dataset, learned):
    """(pair, band, cell) powers of the pairs that a run trained on: true ones, and those of the exported graph as they
    are decoded. And the widths (cell,) of cells in frames."""
    learner, poses, flat = trained_pairs(dataset, learned)
    true = torch.exp(2 * flat[:, learner.field.heads.levels].reshape(-1, *learner.field.heads.shapes["log_magnitude"]))
    log_magnitude, _ = ExportedDirections(learner.field, learner.cells)(*poses)
    frames = learner.cells.all_frames
    found = torch.exp(2 * log_magnitude @ torch.tensor(frames.spread())) @ torch.tensor(frames.pool())
    return true, found, torch.tensor(frames.widths).float()


def test_what_it_learns_is_nearer_than_the_mean(dataset, learned):
    """Of pairs that it trained on: levels of bands, and directions."""
    learner, poses, flat = trained_pairs(dataset, learned)
    field = learner.field
    with torch.no_grad():
        found = field.in_physical_units(field(*poses))
        for name, most in (("log_magnitude", 0.2), ("directions", 0.7)):
            part = field.heads.slices[name]
            spread = (flat[:, part] - flat[:, part].mean(dim=0)).square().mean()
            assert (found[:, part] - flat[:, part]).square().mean() < most * spread


def test_power_is_that_of_the_training_pairs_on_average(dataset, learned):
    """By the level correction, in cells of several frames too, as they are decoded."""
    true, found, widths = powers_of_pairs(dataset, learned)
    whole = (true @ widths).sum(dim=1)[:, None, None]
    loud = (true / whole).mean(dim=0) > 1e-6
    error = 10 * torch.log10((found / whole).mean(dim=0) / (true / whole).mean(dim=0))[loud]
    assert error.abs().max() < 0.5


def test_bands_have_the_levels_of_the_training_pairs_on_average(dataset, learned):
    """In decibels, and not in power: it is what one hears."""
    true, found, widths = powers_of_pairs(dataset, learned)
    assert (10 * torch.log10((found @ widths) / (true @ widths))).mean(dim=0).abs().max() < 0.01


def test_pairs_that_nobody_can_predict_count_little_in_training_and_like_others_in_validation(dataset, directional):
    """The gradient is that of the mean logarithm of the pairs' errors."""
    learner = DirectionalLearner(SimulatedResponses(dataset), directional)
    learner.prepare(SILENT)
    learner.initialise(np.arange(8 * len(dataset.yaws)), 0)
    rows = len(dataset.yaws) * np.arange(8)
    inputs, (flat, known) = learner.batch(rows, None)
    flat = flat + torch.linspace(0, 3, 8)[:, None] * torch.randn(flat.shape, generator=torch.Generator().manual_seed(0))

    def of_pairs(prediction):
        learner.field.eval()
        each = [
            learner.losses(prediction[at : at + 1], (flat[at : at + 1], known[at : at + 1])) for at in range(len(rows))
        ]
        return torch.stack([torch.stack(list(losses.values())).sum() for losses in each])

    def gradient(loss):
        (found,) = torch.autograd.grad(loss(prediction := learner.field(*inputs)), prediction)
        return found / found.norm()

    def whole(prediction, *, training):
        learner.field.train(training)
        return torch.stack(list(learner.losses(prediction, (flat, known)).values())).sum()

    expected = gradient(lambda prediction: torch.log(of_pairs(prediction) + 0.05).mean())
    torch.testing.assert_close(gradient(lambda prediction: whole(prediction, training=True)), expected)
    plain = gradient(lambda prediction: of_pairs(prediction).mean())
    torch.testing.assert_close(gradient(lambda prediction: whole(prediction, training=False)), plain)
    assert (plain - expected).norm() > 0.3


def test_an_interrupted_run_goes_on_to_the_same_field(dataset, directional, tmp_path, monkeypatch):
    responses = SimulatedResponses(dataset)
    short = dataclasses.replace(directional, epochs=3, recipe=DirectionalRecipe(order=1, noise_m=0.1))
    train(responses, tmp_path / "whole", short, SILENT)
    losses = DirectionalLearner.losses

    def interrupted(self, *args):
        if (tmp_path / "broken" / CHECKPOINT).exists():  # after the first epoch
            raise KeyboardInterrupt
        return losses(self, *args)

    with monkeypatch.context() as patch:
        patch.setattr(DirectionalLearner, "losses", interrupted)
        with pytest.raises(KeyboardInterrupt):
            train(responses, tmp_path / "broken", short, SILENT)
    with pytest.raises(RunError, match="epochs are trained"):
        load_learner(responses, tmp_path / "broken")
    train(responses, tmp_path / "broken", short, SILENT)
    whole, again = (load_learner(responses, tmp_path / name).field.state_dict() for name in ("whole", "broken"))
    for name, values in whole.items():
        torch.testing.assert_close(again[name], values, rtol=0, atol=0)


def test_the_recipe_is_kept_with_the_run(learned, directional):
    assert Configuration.read(learned) == directional
    assert Configuration.read(learned).name == Configuration.read(learned).kind == "directional"


def test_measured_responses_are_refused(tmp_path):
    ends = [((x, 1.0, 1.0), (y, 3.0, 1.0)) for x in (1.0, 2.0, 3.0) for y in (1.0, 2.0)]
    noise = np.random.default_rng(0).standard_normal((1, 2000)).astype(np.float32)
    one = (Measurement(listener, emitter, noise, 16_000) for listener, emitter in ends)
    measured = ImportedDataset.write(tmp_path / "data", one, ImportReport(), layout="made up", source="here")
    with pytest.raises(RecipeError, match="train factorised in place of directional"):
        train(measured, tmp_path / "run", configure("directional"), SILENT)


def test_an_order_that_there_is_none_of_is_refused(dataset, directional, tmp_path):
    beyond = dataclasses.replace(directional, recipe=DirectionalRecipe(order=4))
    with pytest.raises(RecipeError, match="order: is 4, must be 0 to 3"):
        train(SimulatedResponses(dataset), tmp_path, beyond, SILENT)
    with pytest.raises(RunError, match="only a directional field"):
        configure("factorised", order=1)
    assert configure("directional", order=0, rank=32).recipe == DirectionalRecipe(order=0)
