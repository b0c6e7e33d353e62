"""A furnished scene as rectangles: floor, ceiling and walls of a scene file, and furniture of our own.

Scene files name no furniture, because its absorption is part of the surfaces that it stands on. So furniture is drawn
at random here, the same for the same seed: along walls, clear of openings, each piece made of boxes. Metres.
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from server.scene.geometry import Geometry
from server.scene.rooms import Room, rooms_of

_Floats = npt.NDArray[np.float64]

_TRIES = 60
_DOOR_CLEARANCE_M = 0.75
_GAP_M = 0.25
_PICTURE_GAP_M = 0.3


class Kind(IntEnum):
    """What a rectangle shows; decides its texture."""

    FLOOR = 0
    CEILING = 1
    WALL = 2
    WOOD = 3
    FABRIC = 4
    BOOKS = 5
    PICTURE = 6
    CARPET = 7
    LAMP = 8


@dataclass(frozen=True)
class Box:
    """An axis-parallel box from `low` to `high`. `style` seeds its colours."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    kind: Kind
    style: int


@dataclass(frozen=True)
class Surfaces:
    """Rectangles, seen from one side: `origin`, `along` and `up` (rectangle, 3), a corner and the edges from it;
    `normal` (rectangle, 3) of length one, towards the side that is seen; `kind` and `style` (rectangle,)."""

    origin: _Floats
    along: _Floats
    up: _Floats
    normal: _Floats
    kind: npt.NDArray[np.int64]
    style: npt.NDArray[np.int64]

    @property
    def size_m(self) -> _Floats:
        """(rectangle, 2) lengths of both edges."""
        return np.stack([np.linalg.norm(self.along, axis=-1), np.linalg.norm(self.up, axis=-1)], axis=-1)


@dataclass(frozen=True)
class Flat:
    """A furnished scene. `lamps` (lamp, 3) are the middles of its lamps."""

    geometry: Geometry
    rooms: tuple[Room, ...]
    boxes: tuple[Box, ...]
    lamps: _Floats
    surfaces: Surfaces

    @classmethod
    def furnished(cls, geometry: Geometry, seed: int) -> "Flat":
        rooms = tuple(rooms_of(geometry))
        boxes: list[Box] = []
        lamps = []
        for number, room in enumerate(rooms):
            rng = np.random.default_rng([seed, 11, number])
            boxes += _Furnisher(geometry, room, rng).furnish()
            lamps.append((*_middle_of(room), geometry.height_m - 0.3))
        for x, y, z in lamps:
            boxes.append(Box((x - 0.12, y - 0.12, z + 0.05), (x + 0.12, y + 0.12, z + 0.25), Kind.LAMP, 0))
        return cls(geometry, rooms, tuple(boxes), np.array(lamps), _surfaces_of(geometry, boxes))

    def is_free(self, points: _Floats, clearance_m: float) -> npt.NDArray[np.bool_]:
        """(...,) whether each point is inside the walls, and this far from walls and furniture."""
        plan = self.geometry.floor_plan
        free = plan.contains(points) & (plan.wall_distance_m(points) >= clearance_m)
        for box in self.boxes:
            outside = np.maximum(np.array(box.low) - points, points - np.array(box.high))
            free &= np.linalg.norm(np.maximum(outside, 0.0), axis=-1) >= clearance_m
        return free

    def room_of(self, points: _Floats) -> npt.NDArray[np.int64]:
        """(...,) number of the room that each point is in; 0 if it is in none."""
        number = np.zeros(points.shape[:-1], dtype=np.int64)
        for each, room in enumerate(self.rooms):
            number[room.plan.contains(points)] = each
        return number


