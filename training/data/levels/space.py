"""Which places of a level are joined by air: rooms, what is outside, and the insides of solid things.

Space is sampled at the points of a grid. Two neighbours are joined if no triangle crosses the line between them, so a
closed surface parts them whatever the size of its triangles, and the points of a region sample its volume without bias.
A gap narrower than the grid's step may join two regions or not. Lengths are in metres.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.kernels.compiled import compiled
from server.kernels.copying import doubles

_Floats = npt.NDArray[np.float64]
_Integers = npt.NDArray[np.int64]

OUTSIDE = 0
"""The region that reaches the border of the grid, which lies around the level."""
_MOST_POINTS = 3_000_000
_FINEST_STEP_M = 0.06
_ON_LINE = 1e-9
# The grid begins off the corner of the level by this share of a step, so that its points avoid round numbers.
_OFFSET = 1.3719


@dataclass(frozen=True)
class Space:
    """`region` (x, y, z) is the region of each point, `points` (region,) how many points each has; region 0 is what is
    outside. `seen` (region, 2) counts the crossings of triangles that show a region their front and their back."""

    origin_m: _Floats
    step_m: float
    region: npt.NDArray[np.int32]
    points: _Integers
    seen: _Integers

    @property
    def volumes_m3(self) -> _Floats:
        return np.asarray(self.points * self.step_m**3)

    def regions_at(self, places: npt.ArrayLike) -> _Integers:
        """(n,) the regions of the points nearest to places (n, 3)."""
        index = np.rint((np.asarray(places, dtype=np.float64).reshape(-1, 3) - self.origin_m) / self.step_m)
        inside = ((index >= 0) & (index < self.region.shape)).all(axis=1)
        x, y, z = np.clip(index, 0, np.array(self.region.shape) - 1).astype(np.int64).T
        return np.where(inside, self.region[x, y, z], OUTSIDE)

    def some_places(self, region: int, count: int, rng: np.random.Generator) -> _Floats:
        """(n, 3) up to `count` points of a region at random."""
        flat = np.flatnonzero(self.region.ravel() == region)
        chosen = rng.choice(flat, min(count, len(flat)), replace=False)
        return self.origin_m + self.step_m * np.stack(np.unravel_index(chosen, self.region.shape), axis=1)

    def bounds_m(self, region: int) -> _Floats:
        """(2, 3) the box of a region's points."""
        index = np.argwhere(self.region == region)
        return self.origin_m + self.step_m * np.stack([index.min(axis=0), index.max(axis=0)])

    def sides(self, corners: _Floats, is_air: npt.NDArray[np.bool_]) -> _Integers:
        """(T, 4) crossings of each triangle of `corners` (T, 3, 3) at which air (region,) is only before it, only
        behind it, on both sides, and on neither. Triangles between the grid's lines have none."""
        found = np.zeros((len(corners), 4), np.int64)
        corners = doubles(corners)
        for axis in range(3):
            _count_sides(corners, self.origin_m, self.step_m, self.region, axis, is_air, found)
        return found


def sample_space(corners: _Floats) -> Space:
    """The space around triangles `corners` (T, 3, 3)."""
    corners = doubles(corners)
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    size = high - low
    step = _FINEST_STEP_M
    while np.prod(np.ceil(size / step) + 5) > _MOST_POINTS:
        step *= 1.1
    shape = (np.ceil(size / step) + 4).astype(np.int64)
    origin = low - _OFFSET * step
    links = np.zeros((3, *shape), np.bool_)
    for axis in range(3):
        _block(corners, origin, step, axis, links[axis])
    region = np.full(shape, -1, np.int32)
    points = _flood(links, region)
    seen = np.zeros((len(points), 2), np.int64)
    for axis in range(3):
        _count_seen(corners, origin, step, region, axis, seen)
    return Space(origin, step, region, points, seen)


@compiled
def _lines(corner, origin, step, first, second, shape):
    """The range of the grid's lines along an axis that a triangle's shadow may meet: first, last, first, last."""
    low_a = min(corner[0, first], corner[1, first], corner[2, first])
    high_a = max(corner[0, first], corner[1, first], corner[2, first])
    low_b = min(corner[0, second], corner[1, second], corner[2, second])
    high_b = max(corner[0, second], corner[1, second], corner[2, second])
    return (
        max(0, int(np.ceil((low_a - origin[first]) / step))),
        min(shape[first] - 1, int(np.floor((high_a - origin[first]) / step))),
        max(0, int(np.ceil((low_b - origin[second]) / step))),
        min(shape[second] - 1, int(np.floor((high_b - origin[second]) / step))),
    )


@compiled
def _crossing(corner, a, b, along, first, second):
    """Where the line at (a, b) along an axis crosses a triangle, and twice the area of its shadow, signed; NaN if it
    misses. A line along the common edge of two triangles crosses both."""
    ax, ay = corner[0, first], corner[0, second]
    bx, by = corner[1, first], corner[1, second]
    cx, cy = corner[2, first], corner[2, second]
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    if area == 0.0:
        return np.nan, 0.0
    u = ((bx - a) * (cy - b) - (by - b) * (cx - a)) / area
    v = ((cx - a) * (ay - b) - (cy - b) * (ax - a)) / area
    w = 1.0 - u - v
    if u < -_ON_LINE or v < -_ON_LINE or w < -_ON_LINE:
        return np.nan, area
    return u * corner[0, along] + v * corner[1, along] + w * corner[2, along], area


