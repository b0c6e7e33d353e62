"""Poses and floor plans.

Units are metres and radians. The world is right-handed: x east, y north, z up. An orientation is a unit quaternion
(x, y, z, w); the identity looks along +x with +y to the left. Points are arrays whose last axis is (x, y, z); leading
axes broadcast.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Points = npt.NDArray[np.float64]
Vector3 = tuple[float, float, float]

# A point nearer to a wall than TOUCH_M is on it. Two points nearer to each other than COINCIDENT_M are the same.
TOUCH_M = 1e-9
COINCIDENT_M = 1e-9

FARTHEST_M = 1e7
"""The largest coordinate, a quarter of the Earth's circumference. Squares of much larger numbers overflow."""
_SHORTEST, _LONGEST = 1e-6, 1e12
"""Limits of a given quaternion's length. Shorter ones are rounding errors; longer ones lose their direction when
squared."""


class _Components(NamedTuple):
    x: float
    y: float
    z: float
    w: float


class Quaternion(_Components):
    """An orientation, normalised to unit length.

    Raises ValueError if a component is not finite, or if the quaternion is too short or too long to have a direction.
    """

    __slots__ = ()

    def __new__(cls, x: float, y: float, z: float, w: float) -> "Quaternion":
        length = math.hypot(x, y, z, w)
        if not math.isfinite(length):
            raise ValueError("orientation must be four finite numbers")
        # guard: a quaternion has a length
        if not _SHORTEST < length < _LONGEST:
            raise ValueError(f"orientation must be a quaternion of non-zero length, not of {length:g}")
        # guard: an orientation is normalised once
        return super().__new__(cls, x / length, y / length, z / length, w / length)

    @classmethod
    def from_yaw(cls, yaw_rad: float) -> "Quaternion":
        """A rotation by `yaw_rad` counter-clockwise about the vertical; 0 looks along +x. Raises ValueError if it is
        not finite."""
        # guard: a yaw is finite
        if not math.isfinite(yaw_rad):
            raise ValueError("yaw must be a finite number")
        return cls(0.0, 0.0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2))

    @classmethod
    def from_angles(cls, yaw_rad: float, pitch_rad: float, roll_rad: float) -> "Quaternion":
        """The orientation of a head that turns counter-clockwise by a yaw, then raises its nose by a pitch, then tilts
        to its right by a roll (right ear down), each about its own axes. Raises ValueError if one is not finite."""
        if not all(map(math.isfinite, (yaw_rad, pitch_rad, roll_rad))):
            raise ValueError("yaw, pitch and roll must be finite numbers")
        yaw, pitch, roll = yaw_rad / 2, -pitch_rad / 2, roll_rad / 2  # about y, which points left, the nose goes down
        cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
        cr, sr = math.cos(roll), math.sin(roll)
        return cls(
            cy * cp * sr - sy * sp * cr,
            cy * sp * cr + sy * cp * sr,
            sy * cp * cr - cy * sp * sr,
            cy * cp * cr + sy * sp * sr,
        )


LEVEL = Quaternion(0.0, 0.0, 0.0, 1.0)


def axes_of(orientation: Sequence[float] | npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """The (3, 3) matrix from world axes to the axes of a head or emitter with this orientation (x, y, z, w)."""
    # As a flat tuple: nested rows take NumPy twice as long.
    return np.array(axis_coordinates(*map(float, orientation))).reshape(3, 3)


def axis_coordinates(x: float, y: float, z: float, w: float) -> tuple[float, ...]:
    """The matrix of `axes_of`, row by row. It is the transpose of the usual one."""
    return (
        *(1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)),
        *(2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)),
        *(2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)),
    )


