import dataclasses

import numpy as np
import pytest
import torch

from training.learning.energies import RAYLEIGH_DEFICIT, EnergyError
from training.learning.factorised import FactorisedLearner
from training.learning.runs import FactorisedRecipe
from training.models.targets import flat_targets
from training.simulation.responses import SimulatedResponses


@pytest.fixture(scope="module")
def learner(dataset, configuration) -> FactorisedLearner:
    weighted = dataclasses.replace(configuration, recipe=FactorisedRecipe(energy_weight=1.0))
    return FactorisedLearner(SimulatedResponses(dataset), weighted)


def decaying_noise(learner, count: int, seed: int = 0) -> np.ndarray:
    samples = learner.cells.codec.samples
    return np.random.default_rng(seed).standard_normal((count, 2, samples)) * np.exp(-np.arange(samples) / 2000)


def levels(learner, responses) -> torch.Tensor:
    return torch.from_numpy(flat_targets(responses, learner.cells)).float()


def exact(learner) -> EnergyError:
    return EnergyError(learner.cells, learner.field.heads, deficit=0.0)


def test_equal_responses_have_no_error_and_a_louder_one_its_level_in_each_of_three_sums(learner) -> None:
    noise = decaying_noise(learner, 3)
    one, louder = levels(learner, noise), levels(learner, 1.3 * noise)
    assert exact(learner)(one, one).tolist() == [0, 0, 0]
    assert exact(learner)(louder, one).tolist() == pytest.approx(3 * [3 * np.log(1.3) ** 2], rel=0.02)


def test_energy_to_come_is_that_of_the_spectrogram(learner) -> None:
    noise = decaying_noise(learner, 2)
    power = np.abs(learner.cells.codec.transform(noise)) ** 2
    to_come = np.cumsum(power.sum(axis=-2)[..., ::-1], axis=-1)[..., ::-1]
    _, found, _ = exact(learner)._energies(levels(learner, noise), 0.0)
    np.testing.assert_allclose(found[..., 0], 0.5 * np.log(to_come[..., 0]), atol=0.01)
    np.testing.assert_allclose(found[..., 1], 0.5 * np.log(to_come[..., 4]), atol=0.01)


def test_the_mean_of_the_logarithms_of_noise_has_its_energy(learner) -> None:
    """What a regression finds: the mean log-magnitude over many draws, against any one of them."""
    many = levels(learner, decaying_noise(learner, 200))
    mean, drawn = many.mean(dim=0, keepdim=True), levels(learner, decaying_noise(learner, 20, seed=1))
    corrected = EnergyError(learner.cells, learner.field.heads, deficit=RAYLEIGH_DEFICIT)
    *_, ours = corrected._energies(mean, RAYLEIGH_DEFICIT)
    *_, theirs = corrected._energies(drawn, 0.0)
    assert float((ours - theirs).mean()) == pytest.approx(0, abs=0.05)
    *_, uncorrected = corrected._energies(mean, 0.0)
    assert float((uncorrected - theirs).mean()) == pytest.approx(-RAYLEIGH_DEFICIT, abs=0.05)


def test_a_learner_that_weighs_energies_has_their_error_among_its_losses(learner) -> None:
    one = levels(learner, decaying_noise(learner, 3))
    field = learner.field
    prediction = (one - field.mean) / field.spread
    targets = (one, torch.ones(3, dtype=torch.bool))
    assert float(learner.losses(prediction + 0.5, targets)["energy"]) > float(
        learner.losses(prediction, targets)["energy"]
    )
