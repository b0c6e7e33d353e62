import numpy as np
import pytest

from server.errors import FieldError
from training import noise
from training.frontier.accuracy import SampledPairs
from training.noise import choose_noise

SCALES = (0.1, 1.0, 10.0)


@pytest.fixture
def draws(monkeypatch, tiny_bundle):
    """Three to choose from, the same noise too quiet, as it should be, and too loud; which of them were drawn."""
    drawn = []

    def draw(*_):
        drawn.append(SCALES[len(drawn)] * tiny_bundle.frozen_noise)
        return drawn[-1]

    monkeypatch.setattr(noise, "even_noise", draw)
    monkeypatch.setattr(noise, "DRAWS", len(SCALES))
    return drawn


def test_the_noise_with_the_smallest_errors_is_taken(tiny_bundle, dataset, draws):
    chosen = choose_noise(tiny_bundle, dataset, seed=0)
    assert len(draws) == len(SCALES)
    assert chosen is draws[SCALES.index(1.0)]


def test_the_seed_decides_it(tiny_bundle, dataset, monkeypatch):
    monkeypatch.setattr(noise, "DRAWS", 2)
    first, again, other = (choose_noise(tiny_bundle, dataset, seed=seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_a_bundle_is_given_the_chosen_noise(tiny_bundle, dataset):
    np.testing.assert_array_equal(tiny_bundle.frozen_noise, choose_noise(tiny_bundle, dataset, seed=0))


@pytest.mark.usefixtures("draws")
def test_it_is_chosen_by_pairs_that_training_saw(tiny_bundle, dataset, monkeypatch):
    samples = []

    def sampled(*arguments, **options):
        samples.append(SampledPairs(*arguments, **options))
        return samples[-1]

    monkeypatch.setattr(noise, "SampledPairs", sampled)
    choose_noise(tiny_bundle, dataset, seed=0)
    held_out = {tuple(pair) for pair in dataset.pairs(held_out=True)}
    numbers = {tuple(probe): number for number, probe in enumerate(dataset.probes)}
    (sample,) = samples
    seen = {(numbers[tuple(entry.emitter)], numbers[tuple(entry.listener)]) for entry in sample.entries}
    assert seen
    assert not seen & held_out


def test_a_noise_with_which_less_can_be_measured_is_not_taken(tiny_bundle, dataset, monkeypatch, draws):
    """However small the errors are that are left."""
    answers = iter([(0.2, 0.1), (0.1, 0.5), (0.1, 0.4)])
    monkeypatch.setattr(SampledPairs, "audible_of", lambda *_: next(answers))
    assert choose_noise(tiny_bundle, dataset, seed=0) is draws[2]


def test_a_field_without_finite_responses_is_left_to_the_health_check(tiny_bundle, dataset, monkeypatch, draws):
    def fail(*_):
        raise FieldError("no finite response")

    monkeypatch.setattr(SampledPairs, "audible_of", fail)
    assert choose_noise(tiny_bundle, dataset, seed=0) is draws[0]