class _Furnisher:
    """Places furniture in one room."""

    def __init__(self, geometry: Geometry, room: Room, rng: np.random.Generator) -> None:
        self._room, self._rng = room, rng
        self._openings = [np.array([opening.start, opening.end]) for opening in geometry.openings]
        self._height_m = geometry.height_m
        self._taken: list[tuple[_Floats, _Floats]] = []
        walls = room.plan.walls
        doors = {frozenset((opening.start, opening.end)) for opening in geometry.openings}
        self._walls = [
            wall
            for wall in walls
            if frozenset(map(tuple, wall.tolist())) not in doors and np.min(np.abs(wall[1] - wall[0])) < 1e-9
        ]

    def furnish(self) -> list[Box]:
        boxes: list[Box] = []
        pieces = [self._bed, self._sofa, self._wardrobe, self._shelf, self._table, self._sideboard, self._shelf]
        most = 2 + int(self._room.plan.area_m2 / 4)
        for piece in self._rng.permutation(np.arange(len(pieces)))[:most]:
            boxes += pieces[piece]()
        boxes += self._carpet()
        for _ in range(6):
            boxes += self._picture()
        return boxes

    def _style(self) -> int:
        return int(self._rng.integers(1, 1 << 30))

    def _against_wall(self, length_m: float, depth_m: float) -> "_Frame | None":
        """A free place against some wall, or None if there is none."""
        for _ in range(_TRIES):
            start, end = self._walls[self._rng.integers(len(self._walls))]
            room_m = float(np.linalg.norm(end - start)) - length_m - 0.04
            if room_m < 0:
                continue
            along = (end - start) / np.linalg.norm(end - start)
            inwards = np.array([-along[1], along[0]])
            corner = start + along * (0.02 + self._rng.uniform(0, room_m)) + 0.01 * inwards
            frame = _Frame(corner, along, inwards, length_m, depth_m)
            if self._fits(*frame.footprint()):
                self._taken.append(frame.footprint())
                return frame
        return None

    def _fits(self, low: _Floats, high: _Floats) -> bool:
        """Whether a footprint lies in the room, clear of other furniture and of openings."""
        x, y = np.meshgrid(np.linspace(low[0], high[0], 7), np.linspace(low[1], high[1], 7))
        if not self._room.plan.contains(np.stack([x, y, 0 * x], axis=-1)).all():
            return False
        if any((low - _GAP_M < other[1]).all() and (high + _GAP_M > other[0]).all() for other in self._taken):
            return False
        for ends in self._openings:
            ways = ends[0] + np.linspace(0, 1, 9)[:, None] * (ends[1] - ends[0])
            outside = np.maximum(np.maximum(low - ways, ways - high), 0)
            if np.linalg.norm(outside, axis=-1).min() < _DOOR_CLEARANCE_M:
                return False
        return True

    def _bed(self) -> list[Box]:
        frame, wood, fabric, pillow = self._against_wall(1.5, 2.0), self._style(), self._style(), self._style()
        if frame is None:
            return []
        return [
            frame.box((0, 1.5), (0, 0.08), (0, 0.95), Kind.WOOD, wood),
            frame.box((0, 1.5), (0.08, 2.0), (0, 0.28), Kind.WOOD, wood),
            frame.box((0, 1.5), (0.08, 2.0), (0.28, 0.52), Kind.FABRIC, fabric),
            frame.box((0.12, 0.7), (0.14, 0.5), (0.52, 0.62), Kind.FABRIC, pillow),
            frame.box((0.8, 1.38), (0.14, 0.5), (0.52, 0.62), Kind.FABRIC, pillow),
        ]

    def _sofa(self) -> list[Box]:
        frame, fabric, cushion = self._against_wall(2.0, 0.9), self._style(), self._style()
        if frame is None:
            return []
        return [
            frame.box((0, 2.0), (0, 0.22), (0, 0.8), Kind.FABRIC, fabric),
            frame.box((0, 0.2), (0.22, 0.9), (0, 0.58), Kind.FABRIC, fabric),
            frame.box((1.8, 2.0), (0.22, 0.9), (0, 0.58), Kind.FABRIC, fabric),
            frame.box((0.2, 1.8), (0.22, 0.88), (0, 0.42), Kind.FABRIC, cushion),
        ]

    def _wardrobe(self) -> list[Box]:
        frame, wood = self._against_wall(1.3, 0.6), self._style()
        return [] if frame is None else [frame.box((0, 1.3), (0, 0.6), (0, 2.05), Kind.WOOD, wood)]

    def _shelf(self) -> list[Box]:
        frame, books = self._against_wall(1.1, 0.35), self._style()
        return [] if frame is None else [frame.box((0, 1.1), (0, 0.35), (0, 1.75), Kind.BOOKS, books)]

    def _sideboard(self) -> list[Box]:
        frame, wood, vase = self._against_wall(1.2, 0.45), self._style(), self._style()
        if frame is None:
            return []
        return [
            frame.box((0, 1.2), (0, 0.45), (0, 0.78), Kind.WOOD, wood),
            frame.box((0.2, 0.4), (0.12, 0.32), (0.78, 1.08), Kind.FABRIC, vase),
        ]

    def _table(self) -> list[Box]:
        """A table in the room, with four legs and two stools."""
        low, high = self._room.plan.walls[:, 0].min(axis=0), self._room.plan.walls[:, 0].max(axis=0)
        wood, seat = self._style(), self._style()
        for _ in range(_TRIES):
            corner = self._rng.uniform(low + 0.8, np.maximum(low + 0.81, high - 0.8 - np.array([1.3, 1.6])))
            frame = _Frame(corner, np.array([1.0, 0.0]), np.array([0.0, 1.0]), 1.3, 1.6)
            if self._fits(*frame.footprint()):
                break
        else:
            return []
        self._taken.append(frame.footprint())
        legs = [(x, y) for x in (0.03, 1.21) for y in (0.43, 1.11)]
        return [
            frame.box((0, 1.3), (0.4, 1.2), (0.7, 0.75), Kind.WOOD, wood),
            *(frame.box((x, x + 0.06), (y, y + 0.06), (0, 0.7), Kind.WOOD, wood) for x, y in legs),
            frame.box((0.45, 0.85), (0, 0.38), (0, 0.45), Kind.FABRIC, seat),
            frame.box((0.45, 0.85), (1.22, 1.6), (0, 0.45), Kind.FABRIC, seat),
        ]

    def _carpet(self) -> list[Box]:
        low, high = self._room.plan.walls[:, 0].min(axis=0), self._room.plan.walls[:, 0].max(axis=0)
        size = np.minimum((high - low) * 0.45, 2.4)
        corner = (low + high - size) / 2
        x, y = np.meshgrid(
            np.linspace(corner[0], corner[0] + size[0], 7), np.linspace(corner[1], corner[1] + size[1], 7)
        )
        if not self._room.plan.contains(np.stack([x, y, 0 * x], axis=-1)).all():
            return []
        (x0, y0), (x1, y1) = corner, corner + size
        return [Box((x0, y0, 0.0), (x1, y1, 0.015), Kind.CARPET, self._style())]

    def _picture(self) -> list[Box]:
        width, height = self._rng.uniform(0.5, 1.1), self._rng.uniform(0.4, 0.8)
        bottom = self._rng.uniform(1.15, max(1.16, min(1.5, self._height_m - height - 0.2)))
        style = self._style()
        for _ in range(8):
            start, end = self._walls[self._rng.integers(len(self._walls))]
            room_m = float(np.linalg.norm(end - start)) - width - 2 * _PICTURE_GAP_M
            if room_m < 0:
                continue
            along = (end - start) / np.linalg.norm(end - start)
            inwards = np.array([-along[1], along[0]])
            corner = start + along * (_PICTURE_GAP_M + self._rng.uniform(0, room_m))
            frame = _Frame(corner, along, inwards, width, 0.03)
            low, high = frame.footprint()
            if not any((low < other[1]).all() and (high > other[0]).all() for other in self._taken):
                self._taken.append((low, high))
                return [frame.box((0, width), (0, 0.03), (bottom, bottom + height), Kind.PICTURE, style)]
        return []


