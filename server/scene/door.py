"""The doors of a scene, and how far they are open."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Final, Literal

from pydantic import BeforeValidator, Field

from server.acoustics.doors import LeafMotion, Openness
from server.core.errors import RequestError
from server.scene.geometry import Finite, Point, Strict

MOST_DOORS: Final = 8
"""The most doors of a scene. What sound does at doors is found anew in every state, so that each door makes all states
dearer."""
_ROUNDED: Final = 1e-6
"""So far beyond shut or open a number is taken for that: engines that blend between the two round."""


def _to_the_ends(value: object) -> object:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if is_number and -_ROUNDED <= value <= 1 + _ROUNDED:  # type: ignore[operator]
        return min(1.0, max(0.0, float(value))) + 0.0  # type: ignore[arg-type]  # and no negative zero
    return value


# guard: a door is open by a share
OpenShare = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False), BeforeValidator(_to_the_ends)]
"""How far a door is open, from 0 to 1."""
DOOR_NAME: Final = r"^[^\s:,=/][^:,=/]{0,63}$"
"""What a door may be called: what can stand in a query, `kitchen:0.5,hall:1`."""
DoorName = Annotated[str, Field(pattern=DOOR_NAME)]


class Door(Strict):
    """A leaf, as it is when shut, in the archive `mesh`, whose arrays are those of a mesh. A swing turns by `angle_deg`
    about the upright line through `pivot`, counter-clockwise as seen from above, when it opens; a slide moves by
    `slide_m`. `openness` is that at the beginning, 0 shut and 1 open."""

    name: DoorName
    mesh: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*\.npz$")]
    kind: Literal["swing", "slide"]
    pivot: Point
    angle_deg: Annotated[Finite, Field(ge=-360, le=360)]
    slide_m: Point
    openness: OpenShare

    @property
    def motion(self) -> LeafMotion:
        return LeafMotion(self.kind, self.pivot, self.angle_deg, self.slide_m)


def openness_of(doors: Sequence[Door]) -> Openness:
    """How far doors are open at the beginning."""
    return tuple(door.openness for door in doors)


def read_openness(doors: Sequence[Door], given: Mapping[str, float], before: Openness | None = None) -> Openness:
    """How far `doors` are open if those `given` by name are, and all others are as `before`, or as at the beginning.
    Raises RequestError unknown_door, which lists the names."""
    names = [door.name for door in doors]
    for name in given:
        if name not in names:
            known = f"only {', '.join(names)}" if names else "and no other"
            raise RequestError("unknown_door", f"the scene has no door {name!r}, {known}", field="door", status=404)
    others = openness_of(doors) if before is None else before
    return tuple(given.get(name, other) for name, other in zip(names, others, strict=True))
