"""Places of probes in a level: on a jittered grid above each floor.

A floor is the surfaces that face up at one height, if they are large enough; the tops of tables are none. Metres.
"""

import numpy as np
import numpy.typing as npt

from server.acoustics.mesh import TriangleMesh
from server.acoustics.surroundings import MeshSurroundings
from training.data.scene_file import Probes

_Floats = npt.NDArray[np.float64]

_UPRIGHT = 0.9
"""The least vertical component of a floor's normal."""
_SAME_FLOOR_M = 0.1
_LEAST_M2, _LEAST_SHARE = 1.0, 0.2
"""The least area of a floor, and its least share of the largest one's."""
_DRAWS_PER_CELL = 32
_ABOVE_GROUND_M = 0.3
"""Under a probe is its floor, or what stands on it by no more than this below; elsewhere there is a void."""


def floors_of(mesh: TriangleMesh) -> list[float]:
    """Heights of the floors, from below."""
    level = mesh.normals[:, 2] > _UPRIGHT
    heights, areas = mesh.corners_m[level, :, 2].mean(axis=-1), mesh.areas_m2[level]
    order = np.argsort(heights)
    heights, areas = heights[order], areas[order]
    floors = np.split(np.arange(len(heights)), np.flatnonzero(np.diff(heights) > _SAME_FLOOR_M) + 1)
    sizes = [float(areas[floor].sum()) for floor in floors]
    least = max(_LEAST_M2, _LEAST_SHARE * max(sizes, default=0.0))
    return [
        float(np.average(heights[floor], weights=areas[floor]))
        for floor, size in zip(floors, sizes, strict=True)
        if size >= least
    ]


def probe_places(surroundings: MeshSurroundings, probes: Probes, rng: np.random.Generator) -> _Floats:
    """(probe, 3) one place in each cell of each floor's grid, if there is room for one."""
    low, high = surroundings.bounds_m[:, :2]
    cells = np.maximum(1, np.rint((high - low) / probes.spacing_m)).astype(int)
    column, row = np.meshgrid(*map(np.arange, cells), indexing="ij")
    centres = low + (np.stack([column.ravel(), row.ravel()], axis=-1) + 0.5) * (high - low) / cells
    found = []
    for floor_m in floors_of(surroundings.mesh):
        draws = np.empty((len(centres), _DRAWS_PER_CELL, 3))
        draws[..., :2] = centres[:, None] + rng.uniform(-probes.jitter_m, probes.jitter_m, draws[..., :2].shape)
        draws[..., 2] = floor_m + rng.uniform(*probes.heights_m, draws.shape[:2])
        for some in draws:
            clear = surroundings.contains(some) & (surroundings.tree.distance_m(some) >= probes.wall_clearance_m)
            below = surroundings.tree.closest(some, np.array([0.0, 0.0, -1.0]))
            clear &= below.distance <= some[:, 2] - floor_m + _ABOVE_GROUND_M
            if clear.any():
                found.append(some[np.argmax(clear)])
    return np.array(found).reshape(-1, 3)
