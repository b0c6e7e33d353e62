from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from server.acoustics.metrics import PARAMETER_METRICS, parameter_errors, spectral_loss, summarise
from server.acoustics.room_parameters import RoomParameters, measure

RATE = 24_000


@pytest.fixture(scope="module")
def parameters() -> RoomParameters:
    time_s = np.arange(12_000) / RATE
    noise = np.random.default_rng(0).standard_normal((4, 2, len(time_s)))
    return measure(noise * 10.0 ** (-3.0 * time_s / 0.35), RATE)


def test_a_response_has_no_error_to_itself(parameters: RoomParameters) -> None:
    errors = parameter_errors(parameters, parameters)
    assert list(errors) == [metric.name for metric in PARAMETER_METRICS]
    for values in errors.values():
        assert_array_equal(values, np.zeros(4))


@pytest.mark.parametrize(
    ("parameter", "change", "metric", "expected"),
    [
        ("reverberation_time_s", lambda value: value * 1.07, "t60", 7.0),
        ("early_decay_time_s", lambda value: value - 0.013, "edt", 13.0),
        ("clarity_db", lambda value: value - 1.5, "c50", 1.5),
        ("direct_to_reverberant_db", lambda value: value + 2.5, "drr", 2.5),
        ("interaural_cross_correlation", lambda value: value - 0.2, "iacc", 0.2),
        ("early_interaural_cross_correlation", lambda value: value + 0.1, "iacc_early", 0.1),
        ("level_db", lambda value: value - 3.0, "level", 3.0),
        ("interaural_time_difference_s", lambda value: value - 30e-6, "itd", 30.0),
        ("onset_s", lambda value: value + 0.002, "onset", 2.0),
    ],
)
def test_each_change_shows_in_its_own_metric(parameters, parameter, change, metric, expected) -> None:
    errors = parameter_errors(parameters, replace(parameters, **{parameter: change(getattr(parameters, parameter))}))
    assert_allclose(errors.pop(metric), np.full(4, expected), rtol=1e-9)
    assert all(not values.any() for values in errors.values())


def test_ears_are_averaged_after_the_difference(parameters: RoomParameters) -> None:
    """Opposite errors at the two ears do not cancel."""
    shifted = replace(parameters, clarity_db=parameters.clarity_db + np.array([1.0, -2.0]))
    assert_allclose(parameter_errors(parameters, shifted)["c50"], np.full(4, 1.5))


def test_one_missing_ear_makes_the_entry_missing(parameters: RoomParameters) -> None:
    times = parameters.reverberation_time_s.copy()
    times[2, 1] = np.nan
    holed = replace(parameters, reverberation_time_s=times)
    for errors in (parameter_errors(parameters, holed), parameter_errors(holed, parameters)):
        summary = summarise(errors["t60"])
        assert (summary.count, summary.missing) == (3, 1)


def test_spectral_loss_of_a_gain_is_its_logarithm() -> None:
    spectrogram = np.random.default_rng(0).standard_normal((3, 2, 5, 7))
    assert_allclose(spectral_loss(spectrogram, spectrogram + np.log(2.0)), np.full(3, np.log(2.0)))


def test_spectral_loss_refuses_what_it_cannot_compare() -> None:
    with pytest.raises(ValueError, match="cannot be compared"):
        spectral_loss(np.zeros((2, 5, 7)), np.zeros((2, 5, 8)))
    with pytest.raises(ValueError, match="not finite"):
        spectral_loss(np.zeros((2, 5, 7)), np.full((2, 5, 7), -np.inf))


@given(st.lists(st.one_of(st.floats(0.0, 1e6), st.just(float("nan"))), max_size=50))
def test_summaries_count_every_entry_once(errors: list[float]) -> None:
    summary = summarise(errors)
    assert summary.count + summary.missing == len(errors)
    present = [error for error in errors if not np.isnan(error)]
    if present:
        assert_allclose([summary.mean, summary.median], [np.mean(present), np.median(present)])
    else:
        assert summary.mean is None
        assert summary.median is None
