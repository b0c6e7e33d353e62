"""Each definition on responses for which its value is known, and where definitions differ."""

import itertools

import numpy as np
import pytest
import torch
from scipy.optimize import brentq

from training.evaluation.comparison import OWN_METRICS, Comparison, digest
from training.evaluation.literature import LITERATURE_METRICS, METRICS, resampled

RATE = 24_000
BY_NAME = {metric.name: metric for metric in METRICS}


def decay(*parts, samples=RATE, start=0):
    """(sample,) of which the energy falls as a sum of exponentials: (share of energy at the start, T60). Its sign
    alternates, so a high-pass lets it through."""
    time_s = np.arange(samples - start) / RATE
    energy = sum(share * 10 ** (-6 * time_s / reverberation_s) for share, reverberation_s in parts)
    return np.concatenate([np.zeros(start), np.sqrt(energy) * (-1.0) ** np.arange(samples - start)])


def error(name, reference, estimate, *, rate=RATE, ears=1):
    """Of one row; a response of one channel stands for `ears` equal ones."""
    shaped = [np.tile(np.atleast_2d(each), (ears, 1))[np.newaxis].astype(np.float32) for each in (reference, estimate)]
    return float(BY_NAME[name].error(Comparison(*shaped, rate))[0])


@pytest.mark.parametrize("channels", [1, 2])
def test_the_reference_itself_has_no_error_by_any_definition(channels):
    rng = np.random.default_rng(3)
    heard = rng.standard_normal((2, channels, 9_600)) * decay((1.0, 0.25), samples=9_600)
    heard[..., 40] += 5.0
    compared = Comparison(heard.astype(np.float32), heard.astype(np.float32), RATE)
    for metric in METRICS:
        if channels >= metric.channels:
            np.testing.assert_allclose(metric.error(compared), np.zeros(2), atol=1e-12, err_msg=metric.name)


@pytest.mark.parametrize("name", ["t60", "t60_naf", "t60_raf", "t60_avr", "t60_xrir"])
def test_every_reverberation_time_is_that_of_an_ideal_decay(name):
    expected = 100 * (0.25 / 0.2 - 1)
    # The filter of RAF's and the ends of short parts change it a little.
    assert error(name, decay((1.0, 0.2)), decay((1.0, 0.25))) == pytest.approx(expected, rel=0.03)


def crossing_s(parts, level_db):
    """When the backward integral of such a decay falls through a level, from the formula."""
    total = sum(share * reverberation_s for share, reverberation_s in parts)

    def curve_db(time_s):
        left = sum(share * reverberation_s * 10 ** (-6 * time_s / reverberation_s) for share, reverberation_s in parts)
        return 10 * np.log10(left / total) - level_db

    return brentq(curve_db, 0.0, 5.0)


def test_reverberation_times_of_two_slopes_differ_by_the_range_of_their_fit():
    single, double = ((1.0, 0.2),), ((1.0, 0.1), (0.01, 0.5))
    found = {}
    for name, fall_db in (("t60_naf", 30.0), ("t60_xrir", 20.0)):
        time_s = 60 / fall_db * (crossing_s(double, -5 - fall_db) - crossing_s(double, -5))
        found[name] = error(name, decay(*single), decay(*double))
        assert found[name] == pytest.approx(100 * abs(time_s / 0.2 - 1), rel=0.02, abs=1.0)
    assert abs(found["t60_naf"] - found["t60_xrir"]) > 20


