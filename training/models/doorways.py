"""Which doors sound goes through on its way from place to place, so that a field need not learn from a few states which
doors matter to whom.

Rooms are what shut doors part. A way from room to room takes as few doors as possible. Where several are equally short,
one of them counts. The walls between rooms are parted in their middle, so that no room changes at places where a
listener can be. Lengths are in metres.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt

from server.acoustics.mesh import TriangleMesh
from training.data.levels.examination import SMALLEST_ROOM_M3
from training.data.levels.level_scene import LevelScene
from training.data.levels.space import OUTSIDE, Space, sample_space

_BESIDE_M = (0.1, 0.2, 0.3, 0.5)
"""How far from the middle of a leaf it is looked for the rooms on both sides."""


@dataclass(frozen=True)
class Doorways:
    """`rooms` (x, y, z) is the number of the room at, or else nearest to, each point of a grid. `on_the_way` (room,
    room, door) is 1 for doors between two rooms, and 0 for others."""

    origin_m: npt.NDArray[np.float64]
    step_m: float
    rooms: npt.NDArray[np.uint8]
    on_the_way: npt.NDArray[np.float32]

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
        return cls(space.origin_m, space.step_m, rooms, _ways(joins, len(used)))


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
