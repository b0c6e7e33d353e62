"""Options of an import: units and axes of a level's file, and what is taken where nothing is asked for. This module
imports nothing heavy, for the command line."""

from enum import StrEnum

MERGE_WITHIN_M = 0.005
"""How far merging may move a surface: an eighth of the wavelength at 8 kHz."""
SAMPLE_RATE_HZ, RAYS = 24_000, 15_000
"""Of the simulation. Rays are few because places are many: a field evens out what each emitter's rays get wrong."""
PROBES = 200
"""About how many places are simulated. The doors stand otherwise for each, and a field learns what happens between
places and between states of doors from neighbours."""


class Units(StrEnum):
    """The unit of a file's coordinates."""

    M = "m"
    CM = "cm"
    MM = "mm"
    IN = "in"
    FT = "ft"

    @property
    def metres(self) -> float:
        return {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}[self.value]


class Up(StrEnum):
    """The axis of a file that points up."""

    Y = "y"
    Z = "z"


class Handedness(StrEnum):
    """Right-handed: seen from the tip of the third axis, the first turns counter-clockwise to the second."""

    RIGHT = "right"
    LEFT = "left"
