"""A level in metres and in Nafir's axes: triangles that stand still, doors, and the places that its nodes name.

A node has a role by its name (`door_kitchen`, `emitter_radio`, `listener_start`, `spawn_hall`) or by its property
`nafir_role`. What hangs below a node with a role belongs to it. Doors keep their triangles apart from the rest. The
triangles of emitters, of the listener's start and of spawn areas say where these are, and are no surfaces.
"""

import math
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, ValidationError

from server.acoustics.mesh import LONGEST_NAME
from server.scene.door import DOOR_NAME
from server.scene.geometry import Finite, Strict
from training.data.levels.import_options import Handedness, Units, Up
from training.data.levels.level_source import LevelError, LevelSource, Node, Part

_Floats = npt.NDArray[np.float64]
_Integers = npt.NDArray[np.int64]
_Point = tuple[float, float, float]

EXTRAS = "nafir_"
"""How the names of the custom properties begin that are read here. Others are left alone."""
UNNAMED = "unnamed"
"""What the material of triangles without one is called."""


class Role(StrEnum):
    """What a node is to the scene."""

    DOOR = "door"
    EMITTER = "emitter"
    LISTENER = "listener_start"
    SPAWN = "spawn"
    NONE = "none"


_PREFIXES = {"door_": Role.DOOR, "emitter_": Role.EMITTER, "spawn_": Role.SPAWN}


@dataclass(frozen=True)
class Axes:
    """How a file's coordinates are meant. x of the file is x here if the file is right-handed or has y up; an axis that
    points away from the viewer in Unreal (left-handed, z up) is -y here. The table is that of the engines' clients."""

    up: Up
    handedness: Handedness
    units: Units

    @property
    def to_world(self) -> _Floats:
        """(3, 3) from the file's coordinates to metres here."""
        right = self.handedness is Handedness.RIGHT
        if self.up is Up.Y:
            turn = np.array([(1, 0, 0), (0, 0, -1 if right else 1), (0, 1, 0)])
        else:
            turn = np.diag((1, 1 if right else -1, 1))
        return turn * self.units.metres


GLTF_AXES = Axes(Up.Y, Handedness.RIGHT, Units.M)
"""Axes and unit of glTF, by its specification (3.4)."""


class _Extras(Strict):
    """Custom properties of a node, without their common beginning."""

    role: Role | None = None
    name: Annotated[str, Field(min_length=1)] | None = None
    kind: Literal["swing", "slide"] = "swing"
    angle_deg: Annotated[float, Field(ge=-180, le=180, allow_inf_nan=False)] = 90.0
    slide: tuple[Finite, Finite, Finite] | None = None
    openness: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)] = 0.0
    mass_kg_m2: Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)] | None = None
    yaw_deg: Annotated[float, Field(ge=-360, le=360, allow_inf_nan=False)] | None = None
    material: Annotated[str, Field(min_length=1)] | None = None


@dataclass(frozen=True)
class Surfaces:
    """`vertices_m` (V, 3); `triangles` (T, 3); `materials` (T,) indices into the level's `material_names`; `nodes` (T,)
    which node each triangle is from."""

    vertices_m: _Floats
    triangles: _Integers
    materials: _Integers
    nodes: _Integers

    @property
    def corners_m(self) -> _Floats:
        """(T, corner, 3)"""
        return self.vertices_m[self.triangles]


@dataclass(frozen=True)
class LevelDoor:
    """A leaf that moves, as it is when shut. A swing turns by `angle_deg` about the upright line through `pivot`,
    counter-clockwise as seen from above; a slide moves by `slide_m`. `mass_kg_m2` decides what goes through it."""

    name: str
    surfaces: Surfaces
    kind: Literal["swing", "slide"]
    pivot: _Point
    angle_deg: float
    slide_m: _Point
    openness: float
    mass_kg_m2: float | None


@dataclass(frozen=True)
class Area:
    """An upright box in which visitors may begin; a point where `low` and `high` are the same."""

    name: str
    low: _Point
    high: _Point


