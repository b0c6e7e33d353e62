"""The node of a lattice that stands for a pair of places, in compiled code or, without a compiler, in Python.

`corners` is (corner, 2), the polygon of a floor plan; `low`, `high` and `offset` (3,) metres.
"""

import math

import numpy as np
import numpy.typing as npt

from server.acoustics.sound_path_kernel import contains, is_visible
from server.compiled import compiled

Floats = npt.NDArray[np.float64]
Coordinates = tuple[float, float, float, float, float, float]

_HALVINGS = 5


@compiled
def _nearest(at: float, low: float, high: float, offset: float, spacing: float) -> float:
    """Along one axis: the middle of the cell that `at` is in, or, where that is out of bounds, of the next one."""
    step = (high - low) / max(1, math.ceil((high - low) / spacing - 1e-9))
    origin = low + offset
    middle = origin + (math.floor((at - origin) / step) + 0.5) * step
    if middle < low:
        middle += step
    elif middle > high:
        middle -= step
    return middle


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
) -> tuple[bool, Coordinates]:
    """Whether listener and emitter see each other, and the places of listener and emitter in the node for them.

    Each sees its place in the node, and those see each other if and only if these do. Where the cells of the lattice
    hold no such node, those of half the size are asked, and so on; in the end, they are their own node.
    """
    in_sight = is_visible(corners, lx, ly, ex, ey)
    for _ in range(_HALVINGS + 1):
        nlx = _nearest(lx, low[0], high[0], offset[0], spacing)
        nly = _nearest(ly, low[1], high[1], offset[1], spacing)
        nex = _nearest(ex, low[0], high[0], offset[0], spacing)
        ney = _nearest(ey, low[1], high[1], offset[1], spacing)
        if (
            contains(corners, nlx, nly)
            and contains(corners, nex, ney)
            and is_visible(corners, lx, ly, nlx, nly)
            and is_visible(corners, ex, ey, nex, ney)
            and is_visible(corners, nlx, nly, nex, ney) == in_sight
        ):
            nlz = _nearest(lz, low[2], high[2], offset[2], spacing)
            nez = _nearest(ez, low[2], high[2], offset[2], spacing)
            return in_sight, (nlx, nly, nlz, nex, ney, nez)
        spacing /= 2
    return in_sight, (lx, ly, lz, ex, ey, ez)
