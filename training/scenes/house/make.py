"""Writes house.glb: a house of two storeys with stairs, six rooms, four doors and furniture.

    python training/scenes/house/make.py

Rooms are boxes of air in solid matter, furniture is boxes of matter in them, and the surface between the two is the
mesh: closed, with all faces towards the air. To the extent possible under law, its authors have waived all copyright to
the house and to this script (CC0 1.0).
"""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from training.data.levels.decimation import merge_flat
from training.data.levels.gltf_writer import Piece, WrittenNode, write_glb

_Floats = npt.NDArray[np.float64]
_Integers = npt.NDArray[np.int64]
_Ends = tuple[float, float]

NOTICE = "CC0 1.0, the Nafir authors"
FLOOR_2_M, DOOR_M = 2.9, 2.05
_LEAF_M = 0.04
_RISERS, _GOING_M = 15, 0.25


@dataclass(frozen=True)
class Box:
    """A box along the axes: x to the east, y to the north, z up, metres."""

    name: str
    x: _Ends
    y: _Ends
    z: _Ends
    material: str = ""

    @property
    def ends(self) -> tuple[_Ends, _Ends, _Ends]:
        return self.x, self.y, self.z


@dataclass(frozen=True)
class Room(Box):
    """Air. `material` is that of its walls."""

    floor: str = "oak parquet"
    ceiling: str = "plasterboard ceiling"


@dataclass(frozen=True)
class Leaf:
    """A door in a wall whose faces are at `x`, from `y[0]`, where it hangs, to `y[1]`."""

    name: str
    x: _Ends
    y: _Ends
    floor_m: float
    angle_deg: float

    @property
    def doorway(self) -> Room:
        return Room(f"doorway {self.name}", self.x, self.y, (self.floor_m, self.floor_m + DOOR_M), "wood frame")

    @property
    def node(self) -> WrittenNode:
        """The leaf, shut, in the middle of the wall. Its node stands at the hinge."""
        middle = sum(self.x) / 2
        hinge = np.array((middle, self.y[0], self.floor_m))
        ends = ((middle - _LEAF_M / 2, middle + _LEAF_M / 2), self.y, (self.floor_m, self.floor_m + DOOR_M))
        vertices, triangles = _box(ends)
        x, y, z = _gltf(hinge[None])[0].tolist()
        extras = {"nafir_kind": "swing", "nafir_angle_deg": self.angle_deg, "nafir_mass_kg_m2": 12.0}
        piece = Piece(_gltf(vertices - hinge), triangles, "wooden door")
        return WrittenNode(f"door_{self.name}", (piece,), {"translation": [x, y, z]}, extras)


ROOMS = (
    Room("hall", (4.0, 6.0), (0.0, 8.0), (0.0, 2.6), "painted wall", "tiles"),
    Room("landing", (4.0, 6.0), (0.0, 8.0), (FLOOR_2_M, 5.4), "painted wall", "oak parquet"),
    Room("stairwell", (5.0, 6.0), (3.25, 6.0), (2.6, FLOOR_2_M), "painted wall"),
    Room("living", (0.0, 3.85), (0.0, 8.0), (0.0, 2.6), "painted wall", "oak parquet"),
    Room("kitchen", (6.15, 10.0), (0.0, 4.5), (0.0, 2.6), "painted wall", "tiles"),
    Room("study", (6.15, 10.0), (4.65, 8.0), (0.0, 2.6), "plasterboard", "carpet"),
    Room("bedroom", (0.0, 3.85), (0.0, 8.0), (FLOOR_2_M, 5.4), "plasterboard", "carpet"),
    Room("bath", (6.15, 10.0), (0.0, 3.6), (FLOOR_2_M, 5.4), "ceramic tiles", "tiles"),
    Room("passage to the kitchen", (6.0, 6.15), (0.6, 1.9), (0.0, 2.2), "painted wall", "tiles"),
)
DOORS = (
    Leaf("living", (3.85, 4.0), (1.0, 1.9), 0.0, 90.0),
    Leaf("study", (6.0, 6.15), (6.8, 7.7), 0.0, -90.0),
    Leaf("bedroom", (3.85, 4.0), (1.0, 1.9), FLOOR_2_M, 90.0),
    Leaf("bath", (6.0, 6.15), (0.8, 1.7), FLOOR_2_M, -90.0),
)


