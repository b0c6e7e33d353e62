"""A check that the corners of a floor plan form a simple polygon.

Edge i runs from corner i to corner i + 1, and the last one back to corner 0. Units are metres.
"""

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import shapely

SHORTEST_WALL_M = 0.001
"""The least length of a wall, and the least distance between two walls that do not meet. A shorter wall means that a
corner was written twice, and geometry divides by the length of a wall."""

_MOST_FAULTS_TOLD = 3

_Corner = tuple[float, float]


def faults_of(corners: Sequence[_Corner]) -> list[str]:
    """The first few reasons why three or more corners are not a simple, counter-clockwise polygon; empty if they are
    one."""
    for index, corner in enumerate(corners):
        # guard: a wall has a length
        if math.dist(corner, corners[index - 1]) < SHORTEST_WALL_M:
            closes = ": leave the last one out, a floor plan closes by itself" if index == 0 else ""
            return [f"corner {index} is where corner {(index - 1) % len(corners)} is, at {_place(corner)}{closes}"]
    meetings = _meetings(corners)
    if meetings:
        return [*meetings[:_MOST_FAULTS_TOLD], "edge 0 runs from corner 0 to corner 1"]
    # guard: a room has an inside
    if not shapely.LinearRing(corners).is_ccw:
        return ["corners must run counter-clockwise: these run clockwise, so write them in the opposite order"]
    return []


def _meetings(corners: Sequence[_Corner]) -> list[str]:
    """Messages about edges that meet anywhere except in the corner between two neighbours."""
    count = len(corners)
    edges = [shapely.LineString([corners[index], corners[(index + 1) % count]]) for index in range(count)]
    near = shapely.STRtree(edges).query(edges, predicate="dwithin", distance=SHORTEST_WALL_M)
    faults = []
    for first, second in sorted((int(a), int(b)) for a, b in near.T if a < b):
        if second - first == 1 or (first == 0 and second == count - 1):
            shared = corners[second] if second - first == 1 else corners[0]
            fault = _fold(edges[first], edges[second], shared)
        else:
            fault = _meeting(edges[first], edges[second])
        if fault:
            faults.append(f"edges {first} and {second} {fault}")
    return faults


def _meeting(edge: shapely.LineString, other: shapely.LineString) -> str:
    """A message about how two edges that are not neighbours meet."""
    common = edge.intersection(other)
    if common.is_empty:
        return f"touch at {_place(shapely.shortest_line(edge, other).coords[0])}"
    if isinstance(common, shapely.LineString):
        return _overlap(common)
    touches = edge.touches(other)
    return f"{'touch' if touches else 'cross'} at {_place(common.coords[0])}"


def _fold(edge: shapely.LineString, other: shapely.LineString, shared: _Corner) -> str:
    """A message about how an edge runs back over its neighbour; empty if it does not."""
    shorter, longer = sorted((edge, other), key=lambda each: each.length)
    free = max(shorter.coords, key=lambda end: math.dist(end, shared))
    if longer.distance(shapely.Point(free)) >= SHORTEST_WALL_M:
        return ""
    return _overlap(shorter)


def _overlap(common: shapely.LineString) -> str:
    first, last = common.coords
    return f"run over each other from {_place(first)} to {_place(last)}"


def _place(point: Sequence[float]) -> str:
    return f"({point[0]:.6g}, {point[1]:.6g})"


def hull_in_plan(points: npt.NDArray[np.float64]) -> tuple[tuple[float, float], ...]:
    """The outline, counter-clockwise, of points (n, 3) as seen from above: two corners if they lie on a line."""
    hull = shapely.MultiPoint(points[:, :2]).convex_hull
    around = shapely.normalize(hull).reverse().exterior if isinstance(hull, shapely.Polygon) else hull
    corners = list(dict.fromkeys(around.coords))
    return tuple((x, y) for x, y in corners)
