"""Resampled responses keep pitch, level and time to -100 dB, and nothing appears above their own band."""

import numpy as np
import pytest

from server.acoustics.resampling import resample_responses, resampled_length, samples_before
from tests.signals import decaying_noise, error_db

OWN, RATES = 24_000, (44_100, 48_000, 96_000)


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("tone_hz", [97.3, 1_234.5, 10_700.0])
def test_a_tone_keeps_its_frequency_and_phase_for_a_second(rate, tone_hz):
    def tone(at_hz):
        time_s = np.arange(at_hz) / at_hz
        return np.sin(2 * np.pi * tone_hz * time_s) * np.sin(np.pi * time_s) ** 4

    (resampled,), *_ = resample_responses(tone(OWN).astype(np.float32)[None, None], OWN, rate)
    heard, expected = resampled * (rate / OWN), tone(rate)
    gain = heard @ expected / (expected @ expected)
    assert abs(20 * np.log10(gain)) < 0.01
    assert error_db(heard, gain * expected) < -100


@pytest.mark.parametrize("rate", RATES)
def test_nothing_appears_above_its_band_and_nothing_is_lost_within(rate):
    response = np.pad(decaying_noise(1, 11_700, decay_samples=1_000), ((0, 0), (300, 0)))[None]
    resampled = resample_responses(response, OWN, rate)
    assert resampled.shape == (1, 2, resampled_length(12_000, OWN, rate))
    # Both spectra at the same frequencies: the padded signals last ten seconds.
    hz = 10
    own, other = (np.fft.rfft(part[0].astype(float), hz * at) for part, at in ((response, OWN), (resampled, rate)))
    peak = np.abs(own).max()
    assert 20 * np.log10(np.abs(other[:, 12_000 * hz :]).max() / peak) < -100
    within = slice(10_800 * hz)
    assert 20 * np.log10(np.abs(other[:, within] - own[:, within]).max() / peak) < -60


@pytest.mark.parametrize("rate", [*RATES, 16_000])
def test_the_beginning_can_be_resampled_alone(rate):
    response = decaying_noise(2, 8_000, decay_samples=2_000)[None]
    own = samples_before(1_500, OWN, rate)
    assert own < 8_000
    whole, beginning = (resample_responses(part, OWN, rate) for part in (response, response[..., :own]))
    assert error_db(beginning[..., :1_500], whole[..., :1_500]) < -100
