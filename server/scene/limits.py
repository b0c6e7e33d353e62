"""What responses a bundle can hold: worth knowing before one is made. Nothing else is here, so that it costs nothing to
ask."""

LOWEST_RATE_HZ, HIGHEST_RATE_HZ = 8_000, 96_000
FEWEST_SAMPLES, MOST_SAMPLES = 256, 960_000
"""Ten seconds at 96 kHz, forty at 24 kHz."""
