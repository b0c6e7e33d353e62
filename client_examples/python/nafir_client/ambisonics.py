"""Ambisonic blocks turned with a head and heard by two ears.

Channels are in ACN order with SN3D norm, in the axes of the scene (x east, y north, z up). Those of a head are x ahead,
y left, z up.
"""

import math

import numpy as np
import numpy.typing as npt

from nafir_client.pose import FORWARD, Orientation
from nafir_client.wire import Samples

Matrix = npt.NDArray[np.float64]
_SAMPLED = np.random.default_rng(0).standard_normal((64, 3))
_SAMPLED /= np.linalg.norm(_SAMPLED, axis=1, keepdims=True)


def harmonics(directions: Matrix, order: int) -> Matrix:
    """(n, (order + 1)**2) gains of the channels for plane waves from unit vectors (n, 3), up to order 3."""
    x, y, z = directions.T
    r, s, t, u = math.sqrt(3), math.sqrt(5 / 8), math.sqrt(3 / 8), math.sqrt(15)
    first = [np.ones_like(x), y, z, x]
    second = [r * x * y, r * y * z, (3 * z * z - 1) / 2, r * x * z, r * (x * x - y * y) / 2]
    third = [
        s * y * (3 * x * x - y * y),
        u * x * y * z,
        t * y * (5 * z * z - 1),
        z * (5 * z * z - 3) / 2,
        t * x * (5 * z * z - 1),
        u * z * (x * x - y * y) / 2,
        s * x * (x * x - 3 * y * y),
    ]
    return np.stack([*first, *second, *third][: (order + 1) ** 2], axis=1)


def rotation(orientation: Orientation, order: int) -> Matrix:
    """The matrix from channels in the axes of the scene to those in the axes of a head with this unit quaternion.

    A rotation makes each channel of the head a sum of the scene's. What the channels are for a few directions, in both
    axes, says which sum.
    """
    x, y, z, w = orientation
    ahead = [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)]
    left = [2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)]
    up = [2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)]
    in_head = _SAMPLED @ np.array([ahead, left, up]).T
    solution = np.linalg.lstsq(harmonics(_SAMPLED, order), harmonics(in_head, order), rcond=None)[0]
    return np.asarray(solution.T, np.float64)


class Ears:
    """Two ears that hear ambisonic blocks through a head's `filters` (ear, channel, tap), which
    `Client.head_filters` gets."""

    def __init__(self, filters: npt.ArrayLike) -> None:
        self._filters = np.asarray(filters, np.float64)
        if self._filters.ndim != 3:
            raise ValueError(f"filters: have axes ear, channel and tap, not {self._filters.ndim} axes")
        channels, taps = self._filters.shape[1:]
        self._order = math.isqrt(channels) - 1
        self._matrix = rotation(FORWARD, self._order)
        self._before = np.zeros((channels, taps - 1))
        """The samples of the channels that the filters still reach back to, in the axes of the head."""

    def process(self, block: Samples, orientation: Orientation) -> Samples:
        """(frame, 2) what is heard of a block (frame, channel) while the head turns from its last orientation to this
        one."""
        matrix = rotation(orientation, self._order)
        share = (np.arange(len(block)) + 1) / len(block)  # in steps, since a jump would click
        turned = (1 - share) * (self._matrix @ block.T) + share * (matrix @ block.T)
        self._matrix = matrix
        reached = np.concatenate([self._before, turned], axis=1)
        self._before = reached[:, len(block) :]
        ears = [
            sum(np.convolve(channel, taps, "valid") for channel, taps in zip(reached, ear, strict=True))
            for ear in self._filters
        ]
        return np.stack(ears, axis=1).astype(np.float32)

    def reset(self) -> None:
        """Forget what was heard; the orientation stays."""
        self._before[:] = 0
