"""The mean spectrogram: levels of the training set, at the delay of the pair that is asked for."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.training.held_out import RATE, SAMPLES
from training.baselines.held_out import open_held_out
from training.baselines.mean_spectrogram import MeanSpectrogram
from training.evaluation.methods import DEFAULT_METHODS, MEAN_SPECTROGRAM, method_columns
from training.models.targets import align

YAWS = 3


def decay(pair, *, channels=2):
    """Noise from the moment on at which sound of this pair arrives, twice as loud for every odd pair, and louder the
    further the head is turned."""
    rng = np.random.default_rng(pair)
    start = round((1.0 + pair) / 343.0 * RATE)
    noise = rng.standard_normal((YAWS, channels, SAMPLES)) * 10.0 ** (-3 * np.arange(SAMPLES) / RATE / 0.8)
    louder = (1 + pair % 2) * (1 + np.arange(YAWS))[:, None, None]
    return louder * np.roll(noise, start, axis=-1) * (np.arange(SAMPLES) >= start)


def level_db(response):
    return 10 * np.log10(np.square(response).sum(axis=-1))


def test_levels_are_the_geometric_mean_of_the_training_set_at_each_orientation(make_held_out):
    data = make_held_out(decay, held_out=(3, 8), pairs=12, yaws=YAWS)
    mean = MeanSpectrogram(data, whole=True)
    found = level_db(mean.response(3, data.yaw_indices))
    training = np.array([level_db(decay(pair)) for pair in range(12) if pair not in (3, 8)]).mean(axis=0)
    # The logarithm of noise is 2.5 dB lower in the mean than that of its mean power.
    assert_allclose(found, training - 2.5, atol=1.0)
    assert_allclose(np.diff(found, axis=0), np.diff(training, axis=0), atol=0.3)


def test_it_is_the_same_for_all_pairs_but_for_the_delay(make_held_out):
    data = make_held_out(decay, held_out=(3, 8), pairs=12, yaws=YAWS)
    mean = MeanSpectrogram(data, whole=True)
    near, far = (mean.response(pair, np.array([1]))[0] for pair in (3, 8))
    assert_array_equal(near, mean.response(3, data.yaw_indices)[1])
    assert_allclose(level_db(near), level_db(far), atol=0.5)
    for pair, response in ((3, near), (8, far)):
        start = round((1.0 + pair) / 343.0 * RATE)
        assert not response[:, : max(0, start - 70)].any()
        assert response[:, max(0, start - 64) : start].any()


def test_the_held_out_pairs_are_not_in_the_mean(make_held_out):
    def loud(pair):
        return 1000 * decay(pair) if pair in (3, 8) else decay(pair)

    means = [
        MeanSpectrogram(make_held_out(take, held_out=(3, 8), pairs=12, yaws=YAWS), whole=True).response(3, [0])
        for take in (decay, loud)
    ]
    assert_array_equal(*means)


def test_one_microphone_has_one_channel(make_held_out):
    data = make_held_out(lambda pair: decay(pair, channels=1), held_out=(3,), yaws=YAWS)
    assert MeanSpectrogram(data, whole=True).response(3, data.yaw_indices).shape == (YAWS, 1, SAMPLES)


def test_silent_ears_have_no_coherence(make_held_out):
    data = make_held_out(lambda pair: 0 * decay(pair), held_out=(3,), yaws=YAWS)
    assert np.isfinite(MeanSpectrogram(data, whole=True).response(3, data.yaw_indices)).all()


def test_of_a_simulation_it_has_the_direct_sound_of_the_pair(dataset):
    """As a field has, which learns the reflected sound alone; of whole responses it has none."""
    with open_held_out(dataset.folder) as everything:
        held_out = everything.sample(pairs=3, yaws=2, seed=0)
        late, whole = method_columns([MEAN_SPECTROGRAM, f"{MEAN_SPECTROGRAM}-whole"], held_out)
        assert MEAN_SPECTROGRAM in DEFAULT_METHODS
        references = held_out.pairs.responses
        for index, pair in enumerate(held_out.held_out):
            geometric = references.geometric(int(pair))[held_out.yaw_indices]
            found = late.source(index, held_out.yaw_indices)
            until = int(held_out.delays_s[pair] * held_out.sample_rate)
            assert_array_equal(found[..., :until], geometric[..., :until])
            rest = found - geometric
            reflected = references.reflected(*references.ends(int(pair)))[held_out.yaw_indices]
            assert_allclose(level_db(rest), level_db(reflected), atol=6)
            assert np.abs(whole.source(index, held_out.yaw_indices)).max() < 0.9 * np.abs(geometric).max()


def test_its_spectrogram_is_the_mean_of_logarithms(make_held_out):
    """Point by point: what a network's normalisation has."""
    data = make_held_out(decay, held_out=(3,), pairs=6, yaws=YAWS)
    mean = MeanSpectrogram(data, whole=True)
    codec = mean._codec
    logs = [
        codec.log_magnitude(codec.transform(align(decay(pair), data.delays_s[pair] * RATE - 64)))
        for pair in range(6)
        if pair != 3
    ]
    assert_allclose(mean._log_magnitude, np.mean(logs, axis=0), atol=1e-3)


@pytest.mark.parametrize("channels", [1, 2])
def test_storage_is_of_all_orientations(make_held_out, channels):
    data = make_held_out(lambda pair: decay(pair, channels=channels), held_out=(3,), yaws=YAWS)
    mean = MeanSpectrogram(data.sample(pairs=None, yaws=1, seed=0), whole=True)
    values = mean._log_magnitude.size + (mean._coherence.size if channels == 2 else 0)
    assert mean.storage_bytes == 2 * YAWS * values
