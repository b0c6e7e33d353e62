"""One tail for all receivers: as much of it, from where and when, as each would have of its own."""

import numpy as np
import pytest

from server.acoustics.bands import OCTAVE_BANDS_HZ
from training.data.scene_file import HISTOGRAM_BIN_S
from training.data.shared_tail import FADE_S, TRAINING, SharedTail, shared_power
from training.simulation.rays import sphere_directions

START_S, BINS = 0.06, 75
DIRECTIONS = sphere_directions(12)


@pytest.fixture(scope="module")
def energies():
    """(tail, direction, band, bin): mostly from +x, bands that decay differently, each tail twice as loud."""
    towards = 1 + 3 * np.maximum(0, DIRECTIONS[:, 0])
    decay = np.exp(-np.outer(np.linspace(8, 25, len(OCTAVE_BANDS_HZ)), np.arange(BINS) * HISTOGRAM_BIN_S))
    return np.stack([1.0, 2.0, 4.0])[:, None, None, None] * towards[:, None, None] * decay * 1e-3


@pytest.fixture(scope="module")
def tail(energies):
    return SharedTail.of(energies, START_S)


def test_own_and_shared_power_add_up_to_one():
    times_s = np.linspace(0, 0.2, 1001)
    shared = shared_power(times_s, START_S)
    assert ((shared >= 0) & (shared <= 1)).all()
    np.testing.assert_array_equal(shared[times_s <= START_S], 0.0)
    np.testing.assert_allclose(shared[times_s >= START_S + FADE_S], 1.0)


def test_energies_join_without_a_step(tail):
    """A receiver whose own energy is that of all gets nothing but what it had."""
    whole = tail.energies[0]
    known = round((START_S + FADE_S) / HISTOGRAM_BIN_S) + 1
    np.testing.assert_allclose(tail.join(0, whole[..., :known]), whole, rtol=1e-5)


def test_the_expected_energy_is_that_of_the_directions_seen(energies, tail):
    """Constant in time here, so sharing directions over time changes nothing."""
    np.testing.assert_allclose(tail.energies, energies, rtol=1e-5)


def test_nothing_is_added_before_it_starts(tail):
    known = round((START_S + FADE_S) / HISTOGRAM_BIN_S) + 1
    silent = np.zeros((len(DIRECTIONS), len(OCTAVE_BANDS_HZ), known), np.float32)
    found = tail.join(1, silent)
    begins = int(START_S / HISTOGRAM_BIN_S)
    assert not found[..., :begins].any()
    np.testing.assert_allclose(found[..., known:], tail.energies[1][..., known:])


def test_the_directions_of_the_training_pairs_tail_are_its_own(energies):
    turned = energies.copy()
    turned[TRAINING] = turned[TRAINING, ::-1]
    found = SharedTail.of(turned, START_S).energies
    np.testing.assert_allclose(found, turned, rtol=1e-5)


def test_a_pair_to_train_on_has_another_tail_than_a_held_out_one(tail):
    assert [tail.number(take, held_out=True) for take in (0, 1)] == [0, 1]
    assert tail.number(0, held_out=False) == TRAINING
    of_earlier_files = SharedTail(tail.start_s, tail.energies[:TRAINING])
    assert of_earlier_files.number(0, held_out=False) == 0


def test_directions_without_any_sound_are_even():
    silent = SharedTail.of(np.zeros((3, 12, 7, BINS)), START_S)
    assert np.isfinite(silent.energies).all()
    assert not silent.energies.any()
