import numpy as np
import pytest

from server.acoustics.decibels import amplitude_to_db
from server.rendering.fractional_delay import BEFORE, PHASES, TAPS, sinc_table


@pytest.mark.parametrize(("of_nyquist", "limit_db"), [(0.5, -100), (0.8, -90)])
def test_a_tone_is_read_between_samples(of_nyquist, limit_db):
    """At every phase and half-way between phases, where the interpolation of the table is worst."""
    table = sinc_table().astype(float)
    frequency = np.linspace(0, of_nyquist * np.pi, 100)
    offset = np.arange(TAPS) - BEFORE
    for share in (0.0, 0.5):
        taps = table[:, :TAPS] + share * table[:, TAPS:]
        fraction = (np.arange(PHASES) + share) / PHASES
        error = taps @ np.exp(1j * np.outer(offset, frequency)) - np.exp(1j * np.outer(fraction, frequency))
        assert amplitude_to_db(np.abs(error).max()) < limit_db


def test_the_last_phase_leads_to_the_next_sample():
    table = sinc_table()
    np.testing.assert_allclose(table[-1, :TAPS] + table[-1, TAPS:], np.eye(TAPS)[BEFORE + 1], atol=1e-6)
    np.testing.assert_allclose(table[0, :TAPS], np.eye(TAPS)[BEFORE], atol=1e-6)