@dataclass(frozen=True)
class Level:
    """`listener` is a position and a heading in degrees, counter-clockwise from +x, or None."""

    surfaces: Surfaces
    material_names: tuple[str, ...]
    node_names: tuple[str, ...]
    doors: tuple[LevelDoor, ...] = ()
    emitters: tuple[tuple[str, _Point], ...] = ()
    listener: tuple[_Point, float] | None = None
    spawns: tuple[Area, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Labelled:
    """A node with what its name and properties say. `owner` is the nearest node above or at it that has a role, or
    -1."""

    node: Node
    role: Role
    name: str
    extras: _Extras
    owner: int


def level_of(path: Path, source: LevelSource, axes: Axes) -> Level:
    """The level of what a file holds. Raises LevelError for coordinates that are not finite, two nodes of one role and
    name, properties that are not known, and doors without triangles."""
    labelled = list(_labelled(path, source.nodes))
    _require_names_once(path, labelled)
    to_world = axes.to_world
    for part in source.parts:
        used = np.isfinite(part.vertices[part.triangles]).all(axis=(1, 2))
        if not used.all():
            place = source.nodes[part.node].name or f"node {part.node}"
            raise LevelError(
                path, place, f"{(~used).sum():,} triangles have coordinates that are no finite numbers: remove them"
            )
    names = dict.fromkeys(_material(part, labelled) for part in source.parts)
    if too_long := [name for name in names if len(name) > LONGEST_NAME or "\0" in name]:
        raise LevelError(
            path, "materials", f"{too_long[0][:40]!r}... is longer than {LONGEST_NAME} characters: shorten it"
        )
    numbers = {name: index for index, name in enumerate(names)}
    notes = list(source.notes)

    parts_of = defaultdict(list)
    for part in source.parts:
        parts_of[labelled[part.node].owner].append(part)

    def surfaces(owner: int) -> Surfaces:
        parts = parts_of.get(owner, [])
        return _joined(parts, [numbers[_material(part, labelled)] for part in parts], to_world)

    silent = {index for index, each in enumerate(labelled) if each.owner == index and each.role is not Role.DOOR}
    if any(labelled[part.node].owner in silent for part in source.parts):
        notes.append("left out: triangles of emitters, of the listener's start and of spawn areas, which are places")
    doors, emitters, spawns, listener = [], [], [], None
    for index, each in enumerate(labelled):
        if each.owner != index:
            continue
        origin = to_world @ each.node.to_file[:3, 3]
        own = surfaces(index)
        if each.role is Role.DOOR:
            if source.kind == "OBJ":
                problem = "an OBJ file does not say where the hinge of this door is: export the level as glTF"
                raise LevelError(path, each.node.name, problem)
            doors.append(_door(path, each, own, _point(origin), to_world))
        elif each.role is Role.EMITTER:
            emitters.append((each.name, _point(origin)))
        elif each.role is Role.SPAWN:
            corners = own.corners_m.reshape(-1, 3) if len(own.triangles) else origin[None]
            spawns.append(Area(each.name, _point(corners.min(axis=0)), _point(corners.max(axis=0))))
        else:
            listener = (_point(origin), _heading(each, to_world))
    return Level(
        surfaces(-1),
        tuple(names),
        tuple(node.name for node in source.nodes),
        tuple(doors),
        tuple(emitters),
        listener,
        tuple(spawns),
        tuple(notes),
    )


def _labelled(path: Path, nodes: tuple[Node, ...]) -> Iterator[_Labelled]:
    owners: list[int] = []
    for index, node in enumerate(nodes):
        extras = _extras(path, node)
        role, name = _role(node.name)
        role, name = extras.role or role, extras.name or name
        above = owners[node.parent] if node.parent >= 0 else -1
        if role is not Role.NONE and above >= 0:
            raise LevelError(
                path, node.name or name, f"hangs below {nodes[above].name!r}, which has a role too: part them"
            )
        owners.append(index if role is not Role.NONE else above)
        yield _Labelled(node, role, name, extras, owners[-1])


def _role(name: str) -> tuple[Role, str]:
    if name.lower() == Role.LISTENER:
        return Role.LISTENER, ""
    for prefix, role in _PREFIXES.items():
        if name.lower().startswith(prefix):
            return role, name[len(prefix) :]
    return Role.NONE, name


def _extras(path: Path, node: Node) -> _Extras:
    given: Mapping[str, Any] = {
        key.removeprefix(EXTRAS): value for key, value in node.extras.items() if key.startswith(EXTRAS)
    }
    try:
        return _Extras.model_validate(given)
    except ValidationError as exc:
        first = exc.errors()[0]
        key = EXTRAS + ".".join(map(str, first["loc"]))
        known = ", ".join(EXTRAS + each for each in _Extras.model_fields)
        raise LevelError(path, f"{node.name}: {key}", f"{first['msg']}; the properties are {known}") from exc


def _require_names_once(path: Path, labelled: list[_Labelled]) -> None:
    seen: dict[tuple[Role, str], str] = {}
    for index, each in enumerate(labelled):
        if each.role is Role.NONE or each.owner != index:
            continue
        if each.role is not Role.LISTENER and not each.name:
            raise LevelError(path, each.node.name, f"this {each.role} has no name: call it {each.role}_NAME")
        key = (each.role, each.name)
        if key in seen:
            raise LevelError(path, each.node.name, f"two nodes are the {each.role} {each.name!r}: name them apart")
        seen[key] = each.node.name


def _material(part: Part, labelled: list[_Labelled]) -> str:
    """The name of a part's material: the property of its node or of the nearest above it, else the file's."""
    index = part.node
    while index >= 0:
        if own := labelled[index].extras.material:
            return own
        index = labelled[index].node.parent
    return part.material or UNNAMED


def _joined(parts: list[Part], materials: list[int], to_world: _Floats) -> Surfaces:
    if not parts:
        return Surfaces(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64))
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    counts = [len(part.triangles) for part in parts]
    return Surfaces(
        np.concatenate([part.vertices for part in parts]) @ to_world.T,
        np.concatenate([part.triangles + start for part, start in zip(parts, starts, strict=False)]),
        np.repeat(materials, counts),
        np.repeat([part.node for part in parts], counts),
    )