def _steps() -> Iterator[Box]:
    rise = FLOOR_2_M / _RISERS
    for number in range(1, _RISERS):
        begin = 6.0 - _GOING_M * (_RISERS - number)
        yield Box("stairs", (5.0, 6.0), (begin, begin + _GOING_M), (0.0, round(rise * number, 4)), "wood")


def _table(name: str, x: _Ends, y: _Ends, floor_m: float, height_m: float = 0.74) -> Iterator[Box]:
    yield Box(name, x, y, (floor_m + height_m - 0.04, floor_m + height_m), "wood")
    for at_x in (x[0] + 0.05, x[1] - 0.11):
        for at_y in (y[0] + 0.05, y[1] - 0.11):
            yield Box(name, (at_x, at_x + 0.06), (at_y, at_y + 0.06), (floor_m, floor_m + height_m - 0.04), "wood")


FURNITURE = (
    *_steps(),
    Box("balustrade", (4.92, 5.0), (3.25, 6.0), (FLOOR_2_M, FLOOR_2_M + 0.95), "wood"),
    # Living room: a window to the west with curtains, a sofa before a low table, a rug and shelves.
    Box("window living", (-0.05, 0.0), (3.0, 5.4), (0.8, 2.2), "window glass"),
    Box("curtain living", (0.1, 0.2), (2.3, 2.9), (0.3, 2.4), "curtain"),
    Box("curtain living", (0.1, 0.2), (5.5, 6.1), (0.3, 2.4), "curtain"),
    Box("sofa", (0.9, 1.75), (6.9, 8.0), (0.0, 0.42), "sofa fabric"),
    Box("sofa", (1.75, 3.1), (7.15, 8.0), (0.0, 0.42), "sofa fabric"),
    Box("sofa", (0.9, 3.1), (7.8, 8.0), (0.42, 0.85), "sofa fabric"),
    Box("rug", (0.9, 3.1), (4.6, 6.6), (0.0, 0.015), "thick carpet"),
    *_table("coffee table", (1.5, 2.5), (5.2, 5.9), 0.015, 0.42),
    Box("shelf living", (3.5, 3.85), (2.6, 4.4), (0.0, 2.1), "wood"),
    Box("sideboard", (0.6, 2.4), (0.0, 0.45), (0.0, 0.7), "wood"),
    # Kitchen: a counter along two walls, and a table.
    Box("window kitchen", (10.0, 10.05), (1.2, 2.8), (1.0, 2.1), "window glass"),
    Box("counter", (9.4, 10.0), (0.0, 3.6), (0.0, 0.9), "wood panel"),
    Box("counter", (7.4, 9.4), (0.0, 0.6), (0.0, 0.9), "wood panel"),
    Box("fridge", (9.3, 10.0), (3.75, 4.5), (0.0, 1.85), "metal"),
    *_table("kitchen table", (7.0, 8.4), (2.4, 3.4), 0.0),
    # Study: a desk at the window, bookshelves.
    Box("window study", (7.4, 9.2), (8.0, 8.05), (0.9, 2.1), "window glass"),
    *_table("desk", (7.5, 9.1), (7.2, 7.95), 0.0),
    Box("bookshelf", (6.4, 9.6), (4.65, 4.95), (0.0, 2.2), "wood"),
    # Bedroom: a bed, a wardrobe, curtains.
    Box("window bedroom", (-0.05, 0.0), (3.2, 5.2), (FLOOR_2_M + 0.8, FLOOR_2_M + 2.1), "window glass"),
    Box("curtain bedroom", (0.1, 0.2), (2.4, 3.1), (FLOOR_2_M + 0.1, FLOOR_2_M + 2.3), "curtain"),
    Box("curtain bedroom", (0.1, 0.2), (5.3, 6.0), (FLOOR_2_M + 0.1, FLOOR_2_M + 2.3), "curtain"),
    Box("bed", (0.9, 2.7), (5.9, 8.0), (FLOOR_2_M, FLOOR_2_M + 0.5), "mattress"),
    Box("bed head", (0.9, 2.7), (7.9, 8.0), (FLOOR_2_M + 0.5, FLOOR_2_M + 1.0), "wood"),
    Box("wardrobe", (3.25, 3.85), (3.0, 5.4), (FLOOR_2_M, FLOOR_2_M + 2.2), "wood"),
    # Bath: a tub whose inside is air, a basin, a mirror.
    Box("tub", (8.3, 10.0), (2.8, 3.6), (FLOOR_2_M, FLOOR_2_M + 0.55), "ceramic"),
    Box("basin", (7.2, 7.9), (0.0, 0.5), (FLOOR_2_M + 0.7, FLOOR_2_M + 0.88), "ceramic"),
    Box("mirror", (7.1, 8.0), (-0.05, 0.0), (FLOOR_2_M + 1.1, FLOOR_2_M + 1.9), "mirror"),
    Box("window bath", (10.0, 10.05), (1.2, 2.0), (FLOOR_2_M + 1.2, FLOOR_2_M + 2.0), "window glass"),
)
HOLLOWS = (
    Room("inside of the tub", (8.4, 9.9), (2.9, 3.5), (FLOOR_2_M + 0.15, FLOOR_2_M + 0.55), "ceramic", "ceramic"),
)
SPAWNS = (
    Box("spawn_living", (1.0, 3.0), (2.0, 4.2), (0.0, 2.0)),
    Box("spawn_bedroom", (1.0, 3.0), (2.0, 5.0), (FLOOR_2_M, FLOOR_2_M + 2.0)),
)
EMITTERS = {
    "radio": (9.6, 1.6, 1.05),
    "television": (1.5, 0.3, 0.95),
    "computer": (7.0, 7.4, 0.9),
    "alarm": (3.4, 6.6, FLOOR_2_M + 0.9),
}
LISTENER, LISTENER_YAW_DEG = (4.5, 2.6, 1.6), 90.0


