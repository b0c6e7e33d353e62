"""Checks that each opening of a scene file leads from one wall of the floor plan to another. Lengths are in metres."""

from collections.abc import Sequence
from itertools import combinations

import shapely

from server.scene.geometry import Geometry, Opening, PlanPoint
from server.scene.rooms import ON_WALL_M

NARROWEST_M = 0.1
"""The probe in the middle of an opening counts rays in a sphere, which must fit into the opening."""


def faults_of(geometry: Geometry) -> list[str]:
    """One message for each opening at fault, beginning with its field (`openings.0 ...`); empty if all are valid."""
    plan = shapely.Polygon(geometry.corners)
    alone = [_fault(opening, plan) for opening in geometry.openings]
    faults = [f"openings.{index}: {fault}" for index, fault in enumerate(alone) if fault]
    if faults:
        return faults
    return [
        f"openings.{second}: {fault}"
        for (first, one), (second, other) in combinations(enumerate(geometry.openings), 2)
        if (fault := _overlap_fault(first, one, other))
    ]


def _fault(opening: Opening, plan: shapely.Polygon) -> str:
    line = _line(opening)
    if line.length < NARROWEST_M:
        return f"is {line.length:.3g} m wide, from {_place(opening.start)} to {_place(opening.end)}: at least 0.1 m"
    for name in ("start", "end"):
        end: PlanPoint = getattr(opening, name)
        reach = shapely.shortest_line(shapely.Point(end), plan.exterior)
        if reach.length >= ON_WALL_M:
            on_wall = _place(reach.coords[1])
            return f"{name} {_place(end)} touches no wall: the nearest is {reach.length:.3g} m away, at {on_wall}"
    inside = line.intersection(plan.buffer(-ON_WALL_M, join_style="mitre"))
    if inside.length < ON_WALL_M:
        along = "runs along a wall" if plan.exterior.distance(line.centroid) < ON_WALL_M else "is outside of the room"
        return f"{along}, from {_place(opening.start)} to {_place(opening.end)}: it must lead across the room"
    if line.intersection(plan).length < line.length - 2 * ON_WALL_M or not isinstance(inside, shapely.LineString):
        return f"goes through a wall on its way from {_place(opening.start)} to {_place(opening.end)}"
    return ""


def _overlap_fault(first: int, one: Opening, other: Opening) -> str:
    """The fault of two openings that touch, or an empty string. Two openings may share one end point, and nothing
    else."""
    line, across = _line(one), _line(other)
    if line.distance(across) >= ON_WALL_M:
        return ""
    common = line.intersection(across)
    if isinstance(common, shapely.LineString) and not common.is_empty:
        begin, finish = common.coords
        return f"lies on openings.{first} from {_place(begin)} to {_place(finish)}"
    at = shapely.Point(shapely.shortest_line(line, across).coords[0])
    if all(each.boundary.distance(at) < ON_WALL_M for each in (line, across)):
        return ""
    return f"crosses openings.{first} at {_place((at.x, at.y))}"


def _line(opening: Opening) -> shapely.LineString:
    return shapely.LineString([opening.start, opening.end])


def _place(point: Sequence[float]) -> str:
    return f"({point[0]:.6g}, {point[1]:.6g})"
