from functools import partial

import numpy as np
import pytest
from rich.progress import Progress

from server.core.errors import FieldError
from training.bundling import noise
from training.bundling.noise import choose_noise, race
from training.frontier.accuracy import SampledPairs, Scores

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
    answers = iter([(0.2, 0.1), (0.1, 0.5), (0.1, 0.4)] * 99)

    def scores(_sample, _estimate, pairs):
        missing, error = next(answers)
        return Scores(np.full((len(pairs), 1), error), np.full(len(pairs), missing))

    monkeypatch.setattr(noise, "_ROUND_PAIRS", noise._PAIRS)
    monkeypatch.setattr(SampledPairs, "scores_of", scores)
    chosen = choose_noise(tiny_bundle, dataset, seed=0)
    assert chosen is draws[2]


def test_the_race_ends_as_if_all_had_run_to_the_end_and_asks_for_less():
    """Sixteen whose errors on a pair have much in common, and differ by chance beside that."""
    asked = np.zeros(16, dtype=int)
    found, best = [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        merits, pairs = rng.uniform(1.0, 1.3, 16), rng.uniform(0.5, 2.0, (80, 1))
        errors = merits[:, None, None] * pairs + 0.05 * rng.standard_normal((16, 80, 5))

        def scores(number, rows, errors=errors):
            asked[number] += len(rows)
            return Scores(errors[number, rows], np.zeros(len(rows)))

        rounds = np.split(rng.permutation(80), 8)
        found.append(race([partial(scores, number) for number in range(16)], rounds, Progress(disable=True)))
        best.append(int(np.argmin(errors.mean(axis=(1, 2)))))
    assert np.mean(np.equal(found, best)) >= 0.9
    assert asked.sum() < 0.5 * 20 * 16 * 80


def test_one_that_nothing_can_be_measured_of_is_out_of_the_race_at_once():
    asked = []

    def of(number, rows):
        asked.append(number)
        return Scores.unmeasurable(len(rows)) if number else Scores(np.ones((len(rows), 2)), np.zeros(len(rows)))

    rounds = np.split(np.arange(40), 4)
    assert race([partial(of, number) for number in range(3)], rounds, Progress(disable=True)) == 0
    assert asked == [0, 1, 2]


def test_a_field_without_finite_responses_is_left_to_the_health_check(tiny_bundle, dataset, monkeypatch, draws):
    def fail(*_):
        raise FieldError("no finite response")

    monkeypatch.setattr(SampledPairs, "scores_of", fail)
    assert choose_noise(tiny_bundle, dataset, seed=0) is draws[0]
