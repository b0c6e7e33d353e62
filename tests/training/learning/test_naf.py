import numpy as np
import pytest
import torch
from rich.progress import Progress

from training.learning.naf import NafLearner
from training.learning.runs import Configuration, NafRecipe, RecipeError
from training.models.naf import NafShape
from training.models.stored_targets import load_expected_points
from training.models.targets import LEAD_SAMPLES, align
from training.simulation.responses import SimulatedResponses

SHAPE = NafShape(width=8, grid_features=4)


def learner(dataset, **changes):
    shape = changes.pop("shape", SHAPE)
    torch.manual_seed(0)
    return NafLearner(SimulatedResponses(dataset), Configuration.naf(shape, NafRecipe(**{"points": 50, **changes})))


def encoded(learner, row):
    """(ear, bin, frame, 2) of a row that may be trained on, as the codec has it."""
    responses = learner.responses
    row = np.flatnonzero(~responses.held_out)[row]
    delay = responses.onset_s[row] * responses.sample_rate - LEAD_SAMPLES
    return np.stack(learner.codec.encode(align(responses.read([row])[0], delay)), axis=-1)


def test_targets_are_the_codecs_at_the_points_drawn(dataset):
    it = learner(dataset)
    rows = np.array([3, 40, 7])
    (listener, _, _, bins, frames), (values, indices) = it.batch(rows, np.random.default_rng(0))
    torch.testing.assert_close(indices, torch.stack([bins, frames]))
    for number, row in enumerate(rows):
        expected = encoded(it, row)[:, bins[number], frames[number]]
        np.testing.assert_allclose(values[number], expected, atol=1e-4)
    assert listener.shape == (3, 3)


def test_statistics_are_those_of_the_training_set(dataset):
    it = learner(dataset)
    rows = np.arange(30)
    it.initialise(rows, seed=0)
    whole = np.stack([encoded(it, row) for row in rows])
    np.testing.assert_allclose(it.field.mean, whole.mean(axis=(0, 1)), atol=1e-3)
    sigma = np.maximum(whole.std(axis=(0, 1)), 0.1)
    np.testing.assert_allclose(it.field.spread, 3 * sigma, rtol=1e-3)
    assert (np.hypot(*it.field.coherence.numpy()) <= 1 + 1e-6).all()


def test_ears_that_hear_the_same_are_coherent_in_the_mean(dataset, monkeypatch):
    it = learner(dataset)
    left = SimulatedResponses.read
    monkeypatch.setattr(SimulatedResponses, "read", lambda *given: np.repeat(left(*given)[:, :1], 2, axis=1))
    it.initialise(np.arange(10), seed=0)
    # Not where there is silence: bins of rounding alone.
    sounding = it.field.mean[..., 0].numpy() > np.log(1e-3)
    np.testing.assert_allclose(it.field.coherence[0].numpy()[sounding], 1, atol=1e-3)
    np.testing.assert_allclose(it.field.coherence[1].numpy()[sounding], 0, atol=1e-3)


def test_a_perfect_prediction_costs_nothing_and_each_part_what_it_weighs(dataset):
    it = learner(dataset, phase_weight=0.1)
    it.initialise(np.arange(20), seed=0)
    _, (values, indices) = it.batch(np.arange(4), None)
    at = tuple(indices)
    perfect = (values - it.field.mean[at][:, None]) / it.field.spread[at][:, None]
    assert all(part == 0 for part in it.losses(perfect, (values, indices)).values())
    wrong = it.losses(perfect + torch.tensor([0.5, 1.0]), (values, indices))
    assert wrong["magnitude"] == pytest.approx(0.25, rel=1e-4)
    assert wrong["phase"] == pytest.approx(0.1, rel=1e-4)


def test_positions_are_shaken_for_training_only(dataset):
    it = learner(dataset, noise_m=0.1)
    rows = np.repeat(np.arange(20), 10)
    still = np.flatnonzero(~it.responses.held_out)[rows]
    (listener, emitter, yaw, *_), _ = it.batch(rows, np.random.default_rng(0))
    for shaken, at in ((listener, it.responses.listener), (emitter, it.responses.emitter)):
        assert np.std(shaken.numpy() - at[still]) == pytest.approx(0.1, rel=0.15)
    np.testing.assert_allclose(yaw, it.responses.yaw[still], rtol=1e-6)
    (listener, *_), _ = it.batch(rows, None)
    np.testing.assert_allclose(listener, it.responses.listener[still], rtol=1e-6)