def yaws_of(heads: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """(B,) headings of heads that are given as orientations (B, 4): of their noses as seen from above, so backwards for
    a head that is tilted back beyond the zenith. Yaws (B,) of level heads are returned as they are."""
    given = np.asarray(heads, dtype=np.float64)
    if given.ndim == 1:
        return given
    return np.array([_heading(*orientation) for orientation in given.tolist()], dtype=np.float64)


def orientations_of(heads: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """(B, 4) orientations of level heads that are given as yaws (B,); orientations (B, 4) are returned as they are."""
    given = np.asarray(heads, dtype=np.float64)
    if given.ndim != 1:
        return given
    level = np.zeros_like(given)
    return np.stack([level, level, np.sin(given / 2), np.cos(given / 2)], axis=-1)


def _heading(x: float, y: float, z: float, w: float) -> float:
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


@dataclass(frozen=True)
class Pose:
    """A position in metres and an orientation.

    Raises ValueError for a position that is not finite or beyond `FARTHEST_M`, and for a quaternion without direction.
    """

    position: Vector3
    orientation: Quaternion = LEVEL

    def __post_init__(self) -> None:
        if len(self.position) != 3:
            raise ValueError("position must be three finite numbers")
        x, y, z = map(float, self.position)  # no loops, because poses arrive hundreds of times a second
        # guard: a position is finite
        if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
            raise ValueError("position must be three finite numbers")
        # guard: a position is somewhere
        if max(abs(x), abs(y), abs(z)) > FARTHEST_M:
            raise ValueError(f"position must lie within {FARTHEST_M:g} m")
        object.__setattr__(self, "position", (x, y, z))
        # guard: an orientation is normalised no second time
        if type(self.orientation) is not Quaternion:  # normalising again would change the last bit
            if len(self.orientation) != 4:
                raise ValueError("orientation must be four finite numbers")
            object.__setattr__(self, "orientation", Quaternion(*(float(c) for c in self.orientation)))

    @classmethod
    def from_yaw(cls, position: Vector3, yaw_rad: float) -> "Pose":
        """A pose with the head level, turned counter-clockwise by `yaw_rad`; 0 looks along +x."""
        return cls(position, Quaternion.from_yaw(yaw_rad))

    @property
    def yaw(self) -> float:
        """The heading of the look direction in the horizontal plane, radians in [-pi, pi]."""
        return _heading(*self.orientation)


@dataclass(frozen=True)
class FloorPlan:
    """A simple polygon of walls, counter-clockwise, extruded from z = `floor_m` to z = `height_m`."""

    corners: tuple[tuple[float, float], ...]
    height_m: float
    floor_m: float = 0.0

    @cached_property
    def walls(self) -> npt.NDArray[np.float64]:
        """(wall, end, 2) end points of the walls. Wall i runs from corner i to corner i + 1, with the inside on its
        left."""
        corners = np.asarray(self.corners, dtype=np.float64)
        return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)

    @cached_property
    def area_m2(self) -> float:
        x, y = self.walls[..., 0], self.walls[..., 1]
        return float(np.sum(x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]) / 2)

    @cached_property
    def bend_corners(self) -> npt.NDArray[np.float64]:
        """(corner, 2) reflex corners, the only points where a shortest path can bend."""
        outgoing = self.walls[:, 1] - self.walls[:, 0]
        incoming = np.roll(outgoing, 1, axis=0)
        turn = incoming[:, 0] * outgoing[:, 1] - incoming[:, 1] * outgoing[:, 0]
        return np.asarray(self.walls[turn < 0, 0])

    @cached_property
    def bend_lengths_m(self) -> npt.NDArray[np.float64]:
        """(corner, corner) lengths of the shortest paths between reflex corners (Dijkstra over the visibility
        graph)."""
        bends = self.bend_corners
        points = np.concatenate([bends, np.zeros((len(bends), 1))], axis=-1)
        distance = np.linalg.norm(bends[:, None] - bends[None], axis=-1)
        return _shortest(np.where(self.is_visible(points[:, None], points[None]), distance, np.inf))

    def contains(self, points: Points) -> npt.NDArray[np.bool_]:
        """(...,) whether each point is inside the room or on its surfaces."""
        points = np.asarray(points, dtype=np.float64)
        start, end = self.walls[:, 0], self.walls[:, 1]
        x, y = points[..., None, 0], points[..., None, 1]
        straddles = (start[:, 1] > y) != (end[:, 1] > y)
        rise = np.where(start[:, 1] == end[:, 1], 1.0, end[:, 1] - start[:, 1])
        crossing = start[:, 0] + (y - start[:, 1]) * (end[:, 0] - start[:, 0]) / rise
        inside = np.sum(straddles & (x < crossing), axis=-1) % 2 == 1
        touches = self.wall_distance_m(points) < TOUCH_M
        # guard: what touches a wall is inside
        return np.asarray((inside | touches) & (points[..., 2] >= self.floor_m) & (points[..., 2] <= self.height_m))

    def holds(self, position: Vector3) -> bool:
        """Whether one point is inside the room or on its surfaces. This is `contains` in scalars, twenty times as
        fast."""
        x, y, z = position
        if not self.floor_m <= z <= self.height_m:
            return False
        is_inside = False
        ax, ay = self.corners[-1]
        for bx, by in self.corners:
            if (ay > y) != (by > y) and x < ax + (y - ay) * (bx - ax) / (by - ay):
                is_inside = not is_inside
            along_x, along_y = bx - ax, by - ay
            share = ((x - ax) * along_x + (y - ay) * along_y) / (along_x * along_x + along_y * along_y)
            share = min(1.0, max(0.0, share))
            # guard: one place that touches a wall is inside
            if math.hypot(x - ax - share * along_x, y - ay - share * along_y) < TOUCH_M:
                return True
            ax, ay = bx, by
        return is_inside

    def wall_distance_m(self, points: Points) -> npt.NDArray[np.float64]:
        """(...,) horizontal distance to the nearest wall, for points inside and outside."""
        points = np.asarray(points, dtype=np.float64)
        start, along = self.walls[:, 0], self.walls[:, 1] - self.walls[:, 0]
        offset = points[..., None, :2] - start
        share = np.clip(np.sum(offset * along, axis=-1) / np.sum(along**2, axis=-1), 0, 1)
        return np.asarray(np.min(np.linalg.norm(offset - share[..., None] * along, axis=-1), axis=-1))

    def is_visible(self, a: Points, b: Points) -> npt.NDArray[np.bool_]:
        """(...,) whether no wall stands between a and b. A line that grazes a wall or a corner is not blocked.

        Both points must be inside. Walls run from floor to ceiling, so only x and y matter.
        """
        a, b = np.broadcast_arrays(np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64))
        start, end = self.walls[:, 0], self.walls[:, 1]
        p, q = a[..., None, :2], b[..., None, :2]

        def side(origin: Points, tip: Points, point: Points) -> Points:
            edge, offset = tip - origin, point - origin
            return np.asarray(edge[..., 0] * offset[..., 1] - edge[..., 1] * offset[..., 0])

        # guard: a line that grazes a corner is free
        crosses = (side(start, end, p) * side(start, end, q) < -TOUCH_M) & (
            side(p, q, start) * side(p, q, end) < -TOUCH_M
        )
        # A sight line through solid wall may pass exactly through its corners, so the midpoint is checked too.
        middle = (a + b) / 2
        level = np.full((*middle.shape[:-1], 1), self.floor_m)
        inside = self.contains(np.concatenate([middle[..., :2], level], axis=-1))
        # guard: a sight line through a block of wall is none
        return np.asarray(~np.any(crosses, axis=-1) & inside)

    def path_length_m(self, a: Points, b: Points) -> npt.NDArray[np.float64]:
        """(...,) length of the shortest path from a to b around the walls. It is the straight distance if nothing
        stands between them, and also if there is no path because one of them is inside a wall."""
        a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
        straight = np.linalg.norm(a - b, axis=-1)
        bends = np.concatenate([self.bend_corners, np.zeros((len(self.bend_corners), 1))], axis=-1)
        if not len(bends):
            return np.asarray(straight)

        def reach(points: Points) -> Points:
            plan = np.linalg.norm(points[..., None, :2] - bends[:, :2], axis=-1)
            return np.where(self.is_visible(points[..., None, :], bends), plan, np.inf)

        # Computed once for each point a, which is paired with many points b.
        to_last = np.min(reach(a)[..., :, None] + self.bend_lengths_m, axis=-2)
        bent = np.hypot(np.min(to_last + reach(b), axis=-1), a[..., 2] - b[..., 2])
        # guard: a path into a wall is as long as the straight line
        return np.asarray(np.where(self.is_visible(a, b) | ~np.isfinite(bent), straight, bent))


def _shortest(direct: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """(n, n) lengths of the shortest paths over steps of lengths `direct` (n, n), infinite where there is no path.

    Dijkstra's algorithm from all points at once. `scipy.sparse.csgraph` would take a tenth of a second to import.
    """
    steps = np.minimum(direct, direct.T)
    start = np.arange(len(steps))
    lengths = np.full_like(steps, np.inf)
    lengths[start, start] = 0.0
    is_open = np.ones(steps.shape, np.bool)
    for _ in range(len(steps)):
        nearest = np.argmin(np.where(is_open, lengths, np.inf), axis=-1)
        is_open[start, nearest] = False
        lengths = np.minimum(lengths, lengths[start, nearest, None] + steps[nearest])
    return lengths
