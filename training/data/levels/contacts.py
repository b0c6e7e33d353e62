"""Triangles that meet where they should not: crossing each other, or lying on each other; and open edges that lie on
other triangles after all.

Candidates come from a grid of cells. The work is bounded: beyond so many pairs the rest is not looked at, and the
result says so. Lengths are in metres.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.kernels.compiled import compiled
from training.data.levels.vectors import dot

_Floats = npt.NDArray[np.float64]
_Integers = npt.NDArray[np.int64]

TOUCH_M = 1e-3
"""Surfaces closer than this touch: they do not cross each other, and an edge there is no opening."""
MOST_PAIRS = 100_000_000
_MOST_ENTRIES = 30_000_000
_PARALLEL = 1e-4
_MOST_CELLS = 4_000_000


@dataclass(frozen=True)
class Cells:
    """Which triangles reach into which cell: those of cell c are `held[starts[c]:starts[c + 1]]`."""

    origin_m: _Floats
    size_m: float
    shape: tuple[int, int, int]
    starts: _Integers
    held: npt.NDArray[np.int32]


@dataclass(frozen=True)
class Contacts:
    """(n, 2) pairs of triangles that cross each other, and that lie on each other. `is_whole` is false if there were
    too many candidates to try all."""

    crossing: _Integers
    lying: _Integers
    is_whole: bool


def cells_of(corners: _Floats) -> Cells:
    """Cells about as large as the triangles `corners` (T, 3, 3), and fewer than memory allows."""
    low, high = corners.min(axis=1) - TOUCH_M, corners.max(axis=1) + TOUCH_M
    origin, extent = low.min(axis=0), high.max(axis=0) - low.min(axis=0)
    size = max(float(np.median(np.linalg.norm(high - low, axis=1))), 10 * TOUCH_M)
    while True:
        reach = np.floor((high - origin) / size) - np.floor((low - origin) / size) + 1
        shape = np.floor(extent / size) + 1
        if reach.prod(axis=1).sum() <= _MOST_ENTRIES and shape.prod() <= _MOST_CELLS:
            break
        size *= 1.5
    x, y, z = (int(each) for each in shape)
    starts, held = _fill(low, high, origin, size, (x, y, z))
    return Cells(origin, size, (x, y, z), starts, held)


def find_contacts(corners: _Floats, triangles: _Integers, cells: Cells) -> Contacts:
    """The contacts of triangles `corners` (T, 3, 3), whose vertices are `triangles` (T, 3). Those that share an edge do
    not cross, and those that share a vertex may meet there."""
    low, high = corners.min(axis=1), corners.max(axis=1)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    triangles = np.ascontiguousarray(triangles)
    pairs, kinds, is_whole = _meet(
        corners, low, high, normals, triangles, cells.origin_m, cells.size_m, cells.shape, cells.starts, cells.held,
        MOST_PAIRS,
    )  # fmt: skip
    return Contacts(pairs[kinds == 1], pairs[kinds == 2], bool(is_whole))


def lies_on_others(places: _Floats, own: _Integers, corners: _Floats, cells: Cells) -> npt.NDArray[np.bool_]:
    """(n,) whether each place (n, 3) is within TOUCH_M of a triangle other than its `own` (n,)."""
    return np.asarray(
        _covered(places, own, corners, cells.origin_m, cells.size_m, cells.shape, cells.starts, cells.held)
    )


@compiled
def _fill(low, high, origin, size, shape):
    counts = np.zeros(shape[0] * shape[1] * shape[2] + 1, np.int64)
    held = np.empty(0, np.int32)
    for is_second in range(2):
        for t in range(len(low)):
            x0, x1 = int((low[t, 0] - origin[0]) / size), int((high[t, 0] - origin[0]) / size)
            y0, y1 = int((low[t, 1] - origin[1]) / size), int((high[t, 1] - origin[1]) / size)
            z0, z1 = int((low[t, 2] - origin[2]) / size), int((high[t, 2] - origin[2]) / size)
            for x in range(x0, min(x1, shape[0] - 1) + 1):
                for y in range(y0, min(y1, shape[1] - 1) + 1):
                    for z in range(z0, min(z1, shape[2] - 1) + 1):
                        cell = (x * shape[1] + y) * shape[2] + z
                        if is_second:
                            counts[cell] -= 1
                            held[counts[cell]] = t
                        else:
                            counts[cell] += 1
        if not is_second:
            counts = np.cumsum(counts)  # ends of cells, which become their starts as they fill
            held = np.empty(counts[-1], np.int32)
    return counts, held


@compiled
def _meet(corners, low, high, normals, triangles, origin, size, shape, starts, held, most):
    """Pairs (n, 2), their kinds (1 crossing, 2 lying on each other), and whether all were tried."""
    pairs = [(np.int64(0), np.int64(0))]
    kinds = [0]
    tried = 0
    for cell in range(len(starts) - 1):
        cx, cy, cz = cell // (shape[1] * shape[2]), cell // shape[2] % shape[1], cell % shape[2]
        for i in range(starts[cell], starts[cell + 1]):
            for j in range(starts[cell], i):
                s, t = held[i], held[j]
                tried += 1
                if tried > most:
                    return np.array(pairs)[1:], np.array(kinds)[1:], False
                apart = False
                for axis in range(3):
                    if low[s, axis] > high[t, axis] or low[t, axis] > high[s, axis]:
                        apart = True
                if apart:
                    continue
                # A pair that meets in several cells is judged in the one where both begin.
                if (
                    int((max(low[s, 0], low[t, 0]) - origin[0]) / size) != cx
                    or int((max(low[s, 1], low[t, 1]) - origin[1]) / size) != cy
                    or int((max(low[s, 2], low[t, 2]) - origin[2]) / size) != cz
                ):
                    continue
                kind = _kind(corners[s], corners[t], normals[s], normals[t], triangles[s], triangles[t])
                if kind:
                    pairs.append((np.int64(min(s, t)), np.int64(max(s, t))))
                    kinds.append(kind)
    return np.array(pairs)[1:], np.array(kinds)[1:], True


@compiled
def _kind(one, two, normal_one, normal_two, vertices_one, vertices_two):
    shared = 0
    for i in range(3):
        for j in range(3):
            if vertices_one[i] == vertices_two[j]:
                shared += 1
    distance = np.empty(3)
    farthest = 0.0
    for j in range(3):
        distance[j] = dot(two[j] - one[0], normal_one)
        farthest = max(farthest, abs(distance[j]))
    if farthest < TOUCH_M:
        return 2 if abs(dot(normal_one, normal_two)) > 1 - _PARALLEL and _overlap(one, two, normal_one) else 0
    if shared >= 2:
        return 0
    for j in range(3):
        k = (j + 1) % 3
        if _pierces(two[j], two[k], one, normal_one) or _pierces(one[j], one[k], two, normal_two):
            return 1
    return 0


@compiled
def _pierces(p, q, corner, normal):
    """Whether the line from p to q goes through the inside of a triangle, by more than a touch on either side."""
    before, behind = dot(p - corner[0], normal), dot(q - corner[0], normal)
    if before * behind >= 0 or min(abs(before), abs(behind)) < TOUCH_M:
        return False
    at = p + (q - p) * (before / (before - behind))
    for i in range(3):
        side = corner[(i + 1) % 3] - corner[i]
        length = np.sqrt(dot(side, side))
        if dot(np.cross(side, at - corner[i]), normal) < TOUCH_M * length:
            return False
    return True


@compiled
def _overlap(one, two, normal):
    """Whether two triangles of one plane overlap by more than a touch: no side of either parts them."""
    for which in range(2):
        own, other = (one, two) if which == 0 else (two, one)
        for i in range(3):
            side = own[(i + 1) % 3] - own[i]
            out = np.cross(side, normal)
            out = out / np.sqrt(dot(out, out))
            nearest = np.inf
            reach = -np.inf
            for j in range(3):
                nearest = min(nearest, dot(other[j] - own[i], out))
                reach = max(reach, dot(own[j] - own[i], out))
            farthest = -np.inf
            lowest = np.inf
            for j in range(3):
                farthest = max(farthest, dot(other[j] - own[i], out))
                lowest = min(lowest, dot(own[j] - own[i], out))
            if nearest > reach - TOUCH_M or lowest > farthest - TOUCH_M:
                return False
    return True


@compiled
def _covered(places, own, corners, origin, size, shape, starts, held):
    found = np.zeros(len(places), np.bool_)
    for n in range(len(places)):
        x = min(shape[0] - 1, max(0, int((places[n, 0] - origin[0]) / size)))
        y = min(shape[1] - 1, max(0, int((places[n, 1] - origin[1]) / size)))
        z = min(shape[2] - 1, max(0, int((places[n, 2] - origin[2]) / size)))
        cell = (x * shape[1] + y) * shape[2] + z
        for i in range(starts[cell], starts[cell + 1]):
            if held[i] != own[n] and _distance(places[n], corners[held[i]]) < TOUCH_M:
                found[n] = True
                break
    return found


@compiled
def _distance(p, corner):
    """The distance from a point to a triangle: to its plane if the point stands over it, else to its nearest side."""
    normal = np.cross(corner[1] - corner[0], corner[2] - corner[0])
    length = np.sqrt(dot(normal, normal))
    stands_over = length > 0
    nearest = np.inf
    for i in range(3):
        side = corner[(i + 1) % 3] - corner[i]
        offset = p - corner[i]
        if dot(np.cross(side, offset), normal) < 0:
            stands_over = False
        square = dot(side, side)
        share = min(1.0, max(0.0, dot(offset, side) / square)) if square > 0 else 0.0
        apart = offset - share * side
        nearest = min(nearest, np.sqrt(dot(apart, apart)))
    return abs(dot(p - corner[0], normal)) / length if stands_over else nearest
