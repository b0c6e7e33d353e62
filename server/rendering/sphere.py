"""Directions on the sphere: interpolation between measured directions, and the share of the sphere nearest to each.

A direction d in the triangle with corners v is d = w0 v0 + w1 v1 + w2 v2 with all w positive; the weight of each corner
is its share of w0 + w1 + w2. The weights are continuous over the whole sphere, and at a corner only this corner counts.

Directions are unit vectors in the head's frame: x ahead, y left, z up.
"""

from itertools import product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from server.core.errors import NafirError
from server.kernels.compiled import compiled_in_place

_Floats = npt.NDArray[np.float64]

_WIDEST_GAP = np.radians(30)
_SAME_CONE = np.radians(10)
_SAME_SIDE = np.radians(60)
_SPHERE_POINTS = 20_000
CUBE_CELLS = 8
"""Cells along an edge of the cube of `cube_cell`."""


class CoverageError(NafirError):
    """The measured directions cannot be triangulated to cover the whole sphere."""


class Triangulation(NamedTuple):
    triangles: npt.NDArray[np.int64]
    """(t, 3) the corners of each triangle, as indices of directions."""
    across: npt.NDArray[np.int64]
    """(t, 3) the triangle on the other side of the edge opposite each corner."""
    inverses: _Floats
    """(t, 3, 3) matrices that convert a direction to its weights w."""


@compiled_in_place
def cube_cell(direction: _Floats) -> int:
    """The number of the cell of a cube around the head through which `direction` (3,) leaves: CUBE_CELLS**2 squares on
    each face, which are the faces ahead, behind, left, right, above and below."""
    axis = 0
    for other in range(1, 3):
        if abs(direction[other]) > abs(direction[axis]):
            axis = other
    reach = abs(direction[axis])
    # What is no direction leaves through some cell too.
    half = 0.5 * CUBE_CELLS / reach if reach > 0.0 else 0.0
    row = max(0, min(CUBE_CELLS - 1, int(half * direction[(axis + 1) % 3] + 0.5 * CUBE_CELLS)))
    column = max(0, min(CUBE_CELLS - 1, int(half * direction[(axis + 2) % 3] + 0.5 * CUBE_CELLS)))
    face = 2 * axis + (1 if direction[axis] < 0.0 else 0)
    return (face * CUBE_CELLS + row) * CUBE_CELLS + column


@compiled_in_place
def find_triangle(
    across: npt.NDArray[np.int64],
    inverses: _Floats,
    direction: _Floats,
    start: int,
    weights: _Floats,
) -> int:
    """Find the triangle that contains `direction` (3,), and write the weights (3,) of its corners, which sum to one.

    The search walks from `start`, each time across the edge that the direction is furthest beyond. In a triangulation
    of a convex hull such a walk arrives. Its length is limited all the same, and the weights are made positive, so that
    rounding cannot trap it.
    """
    triangle = start
    for _ in range(across.shape[0]):
        least = 0
        for corner in range(3):
            weights[corner] = (
                inverses[triangle, corner, 0] * direction[0]
                + inverses[triangle, corner, 1] * direction[1]
                + inverses[triangle, corner, 2] * direction[2]
            )
            if weights[corner] < weights[least]:
                least = corner
        if weights[least] >= -1e-9:
            break
        triangle = across[triangle, least]
    total = 0.0
    for corner in range(3):
        weights[corner] = max(weights[corner], 0.0)
        total += weights[corner]
    if not total > 0.0:
        weights[:] = 1.0
        total = 3.0
    for corner in range(3):
        weights[corner] /= total
    return triangle


def fill_gaps(measured: _Floats) -> tuple[_Floats, _Floats]:
    """(d + gap, 3) directions without wide gaps, and (gap, d) the weight of each measured direction for each added one.

    The response from a gap, such as below KEMAR, is about the response from elsewhere on the same cone around the axis
    of the ears: it has the same delay and nearly the same level difference.
    """
    lattice = np.array([corner for corner in product((0, 1, -1), repeat=3) if any(corner)], dtype=np.float64)
    lattice /= np.linalg.norm(lattice, axis=-1, keepdims=True)
    # The axes come first: most files have their gap straight down.
    lattice = lattice[np.argsort(-np.abs(lattice).max(axis=-1), kind="stable")]
    directions = measured
    shares = []
    side = np.arcsin(np.clip(measured[:, 1], -1, 1))
    for candidate in lattice:
        if (directions @ candidate).max() >= np.cos(_WIDEST_GAP):
            continue
        off_cone = (side - np.arcsin(candidate[1])) / _SAME_CONE
        away = np.arccos(np.clip(measured @ candidate, -1, 1)) / _SAME_SIDE
        distance = off_cone**2 + away**2
        share = np.exp(distance.min() - distance)
        shares.append(share / share.sum())
        directions = np.concatenate([directions, candidate[None]])
    return directions, np.array(shares).reshape(len(shares), len(measured))


def triangulate(directions: _Floats) -> Triangulation:
    """Triangulate the sphere. Raises CoverageError if some direction has no triangle, or a measured one no corner."""
    from scipy.spatial import ConvexHull, QhullError  # takes a tenth of a second, and a prepared head does not need it

    try:
        hull = ConvexHull(directions)
    except QhullError as exc:
        raise CoverageError("the directions do not surround the head") from exc
    triangles = hull.simplices.astype(np.int64)
    across = hull.neighbors.astype(np.int64)
    corners = directions[triangles]
    surrounded = hull.equations[:, 3].max() < -1e-3
    if not surrounded or len(hull.vertices) != len(directions) or np.abs(np.linalg.det(corners)).min() < 1e-9:
        raise CoverageError("the directions do not surround the head")
    inverses = np.ascontiguousarray(np.linalg.inv(np.swapaxes(corners, 1, 2)))
    return Triangulation(triangles, across, inverses)


def triangles_by_cell(directions: _Floats, triangles: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """(cell,) a triangle near the middle of each cell of `cube_cell`: a search for a direction that leaves through it
    is a step or two long from there."""
    middles = directions[triangles].sum(axis=1)
    middles /= np.linalg.norm(middles, axis=-1, keepdims=True)
    near = []
    across = (2 * np.arange(CUBE_CELLS) + 1) / CUBE_CELLS - 1
    for axis, sign in product(range(3), (1.0, -1.0)):
        cells = np.empty((CUBE_CELLS, CUBE_CELLS, 3))
        cells[..., axis], cells[..., (axis + 1) % 3], cells[..., (axis + 2) % 3] = sign, across[:, None], across
        near.append(np.argmax(cells.reshape(-1, 3) @ middles.T, axis=-1))
    return np.concatenate(near)


def solid_angles(directions: _Floats) -> _Floats:
    """(direction,) share of the sphere that is nearest to each direction; measured grids are denser at the poles."""
    from scipy.spatial import cKDTree  # takes a tenth of a second

    index = np.arange(_SPHERE_POINTS) + 0.5
    height = 1 - 2 * index / _SPHERE_POINTS
    azimuth = np.pi * (1 + np.sqrt(5)) * index
    ring = np.sqrt(1 - height**2)
    sphere = np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), height], axis=-1)  # a Fibonacci lattice
    _, nearest = cKDTree(directions).query(sphere)
    return np.bincount(nearest, minlength=len(directions)) / _SPHERE_POINTS