def _door(path: Path, each: _Labelled, surfaces: Surfaces, pivot: _Point, to_world: _Floats) -> LevelDoor:
    if not len(surfaces.triangles):
        raise LevelError(path, each.node.name, "this door has no triangles: give it its leaf, shut")
    if not re.fullmatch(DOOR_NAME, each.name):
        problem = (
            f"{each.name!r} is no name for a door: give it up to 64 characters, without : , = / and no blank first"
        )
        raise LevelError(path, each.node.name, problem)
    extras = each.extras
    if extras.slide is not None:
        slide = _point(to_world @ each.node.to_file[:3, :3] @ np.array(extras.slide))
    else:
        size = np.ptp(surfaces.corners_m.reshape(-1, 3), axis=0)
        size[2] = 0.0
        slide = _point(np.where(size == size.max(), size, 0.0))
    return LevelDoor(
        each.name, surfaces, extras.kind, pivot, extras.angle_deg, slide, extras.openness, extras.mass_kg_m2
    )


def _heading(each: _Labelled, to_world: _Floats) -> float:
    """The heading of the start: its property, or where its own -z looks, as cameras do."""
    if each.extras.yaw_deg is not None:
        return each.extras.yaw_deg
    ahead = to_world @ each.node.to_file[:3, :3] @ np.array((0.0, 0.0, -1.0))
    return math.degrees(math.atan2(ahead[1], ahead[0])) if np.hypot(*ahead[:2]) > 1e-9 else 0.0


def _point(place: _Floats) -> _Point:
    x, y, z = (float(value) + 0.0 for value in place)
    return x, y, z