@dataclass(frozen=True)
class _Frame:
    """A rectangle in plan with axes of its own: along a wall, and away from it."""

    corner: _Floats
    along: _Floats
    inwards: _Floats
    length_m: float
    depth_m: float

    def footprint(self) -> tuple[_Floats, _Floats]:
        ends = np.stack([self.corner, self.corner + self.length_m * self.along + self.depth_m * self.inwards])
        return ends.min(axis=0), ends.max(axis=0)

    def box(
        self, x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], kind: Kind, style: int
    ) -> Box:
        ends = np.stack([self.corner + a * self.along + b * self.inwards for a, b in zip(x, y, strict=True)])
        (x0, y0), (x1, y1) = ends.min(axis=0).tolist(), ends.max(axis=0).tolist()
        return Box((x0, y0, z[0]), (x1, y1, z[1]), kind, style)


def _middle_of(room: Room) -> tuple[float, float]:
    """The place in a room that is farthest from its walls."""
    corners = room.plan.walls[:, 0]
    low, high = corners.min(axis=0), corners.max(axis=0)
    x, y = np.meshgrid(np.linspace(low[0], high[0], 41), np.linspace(low[1], high[1], 41))
    points = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    distance_m = np.where(room.plan.contains(points), room.plan.wall_distance_m(points), -1.0)
    # Of places that are about as far from the walls, the one nearest to the middle.
    centre = (low + high) / 2
    score = np.minimum(distance_m, 0.9 * distance_m.max()) - 0.05 * np.linalg.norm(points[:, :2] - centre, axis=-1)
    at = points[int(np.argmax(score))]
    return float(at[0]), float(at[1])


def _surfaces_of(geometry: Geometry, boxes: list[Box]) -> Surfaces:
    plan = geometry.floor_plan
    low, high = np.min(plan.corners, axis=0), np.max(plan.corners, axis=0)
    width, depth = high - low
    found: list[tuple[_Floats, _Floats, _Floats, Kind, int]] = [
        (np.array([*low, plan.floor_m]), np.array([width, 0, 0]), np.array([0, depth, 0]), Kind.FLOOR, 0),
        (np.array([*low, plan.height_m]), np.array([0, depth, 0]), np.array([width, 0, 0]), Kind.CEILING, 0),
    ]
    up = np.array([0, 0, plan.height_m - plan.floor_m])
    for start, end in plan.walls:
        # The inside is on a wall's left, and `along` times `up` would point to its right: so it runs backwards.
        found.append((np.array([*end, plan.floor_m]), np.array([*(start - end), 0.0]), up, Kind.WALL, 0))
    for box in boxes:
        (x0, y0, z0), (x1, y1, z1) = box.low, box.high
        a, b, c = np.array([x1 - x0, 0, 0]), np.array([0, y1 - y0, 0]), np.array([0, 0, z1 - z0])
        faces = [
            ((x0, y0, z1), a, b),
            ((x0, y0, z0), b, a),
            ((x0, y0, z0), a, c),
            ((x1, y1, z0), -a, c),
            ((x1, y0, z0), b, c),
            ((x0, y1, z0), -b, c),
        ]
        found += [(np.array(corner), first, second, box.kind, box.style) for corner, first, second in faces]
    origin, along, upwards = (np.array([each[part] for each in found], dtype=np.float64) for part in range(3))
    normal = np.cross(along, upwards)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    kind, style = (np.array([int(each[part]) for each in found]) for part in (3, 4))
    return Surfaces(origin, along, upwards, normal, kind, style)
