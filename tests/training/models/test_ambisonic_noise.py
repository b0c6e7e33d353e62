"""Optimised amplitudes have the power of signs and fit into their file; the optimisation lessens its errors."""

import numpy as np
import pytest

from server.field.ambisonic_noise import AMPLITUDE_STEP, AMPLITUDES_FILE, LOW_HZ, NOISES, UNIT_S
from training.models import ambisonic_noise


def test_stored_amplitudes_have_the_power_of_signs_and_fit_into_the_file():
    stored = np.load(AMPLITUDES_FILE)
    assert stored.dtype == np.int8
    assert stored.shape[1:] == (NOISES, round(2 * LOW_HZ[-1] * UNIT_S))
    amplitudes = stored * AMPLITUDE_STEP
    assert np.abs(amplitudes).max() < 3.6
    assert np.mean(amplitudes**2) == pytest.approx(1, abs=0.35)


def test_the_error_falls(monkeypatch, caplog):
    monkeypatch.setattr(ambisonic_noise, "_UNITS", 4)
    monkeypatch.setattr(ambisonic_noise, "_KEPT_UNITS", 3)
    with caplog.at_level("INFO", logger=ambisonic_noise.__name__):
        found = ambisonic_noise.optimise(iterations=25)
    assert found.shape == (3, NOISES, round(2 * LOW_HZ[-1] * UNIT_S))
    errors = [float(record.getMessage()) for record in caplog.records]
    assert min(errors) < 0.5 * errors[0]
