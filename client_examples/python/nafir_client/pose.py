"""Where something is and how it is turned: metres, x east, y north, z up; unit quaternions (x, y, z, w).

The identity looks along +x. Yaw turns counter-clockwise from there, in radians.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

Position = tuple[float, float, float]
Orientation = tuple[float, float, float, float]
FORWARD: Orientation = (0.0, 0.0, 0.0, 1.0)


def yawed(yaw: float) -> Orientation:
    """The orientation after a turn about the vertical axis."""
    return (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))


def turned(yaw: float, pitch: float) -> Orientation:
    """The orientation of a head that looks up by the `pitch` and is then turned by the `yaw`, both in radians."""
    about_z, about_y = (math.sin(yaw / 2), math.cos(yaw / 2)), (-math.sin(pitch / 2), math.cos(pitch / 2))
    return (-about_z[0] * about_y[0], about_z[1] * about_y[0], about_z[0] * about_y[1], about_z[1] * about_y[1])


@dataclass(frozen=True)
class Pose:
    """A position and an orientation, of numbers as a binary message holds them: single precision."""

    position: Position
    orientation: Orientation = FORWARD

    @classmethod
    def of(
        cls, position: Iterable[float], *, yaw: float | None = None, orientation: Iterable[float] | None = None
    ) -> "Pose":
        """Raises ValueError unless there are three finite numbers, and a yaw or four numbers or neither."""
        x, y, z = _singles(position, 3, "position")
        if orientation is None:
            return cls((x, y, z), _quaternion(yawed(yaw or 0.0)))
        if yaw is not None:
            raise ValueError("orientation: give orientation or yaw, not both")
        return cls((x, y, z), _quaternion(orientation))


def _quaternion(numbers: Iterable[float]) -> Orientation:
    x, y, z, w = _singles(numbers, 4, "orientation")
    if x == y == z == w == 0:
        raise ValueError("orientation: a quaternion of zeros has no direction")
    return (x, y, z, w)


def _singles(numbers: Iterable[float], count: int, name: str) -> list[float]:
    singles = [float(np.float32(number)) for number in numbers]
    if len(singles) != count or not all(map(math.isfinite, singles)):
        raise ValueError(f"{name}: has to be {count} finite numbers, not {singles}")
    return singles
