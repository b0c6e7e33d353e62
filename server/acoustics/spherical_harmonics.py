"""Real spherical harmonics up to the third order, in the conventions of AmbiX: ACN order, SN3D norm (Nachbar, Zotter,
Deleflie and Sontacchi, "AmbiX - a suggested ambisonics format", Ambisonics Symposium 2011).

Directions are unit vectors (x ahead, y left, z up). Axes: k harmonics, (order + 1)**2 of them; the first is 1
everywhere, the next three are y, z and x.
"""

from collections.abc import Sequence
from functools import cache

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import axes_of

_Floats = npt.NDArray[np.float64]

HIGHEST_ORDER = 3
_SAMPLED = 24
_COORDINATES = (1, 2, 0)
"""Of the harmonics of the first degree: y, z, x."""


def harmonic_count(order: int) -> int:
    """The number of harmonics up to an order. Raises ValueError for an order that is not 0 to HIGHEST_ORDER."""
    if not 0 <= order <= HIGHEST_ORDER:
        raise ValueError(f"order: is {order}, must be 0 to {HIGHEST_ORDER}")
    return (order + 1) ** 2


def degrees(order: int) -> npt.NDArray[np.int64]:
    """(k,) the degree n of each harmonic, which occurs 2 n + 1 times."""
    harmonic_count(order)
    return np.repeat(np.arange(order + 1), 2 * np.arange(order + 1) + 1)


def real_harmonics(directions: npt.ArrayLike, order: int) -> _Floats:
    """(..., k) harmonics of unit vectors (..., 3). Raises ValueError for an order that is not 0 to HIGHEST_ORDER."""
    count = harmonic_count(order)
    x, y, z = np.moveaxis(np.asarray(directions, dtype=np.float64), -1, 0)
    harmonics = [np.ones_like(x)]
    if order >= 1:
        harmonics += [y, z, x]
    if order >= 2:
        root = np.sqrt(3.0)
        harmonics += [
            root * x * y,
            root * y * z,
            0.5 * (3 * z * z - 1),
            root * x * z,
            0.5 * root * (x * x - y * y),
        ]
    if order >= 3:
        outer, inner, middle = np.sqrt(5 / 8), np.sqrt(3 / 8), np.sqrt(15.0)
        harmonics += [
            outer * y * (3 * x * x - y * y),
            middle * x * y * z,
            inner * y * (5 * z * z - 1),
            0.5 * z * (5 * z * z - 3),
            inner * x * (5 * z * z - 1),
            0.5 * middle * z * (x * x - y * y),
            outer * x * (x * x - 3 * y * y),
        ]
    return np.stack(harmonics[:count], axis=-1)


def mean_squares(order: int) -> _Floats:
    """(k,) the mean of each squared harmonic over the sphere: 1 / (2 n + 1)."""
    return np.asarray(1 / (2 * degrees(order) + 1), dtype=np.float64)


def rotation(orientation: Sequence[float] | npt.NDArray[np.floating], order: int) -> _Floats:
    """(k, k) the matrix from harmonics of directions in world axes to harmonics of the same directions in the axes of a
    head with this orientation (x, y, z, w).

    The harmonics of the first degree are coordinates, and turn as they do. A rotation turns harmonics of one degree
    into each other: so for higher orders their values at a few directions, before and after the rotation, determine the
    matrix.
    """
    if order == 1:  # a stream turns a head so many times a second
        turned = np.eye(4)
        turned[1:, 1:] = axes_of(orientation)[np.ix_(_COORDINATES, _COORDINATES)]
        return turned
    directions, inverse, is_apart = _sampled(order)
    matrix = (inverse @ real_harmonics(directions @ axes_of(orientation).T, order)).T
    matrix[is_apart] = 0
    return matrix


def even_directions(count: int) -> _Floats:
    """(count, 3) directions that are nearly evenly spread over the sphere: a Fibonacci spiral (Swinbank and Purser,
    Q. J. R. Meteorol. Soc. 132, 1769, 2006)."""
    z = 1 - (2 * np.arange(count) + 1) / count
    azimuth = np.arange(count) * np.pi * (3 - np.sqrt(5))
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], axis=-1)


@cache
def _sampled(order: int) -> tuple[_Floats, _Floats, npt.NDArray[np.bool_]]:
    """Directions (direction, 3), the matrix (k, direction) from a function's values there to its coefficients, and (k,
    k) which harmonics are of different degrees."""
    directions, n = even_directions(_SAMPLED), degrees(order)
    inverse = np.asarray(np.linalg.pinv(real_harmonics(directions, order)), dtype=np.float64)
    return directions, inverse, np.not_equal.outer(n, n)
