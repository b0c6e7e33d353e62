import numpy as np
import pytest

from server.acoustics.audibility import THRESHOLDS, in_jnd
from server.acoustics.metrics import PARAMETER_METRICS, parameter_errors
from server.acoustics.room_parameters import measure

RATE = 24_000


def decaying(t60_s: float, gain: float = 1.0, seed: int = 0) -> np.ndarray:
    time = np.arange(RATE) / RATE
    noise = np.random.default_rng(seed).standard_normal((2, RATE))
    return gain * noise * 10 ** (-3 * time / t60_s)


def test_every_threshold_is_of_a_metric_and_says_where_it_is_from() -> None:
    names = {metric.name for metric in PARAMETER_METRICS}
    assert set(THRESHOLDS) <= names
    assert all(threshold.amount > 0 and threshold.source for threshold in THRESHOLDS.values())


@pytest.mark.parametrize("t60_s", [0.3, 0.6])
def test_one_jnd_is_a_decay_longer_by_a_twentieth(t60_s) -> None:
    reference, estimate = measure(decaying(t60_s), RATE), measure(decaying(1.05 * t60_s), RATE)
    audible = in_jnd(parameter_errors(reference, estimate), reference)
    assert audible["t60"] == pytest.approx(1, abs=0.1)
    assert audible["edt"] == pytest.approx(1, abs=0.15)


def test_one_jnd_of_level_is_a_decibel() -> None:
    reference, estimate = measure(decaying(0.4), RATE), measure(decaying(0.4, gain=10 ** (1 / 20)), RATE)
    assert in_jnd(parameter_errors(reference, estimate), reference)["level"] == pytest.approx(1, abs=1e-6)


def test_what_cannot_be_measured_stays_missing() -> None:
    reference = measure(decaying(0.4), RATE)
    errors = {"t60": np.array(np.nan), "onset": np.array(1.0)}
    audible = in_jnd(errors, reference)
    assert list(audible) == ["t60"]
    assert np.isnan(audible["t60"])
