"""The path of the first sound from each emitter to a listener: straight if visible, otherwise round what stands between
them.

In a floor plan walls run from floor to ceiling, so a path bends in plan and rises evenly along its length. Paths in
triangle meshes are found by `server.acoustics.mesh_paths`. Points and unit vectors are (..., xyz) in world axes, in
metres; bands are OCTAVE_BANDS_HZ.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.geometry import FloorPlan
from server.acoustics.sound_path_kernel import describe_paths, find_sound_paths
from server.kernels.copying import doubles

Float32 = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class SoundPaths:
    """The shortest paths of n emitters. Every number is finite, and changes without jumps as the poses move.

    `length_m` (n,); `excess_m` (n,), the length beyond the straight line, 0 if visible. `arrival` (n, 3) points from
    the listener along the end of the path, `departure` (n, 3) from the emitter along its beginning; both are arbitrary
    if the two points coincide. `screen_db` (n, band) <= 0 is the gain of the walls' edges, in addition to 1 / length.
    """

    length_m: Floats
    arrival: Floats
    departure: Floats
    excess_m: Floats
    in_sight: Flags
    screen_db: Floats

    @classmethod
    def empty(cls, count: int) -> "SoundPaths":
        """Allocate uninitialised arrays for `count` emitters, which `SoundPathFinder.find` fills."""
        return cls(
            np.empty(count),
            np.empty((count, 3)),
            np.empty((count, 3)),
            np.empty(count),
            np.empty(count, dtype=np.bool_),
            np.empty((count, len(OCTAVE_BANDS_HZ))),
        )


DESCRIPTION = 6
"""How many numbers describe a path."""


@dataclass(frozen=True)
class DescribedPaths:
    """The shortest paths of B pairs of listener and emitter, as a field needs them.

    `length_m` (B,). `described` (B, DESCRIPTION): that length; sight, which is 1 where the two see each other and falls
    to 0 behind a corner; and two unit vectors in plan, in which the path leaves the listener and the emitter.
    """

    length_m: Floats
    described: Float32


class SoundPathFinder(Protocol):
    """Finds the shortest paths in one place; safe to share between threads."""

    def find(self, listener: npt.ArrayLike, emitters: npt.ArrayLike, into: SoundPaths | None = None) -> SoundPaths:
        """Find the paths to `listener` (3,) from `emitters` (n, 3). They are written to `into`, which must have n rows,
        if it is given."""

    def describe(self, listeners: npt.ArrayLike, emitters: npt.ArrayLike) -> DescribedPaths:
        """Describe the paths to listeners (B, 3) from emitters (B, 3), by pairs."""


class PlanPathFinder:
    """Finds the shortest paths in one floor plan; safe to share between threads."""

    def __init__(self, plan: FloorPlan, speed_of_sound: float) -> None:
        self._wavelengths_m = speed_of_sound / np.asarray(OCTAVE_BANDS_HZ, dtype=np.float64)
        self._corners = np.ascontiguousarray(plan.walls[:, 0])
        self._bends = np.ascontiguousarray(plan.bend_corners)
        self._bend_lengths_m = np.ascontiguousarray(plan.bend_lengths_m)
        # Compile here, where it may take long, and not on the audio thread at the first pose.
        self.find(np.zeros(3), np.zeros((1, 3)))
        self.describe(np.zeros((1, 3)), np.zeros((1, 3)))

    def find(self, listener: npt.ArrayLike, emitters: npt.ArrayLike, into: SoundPaths | None = None) -> SoundPaths:
        """Find the paths to `listener` (3,) from `emitters` (n, 3), all inside the room. They are written to `into`,
        which must have n rows, if it is given.

        From a point outside the room, which no path reaches, sound travels straight through the walls.
        """
        listener = doubles(listener)
        emitters = doubles(emitters)
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

    def describe(self, listeners: npt.ArrayLike, emitters: npt.ArrayLike) -> DescribedPaths:
        """Describe the paths to listeners (B, 3) from emitters (B, 3), by pairs."""
        listeners = doubles(listeners)
        emitters = doubles(emitters)
        paths = DescribedPaths(np.empty(len(listeners)), np.empty((len(listeners), DESCRIPTION), np.float32))
        describe_paths(
            self._corners,
            self._bends,
            self._bend_lengths_m,
            listeners,
            emitters,
            paths.length_m,
            paths.described,
        )
        return paths
