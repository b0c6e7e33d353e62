"""Which doors sound goes through on its way from place to place, and how much of it passes a door that is ajar: so a
field need not learn from a few states which doors matter to whom, and from where on a leaf lets sound by.

Rooms are what shut doors part. A way from room to room takes as few doors as possible. Where several are equally short,
one of them counts. The walls between rooms are parted in their middle, so that no room changes at places where a
listener can be. Lengths are in metres.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt

from server.acoustics.doors import DoorLeaf
from server.acoustics.mesh import TriangleMesh
from server.acoustics.mesh_tree import MeshTree
from training.data.levels.examination import SMALLEST_ROOM_M3
from training.data.levels.level_scene import LevelScene
from training.data.levels.space import OUTSIDE, Space, sample_space

_BESIDE_M = (0.1, 0.2, 0.3, 0.5)
"""How far from the middle of a leaf it is looked for the rooms on both sides."""
_STEPS = 32
"""Parts of the way of a leaf: a few centimetres of a door's edge each."""
_RAYS = 8_000
_THROUGH_M = 1.0
"""How far a ray has to get on both sides of a leaf: further than a leaf reaches into a room."""
_FACING = 0.999
"""Cosine from which on a triangle belongs to the face of a leaf."""


@dataclass(frozen=True)
class Doorways:
    """`rooms` (x, y, z) is the number of the room at, or else nearest to, each point of a grid. `on_the_way` (room,
    room, door) is 1 for doors between two rooms, and 0 for others. `apertures` (door, step) is the power that passes a
    door as its leaf opens in equal steps, as a share of what passes when it is open (`aperture`)."""

    origin_m: npt.NDArray[np.float64]
    step_m: float
    rooms: npt.NDArray[np.uint8]
    on_the_way: npt.NDArray[np.float32]
    apertures: npt.NDArray[np.float32]

    @classmethod
    def of_level(cls, level: LevelScene) -> "Doorways":
        """Of all doors of a level, in its order."""
        doors = level.mesh_with_doors()
        mesh = doors.mesh_at((0.0,) * len(doors.leaves))
        space = sample_space(mesh.vertices_m[mesh.triangles])
        is_room = space.volumes_m3 >= SMALLEST_ROOM_M3
        is_room[OUTSIDE] = level.file.geometry.open_sky
        beside = [_rooms_beside(leaf.mesh, space, is_room) for leaf in doors.leaves]
        # Of very many closed spaces, those without a door are nobody's.
        used = np.unique([room for pair in beside for room in pair] or np.flatnonzero(is_room)[:1])
        number = np.zeros(len(is_room), np.uint8)
        number[used] = np.arange(len(used))
        joins = [(int(number[one]), int(number[other])) for one, other in beside]
        nearest = distance_transform_edt(~np.isin(space.region, used), return_distances=False, return_indices=True)
        rooms = number[space.region[tuple(nearest)]]
        apertures = np.stack([aperture(leaf, doors.still) for leaf in doors.leaves])
        return cls(space.origin_m, space.step_m, rooms, _ways(joins, len(used)), apertures)


def aperture(leaf: DoorLeaf, still: TriangleMesh) -> npt.NDArray[np.float32]:
    """(step,) the power of a diffuse field that passes a doorway with the leaf shut, opened by one step after the
    other, and open, as a share of the last. `still` is the mesh without leaves.

    The power is that of straight rays through the middle plane of the shut leaf, from both sides in proportion to the
    cosine of their angle (Kuttruff, Room Acoustics, 4.1), by the Monte Carlo method. In a deep frame, a door that is
    hardly ajar lets nothing by. A leaf that is in nobody's way is taken to let by as much as it is open.
    """
    shut = leaf.mesh
    normal = shut.normals[int(np.argmax(shut.areas_m2))]
    points = _points_on(shut, np.flatnonzero(shut.normals @ normal > _FACING))
    points -= ((points - shut.vertices_m.mean(axis=0)) @ normal)[:, None] * normal
    towards = _diffuse(normal) * _THROUGH_M
    one, other = points - towards, points + towards
    is_free = MeshTree(still).is_visible(one, other)
    passed = np.array(
        [
            np.count_nonzero(MeshTree(leaf.at(float(share))).is_visible(one[is_free], other[is_free]))
            for share in np.linspace(0, 1, _STEPS + 1)
        ],
        np.float32,
    )
    # guard: a leaf that does not let by more as it opens has no aperture
    if passed[-1] <= passed[0]:
        return np.linspace(0, 1, _STEPS + 1, dtype=np.float32)
    return np.asarray(passed / passed[-1])


def _points_on(mesh: TriangleMesh, triangles: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
    """(ray, 3) points that are evenly distributed over these triangles."""
    rng = np.random.default_rng(0)
    areas = mesh.areas_m2[triangles]
    corners = mesh.corners_m[rng.choice(triangles, _RAYS, p=areas / areas.sum())]
    along, across = np.sqrt(rng.random((_RAYS, 1))), rng.random((_RAYS, 1))
    weights = np.concatenate([1 - along, along * (1 - across), along * across], axis=1)
    return np.asarray(np.einsum("rc,rcx->rx", weights, corners))


def _diffuse(normal: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """(ray, 3) directions about a normal, as often as the cosine of their angle to it."""
    rng = np.random.default_rng(1)
    beside = np.cross(normal, np.eye(3)[int(np.argmin(abs(normal)))])
    beside /= np.linalg.norm(beside)
    share, turn = rng.random((_RAYS, 1)), 2 * np.pi * rng.random((_RAYS, 1))
    sideways = np.cos(turn) * beside + np.sin(turn) * np.cross(normal, beside)
    return np.asarray(np.sqrt(1 - share) * normal + np.sqrt(share) * sideways)


def _rooms_beside(leaf: TriangleMesh, space: Space, is_room: npt.NDArray[np.bool_]) -> tuple[int, int]:
    """The rooms on both sides of a shut leaf; one twice if it parts none."""
    largest = int(np.argmax(leaf.areas_m2))
    middle, normal = leaf.vertices_m.mean(axis=0), leaf.normals[largest]
    found = [
        next((int(room) for room in space.regions_at(middle + side * away) if is_room[room]), None)
        for side, away in ((side, normal * np.array(_BESIDE_M)[:, None]) for side in (-1, 1))
    ]
    known = [room for room in found if room is not None]
    return (known[0], known[-1]) if known else (int(np.argmax(is_room)),) * 2


def _ways(joins: list[tuple[int, int]], rooms: int) -> npt.NDArray[np.float32]:
    """(room, room, door) the doors on the shortest way between rooms, of doors that each join two."""
    ways = np.zeros((rooms, rooms, len(joins)), np.float32)
    for start in range(rooms):
        reached, waiting = {start}, deque([start])
        while waiting:
            here = waiting.popleft()
            for door, ends in enumerate(joins):
                for near, far in (ends, ends[::-1]):
                    if near == here and far not in reached:
                        ways[start, far] = ways[start, here]
                        ways[start, far, door] = 1
                        reached.add(far)
                        waiting.append(far)
    there = np.triu_indices(rooms)
    ways[there[1], there[0]] = ways[there]  # the same way back, also of several
    return ways
