"""The compiled code of `server.acoustics.sound_path`, for one emitter after the other.

Points are scalars (x, y in plan, metres); `corners` is (corner, 2), the polygon of a floor plan.
"""

import math

import numpy as np
import numpy.typing as npt

from server.acoustics.diffraction import diffraction_gain_db
from server.acoustics.geometry import COINCIDENT_M, TOUCH_M
from server.kernels.compiled import compiled

Float32 = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Numbers = npt.NDArray[np.int64]

PENUMBRA_M = 0.05
"""Sight has fallen to 1 / e where the path round a corner is this much longer in plan than the straight line: half a
wavelength at 3 kHz. Reflected sound does not change at once where the line of sight breaks, so predicted levels must
not jump there."""
SOFTENED_M = 1e-4
"""Directions in plan are divided by lengths that are longer by this, so that they turn without a jump where two places
coincide in plan."""


@compiled
def contains(corners: Floats, x: float, y: float) -> bool:
    """Compute `FloorPlan.contains` for one point in plan."""
    inside = False
    x0, y0 = corners[-1]
    for x1, y1 in corners:
        if (y0 > y) != (y1 > y) and x < x0 + (y - y0) * (x1 - x0) / (y1 - y0):
            inside = not inside
        x0, y0 = x1, y1
    if inside:
        return True
    for x1, y1 in corners:
        along_x, along_y = x1 - x0, y1 - y0
        share = ((x - x0) * along_x + (y - y0) * along_y) / (along_x**2 + along_y**2)
        share = min(1.0, max(0.0, share))
        if math.hypot(x - x0 - share * along_x, y - y0 - share * along_y) < TOUCH_M:
            return True
        x0, y0 = x1, y1
    return False


@compiled
def is_visible(corners: Floats, px: float, py: float, qx: float, qy: float) -> bool:
    """Compute `FloorPlan.is_visible` for one pair of points."""
    ray_x, ray_y = qx - px, qy - py
    x0, y0 = corners[-1]
    start = ray_x * (y0 - py) - ray_y * (x0 - px)
    for x1, y1 in corners:
        end = ray_x * (y1 - py) - ray_y * (x1 - px)
        if start * end < -TOUCH_M:
            wall_x, wall_y = x1 - x0, y1 - y0
            p_side = wall_x * (py - y0) - wall_y * (px - x0)
            q_side = wall_x * (qy - y0) - wall_y * (qx - x0)
            if p_side * q_side < -TOUCH_M:
                return False
        x0, y0, start = x1, y1, end
    return contains(corners, (px + qx) / 2, (py + qy) / 2)


@compiled
def _clearance_m(bends: Floats, from_listener: Floats, listener: Floats, emitter: Floats) -> float:
    """How much longer the path over the nearest corner is than the straight line, for a visible emitter.

    The difference is divided by the cosine of the turn at the corner. The cosine is almost 1 where the line grazes the
    corner. If the path would turn by a right angle or more, the corner is beside the line and screens nothing; its
    result is infinite. The result has no jump when the nearest corner changes. It is enough to test which corners the
    listener sees: a wall that hides a corner from the emitter lies in the triangle of the three points, so it has a
    nearer corner that both see.
    """
    plan = math.hypot(emitter[0] - listener[0], emitter[1] - listener[1])
    rise = emitter[2] - listener[2]
    straight = math.hypot(plan, rise)
    clearance = np.inf
    for bend in range(len(bends)):
        to_listener = from_listener[bend]
        x, y = bends[bend]
        to_emitter = math.hypot(emitter[0] - x, emitter[1] - y)
        if to_listener == np.inf or to_emitter < COINCIDENT_M:
            continue
        ahead = -((listener[0] - x) * (emitter[0] - x) + (listener[1] - y) * (emitter[1] - y))
        if ahead <= 0:
            continue
        detour = math.hypot(to_listener + to_emitter, rise) - straight
        clearance = min(clearance, max(0.0, detour) * to_listener * to_emitter / ahead)
    return clearance


@compiled
def _reach_bends(
    corners: Floats,
    bends: Floats,
    bend_lengths_m: Floats,
    listener: Floats,
    from_listener: Floats,
    to_bend: Floats,
    first: Numbers,
) -> None:
    """Fill the last three arrays, one value for each of the corners `bends` (bend, 2). All lengths are in plan, metres.

    `from_listener` is the straight distance; it is infinite for a corner that the listener does not see or stands at.
    `to_bend` is the length of the shortest path, which may bend at other corners on the way, and is infinite without
    one. `first` is the number of the first corner of that path. `bend_lengths_m` (bend, bend) are the lengths of the
    shortest paths between corners.
    """
    count = len(bends)
    for bend in range(count):
        x, y = bends[bend]
        from_listener[bend], to_bend[bend], first[bend] = np.inf, np.inf, 0
        distance = math.hypot(x - listener[0], y - listener[1])
        if distance >= COINCIDENT_M and is_visible(corners, listener[0], listener[1], x, y):
            from_listener[bend] = distance
    for bend in range(count):
        for via in range(count):
            length = from_listener[via] + bend_lengths_m[via, bend]
            if length < to_bend[bend]:
                to_bend[bend], first[bend] = length, via


