"""First reflections in NumPy, for all emitters and surfaces at once."""

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import COINCIDENT_M, TOUCH_M, FloorPlan
from server.acoustics.reflections import Reflections
from server.acoustics.reflections_kernel import CEILING, FLOOR, WALL

Floats = npt.NDArray[np.float64]


class NumpyReflectionFinder:
    """See `server.acoustics.reflections.ReflectionFinder`."""

    def __init__(self, plan: FloorPlan, gains_db: npt.ArrayLike) -> None:
        self._plan = plan
        self._gains_db = np.array(gains_db, dtype=np.float64)

    def find(self, listener: npt.ArrayLike, emitters: npt.ArrayLike) -> Reflections:
        listener, emitters = np.asarray(listener, np.float64), np.asarray(emitters, np.float64)
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
