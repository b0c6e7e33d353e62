"""Early reflections: sound that is reflected once, by a wall, the floor or the ceiling.

Each path comes from an image source of the emitter behind the surface (Allen & Berkley, JASA 65(4), 1979; for rooms
that are not boxes, Borish, JASA 75(6), 1984). A path appears or vanishes suddenly when a listener or emitter passes the
end of a wall, so the renderer has to fade it.

Points and unit vectors are (..., xyz) in world coordinates, in metres. Bands are OCTAVE_BANDS_HZ. Surfaces are 0 for
any wall, 1 for the floor, 2 for the ceiling.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.acoustics.decibels import power_to_db
from server.acoustics.geometry import FloorPlan
from server.acoustics.reflections_kernel import find_first_echoes, find_reflections
from server.kernels.copying import doubles

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

# A lower bound of reflected power, since filters need a finite level.
_LEAST_POWER = 1e-10


class FirstEcho:
    """A lower bound of the path length of the first reflection: the distance from the nearest image source, over all
    surfaces that face both emitter and listener. `normals` (surface, 3) point from planes of surfaces to where sound is
    mirrored, and `offsets` (surface,) are the distances of the origin from the planes, along the normals. Safe to share
    between threads."""

    def __init__(self, normals: Floats, offsets: Floats) -> None:
        self._normals = np.ascontiguousarray(normals)
        self._offsets = np.ascontiguousarray(offsets)
        # Compile here, so that the first pose need not wait for it.
        self.length_m(np.zeros((1, 3)), np.zeros((1, 3)))

    @classmethod
    def of_plan(cls, plan: FloorPlan) -> "FirstEcho":
        start, end = plan.walls[:, 0], plan.walls[:, 1]
        along = (end - start) / np.linalg.norm(end - start, axis=-1, keepdims=True)
        inward = np.stack([-along[:, 1], along[:, 0], np.zeros(len(along))], axis=-1)
        offsets = -np.sum(inward[:, :2] * start, axis=-1)
        return cls(
            np.concatenate([inward, [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0)]]),
            np.concatenate([offsets, [-plan.floor_m, plan.height_m]]),
        )

    def length_m(self, listeners: npt.ArrayLike, emitters: npt.ArrayLike) -> Floats:
        """(n,) lower bounds of the path length for pairs of points (n, 3) inside the room."""
        listeners, emitters = doubles(listeners), doubles(emitters)
        length_m = np.empty(len(listeners))
        find_first_echoes(self._normals, self._offsets, listeners, emitters, length_m)
        return length_m


def mirror_gain_db(absorption: npt.ArrayLike, scattering: npt.ArrayLike) -> Floats:
    """(...) levels of specular reflections, at least -100 dB. `absorption` is the share of energy absorbed, and
    `scattering` the share of the reflected energy that is scattered."""
    mirrored = (1 - np.asarray(absorption, dtype=np.float64)) * (1 - np.asarray(scattering, dtype=np.float64))
    return power_to_db(np.maximum(mirrored, _LEAST_POWER))


@dataclass(frozen=True)
class Reflections:
    """The m paths of early reflections, ordered by emitter.

    `emitter` (m,) is the index of the emitter. `arrival` (m, 3) points from the listener along the arriving path,
    `departure` (m, 3) from the emitter along the departing path. `gain_db` (m, band) <= 0 is the gain of the surface,
    in addition to 1 / length.
    """

    emitter: Integers
    length_m: Floats
    arrival: Floats
    departure: Floats
    gain_db: Floats


class ReflectionFinder:
    """Finds the early reflections in one floor plan. `gains_db` (surface, band) are the specular gains of walls, floor
    and ceiling. Safe to share between threads."""

    def __init__(self, plan: FloorPlan, gains_db: npt.ArrayLike) -> None:
        self._height_m = plan.height_m
        self._gains_db = np.array(gains_db, dtype=np.float64)
        self._corners = np.ascontiguousarray(plan.walls[:, 0])
        # Compile here, so that the first pose need not wait for it.
        self.find(np.zeros(3), np.zeros((1, 3)))

    def find(self, listener: npt.ArrayLike, emitters: npt.ArrayLike) -> Reflections:
        """Find the reflections at `listener` (3,) from `emitters` (n, 3), all inside the room."""
        listener = np.ascontiguousarray(listener, dtype=np.float64)
        emitters = np.ascontiguousarray(emitters, dtype=np.float64)
        room = len(emitters) * (len(self._corners) + 2)
        emitter, surface = np.empty(room, np.int64), np.empty(room, np.int64)
        length_m, arrival, departure = np.empty(room), np.empty((room, 3)), np.empty((room, 3))
        count = find_reflections(
            self._corners,
            self._height_m,
            listener,
            emitters,
            emitter,
            surface,
            length_m,
            arrival,
            departure,
        )
        return Reflections(
            emitter[:count], length_m[:count], arrival[:count], departure[:count], self._gains_db[surface[:count]]
        )
