"""Limits of a simulation that the command line has too. This module imports nothing, so that it loads quickly."""

FEWEST_RAYS, MOST_RAYS = 100, 2_000_000
"""For each emitter."""
FEWEST_LISTENERS = 8
