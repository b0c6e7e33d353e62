"""The way the first sound takes from each emitter to a listener: straight in sight, else round the walls' corners.

Walls run from floor to ceiling, so a path bends in plan and rises evenly along its length. Points and unit vectors are
(..., xyz) of the world in metres; bands are OCTAVE_BANDS_HZ.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.geometry import FloorPlan
from server.acoustics.sound_path_kernel import find_sound_paths

Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class SoundPaths:
    """The shortest paths of n emitters; every number is finite, and follows the poses without jumps.

    `length_m` (n,); `excess_m` (n,) what it is longer than the straight line, 0 in sight. `arrival` (n, 3) points from
    the listener along the end of the path, `departure` (n, 3) from the emitter along its beginning; any direction where
    the two are one point. `screen_db` (n, band) <= 0 is the gain of the walls' edges, on top of 1 / length.
    """

    length_m: Floats
    arrival: Floats
    departure: Floats
    excess_m: Floats
    in_sight: Flags
    screen_db: Floats

    @classmethod
    def empty(cls, count: int) -> "SoundPaths":
        """To be filled."""
        return cls(
            np.empty(count),
            np.empty((count, 3)),
            np.empty((count, 3)),
            np.empty(count),
            np.empty(count, dtype=np.bool_),
            np.empty((count, len(OCTAVE_BANDS_HZ))),
        )


class SoundPathFinder:
    """Finds the shortest paths through one floor plan; safe to share between threads."""

    def __init__(self, plan: FloorPlan, speed_of_sound: float) -> None:
        self._wavelengths_m = speed_of_sound / np.asarray(OCTAVE_BANDS_HZ, dtype=np.float64)
        self._corners = np.ascontiguousarray(plan.walls[:, 0])
        self._bends = np.ascontiguousarray(plan.bend_corners)
        self._bend_lengths_m = np.ascontiguousarray(plan.bend_lengths_m)
        # Compiled here, where it may take its time, and not on the audio thread at the first pose.
        self.find(np.zeros(3), np.zeros((1, 3)))

    def find(self, listener: npt.ArrayLike, emitters: npt.ArrayLike, into: SoundPaths | None = None) -> SoundPaths:
        """Paths to `listener` (3,) from `emitters` (n, 3), all inside the room; put `into` as many, where given.

        From a point that is not, where nothing leads, sound goes straight through the walls.
        """
        listener = np.ascontiguousarray(listener, dtype=np.float64)
        emitters = np.ascontiguousarray(emitters, dtype=np.float64)
        paths = SoundPaths.empty(len(emitters)) if into is None else into
        find_sound_paths(
            self._corners,
            self._bends,
            self._bend_lengths_m,
            self._wavelengths_m,
            listener,
            emitters,
            paths.length_m,
            paths.arrival,
            paths.departure,
            paths.excess_m,
            paths.in_sight,
            paths.screen_db,
        )
        return paths
