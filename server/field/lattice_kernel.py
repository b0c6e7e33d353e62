"""The node of a lattice that represents a pair of positions, in compiled code.

`corners` is (corner, 2), the polygon of a floor plan; `low`, `high` and `offset` (3,) metres.
"""

import math

import numpy as np
import numpy.typing as npt

from server.acoustics.sound_path_kernel import contains, is_visible
from server.kernels.compiled import compiled

Floats = npt.NDArray[np.float64]
Coordinates = tuple[float, float, float, float, float, float]

_HALVINGS = 5
_SLACK_M = 1e-3
"""Safety margin of distances that are reported as certain, for rounding errors."""
_ON_A_WALL_M = 1e-5
"""So close to a wall, rounding decides what is visible through it."""


@compiled
def _nearest(at: float, low: float, high: float, offset: float, spacing: float) -> tuple[float, float]:
    """Find the cell along one axis: the middle of the cell that contains `at` (of the next cell, if that middle is out
    of bounds), and the distance from `at` to the nearer end of the cell."""
    step = (high - low) / max(1, math.ceil((high - low) / spacing - 1e-9))
    origin = low + offset
    cell = math.floor((at - origin) / step)
    into = at - origin - cell * step
    middle = origin + (cell + 0.5) * step
    if middle < low:
        middle += step
    elif middle > high:
        middle -= step
    return middle, min(into, step - into)


@compiled
def _distance(px: float, py: float, ax: float, ay: float, bx: float, by: float) -> float:
    """Distance of point p from the line segment between a and b."""
    along_x, along_y = bx - ax, by - ay
    squared = along_x**2 + along_y**2
    share = 0.0
    if squared > 0:
        share = min(1.0, max(0.0, ((px - ax) * along_x + (py - ay) * along_y) / squared))
    return math.hypot(px - ax - share * along_x, py - ay - share * along_y)


@compiled
def _from_walls(corners: Floats, px: float, py: float) -> float:
    least = math.inf
    x0, y0 = corners[-1]
    for x1, y1 in corners:
        least = min(least, _distance(px, py, x0, y0, x1, y1))
        x0, y0 = x1, y1
    return least


@compiled
def _clearance(corners: Floats, px: float, py: float, qx: float, qy: float) -> float:
    """How far p may move without the end of a wall coming between p and q: within this distance q's view of p stays the
    same, as long as p passes through no wall. Each wall end casts a shadow straight away from q; the result is the
    distance to the nearest edge of a shadow."""
    least = math.inf
    for x, y in corners:
        away_x, away_y = x - qx, y - qy
        squared = away_x**2 + away_y**2
        along = 0.0
        if squared > 0:
            along = max(0.0, ((px - x) * away_x + (py - y) * away_y) / squared)
        least = min(least, math.hypot(px - x - along * away_x, py - y - along * away_y))
    return least if _from_walls(corners, qx, qy) > _ON_A_WALL_M else 0.0


@compiled
def find_node(
    corners: Floats,
    low: Floats,
    high: Floats,
    offset: Floats,
    spacing: float,
    lx: float,
    ly: float,
    lz: float,
    ex: float,
    ey: float,
    ez: float,
    looks_about: bool,
) -> tuple[bool, Coordinates, float]:
    """Whether listener and emitter see each other; their positions in the node that represents them; and how far the
    listener may move while both certainly stay the same (0 unless `looks_about`).

    Listener and emitter each see their position in the node, and these two see each other if and only if listener and
    emitter do. If there is no such node among the cells of the lattice, cells of half the size are tried, and so on; in
    the end, the positions are their own node.
    """
    in_sight = is_visible(corners, lx, ly, ex, ey)
    certain = 0.0
    if looks_about:
        certain = min(_from_walls(corners, lx, ly), _clearance(corners, lx, ly, ex, ey))
    for _ in range(_HALVINGS + 1):
        nlx, end_x = _nearest(lx, low[0], high[0], offset[0], spacing)
        nly, end_y = _nearest(ly, low[1], high[1], offset[1], spacing)
        nex, _ = _nearest(ex, low[0], high[0], offset[0], spacing)
        ney, _ = _nearest(ey, low[1], high[1], offset[1], spacing)
        certain = min(certain, end_x, end_y)
        if contains(corners, nlx, nly) and contains(corners, nex, ney):
            if certain > _SLACK_M:
                certain = min(certain, _clearance(corners, lx, ly, nlx, nly))
            if (
                is_visible(corners, lx, ly, nlx, nly)
                and is_visible(corners, ex, ey, nex, ney)
                and is_visible(corners, nlx, nly, nex, ney) == in_sight
            ):
                nlz, end_z = _nearest(lz, low[2], high[2], offset[2], spacing)
                nez, _ = _nearest(ez, low[2], high[2], offset[2], spacing)
                return in_sight, (nlx, nly, nlz, nex, ney, nez), max(0.0, min(certain, end_z) - _SLACK_M)
        spacing /= 2
    return in_sight, (lx, ly, lz, ex, ey, ez), 0.0
