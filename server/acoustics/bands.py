"""Octave bands: the frequencies at which materials, directivities and screens are described."""

OCTAVE_BANDS_HZ = (125.0, 250.0, 500.0, 1000.0, 2000.0, 4000.0, 8000.0)
