"""What a triangle mesh looks like from above: its floors, and cuts at a height.

A floor is the surfaces that face up at one height, if they are large enough; the tops of tables are none. Metres.
"""

import numpy as np
import numpy.typing as npt

from server.acoustics.mesh import TriangleMesh

_Floats = npt.NDArray[np.float64]

_UPRIGHT = 0.9
"""The least vertical component of a floor's normal."""
SAME_FLOOR_M = 0.1
"""From the lowest to the highest surface of a floor."""
_STEP_M = 0.01
_LEAST_M2, _LEAST_SHARE = 1.0, 0.2
"""The least area of a floor, and its least share of the largest one's."""
_APART_M = 1e-6
"""A cut at the height of vertices is made so far above them."""
_SHORTEST_M = 1e-3


def floors_of(mesh: TriangleMesh) -> list[float]:
    """Heights of the floors, from below. Ramps and stairs that join floors are none, unless they have as much area
    within SAME_FLOOR_M as a floor has."""
    level = mesh.normals[:, 2] > _UPRIGHT
    heights, areas = mesh.corners_m[level, :, 2].mean(axis=-1), mesh.areas_m2[level]
    # In steps, so that the work is bounded by the heights and not by the triangles.
    steps, step_of = np.unique(np.rint(heights / _STEP_M), return_inverse=True)
    ends = np.searchsorted(steps, steps + round(SAME_FLOOR_M / _STEP_M), side="right")
    left = np.bincount(step_of, weights=areas, minlength=len(steps))
    floors: list[float] = []
    least = _LEAST_M2
    while len(steps):
        sums = np.concatenate([[0.0], np.cumsum(left)])
        sizes = sums[ends] - sums[:-1]
        begin = int(np.argmax(sizes))
        if sizes[begin] < least:
            break
        if not floors:
            least = max(_LEAST_M2, _LEAST_SHARE * float(sizes[begin]))
        own = (step_of >= begin) & (step_of < ends[begin]) & (left[step_of] > 0)
        floors.append(float(np.average(heights[own], weights=areas[own])))
        left[begin : ends[begin]] = 0.0
    return sorted(floors)


def section(mesh: TriangleMesh, height_m: float) -> _Floats:
    """(n, end, xy) the lines in which a horizontal plane cuts the mesh, without any shorter than a millimetre."""
    heights = mesh.corners_m[..., 2] - height_m
    heights = np.where(np.abs(heights) < _APART_M, -_APART_M, heights)
    above = heights > 0
    cut = np.flatnonzero(above.any(axis=1) & ~above.all(axis=1))
    corners, heights, above = mesh.corners_m[cut], heights[cut], above[cut]
    # Two sides leave the corner that is alone on its side of the plane.
    lone = np.argmax(above != (above.sum(axis=1) == 2)[:, None], axis=1)
    rows, ends = np.arange(len(cut)), []
    for step in (1, 2):
        other = (lone + step) % 3
        share = heights[rows, lone] / (heights[rows, lone] - heights[rows, other])
        ends.append(corners[rows, lone] + share[:, None] * (corners[rows, other] - corners[rows, lone]))
    lines: _Floats = np.stack(ends, axis=1)[..., :2]
    are_long = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=-1) >= _SHORTEST_M
    return np.asarray(lines[are_long])
