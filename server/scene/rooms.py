"""Division of a floor plan into rooms at its openings."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from server.acoustics.geometry import FloorPlan
from server.scene.geometry import Geometry, PlanPoint

# An opening whose end is nearer to a wall than this ends on the wall.
ON_WALL_M = 0.001
_LEAST_M2 = 0.001


@dataclass(frozen=True)
class Room:
    """One room of a floor plan. `plan` is its outline, closed by a straight line at each opening to another room;
    `passage_m` is the total width of these openings."""

    plan: FloorPlan
    passage_m: float


def rooms_of(geometry: Geometry) -> list[Room]:
    """The rooms of a floor plan, at least one. An opening divides a room only if it runs from wall to wall."""
    parts, passages = [list(geometry.corners)], set()
    for opening in geometry.openings:
        for index, corners in enumerate(parts):
            first, last = _wall_at(corners, opening.start), _wall_at(corners, opening.end)
            if first is None or last is None or first == last:
                continue
            sides = (
                [opening.start, *_between(corners, first, last), opening.end],
                [opening.end, *_between(corners, last, first), opening.start],
            )
            if min(FloorPlan(tuple(side), geometry.height_m).area_m2 for side in sides) < _LEAST_M2:
                continue  # the opening runs along a wall
            parts[index : index + 1] = sides
            passages.add(frozenset((opening.start, opening.end)))
            break
    return [
        Room(
            FloorPlan(tuple(corners), geometry.height_m),
            math.fsum(math.dist(*ends) for ends in pairwise([*corners, corners[0]]) if frozenset(ends) in passages),
        )
        for corners in parts
    ]


def _wall_at(corners: Sequence[PlanPoint], point: PlanPoint) -> int | None:
    """The index of the wall on which the point lies; None if it lies on none."""
    starts = np.array(corners)
    along = np.roll(starts, -1, axis=0) - starts
    share = np.clip(np.sum((point - starts) * along, axis=-1) / np.sum(along**2, axis=-1), 0, 1)
    distance_m = np.linalg.norm(starts + share[:, None] * along - point, axis=-1)
    nearest = int(np.argmin(distance_m))
    return nearest if distance_m[nearest] < ON_WALL_M else None


def _between(corners: Sequence[PlanPoint], first: int, last: int) -> list[PlanPoint]:
    """The corners from the end of wall `first` to the beginning of wall `last`."""
    count = (last - first) % len(corners)
    return [corners[(first + 1 + step) % len(corners)] for step in range(count)]
