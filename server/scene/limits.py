"""Limits of the responses in a bundle, and the sample rates of streams. This module imports nothing, so that it loads
quickly."""

LOWEST_RATE_HZ, HIGHEST_RATE_HZ = 8_000, 96_000
STREAM_RATES_HZ = (44_100, 48_000, 96_000)
"""The sample rates at which any scene can be streamed, besides its own."""
FEWEST_SAMPLES, MOST_SAMPLES = 256, 960_000
"""Length of a response. The longest lasts ten seconds at 96 kHz, or forty at 24 kHz."""
