"""Room parameters of responses that hardly are any: missing, told as such, or what the definition says; never a wrong
number."""

import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as of_numpy

from server.acoustics.room_parameters import (
    UnmeasurableError,
    clarity_db,
    direct_to_reverberant_db,
    early_decay_time_s,
    energy_decay_db,
    interaural_cross_correlation,
    interaural_time_difference_s,
    level_db,
    measure,
    onset_sample,
    reverberation_time_s,
)

RATE = 24_000
PARAMETERS = [
    reverberation_time_s,
    early_decay_time_s,
    clarity_db,
    direct_to_reverberant_db,
    interaural_cross_correlation,
    interaural_time_difference_s,
]


def decay(t60_s, length_s=1.0, *, seed=0, onset=240):
    """Two ears of noise that decays by 60 dB in `t60_s`, exactly in expectation."""
    time_s = np.arange(round(length_s * RATE)) / RATE
    noise = np.random.default_rng(seed).standard_normal((2, time_s.size))
    response = noise * 10 ** (-3 * time_s / t60_s)
    return np.concatenate([np.zeros((2, onset)), response], axis=-1)


@pytest.mark.parametrize("parameter", PARAMETERS)
@pytest.mark.parametrize("samples", [1, 2, 100, 5_000])
def test_a_silent_response_has_no_parameters(parameter, samples):
    with pytest.raises(UnmeasurableError):
        parameter(np.zeros((2, samples)), RATE)


def test_a_silent_response_has_no_level_and_no_onset_and_is_counted():
    silent = np.zeros((3, 2, 500))
    silent[1] = decay(0.3)[:, :500]
    with pytest.raises(UnmeasurableError):
        level_db(silent)
    np.testing.assert_array_equal(onset_sample(silent)[[0, 2]], -1)
    missing = measure(silent, RATE).missing()
    assert missing["level_db"] == missing["onset_s"] == 4
    assert missing["interaural_cross_correlation"] == 2


@pytest.mark.parametrize("parameter", PARAMETERS)
def test_an_empty_response_is_refused(parameter):
    with pytest.raises(ValueError, match="at least one sample"):
        parameter(np.zeros((2, 0)), RATE)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("parameter", PARAMETERS)
def test_a_response_that_is_not_finite_is_refused(parameter, value):
    response = decay(0.3)
    response[1, 3_000] = value
    with pytest.raises(ValueError, match="not finite"):
        parameter(response, RATE)


@pytest.mark.parametrize("at", [0, 10, 499])
def test_a_single_sample_has_an_onset_and_a_level_and_no_decay(at, measured):
    click = np.zeros((2, 500))
    click[:, at] = 0.5
    assert onset_sample(click).tolist() == [at, at]
    measured("level", abs(level_db(click) - 20 * np.log10(0.5)).max(), 1e-9, "dB")
    for parameter in (reverberation_time_s, early_decay_time_s, clarity_db, direct_to_reverberant_db):
        with pytest.raises(UnmeasurableError):
            parameter(click, RATE)
    measured("coherence of equal ears", float(interaural_cross_correlation(click, RATE)), 1.0 - 1e-9, at_least=True)


@pytest.mark.parametrize("scale", [1e-30, 1e-20, 1.0, 1e20])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_how_loud_a_response_is_decides_its_level_alone(scale, dtype, measured):
    plain, scaled = decay(0.4), (decay(0.4) * scale).astype(dtype)
    expected, found = measure(plain, RATE), measure(scaled, RATE)
    tolerance = 1e-3 if dtype == np.float32 else 1e-6
    measured("T60", np.abs(found.reverberation_time_s / expected.reverberation_time_s - 1).max(), tolerance)
    measured("C50", np.abs(found.clarity_db - expected.clarity_db).max(), tolerance, "dB")
    measured("level", np.abs(found.level_db - expected.level_db - 20 * np.log10(scale)).max(), tolerance, "dB")


@pytest.mark.parametrize("scale", [1e-170, 1e170])
def test_a_response_whose_square_leaves_the_floating_point_is_not_measured_wrongly(scale):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        try:
            found = measure(decay(0.4) * scale, RATE)
        except ValueError:
            return
    times = found.reverberation_time_s
    assert np.all(np.isnan(times) | (np.abs(times / 0.4 - 1) < 0.2))


@pytest.mark.parametrize("t60_s", [0.001, 0.005])
def test_a_decay_of_next_to_no_time_is_short_or_not_measurable(t60_s):
    """Windows are of 10 ms: below, there is no line to fit."""
    times = measure(decay(t60_s), RATE).reverberation_time_s
    assert np.all(np.isnan(times) | (times < 0.05))


