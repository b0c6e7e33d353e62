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
from server.acoustics.geometry import COINCIDENT_M, TOUCH_M, FloorPlan
from server.acoustics.reflections_kernel import CEILING, FLOOR, WALL, find_first_echoes, find_reflections
from server.kernels.compiled import HAS_NUMBA

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

# A lower bound of reflected power, since filters need a finite level.
_LEAST_POWER = 1e-10


class FirstEcho:
    """A lower bound of the path length of the first reflection: the distance from the nearest image source, over all
    surfaces that face both emitter and listener. Safe to share between threads."""

    def __init__(self, plan: FloorPlan) -> None:
        start, end = plan.walls[:, 0], plan.walls[:, 1]
        along = (end - start) / np.linalg.norm(end - start, axis=-1, keepdims=True)
        inward = np.stack([-along[:, 1], along[:, 0], np.zeros(len(along))], axis=-1)
        self._normals = np.concatenate([inward, [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0)]])
        offsets = -np.sum(inward[:, :2] * start, axis=-1)
        self._offsets = np.concatenate([offsets, [-plan.floor_m, plan.height_m]])
        # Compiled here, where it may take its time, and not for the first pose.
        self.length_m(np.zeros((1, 3)), np.zeros((1, 3)))

    def length_m(self, listeners: npt.ArrayLike, emitters: npt.ArrayLike) -> Floats:
        """(n,) lower bounds for pairs of points (n, 3) inside the room."""
        listeners = np.ascontiguousarray(listeners, dtype=np.float64)
        emitters = np.ascontiguousarray(emitters, dtype=np.float64)
        length_m = np.empty(len(listeners))
        find_first_echoes(self._normals, self._offsets, listeners, emitters, length_m)
        return length_m


def mirror_gain_db(absorption: npt.ArrayLike, scattering: npt.ArrayLike) -> Floats:
    """(...) level of the specular reflection, at least -100 dB. `absorption` is the share of energy absorbed, and
    `scattering` the share of the rest that is scattered."""
    mirrored = (1 - np.asarray(absorption, dtype=np.float64)) * (1 - np.asarray(scattering, dtype=np.float64))
    return power_to_db(np.maximum(mirrored, _LEAST_POWER))


@dataclass(frozen=True)
class Reflections:
    """m paths of early reflections, ordered by emitter.

    `emitter` (m,) is the index of the emitter. `arrival` (m, 3) points from the listener along the arriving path,
    `departure` (m, 3) from the emitter along the departing path. `gain_db` (m, band) <= 0 is the gain of the surface,
    on top of 1 / length.
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
        self._plan = plan
        self._gains_db = np.array(gains_db, dtype=np.float64)
        self._corners = np.ascontiguousarray(plan.walls[:, 0])
        # Compiled here, where it may take its time, and not for the first pose.
        self.find(np.zeros(3), np.zeros((1, 3)))

    def find(self, listener: npt.ArrayLike, emitters: npt.ArrayLike) -> Reflections:
        """Paths to `listener` (3,) from `emitters` (n, 3), all inside the room."""
        listener = np.ascontiguousarray(listener, dtype=np.float64)
        emitters = np.ascontiguousarray(emitters, dtype=np.float64)
        if not HAS_NUMBA:
            return self.find_with_numpy(listener, emitters)
        room = len(emitters) * (len(self._corners) + 2)
        emitter, surface = np.empty(room, np.int64), np.empty(room, np.int64)
        length_m, arrival, departure = np.empty(room), np.empty((room, 3)), np.empty((room, 3))
        count = find_reflections(
            self._corners,
            self._plan.height_m,
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

    def find_with_numpy(self, listener: Floats, emitters: Floats) -> Reflections:
        """What `find` does where nothing can be compiled."""
        start, end = self._plan.walls[:, 0], self._plan.walls[:, 1]
        extent = np.linalg.norm(end - start, axis=-1)
        along = (end - start) / extent[:, None]
        inward = np.stack([-along[:, 1], along[:, 0]], axis=-1)

        def of_walls(points: Floats, axes: Floats) -> Floats:
            return np.asarray(np.sum((points[..., None, :2] - start) * axes, axis=-1))

        # (n, wall) or (wall,): how far into the room each end is from a wall, and how far along it.
        l_off, e_off = of_walls(listener, inward), of_walls(emitters, inward)
        between = l_off + e_off
        faces = (l_off >= -TOUCH_M) & (e_off >= -TOUCH_M) & (between >= COINCIDENT_M)
        l_along, e_along = of_walls(listener, along), of_walls(emitters, along)
        at = (l_along * e_off + e_along * l_off) / np.where(faces, between, 1.0)
        mirrors = faces & (at >= 0) & (at < extent)
        row, wall = np.nonzero(mirrors)
        touched = np.concatenate(
            [start[wall] + at[row, wall, None] * along[wall], np.zeros((len(wall), 1))],
            axis=-1,
        )
        reached = self._plan.is_visible(listener, touched) & self._plan.is_visible(emitters[row], touched)
        row, wall = row[reached], wall[reached]
        behind = np.concatenate([2 * inward[wall], np.zeros((len(wall), 1))], axis=-1)
        images = [emitters[row] - e_off[row, wall, None] * behind]
        mirrored_listeners = [listener - l_off[wall, None] * behind]
        rows, surfaces = [row], [np.full(len(row), WALL)]

        seen = np.flatnonzero(self._plan.is_visible(listener, emitters))
        for surface, level_m in ((FLOOR, 0.0), (CEILING, self._plan.height_m)):
            flipped, flipped_listener = emitters[seen], np.tile(listener, (len(seen), 1))
            flipped[:, 2] = 2 * level_m - flipped[:, 2]
            flipped_listener[:, 2] = 2 * level_m - flipped_listener[:, 2]
            apart = np.linalg.norm(flipped - listener, axis=-1) >= COINCIDENT_M
            images.append(flipped[apart])
            mirrored_listeners.append(flipped_listener[apart])
            rows.append(seen[apart])
            surfaces.append(np.full(int(apart.sum()), surface))

        emitter = np.concatenate(rows)
        order = np.argsort(emitter, kind="stable")
        emitter = emitter[order]
        arrival = np.concatenate(images)[order] - listener
        departure = np.concatenate(mirrored_listeners)[order] - emitters[emitter]
        length_m = np.linalg.norm(arrival, axis=-1)
        return Reflections(
            emitter,
            length_m,
            arrival / length_m[:, None],
            departure / length_m[:, None],
            self._gains_db[np.concatenate(surfaces)[order]],
        )