@pytest.mark.parametrize(("padding", "beyond"), [(0.0, False), (1.0, True)])
def test_the_silence_after_a_recording_is_shown_now_and_then(dataset, monkeypatch, padding, beyond):
    it = learner(dataset, padding=padding, points=400)
    half = it.responses.samples // 2
    # As if it came from far away: aligned, half of the recording is left.
    it.responses.onset_s = np.full_like(it.responses.onset_s, half / it.responses.sample_rate)
    noise = np.random.default_rng(0).standard_normal((1, 2, 2 * half)) * (np.arange(2 * half) >= half)
    monkeypatch.setattr(SimulatedResponses, "read", lambda *_: noise)
    (*_, frames), (values, _) = it.batch(np.arange(5), np.random.default_rng(0))
    ends = it.codec.frames / 2 + 3
    assert bool((frames > ends).any()) == beyond
    if beyond:
        silent = values[..., 0].swapaxes(1, 2)[frames > ends]
        assert (silent < np.log(2e-5)).float().mean() > 0.9


def test_an_epoch_meets_every_pair_once_in_any_orientation(dataset):
    it = learner(dataset)
    rows = np.arange(int(np.sum(~it.responses.held_out)))
    pairs = it.responses.pair[~it.responses.held_out]
    met = [it.epoch(rows, np.random.default_rng(seed)) for seed in range(20)]
    for order in met:
        assert sorted(pairs[order]) == sorted(set(pairs))
    assert len(np.unique(np.concatenate(met))) > 0.9 * len(rows)


def test_what_is_expected_of_responses_is_the_target_if_that_is_asked_for(dataset):
    it = learner(dataset, expected=True)
    it.prepare(Progress(disable=True))
    it.initialise(np.arange(30), seed=0)
    rows = np.array([3, 40, 7])
    (*_, bins, frames), (values, _) = it.batch(rows, np.random.default_rng(0))
    stored = load_expected_points(it.responses, it.codec, dataset.folder / "targets", Progress(disable=True)).flat
    for number, row in enumerate(rows):
        points = stored[row].reshape(2, it.codec.bins, it.codec.frames, 2)
        np.testing.assert_allclose(values[number], points[:, bins[number], frames[number]], atol=1e-6)
    assert not torch.isnan(it.field.coherence).any()
    assert it.field.coherence.any()


@pytest.mark.parametrize("recipe", [{"whole": True}, {"shape": NafShape(domain="time", width=8)}])
def test_only_reflected_spectrograms_have_expected_values(dataset, recipe):
    with pytest.raises(RecipeError, match="expected values"):
        learner(dataset, expected=True, **recipe)


def test_in_the_time_domain_the_waveform_is_the_target(dataset):
    it = learner(dataset, shape=NafShape(domain="time", width=8))
    it.initialise(np.arange(20), seed=0)
    (_, _, _, samples), (values, indices) = it.batch(np.array([5]), None)
    responses = it.responses
    row = np.flatnonzero(~responses.held_out)[5]
    aligned = align(responses.read([row])[0], responses.onset_s[row] * responses.sample_rate - LEAD_SAMPLES)
    np.testing.assert_allclose(values[0, ..., 0], aligned[:, samples[0]], atol=1e-6)
    assert set(it.losses(values, (values, indices))) == {"waveform"}
    assert not it.field.mean.any()


def test_only_grids_decay(dataset):
    for grid, decaying in (("shared", 1), ("dual", 2), ("none", 0)):
        it = learner(dataset, shape=NafShape(width=8, grid=grid))
        groups = it.parameter_groups()
        assert sum(len(group["params"]) for group in groups if group["weight_decay"]) == decaying
        assert sum(len(group["params"]) for group in groups) == len(list(it.field.parameters()))