@dataclass
class _Matter:
    """What fills each cell of a grid whose planes are those of all boxes. `who` is an index in `boxes`, or -1 for the
    matter around; it is a room's where `air` is true."""

    boxes: Sequence[Box]
    planes: list[_Floats] = field(init=False)
    air: npt.NDArray[np.bool_] = field(init=False)
    who: _Integers = field(init=False)

    def __post_init__(self) -> None:
        ends = np.array([box.ends for box in self.boxes])
        self.planes = [np.unique(np.concatenate([ends[:, axis].ravel(), _beyond(ends[:, axis])])) for axis in range(3)]
        shape = tuple(len(planes) - 1 for planes in self.planes)
        self.air, self.who = np.zeros(shape, np.bool_), np.full(shape, -1)
        for index, box in enumerate(self.boxes):
            cells = tuple(
                slice(*np.searchsorted(planes, own).tolist()) for planes, own in zip(self.planes, box.ends, strict=True)
            )
            self.air[cells], self.who[cells] = isinstance(box, Room), index

    def faces(self) -> Iterator[tuple[str, str, _Floats]]:
        """(node, material, corners (4, 3)) of each face between matter and air, counter-clockwise as seen from the
        air."""
        for axis in range(3):
            one, two = (axis + 1) % 3, (axis + 2) % 3
            low = np.moveaxis(self.air, axis, 0)
            for k, i, j in np.argwhere(low[:-1] != low[1:]).tolist():
                index = [0, 0, 0]
                index[one], index[two] = (i, j) if one < two else (j, i)
                below, above = index.copy(), index.copy()
                below[axis], above[axis] = k, k + 1
                rises = bool(self.air[tuple(above)])
                air, solid = (above, below) if rises else (below, above)
                corners = np.empty((4, 3))
                corners[:, axis] = self.planes[axis][k + 1]
                corners[:, one] = self.planes[one][index[one] + np.array((0, 1, 1, 0))]
                corners[:, two] = self.planes[two][index[two] + np.array((0, 0, 1, 1))]
                node, material = self._surface(
                    int(self.who[tuple(air)]), int(self.who[tuple(solid)]), axis, rises=rises
                )
                yield node, material, corners if rises else corners[::-1]

    def _surface(self, air: int, solid: int, axis: int, *, rises: bool) -> tuple[str, str]:
        if solid >= 0:
            return self.boxes[solid].name, self.boxes[solid].material
        room = self.boxes[air]
        assert isinstance(room, Room)
        material = room.material if axis < 2 else room.floor if rises else room.ceiling
        return room.name, material


