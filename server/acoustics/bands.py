"""Octave bands, in which materials, directivities and diffraction are described."""

import math

OCTAVE_BANDS_HZ = (125.0, 250.0, 500.0, 1000.0, 2000.0, 4000.0, 8000.0)


def bands_within(sample_rate: float) -> int:
    """Number of OCTAVE_BANDS_HZ that begin below half the sample rate. Higher bands hold no sound."""
    return sum(centre_hz / math.sqrt(2) < sample_rate / 2 for centre_hz in OCTAVE_BANDS_HZ)
