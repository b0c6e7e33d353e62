"""Limits of a simulation that the command line has too. This module imports nothing, so that it loads quickly."""

FEWEST_RAYS, MOST_RAYS = 100, 2_000_000
"""For each emitter."""
FEWEST_LISTENERS = 8
FEWEST_PROBES, MOST_PROBES = 3, 2_000
"""At least one couple of probes is held out, and two probes make only one couple. If each of the most probes is heard
from every other, these are four million pairs."""
