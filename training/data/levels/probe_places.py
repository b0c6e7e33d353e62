"""Places of probes in a level: on a jittered grid above each floor. Metres."""

import numpy as np
import numpy.typing as npt

from server.acoustics.mesh_plan import SAME_FLOOR_M, floors_of
from server.acoustics.surroundings import MeshSurroundings
from training.data.scene_file import CELLS_PER_BATCH, MOST_CELLS, Probes, SceneFileError

_Floats = npt.NDArray[np.float64]

_DRAWS_PER_CELL = 32
_ABOVE_GROUND_M = 0.3
"""Under a probe is its floor, or what stands on it, or what lies no farther below it; elsewhere there is a void, or
another floor."""


def probe_places(surroundings: MeshSurroundings, probes: Probes, rng: np.random.Generator) -> _Floats:
    """(probe, 3) one place in each cell of each floor's grid, if there is room for one above that floor. Raises
    SceneFileError for more cells than MOST_CELLS, before anything is drawn."""
    low, high = surroundings.bounds_m[:, :2]
    sides = np.maximum(1, np.rint((high - low) / probes.spacing_m))
    floors = floors_of(surroundings.mesh)
    if len(floors) * sides.prod() > MOST_CELLS:
        count = f"{sides[0]:,.0f} x {sides[1]:,.0f} cells above each of {len(floors)}"
        raise SceneFileError(f"probes.spacing_m: at most {MOST_CELLS:,} cells above all floors, and this is {count}")
    column, row = np.meshgrid(*map(np.arange, sides), indexing="ij")
    centres = low + (np.stack([column.ravel(), row.ravel()], axis=-1) + 0.5) * (high - low) / sides
    found = [np.zeros((0, 3))]
    for below_m, floor_m, next_m in zip([-np.inf, *floors], floors, [*floors[1:], np.inf], strict=False):
        # Ground between two floors is the lower one's, where that has probes so far up.
        is_shared = below_m + probes.heights_m[1] > floor_m - _ABOVE_GROUND_M
        least_m = floor_m - (SAME_FLOOR_M if is_shared else _ABOVE_GROUND_M)
        for begin in range(0, len(centres), CELLS_PER_BATCH):
            some = centres[begin : begin + CELLS_PER_BATCH]
            draws = np.empty((len(some), _DRAWS_PER_CELL, 3))
            draws[..., :2] = some[:, None] + rng.uniform(-probes.jitter_m, probes.jitter_m, draws[..., :2].shape)
            draws[..., 2] = floor_m + rng.uniform(*probes.heights_m, draws.shape[:2])
            flat = draws.reshape(-1, 3)
            clear = surroundings.contains(flat) & (surroundings.tree.distance_m(flat) >= probes.wall_clearance_m)
            ground_m = flat[:, 2] - surroundings.tree.closest(flat, np.array([0.0, 0.0, -1.0])).distance
            clear &= (ground_m >= least_m) & (ground_m < next_m - SAME_FLOOR_M)
            by_cell = clear.reshape(draws.shape[:2])
            # Each cell takes its first draw that is clear.
            found.append(draws[np.arange(len(some)), np.argmax(by_cell, axis=1)][by_cell.any(axis=1)])
    return np.concatenate(found)
