"""Rays that leave a level: straight lines from its rooms that meet no triangle. Lengths are in metres."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.kernels.compiled import compiled
from training.data.levels.contacts import cells_of
from training.data.levels.vectors import dot

_Floats = npt.NDArray[np.float64]

_RAYS = 500
_MOST_KEPT = 400
_OUTSIDE_SHARE = 0.5
_STRAY = 1e-9
"""A ray that passes the side of a triangle by less than this share of the triangle meets it."""


@dataclass(frozen=True)
class Escape:
    """`left` of `rays` met nothing. `starts` (n, 3) and `ends` (n, 3) are of some of those: where they began, and where
    they left the box around the level."""

    rays: int
    left: int
    starts: _Floats
    ends: _Floats

    @property
    def share(self) -> float:
        return self.left / self.rays if self.rays else 0.0


def escaping(corners: _Floats, origins: _Floats, leaves: Sequence[_Floats], rng: np.random.Generator) -> Escape:
    """Send rays from each of `origins` (n, 3) in directions that cover the sphere evenly, turned at random for each.
    Origins from which more than half leave are outside, and do not count unless all are.

    Triangles are `corners` (T, 3, 3) and those of the shut doors' leaves.
    """
    everything = np.concatenate([corners, *leaves], dtype=np.float64)
    cells = cells_of(everything)
    directions = _sphere(_RAYS)
    starts = np.repeat(origins, _RAYS, axis=0)
    along = np.concatenate([directions @ _turn(rng).T for _ in origins]) if len(origins) else np.zeros((0, 3))
    missed, reach = _march(
        starts, along, everything, cells.origin_m, cells.size_m, cells.shape, cells.starts, cells.held
    )
    # Where more than half of all directions are free, one stands outside, as in a gap that was taken for a room.
    share = missed.reshape(-1, _RAYS).mean(axis=1)
    inside = np.repeat(share <= _OUTSIDE_SHARE, _RAYS)
    if inside.any():
        starts, along, missed, reach = starts[inside], along[inside], missed[inside], reach[inside]
    which = np.flatnonzero(missed)
    some = which[rng.permutation(len(which))[:_MOST_KEPT]]
    return Escape(len(along), len(which), starts[some], starts[some] + reach[some, None] * along[some])


def _sphere(count: int) -> _Floats:
    """(count, 3) unit vectors on a Fibonacci spiral."""
    up = 1 - (2 * np.arange(count) + 1) / count
    around = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    flat = np.sqrt(1 - up**2)
    return np.stack([flat * np.cos(around), flat * np.sin(around), up], axis=1)


def _turn(rng: np.random.Generator) -> _Floats:
    """A rotation (3, 3) at random."""
    turn, upper = np.linalg.qr(rng.normal(size=(3, 3)))
    return np.asarray(turn * np.sign(np.diag(upper)))


@compiled
def _march(starts, along, corners, origin, size, shape, cell_starts, held):
    """(n,) whether each ray meets nothing, and (n,) how far it goes within the cells. Steps from cell to cell
    (Amanatides & Woo, "A fast voxel traversal algorithm for ray tracing", Eurographics 1987)."""
    missed = np.zeros(len(starts), np.bool_)
    reach = np.zeros(len(starts))
    at, step = np.zeros(3, np.int64), np.zeros(3, np.int64)
    until, each = np.zeros(3), np.zeros(3)
    for n in range(len(starts)):
        for axis in range(3):
            at[axis] = int(np.floor((starts[n, axis] - origin[axis]) / size))
            step[axis] = 1 if along[n, axis] > 0 else -1
            each[axis] = size / abs(along[n, axis]) if along[n, axis] != 0 else np.inf
            border = origin[axis] + size * (at[axis] + (1 if along[n, axis] > 0 else 0))
            until[axis] = (border - starts[n, axis]) / along[n, axis] if along[n, axis] != 0 else np.inf
        met = False
        gone = 0.0
        while 0 <= at[0] < shape[0] and 0 <= at[1] < shape[1] and 0 <= at[2] < shape[2]:
            cell = (at[0] * shape[1] + at[1]) * shape[2] + at[2]
            for i in range(cell_starts[cell], cell_starts[cell + 1]):
                if _meets(starts[n], along[n], corners[held[i]]):
                    met = True
                    break
            if met:
                break
            axis = int(np.argmin(until))
            gone = until[axis]
            at[axis] += step[axis]
            until[axis] += each[axis]
        missed[n] = not met
        reach[n] = gone
    return missed, reach


@compiled
def _meets(start, along, corner):
    """Whether a ray meets a triangle, from either side (Möller & Trumbore, 1997)."""
    one, two = corner[1] - corner[0], corner[2] - corner[0]
    across = np.cross(along, two)
    determinant = dot(one, across)
    if determinant == 0.0:
        return False
    offset = start - corner[0]
    u = dot(offset, across) / determinant
    if u < -_STRAY or u > 1 + _STRAY:
        return False
    beside = np.cross(offset, one)
    v = dot(along, beside) / determinant
    if v < -_STRAY or u + v > 1 + _STRAY:
        return False
    return dot(two, beside) / determinant > 0
