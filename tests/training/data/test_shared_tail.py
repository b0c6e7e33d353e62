"""One tail for all receivers: as much of it, from where and when, as each would have of its own."""

import numpy as np
import pytest

from server.acoustics.bands import OCTAVE_BANDS_HZ
from training.data.scene_file import HISTOGRAM_BIN_S
from training.data.shared_tail import FADE_S, shared_power
from training.simulation.rays import sphere_directions
from training.simulation.synthesis import BinauralSynthesis
from training.simulation.tail_noise import draw_tail

RATE, SAMPLES, START_S = 24_000, 7200, 0.06
BINS = round(SAMPLES / RATE / HISTOGRAM_BIN_S)
DIRECTIONS = sphere_directions(12)
YAWS = 2 * np.pi * np.arange(3) / 3


@pytest.fixture(scope="module")
def synthesis(kemar):
    return BinauralSynthesis(kemar, DIRECTIONS, YAWS, SAMPLES)


@pytest.fixture(scope="module")
def energies():
    """(take, direction, band, bin): mostly from +x, bands that decay differently, the second take twice as loud."""
    towards = 1 + 3 * np.maximum(0, DIRECTIONS[:, 0])
    decay = np.exp(-np.outer(np.linspace(8, 25, len(OCTAVE_BANDS_HZ)), np.arange(BINS) * HISTOGRAM_BIN_S))
    return np.stack([1.0, 2.0])[:, None, None, None] * towards[:, None, None] * decay * 1e-3


@pytest.fixture(scope="module")
def tail(synthesis, energies):
    return draw_tail(synthesis, energies, start_s=START_S, rng=np.random.default_rng(0))


def draws(tail, take, rng, count):
    """Of receivers that have nothing of their own."""
    silence = np.zeros((len(YAWS), 2, round(0.08 * RATE)), dtype=np.float16)
    return np.stack([tail.extend(take, silence, tail.begin(rng)) for _ in range(count)]).astype(np.float64)


def octave_energies(responses, first):
    """(yaw, ear, band) mean over draws from sample `first` on."""
    spectra = np.abs(np.fft.rfft(responses[..., first:])) ** 2
    frequencies = np.fft.rfftfreq(responses.shape[-1] - first, 1 / RATE)
    bands = [
        spectra[..., (frequencies > band / np.sqrt(2)) & (frequencies < band * np.sqrt(2))].sum(axis=-1)
        for band in OCTAVE_BANDS_HZ
    ]
    return np.stack(bands, axis=-1).mean(axis=0)


@pytest.mark.parametrize("take", [0, 1])
def test_it_is_what_each_would_draw_of_its_own(synthesis, energies, tail, take):
    """Per octave, ear and orientation, after the fade."""
    rng, first = np.random.default_rng(1), round((START_S + FADE_S) * RATE)
    own = np.stack([synthesis.late(energies[take].astype(np.float32), 0.01, rng) for _ in range(40)])
    shared = draws(tail, take, rng, 40)
    difference_db = 10 * np.log10(octave_energies(shared, first) / octave_energies(own.astype(float), first))
    # 40 draws of an octave of 88 Hz for about 50 ms leave 0.3 dB, the one noise of all 0.25 dB more.
    assert np.abs(difference_db).max() < 1.5
    assert np.abs(difference_db.mean()) < 0.15


def test_ears_are_as_coherent_as_of_their_own(synthesis, energies, tail):
    rng, first = np.random.default_rng(2), round((START_S + FADE_S) * RATE)
    own = np.stack([synthesis.late(energies[0].astype(np.float32), 0.01, rng) for _ in range(30)]).astype(float)
    shared = draws(tail, 0, rng, 30)

    def coherence(responses):
        spectra = np.fft.rfft(responses[..., first:])
        frequencies = np.fft.rfftfreq(SAMPLES - first, 1 / RATE)
        chosen = spectra[..., (frequencies > 200) & (frequencies < 1500)]
        left, right = chosen[:, :, 0], chosen[:, :, 1]
        cross = np.abs((left * right.conj()).sum(axis=-1)) / np.sqrt(
            (np.abs(left) ** 2).sum(axis=-1) * (np.abs(right) ** 2).sum(axis=-1)
        )
        return cross.mean(axis=0)

    np.testing.assert_allclose(coherence(shared), coherence(own), atol=0.06)


def test_pairs_take_different_parts_of_the_noise(tail):
    rng = np.random.default_rng(3)
    one, other = draws(tail, 0, rng, 2)
    late = slice(round((START_S + FADE_S) * RATE), None)
    correlations = [
        np.corrcoef(one[yaw, ear, late], other[yaw, ear, late])[0, 1] for yaw in range(len(YAWS)) for ear in (0, 1)
    ]
    assert np.abs(correlations).max() < 0.1


def test_nothing_is_added_before_it_starts(tail):
    (response,) = draws(tail, 0, np.random.default_rng(4), 1)
    assert not response[..., : round(START_S * RATE)].any()
    assert response[..., round(START_S * RATE) + 1 :].all(axis=(0, 1)).any()


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
