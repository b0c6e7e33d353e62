"""The compiled code of `server.acoustics.reflections`, for one emitter after the other.

Points are (x, y, z) in metres; `corners` is (corner, 2), the polygon of a floor plan. Wall i runs from corner i to the
next, with the room on its left.
"""

import math

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import COINCIDENT_M, TOUCH_M
from server.acoustics.sound_path_kernel import is_visible
from server.kernels.compiled import compiled

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

WALL, FLOOR, CEILING = 0, 1, 2


@compiled
def _aim(vector: Floats, x: float, y: float, z: float, length: float) -> None:
    vector[0], vector[1], vector[2] = x / length, y / length, z / length


@compiled
def find_first_echoes(normals: Floats, offsets: Floats, listeners: Floats, emitters: Floats, length_m: Floats) -> None:
    """Fill `length_m` (n,) for pairs of points (n, 3), from the inward normals (surface, 3) of planes and their
    offsets; see FirstEcho."""
    for row in range(len(listeners)):
        lx, ly, lz = listeners[row, 0], listeners[row, 1], listeners[row, 2]
        ex, ey, ez = emitters[row, 0], emitters[row, 1], emitters[row, 2]
        least = math.inf
        for plane in range(len(offsets)):
            x, y, z = normals[plane, 0], normals[plane, 1], normals[plane, 2]
            from_listener = x * lx + y * ly + z * lz + offsets[plane]
            from_emitter = x * ex + y * ey + z * ez + offsets[plane]
            if from_listener > -TOUCH_M and from_emitter > -TOUCH_M:
                least = min(least, from_listener * from_emitter)
        # The square of the path from the image exceeds that of the straight path by four times the product of both
        # distances from the mirror.
        length_m[row] = math.sqrt(max((ex - lx) ** 2 + (ey - ly) ** 2 + (ez - lz) ** 2 + 4 * least, 0.0))


@compiled
def find_reflections(
    corners: Floats,
    height_m: float,
    listener: Floats,
    emitters: Floats,
    emitter: Integers,
    surface: Integers,
    length_m: Floats,
    arrival: Floats,
    departure: Floats,
) -> int:
    """Fill the first rows of the last five arrays and return the number of reflections; see Reflections. The arrays
    need one row per emitter and surface: walls, floor and ceiling."""
    count = len(corners)
    lx, ly, lz = listener[0], listener[1], listener[2]
    found = 0
    for row in range(len(emitters)):
        ex, ey, ez = emitters[row, 0], emitters[row, 1], emitters[row, 2]
        dx, dy, dz = ex - lx, ey - ly, ez - lz
        for wall in range(count):
            x0, y0 = corners[wall]
            x1, y1 = corners[wall + 1 if wall + 1 < count else 0]
            extent = math.hypot(x1 - x0, y1 - y0)
            ux, uy = (x1 - x0) / extent, (y1 - y0) / extent
            # The distance of listener and emitter from the wall, into the room, and their positions along it.
            l_off, e_off = ux * (ly - y0) - uy * (lx - x0), ux * (ey - y0) - uy * (ex - x0)
            if l_off < -TOUCH_M or e_off < -TOUCH_M or l_off + e_off < COINCIDENT_M:
                continue
            l_along, e_along = ux * (lx - x0) + uy * (ly - y0), ux * (ex - x0) + uy * (ey - y0)
            at = (l_along * e_off + e_along * l_off) / (l_off + e_off)
            if at < 0 or at >= extent:
                continue
            x, y = x0 + at * ux, y0 + at * uy
            if not (is_visible(corners, lx, ly, x, y) and is_visible(corners, ex, ey, x, y)):
                continue
            emitter[found], surface[found] = row, WALL
            length = math.sqrt((e_along - l_along) ** 2 + (l_off + e_off) ** 2 + dz**2)
            length_m[found] = length
            _aim(arrival[found], dx + 2 * e_off * uy, dy - 2 * e_off * ux, dz, length)
            _aim(departure[found], 2 * l_off * uy - dx, -2 * l_off * ux - dy, -dz, length)
            found += 1
        if not is_visible(corners, lx, ly, ex, ey):
            continue
        for level in range(2):
            climb = lz + ez if level == 0 else 2 * height_m - lz - ez
            length = math.sqrt(dx**2 + dy**2 + climb**2)
            if length < COINCIDENT_M:
                continue
            emitter[found], surface[found], length_m[found] = row, FLOOR + level, length
            steep = -climb if level == 0 else climb
            _aim(arrival[found], dx, dy, steep, length)
            _aim(departure[found], -dx, -dy, steep, length)
            found += 1
    return found