@compiled
def _way_around(
    corners: Floats, bends: Floats, to_bend: Floats, listener: Floats, emitter: Floats
) -> tuple[float, int]:
    """The length in plan of the path round corners, and the last of them; infinity and -1 if the emitter is seen, or if
    no path leads to it."""
    count = len(bends)
    around, last = np.inf, -1
    if count == 0 or is_visible(corners, listener[0], listener[1], emitter[0], emitter[1]):
        return around, last
    for bend in range(count):
        x, y = bends[bend]
        distance = math.hypot(x - emitter[0], y - emitter[1])
        if (
            distance >= COINCIDENT_M
            and to_bend[bend] + distance < around
            and is_visible(corners, emitter[0], emitter[1], x, y)
        ):
            around, last = to_bend[bend] + distance, bend
    return around, last


@compiled
def find_sound_paths(
    corners: Floats,
    bends: Floats,
    bend_lengths_m: Floats,
    wavelengths_m: Floats,
    listener: Floats,
    emitters: Floats,
    length_m: Floats,
    arrival: Floats,
    departure: Floats,
    excess_m: Floats,
    in_sight: Flags,
    screen_db: Floats,
) -> None:
    """Fill the last six arrays, one row per emitter; see SoundPaths."""
    count = len(bends)
    from_listener, to_bend = np.empty(count), np.empty(count)
    first = np.empty(count, np.int64)
    _reach_bends(corners, bends, bend_lengths_m, listener, from_listener, to_bend, first)
    for row in range(len(emitters)):
        emitter = emitters[row]
        rise = emitter[2] - listener[2]
        plan = math.hypot(emitter[0] - listener[0], emitter[1] - listener[1])
        straight = math.hypot(plan, rise)
        around, last = _way_around(corners, bends, to_bend, listener, emitter)
        in_sight[row] = last < 0
        if last < 0:
            length_m[row], excess_m[row] = straight, 0.0
            if straight < COINCIDENT_M:
                arrival[row, 0], arrival[row, 1], arrival[row, 2] = 1.0, 0.0, 0.0
            else:
                for axis in range(3):
                    arrival[row, axis] = (emitter[axis] - listener[axis]) / straight
            for axis in range(3):
                departure[row, axis] = -arrival[row, axis]
            detour = -_clearance_m(bends, from_listener, listener, emitter)
        else:
            length = math.hypot(around, rise)
            length_m[row], excess_m[row] = length, max(0.0, length - straight)
            level, near = around / length, first[last]
            for axis in range(2):
                arrival[row, axis] = level * (bends[near, axis] - listener[axis]) / from_listener[near]
                departure[row, axis] = level * (bends[last, axis] - emitter[axis]) / (around - to_bend[last])
            arrival[row, 2], departure[row, 2] = rise / length, -rise / length
            detour = excess_m[row]
        for band in range(len(wavelengths_m)):
            screen_db[row, band] = diffraction_gain_db(2 * detour / wavelengths_m[band])


@compiled
def describe_paths(
    corners: Floats,
    bends: Floats,
    bend_lengths_m: Floats,
    listeners: Floats,
    emitters: Floats,
    length_m: Floats,
    described: Float32,
) -> None:
    """Fill the last two arrays, one row for each listener and its emitter; see DescribedPaths."""
    count = len(bends)
    from_listener, to_bend = np.empty(count), np.empty(count)
    first = np.empty(count, np.int64)
    for row in range(len(emitters)):
        listener, emitter = listeners[row], emitters[row]
        if row == 0 or _is_elsewhere(listener, listeners[row - 1]):
            _reach_bends(corners, bends, bend_lengths_m, listener, from_listener, to_bend, first)
        around, last = _way_around(corners, bends, to_bend, listener, emitter)
        plan = math.hypot(emitter[0] - listener[0], emitter[1] - listener[1])
        after, before, level, sight = emitter, listener, plan, 1.0
        if last >= 0:
            after, before, level = bends[first[last]], bends[last], around
            sight = math.exp(min(0.0, plan - around) / PENUMBRA_M)
        length_m[row] = math.hypot(level, emitter[2] - listener[2])
        described[row, 0], described[row, 1] = length_m[row], sight
        _point(listener, after, described[row, 2:4])
        _point(emitter, before, described[row, 4:6])


@compiled
def _is_elsewhere(one: Floats, other: Floats) -> bool:
    """Whether two points differ in plan."""
    return bool(one[0] != other[0] or one[1] != other[1])


@compiled
def _point(start: Floats, end: Floats, direction: Float32) -> None:
    """Write the unit vector in plan from `start` to `end`. Where these are closer than about a millimetre, it is
    shorter than one, down to zero where they coincide."""
    x, y = end[0] - start[0], end[1] - start[1]
    scale = 1.0 / (math.hypot(x, y) + SOFTENED_M)
    direction[0], direction[1] = x * scale, y * scale
