import numpy as np
import pytest

from server.acoustics.bands import OCTAVE_BANDS_HZ
from training.data.scene_file import HISTOGRAM_BIN_S
from training.trials import field_decay as module
from training.trials.field_decay import FieldDecay, band_energy, field_decay
from training.trials.reverberation import reverberation_time_s

RATE = 24_000


def test_noise_that_decays_has_its_own_reverberation_time_in_every_octave():
    rng, time_s = np.random.default_rng(0), np.arange(RATE) / RATE
    responses = 10 ** (-3 * time_s / 0.6) * rng.standard_normal((200, RATE))
    energy = band_energy(responses, RATE, round(1 / HISTOGRAM_BIN_S))
    np.testing.assert_allclose(reverberation_time_s(energy), 0.6, rtol=0.02)


def test_octaves_are_told_apart():
    tone = np.sin(2 * np.pi * 1000 * np.arange(RATE) / RATE)
    energy = band_energy(tone, RATE, 250).sum(axis=-1)
    assert energy[3] == pytest.approx(np.sum(tone**2), rel=0.01)
    assert np.delete(energy, 3).max() < 0.01 * energy[3]


def test_octaves_above_half_the_sample_rate_are_silent():
    noise = np.random.default_rng(0).standard_normal(8_000)
    energy = band_energy(noise, 8_000, 250)
    assert not energy[np.asarray(OCTAVE_BANDS_HZ) > 5_000].any()
    assert energy[:5].all()


def test_a_field_that_decays_faster_than_its_data_is_told_by_how_much(tiny_bundle, dataset, monkeypatch):
    """Its answers are the data's own, of both takes, with so many decibels a second more of decay: 1/T adds up."""
    more_db_per_s = 40.0

    def source(_, held_out):
        gain = 10 ** (-more_db_per_s / 20 * np.arange(held_out.samples) / held_out.sample_rate)

        def answer(index, turns):
            pair = int(held_out.held_out[index])
            takes = held_out.pairs.response(pair)[turns], held_out.repeats[pair][turns]
            return np.concatenate(takes) * gain

        return answer

    monkeypatch.setattr(module, "field_source", source)
    found = field_decay(tiny_bundle.folder, dataset.folder)
    expected = 1 / (1 / np.asarray(found.data_s) + more_db_per_s / 60)
    np.testing.assert_allclose(found.field_s, expected, rtol=0.02)


def test_a_field_is_asked_for_what_the_data_hold(tiny_bundle, dataset):
    found = field_decay(tiny_bundle.folder, dataset.folder)
    assert np.isfinite(found.field_s).any()
    assert found.window_s == pytest.approx(tiny_bundle.manifest.codec.n_fft / tiny_bundle.manifest.codec.sample_rate)


def test_a_field_that_does_not_decay_is_beyond_the_limit():
    never = FieldDecay((np.nan,) * 7, (0.5,) * 7, window_s=0.01)
    assert never.beyond() != []
    assert FieldDecay((np.nan,) * 7, (np.nan,) * 7, window_s=0.01).beyond() == []
