"""Exact specular reflections: image sources in a floor plan with a height, each tested for visibility from every
receiver.

Walls are vertical, floor and ceiling level, so a specular path is an independent combination of a path in plan and one
in height (Borish, "Extension of the image model to arbitrary polyhedra", JASA 75(6), 1984, in two dimensions; Allen &
Berkley, JASA 65(4), 1979, in one). Metres.
"""

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import FloorPlan
from server.kernels.compiled import compiled

_Floats = npt.NDArray[np.float64]
_Counts = npt.NDArray[np.int64]

# A path that misses the end of a wall by less than this still hits the wall.
_GRAZING = 1e-9
_SAME_PLACE_DIGITS = 6


def images_in_height(z: float, height_m: float, order: int) -> tuple[_Floats, _Counts]:
    """(image,) heights of an emitter at `z` and its images of up to `order` reflections, and (image, surface) the
    number of reflections from the floor and from the ceiling."""
    heights, counts = [z], [(0, 0)]
    for reflections in range(1, order + 1):
        for first_is_ceiling in (False, True):
            mirrored, of_ceiling = z, first_is_ceiling
            for _ in range(reflections):
                mirrored = 2 * height_m * of_ceiling - mirrored
                of_ceiling = not of_ceiling
            more, fewer = (reflections + 1) // 2, reflections // 2
            heights.append(mirrored)
            counts.append((fewer, more) if first_is_ceiling else (more, fewer))
    return np.array(heights), np.array(counts)


def images_in_plan(
    plan: FloorPlan, emitter: _Floats, receivers: _Floats, order: int
) -> tuple[_Counts, _Floats, _Counts]:
    """The images of an emitter (2,) that each receiver (receiver, 2) sees, including the emitter itself: (path,)
    receivers, (path, 2) image positions, and (path,) numbers of reflecting walls. A path that touches a corner is
    valid."""
    corners = np.asarray(plan.corners, dtype=np.float64)
    paths = _see(corners, emitter.astype(np.float64), np.ascontiguousarray(receivers, dtype=np.float64), order)
    # A path through a corner is found twice, once for each of the corner's walls.
    _, once = np.unique(np.column_stack(paths[:2]).round(_SAME_PLACE_DIGITS), axis=0, return_index=True)
    once.sort()
    return paths[0][once], paths[1][once], paths[2][once]


@compiled
def _is_blocked(corners, ax, ay, bx, by, first, second):
    """Whether a wall stands between a and b. The walls `first` and `second`, on which a and b lie, are left out (-1 for
    none)."""
    for wall in range(len(corners)):
        if wall in (first, second):
            continue
        cx, cy = corners[wall, 0], corners[wall, 1]
        following = (wall + 1) % len(corners)
        ex, ey = corners[following, 0] - cx, corners[following, 1] - cy
        a_side, b_side = ex * (ay - cy) - ey * (ax - cx), ex * (by - cy) - ey * (bx - cx)
        if a_side * b_side >= 0.0:
            continue
        dx, dy = bx - ax, by - ay
        start, end = dx * (cy - ay) - dy * (cx - ax), dx * (cy + ey - ay) - dy * (cx + ex - ax)
        if start * end < 0.0:
            return True
    return False


@compiled
def _is_seen(corners, walls, images, depth, receiver):
    """Whether the path of the image in `walls[:depth]` reaches the receiver. `images[k]` is the emitter mirrored in the
    first k walls."""
    x, y, last = receiver[0], receiver[1], -1
    for level in range(depth, 0, -1):
        wall = walls[level - 1]
        cx, cy = corners[wall, 0], corners[wall, 1]
        following = (wall + 1) % len(corners)
        ex, ey = corners[following, 0] - cx, corners[following, 1] - cy
        dx, dy = images[level, 0] - x, images[level, 1] - y
        through = dx * ey - dy * ex
        if through <= 0.0:
            return False
        along = ((cx - x) * dy - (cy - y) * dx) / through
        share = ((cx - x) * ey - (cy - y) * ex) / through
        if along < -_GRAZING or along > 1.0 + _GRAZING or share < -_GRAZING or share > 1.0:
            return False
        hit_x, hit_y = cx + along * ex, cy + along * ey
        if _is_blocked(corners, x, y, hit_x, hit_y, last, wall):
            return False
        x, y, last = hit_x, hit_y, wall
    return not _is_blocked(corners, x, y, images[0, 0], images[0, 1], last, -1)


@compiled
def _see(corners, emitter, receivers, order):
    count = len(corners)
    walls = np.full(order + 1, -1)
    images = np.empty((order + 1, 2))
    images[0] = emitter
    capacity = 64 * len(receivers) + 64
    seen_by, seen, reflections = np.empty(capacity, np.int64), np.empty((capacity, 2)), np.empty(capacity, np.int64)
    found, depth = 0, 0
    while True:
        for receiver in range(len(receivers)):
            if _is_seen(corners, walls, images, depth, receivers[receiver]):
                if found == capacity:
                    capacity *= 2
                    seen_by = np.concatenate((seen_by, np.empty_like(seen_by)))
                    seen = np.concatenate((seen, np.empty_like(seen)))
                    reflections = np.concatenate((reflections, np.empty_like(reflections)))
                seen_by[found], seen[found], reflections[found] = receiver, images[depth], depth
                found += 1
        # The next sequence of walls has one wall more, or another last wall.
        if depth < order:
            depth += 1
            walls[depth - 1] = -1
        while depth > 0:
            wall = walls[depth - 1] + 1
            while wall < count:
                # An image is mirrored only in walls that face it.
                cx, cy = corners[wall, 0], corners[wall, 1]
                following = (wall + 1) % count
                ex, ey = corners[following, 0] - cx, corners[following, 1] - cy
                x, y = images[depth - 1, 0], images[depth - 1, 1]
                before = ex * (y - cy) - ey * (x - cx)
                if before > 0.0:
                    away = 2 * before / (ex * ex + ey * ey)
                    images[depth, 0], images[depth, 1] = x + away * ey, y - away * ex
                    break
                wall += 1
            walls[depth - 1] = wall
            if wall < count:
                break
            depth -= 1
        if depth == 0:
            break
    return seen_by[:found], seen[:found], reflections[:found]