@compiled
def _block(corners, origin, step, along, blocked):
    """Set the flags of links, between each point and the next along an axis, that a triangle crosses."""
    first, second = (along + 1) % 3, (along + 2) % 3
    shape = blocked.shape
    index = np.zeros(3, np.int64)
    for t in range(len(corners)):
        a0, a1, b0, b1 = _lines(corners[t], origin, step, first, second, shape)
        for i in range(a0, a1 + 1):
            for j in range(b0, b1 + 1):
                at, _ = _crossing(corners[t], origin[first] + i * step, origin[second] + j * step, along, first, second)
                if np.isnan(at):
                    continue
                index[along] = int(np.floor((at - origin[along]) / step))
                index[first], index[second] = i, j
                if 0 <= index[along] < shape[along] - 1:
                    blocked[index[0], index[1], index[2]] = True


@compiled
def _count_seen(corners, origin, step, region, along, seen):
    """Add to `seen` (region, 2) the crossings that show each region a front and a back."""
    first, second = (along + 1) % 3, (along + 2) % 3
    shape = region.shape
    index = np.zeros(3, np.int64)
    for t in range(len(corners)):
        a0, a1, b0, b1 = _lines(corners[t], origin, step, first, second, shape)
        for i in range(a0, a1 + 1):
            for j in range(b0, b1 + 1):
                at, area = _crossing(
                    corners[t], origin[first] + i * step, origin[second] + j * step, along, first, second
                )
                if np.isnan(at):
                    continue
                index[along] = int(np.floor((at - origin[along]) / step))
                index[first], index[second] = i, j
                if not 0 <= index[along] < shape[along] - 1:
                    continue
                below = region[index[0], index[1], index[2]]
                index[along] += 1
                above = region[index[0], index[1], index[2]]
                seen[above, 0 if area > 0 else 1] += 1
                seen[below, 1 if area > 0 else 0] += 1


@compiled
def _count_sides(corners, origin, step, region, along, is_air, found):
    first, second = (along + 1) % 3, (along + 2) % 3
    shape = region.shape
    index = np.zeros(3, np.int64)
    for t in range(len(corners)):
        a0, a1, b0, b1 = _lines(corners[t], origin, step, first, second, shape)
        for i in range(a0, a1 + 1):
            for j in range(b0, b1 + 1):
                at, area = _crossing(
                    corners[t], origin[first] + i * step, origin[second] + j * step, along, first, second
                )
                if np.isnan(at):
                    continue
                index[along] = int(np.floor((at - origin[along]) / step))
                index[first], index[second] = i, j
                if not 0 <= index[along] < shape[along] - 1:
                    continue
                below = is_air[region[index[0], index[1], index[2]]]
                index[along] += 1
                above = is_air[region[index[0], index[1], index[2]]]
                if above == below:
                    found[t, 2 if above else 3] += 1
                else:
                    found[t, 0 if above == (area > 0) else 1] += 1


@compiled
def _flood(links, region):
    """Number the regions in `region` (x, y, z), which is -1 throughout, and return the number of points of each."""
    nx, ny, nz = region.shape
    counts = [np.int64(0)]
    stack = np.empty(nx * ny * nz, np.int64)
    for begin in range(-1, nx * ny * nz):
        if begin >= 0 and region[begin // (ny * nz), begin // nz % ny, begin % nz] >= 0:
            continue
        held, label = 0, 0
        if begin < 0:  # the border is outside, all of it
            for x in range(nx):
                for y in range(ny):
                    for z in range(nz):
                        if x in (0, nx - 1) or y in (0, ny - 1) or z in (0, nz - 1):
                            region[x, y, z] = 0
                            stack[held] = (x * ny + y) * nz + z
                            held += 1
        else:
            label = len(counts)
            counts.append(np.int64(0))
            region[begin // (ny * nz), begin // nz % ny, begin % nz] = label
            stack[0], held = begin, 1
        while held:
            held -= 1
            counts[label] += 1
            x, y, z = stack[held] // (ny * nz), stack[held] // nz % ny, stack[held] % nz
            for axis in range(3):
                for sign in (-1, 1):
                    to_x = x + (sign if axis == 0 else 0)
                    to_y = y + (sign if axis == 1 else 0)
                    to_z = z + (sign if axis == 2 else 0)
                    if not (0 <= to_x < nx and 0 <= to_y < ny and 0 <= to_z < nz) or region[to_x, to_y, to_z] >= 0:
                        continue
                    if links[axis, min(x, to_x), min(y, to_y), min(z, to_z)]:
                        continue
                    region[to_x, to_y, to_z] = label
                    stack[held] = (to_x * ny + to_y) * nz + to_z
                    held += 1
    return np.array(counts)