def house() -> list[WrittenNode]:
    """The nodes of the house, in glTF's axes."""
    matter = _Matter((*ROOMS, *(door.doorway for door in DOORS), *FURNITURE, *HOLLOWS))
    named: dict[tuple[str, str], int] = {}
    faces, owners = [], []
    for node, material, corners in matter.faces():
        faces.append(corners)
        owners.append(named.setdefault((node, material), len(named)))
    vertices, index = np.unique(np.concatenate(faces), axis=0, return_inverse=True)
    quads = index.reshape(-1, 4)
    triangles = np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])
    merged = merge_flat(vertices, triangles, np.array(owners * 2), 1e-6)
    owner = np.array(owners * 2)[merged.kept]
    pieces: dict[str, list[Piece]] = {}
    for (node, material), number in named.items():
        own = merged.triangles[owner == number]
        if len(own):
            used, compact = np.unique(own, return_inverse=True)
            pieces.setdefault(node, []).append(Piece(_gltf(vertices[used]), compact.reshape(-1, 3), material))
    nodes = [WrittenNode(name.replace(" ", "_"), tuple(own)) for name, own in pieces.items()]
    nodes += [door.node for door in DOORS]
    for name, place in EMITTERS.items():
        nodes.append(WrittenNode(f"emitter_{name}", (), {"translation": _gltf(np.array([place]))[0].tolist()}))
    start = {"translation": _gltf(np.array([LISTENER]))[0].tolist()}
    nodes.append(WrittenNode("listener_start", (), start, {"nafir_yaw_deg": LISTENER_YAW_DEG}))
    for area in SPAWNS:
        corners, sides = _box(area.ends)
        nodes.append(WrittenNode(area.name, (Piece(_gltf(corners), sides, "area"),)))
    return nodes


def _beyond(ends: _Floats) -> list[float]:
    """Planes around everything, so that each face has matter behind it."""
    return [float(ends.min()) - 1.0, float(ends.max()) + 1.0]


def _box(ends: Sequence[_Ends]) -> tuple[_Floats, _Integers]:
    """Vertices and triangles of a box, seen from outside."""
    (x0, x1), (y0, y1), (z0, z1) = ends
    corners = np.array([(x, y, z) for x in (x0, x1) for y in (y0, y1) for z in (z0, z1)])
    quads = np.array([(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)])
    return corners, np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])


def _gltf(points: _Floats) -> _Floats:
    """(x, y, z) with z up, as (x, y, z) with y up."""
    return np.stack([points[:, 0], points[:, 2], -points[:, 1]], axis=1) + 0.0


if __name__ == "__main__":
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "house.glb"
    write_glb(path, house(), NOTICE)