def test_a_decay_that_does_not_fall_far_enough_counts_as_the_authors_count_it():
    # 30 dB down there is no more: too short for -35 dB.
    short = decay((1.0, 0.5), samples=round(0.25 * RATE))
    assert np.isnan(error("t60", short, short))
    assert not np.isnan(error("t60_naf", short, short))  # a curve that is cut off bends down
    noise = np.ones(RATE // 10)
    flat = error("t60_naf", noise, noise)
    assert flat == pytest.approx(0.0) or np.isnan(flat)
    pulse = np.zeros(2_400)
    pulse[:2] = 1.0, 0.9
    assert np.isnan(error("t60_naf", pulse, pulse))
    assert BY_NAME["t60_naf"].counted_as == 100.0
    assert BY_NAME["t60"].counted_as is None


def test_the_time_of_travel_counts_in_early_decays_from_the_first_sample_only():
    delay = 240
    reference, late = decay((1.0, 0.4)), decay((1.0, 0.4), start=delay)
    assert error("edt", reference, late) == pytest.approx(0.0, abs=0.5)
    for name in ("edt_neraf", "edt_avr"):
        assert error(name, reference, late) == pytest.approx(1e3 * 6 * delay / RATE, rel=0.01)


def test_clarity_from_the_first_sample_loses_the_time_of_travel():
    delay_s, reverberation_s = 0.010, 0.4
    reference = decay((1.0, reverberation_s))
    late = decay((1.0, reverberation_s), start=round(delay_s * RATE))

    def clarity_db(early_s):
        left = 10 ** (-6 * early_s / reverberation_s)
        return 10 * np.log10((1 - left) / left)

    assert error("c50", reference, late) == pytest.approx(0.0, abs=0.02)
    expected = clarity_db(0.050) - clarity_db(0.050 - delay_s)
    assert error("c50_neraf", reference, late) == pytest.approx(expected, abs=0.02)


def test_what_precedes_the_direct_sound_counts_as_it_in_the_ratio_of_xrir():
    direct, late = np.zeros(2_400), np.zeros(2_400)
    direct[[100, 1_000]] = 1.0, 0.5
    late[[100, 1_000]] = 1.0, 0.25
    assert error("drr_xrir", direct, late) == pytest.approx(20 * np.log10(2), abs=1e-6)
    before = late.copy()
    before[10] = 1e-3  # 90 samples before, more than 3 ms: what follows all counts as reverberation
    assert error("drr_xrir", late, before) > 60
    assert error("drr", direct, late) == pytest.approx(20 * np.log10(2), abs=1e-3)


def test_the_lag_is_a_time_and_the_coefficient_is_not():
    rng = np.random.default_rng(2)
    heard = rng.standard_normal(4_800) * decay((1.0, 0.2), samples=4_800)
    together = np.stack([heard, heard])
    apart = np.stack([heard, np.roll(heard, 12)])
    apart[1, :12] = 0.0
    assert error("iacc_lag", together, apart) == pytest.approx(1e6 * 12 / RATE)
    assert error("iacc", together, apart) < 0.02
    # Beyond a millisecond the coefficient loses it, and the lag does not.
    far = np.stack([heard, np.concatenate([np.zeros(200), heard[:-200]])])
    assert error("iacc_lag", together, far) == pytest.approx(1e6 * 200 / RATE)
    assert error("iacc", together, far) > 0.5


def test_a_gain_is_told_by_its_size_where_there_is_no_floor():
    rng = np.random.default_rng(5)
    heard = rng.standard_normal(4_800) * decay((1.0, 0.2), samples=4_800)
    assert error("amplitude_avr", heard, 1.5 * heard) == pytest.approx(0.5, rel=1e-5)
    assert error("phase_avr", heard, 1.5 * heard) == pytest.approx(0.0, abs=1e-4)
    assert error("level", heard, 2 * heard) == pytest.approx(20 * np.log10(2), rel=1e-5)
    # Of phases at random, as the definition says.
    assert error("phase_avr", heard, rng.standard_normal(4_800)) == pytest.approx(1.62, abs=0.05)


def test_the_envelope_is_that_of_a_tone():
    tone = np.sin(2 * np.pi * 1_000 * np.arange(RATE) / RATE)
    assert error("envelope_avr", tone, 0.75 * tone) == pytest.approx(25.0, rel=1e-3)
    # Silence after it halves the mean, but for what the analytic signal spreads at the edge, where it also peaks.
    padded = np.concatenate([tone, np.zeros(RATE)])
    assert 10.0 < error("envelope_avr", padded, 0.75 * padded) < 13.0


def stft(waveform, n_fft, window, hop):
    """The transform of torch, on which the authors' code rests."""
    taper = torch.hann_window(window, dtype=torch.float64)
    transformed = torch.stft(torch.from_numpy(waveform), n_fft, hop, window, taper, return_complex=True)
    return transformed.abs().numpy()


@pytest.fixture
def two():
    rng = np.random.default_rng(7)
    both = 0.3 * rng.standard_normal((2, 6_000)) * decay((1.0, 0.2), samples=6_000)
    return tuple(each.astype(np.float32).astype(np.float64) for each in both)


def test_spectral_losses_are_those_of_the_authors_transforms(two):
    naf = [np.pad(np.clip(resampled(each, RATE, 22_050), -1, 1), (0, 256)) for each in two]
    logs = [np.log(stft(each, 512, 512, 128)[:-1] + 1e-3) for each in naf]
    assert error("spectral_naf", *two) == pytest.approx(np.abs(logs[1] - logs[0]).mean(), rel=1e-9)
    raf = [np.log(stft(each, 1_024, 512, 256) + 1e-3) for each in two]
    expected = np.abs(raf[1] - raf[0]).mean()
    assert error("spectral_raf", *two, rate=48_000) == pytest.approx(expected, rel=1e-9)
    slow = [np.log(stft(each, 512, 256, 128) + 1e-3) for each in two]
    assert error("spectral_raf", *two, rate=16_000) == pytest.approx(np.abs(slow[1] - slow[0]).mean(), rel=1e-9)


def test_a_short_response_is_padded_as_nafs_is():
    short = [0.1 * np.random.default_rng(seed).standard_normal(600) for seed in (1, 2)]
    padded = [np.pad(each.astype(np.float32).astype(np.float64), (0, 4_410 - 600)) for each in short]
    logs = [np.log(stft(each, 512, 512, 128)[:-1] + 1e-3) for each in padded]
    found = error("spectral_naf", *short, rate=22_050)
    assert found == pytest.approx(np.abs(logs[1] - logs[0]).mean(), rel=1e-9)


def test_the_loss_of_several_resolutions_is_the_mean_of_their_terms(two):
    total = 0.0
    for n_fft, window, hop in ((512, 300, 60), (256, 150, 30), (128, 75, 8)):
        truth, estimate = (np.sqrt(np.maximum(stft(each, n_fft, window, hop) ** 2, 1e-8)) for each in two)
        total += np.linalg.norm(estimate - truth) / np.linalg.norm(estimate)
        total += np.abs(np.log(estimate) - np.log(truth)).mean() + np.abs(estimate - truth).mean()
    assert error("mrstft_avr", *two) == pytest.approx(total / 3, rel=1e-9)


def test_quiet_differences_hide_below_a_floor_and_not_in_ours(two):
    quiet = [1e-4 * each for each in two]
    assert error("spectral_naf", *quiet) < 0.2 * error("spectral_loss", *quiet)


def test_resampling_keeps_amplitudes_of_waveforms():
    tone = 0.5 * np.sin(2 * np.pi * 500 * np.arange(4_800) / 48_000)
    slower = resampled(tone, 48_000, 16_000)
    assert slower.shape == (1_600,)
    assert np.abs(slower[200:-200]).max() == pytest.approx(0.5, abs=0.01)


def test_each_definition_is_told_in_full_and_changes_the_digest():
    assert len(BY_NAME) == len(METRICS) == len(OWN_METRICS) + len(LITERATURE_METRICS)
    for metric in METRICS:
        stated = metric.definition
        for text in (stated.formula, stated.over, stated.band, stated.failures, stated.source, metric.by):
            assert text.strip(), metric.name
    # Those of one quantity stand beside each other.
    quantities = [metric.quantity for metric in METRICS]
    changes = sum(before != after for before, after in itertools.pairwise(quantities))
    assert changes + 1 == len(set(quantities))
    assert digest(METRICS) != digest(METRICS[1:])
