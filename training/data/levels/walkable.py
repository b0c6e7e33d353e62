"""Where a listener can walk in a level: the ground that is reached from where visits begin and from the emitters, up
and down steps, through all doors. Metres.

The level is sampled on a grid of upright lines. Where a line meets a surface that faces up, with head room above it, is
a spot. Two spots of neighbouring lines are joined if the step between them is low enough and nothing stands between
them, just above such a step and at the height of ears.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from server.acoustics.geometry import Vector3
from server.acoustics.surroundings import MeshSurroundings

_Floats = npt.NDArray[np.float64]
_Integers = npt.NDArray[np.int64]

STEP_M = 0.5
"""The highest step that a listener takes."""
_STEEPEST = math.cos(math.radians(50.0))
"""The least vertical component of the normal of what is walked on."""
_FINEST_M, _MOST_LINES = 0.2, 2_000_000
_OFFSET = 0.4613
"""Where the first line is in its cell of the grid. Lines avoid round numbers, and so the edges of triangles."""
_MOST_LAYERS = 256
_BELOW_M = 1e-4
"""The next surface on a line is looked for so far below the last one."""
_OVER_STEP_M = 0.1
_SPOTS_TRIED = 512


@dataclass(frozen=True)
class Ground:
    """Spots (spot, 3) on which a listener can stand, on the lines (spot, 2) of a grid, each counted from `origin_m` in
    steps of `step_m`."""

    spots: _Floats
    lines: _Integers
    origin_m: _Floats
    step_m: float


def reached_ground(
    surroundings: MeshSurroundings,
    starts: Iterable[Vector3],
    emitters: Iterable[Vector3] = (),
    *,
    ear_m: float,
    head_room_m: float,
) -> Ground:
    """The ground that is reached from the spots below `starts`, and from the largest ground near to each of `emitters`,
    which may stand on a table. Ears are `ear_m` above the ground, and nothing is lower than `head_room_m` above it."""
    ground = _all_ground(surroundings, ear_m, head_room_m)
    if not len(ground.spots):
        return ground
    part = _parts(surroundings, ground, ear_m)
    size = np.bincount(part)
    spots, ears = ground.spots, raised(ground.spots, ear_m)
    reached = np.zeros(len(size), np.bool_)

    def in_sight(place: Vector3, order: _Integers) -> _Integers:
        below = order[spots[order, 2] <= place[2]][:_SPOTS_TRIED]
        return np.asarray(below[surroundings.is_visible(np.asarray(place, dtype=np.float64), ears[below])])

    for start in starts:
        apart = np.sum((spots[:, :2] - start[:2]) ** 2, axis=-1)
        seen = part[in_sight(start, np.lexsort((-spots[:, 2], apart)))]
        reached[seen[:1]] = True
    for emitter in emitters:
        seen = part[in_sight(emitter, np.argsort(np.sum((ears - emitter) ** 2, axis=-1)))]
        if len(seen):
            reached[seen[np.argmax(size[seen])]] = True
    kept = reached[part]
    return Ground(spots[kept], ground.lines[kept], ground.origin_m, ground.step_m)


def raised(points: _Floats, height_m: float) -> _Floats:
    """(..., 3) points so far above."""
    return np.asarray(points + np.array((0.0, 0.0, height_m)))


def _all_ground(surroundings: MeshSurroundings, ear_m: float, head_room_m: float) -> Ground:
    (west, south, _), (east, north, top) = surroundings.bounds_m
    step = max(_FINEST_M, math.sqrt((east - west) * (north - south) / _MOST_LINES))
    origin = np.array((west, south)) + _OFFSET * step
    shape = np.maximum(1, np.ceil((np.array((east, north)) - origin) / step)).astype(np.int64)
    lines = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 2)
    tree, normals = surroundings.tree, surroundings.mesh.normals
    from_m = np.full(len(lines), top + 1.0)
    spots, of_line = [], []
    for _ in range(_MOST_LAYERS):
        if not len(lines):
            break
        origins = np.column_stack([origin + step * lines, from_m])
        down = tree.closest(origins, np.array((0.0, 0.0, -1.0)))
        met = down.triangle >= 0
        lines, from_m = lines[met], from_m[met] - down.distance[met]
        here = np.column_stack([origin + step * lines, from_m])
        level = down.faces[met] & (normals[down.triangle[met], 2] >= _STEEPEST)
        spots.append(here[level])
        of_line.append(lines[level])
        from_m = from_m - _BELOW_M
    found = Ground(np.concatenate(spots), np.concatenate(of_line), origin, step)
    above = tree.closest(raised(found.spots, _BELOW_M), np.array((0.0, 0.0, 1.0)))
    stands = (above.distance >= head_room_m) & surroundings.contains(raised(found.spots, ear_m))
    order = np.lexsort((found.spots[stands, 2], *found.lines[stands].T[::-1]))
    return Ground(found.spots[stands][order], found.lines[stands][order], origin, step)


def _parts(surroundings: MeshSurroundings, ground: Ground, ear_m: float) -> _Integers:
    """(spot,) numbers of the parts of the ground between which nobody walks."""
    width = int(ground.lines[:, 1].max()) + 2
    number = ground.lines[:, 0] * width + ground.lines[:, 1]
    ends = []
    for beside in (1, width):
        first = np.searchsorted(number, number + beside)
        count = np.searchsorted(number, number + beside, side="right") - first
        one = np.repeat(np.arange(len(number)), count)
        other = np.arange(len(one)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first, count)
        low = np.abs(ground.spots[one, 2] - ground.spots[other, 2]) <= STEP_M
        ends.append(np.stack([one[low], other[low]]))
    one, other = np.concatenate(ends, axis=1)
    for height_m in (STEP_M + _OVER_STEP_M, ear_m):
        places = raised(ground.spots, height_m)
        free = surroundings.is_visible(places[one], places[other])
        one, other = one[free], other[free]
    joined = coo_array((np.ones(len(one), np.bool_), (one, other)), shape=(len(number), len(number)))
    return np.asarray(connected_components(joined, directed=False)[1], dtype=np.int64)