@pytest.mark.parametrize("t60_s", [60.0, 600.0])
def test_a_decay_of_minutes_is_not_told_from_a_second_of_it(t60_s):
    """No more than 1 dB of it is there: too little for 30."""
    with pytest.raises(UnmeasurableError, match="dB of decay"):
        reverberation_time_s(decay(t60_s), RATE)


def test_a_decay_of_a_minute_is_measured_in_a_minute(measured):
    found = reverberation_time_s(decay(60.0, length_s=60.0), RATE)
    measured("error of T60", np.abs(found / 60 - 1).max(), 0.02)


@pytest.mark.parametrize("kind", ["direct current", "tone", "noise", "growing"])
def test_what_does_not_decay_has_no_reverberation_time(kind):
    time_s = np.arange(RATE) / RATE
    signal = {
        "direct current": np.ones(RATE),
        "tone": np.sin(2 * np.pi * 440 * time_s),
        "noise": np.random.default_rng(2).standard_normal(RATE),
        "growing": np.random.default_rng(2).standard_normal(RATE) * np.exp(3 * time_s),
    }[kind]
    with pytest.raises(UnmeasurableError):
        reverberation_time_s(np.stack([signal, signal]), RATE)


def test_the_end_of_a_decay_in_noise_is_not_measured_as_decay(measured):
    """Noise 40 dB below: T30 needs 45."""
    noisy = decay(0.3) + 10 ** (-40 / 20) * np.random.default_rng(3).standard_normal((2, RATE + 240))
    times = measure(noisy, RATE).reverberation_time_s
    assert np.isnan(times).all()
    quieter = decay(0.3) + 10 ** (-70 / 20) * np.random.default_rng(3).standard_normal((2, RATE + 240))
    measured("error of T60", np.abs(reverberation_time_s(quieter, RATE) / 0.3 - 1).max(), 0.05)


def test_a_gap_of_digital_silence_leaves_the_decay_measurable(measured):
    gapped = decay(0.8, 0.5)
    gapped[:, 6_000:6_600] = 0.0  # in what the line through the late decay is fitted to
    measured("error of T60", np.abs(reverberation_time_s(gapped, RATE) / 0.8 - 1).max(), 0.1)


def test_one_silent_ear_leaves_the_other_measurable():
    response = decay(0.4)
    response[0] = 0
    found = measure(response, RATE)
    assert np.isnan(found.reverberation_time_s[0])
    assert abs(found.reverberation_time_s[1] / 0.4 - 1) < 0.1
    assert np.isnan(found.interaural_cross_correlation)
    assert np.isnan(found.interaural_time_difference_s)


@pytest.mark.parametrize("factor", [1.0, -1.0, 1e-6])
def test_ears_that_hear_the_same_cohere_whatever_sign_and_loudness(factor, measured):
    one = decay(0.4)[0]
    found = interaural_cross_correlation(np.stack([one, factor * one]), RATE)
    measured("coherence", float(found), 1.0 - 1e-6, at_least=True)


def test_an_onset_outside_the_response_finds_no_direct_sound():
    response = decay(0.4)
    for onset in (10_000_000, response.shape[-1] + 73):
        with pytest.raises(UnmeasurableError):
            direct_to_reverberant_db(response, RATE, onset=onset)


@pytest.mark.parametrize("noise_db", [-np.inf, -40.0])
@pytest.mark.parametrize("at", [1e-3, 0.1, 0.5])
def test_the_decay_curve_never_rises_and_ends_in_nothing(at, noise_db):
    """Nor where the noise that is taken off it is more than there is."""
    response = decay(0.2) + 10 ** (noise_db / 20) * np.random.default_rng(3).standard_normal((2, RATE + 240))
    response[:, round(at * RATE) + 240 :] = 0
    left = 10 ** (energy_decay_db(response, RATE) / 10)
    assert np.all(np.diff(left, axis=-1) <= 1e-12)
    np.testing.assert_allclose(left.max(axis=-1), 1.0)


@settings(settings.get_profile("hard_cases"), max_examples=80)
@given(
    response=of_numpy.arrays(
        np.float32,
        st.tuples(st.just(2), st.integers(1, 3_000)),
        elements=st.floats(-1e3, 1e3, width=32, allow_subnormal=True),
        fill=st.just(np.float32(0)),
    )
)
def test_whatever_is_finite_has_parameters_in_their_range_or_none(response):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = measure(response, RATE)
    assert not np.any(found.reverberation_time_s < 0)
    assert not np.any(found.early_decay_time_s < 0)
    for values in (found.interaural_cross_correlation, found.early_interaural_cross_correlation):
        assert np.isnan(values) or 0 <= values <= 1
    assert np.isnan(found.interaural_time_difference_s) or abs(found.interaural_time_difference_s) <= 1e-3
    for values in vars(found).values():
        assert not np.any(np.isinf(values))
