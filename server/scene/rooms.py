"""The rooms that openings part a floor plan into."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from server.acoustics.geometry import FloorPlan
from server.scene.geometry import Geometry, PlanPoint

# An opening that ends nearer to a wall than this ends on it.
_TOUCH_M = 0.001


@dataclass(frozen=True)
class Room:
    """`plan` is closed across its openings, which are `passage_m` wide together."""

    plan: FloorPlan
    passage_m: float


def rooms_of(geometry: Geometry) -> list[Room]:
    """One or more. Openings that do not lead from wall to wall part nothing."""
    parts = [list(geometry.corners)]
    for opening in geometry.openings:
        for index, corners in enumerate(parts):
            first, last = _wall_at(corners, opening.start), _wall_at(corners, opening.end)
            if first is None or last is None or first == last:
                continue
            parts[index : index + 1] = [
                [opening.start, *_between(corners, first, last), opening.end],
                [opening.end, *_between(corners, last, first), opening.start],
            ]
            break
    passages = {frozenset((opening.start, opening.end)) for opening in geometry.openings}
    return [
        Room(
            FloorPlan(tuple(corners), geometry.height_m),
            math.fsum(math.dist(*ends) for ends in pairwise([*corners, corners[0]]) if frozenset(ends) in passages),
        )
        for corners in parts
    ]


def _wall_at(corners: Sequence[PlanPoint], point: PlanPoint) -> int | None:
    for number, start in enumerate(corners):
        end = corners[(number + 1) % len(corners)]
        if math.dist(start, point) + math.dist(point, end) < math.dist(start, end) + _TOUCH_M:
            return number
    return None


def _between(corners: Sequence[PlanPoint], first: int, last: int) -> list[PlanPoint]:
    """Corners after wall `first` up to where wall `last` begins, on along the walls."""
    count = (last - first) % len(corners)
    return [corners[(first + 1 + step) % len(corners)] for step in range(count)]
