"""Places of probes in a level: above the ground on which a listener can walk, on a jittered grid. Metres."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from server.acoustics.surroundings import MeshSurroundings
from training.data.levels.walkable import STEP_M, Ground, raised
from training.data.scene_file import CELLS_PER_BATCH, MOST_CELLS, Probes, SceneFileError

_Floats = npt.NDArray[np.float64]
_Integers = npt.NDArray[np.int64]
_Flags = npt.NDArray[np.bool_]

_DRAWS = 32
"""Of each patch, of which it takes the first that is clear."""


def require_few_cells(surroundings: MeshSurroundings, probes: Probes) -> None:
    """Raises SceneFileError for more cells than MOST_CELLS."""
    columns, rows = _sides(surroundings, probes).tolist()
    if columns * rows > MOST_CELLS:
        raise SceneFileError(
            f"probes.spacing_m: at most {MOST_CELLS:,} cells of a grid, and this is {columns:,} x {rows:,} cells"
        )


def probe_places(surroundings: MeshSurroundings, ground: Ground, probes: Probes, rng: np.random.Generator) -> _Floats:
    """(probe, 3) places of ears above the ground. Where a cell of a grid has ground, there is one near its middle, and
    another one on each further storey. Where there is no room for it, there is one elsewhere in the cell, if no other
    is as near as a cell is wide."""
    if not len(ground.spots):
        return np.zeros((0, 3))
    patches = _Patches.of(surroundings, ground, probes)
    in_the_middle = patches.middles[:, None] + rng.uniform(
        -probes.jitter_m, probes.jitter_m, (len(patches.middles), _DRAWS, 2)
    )
    places, is_clear = patches.places(np.arange(len(patches.middles)), in_the_middle, rng)
    found = places[is_clear]
    bare = np.flatnonzero(~is_clear)
    if len(found) and len(bare):
        bare = bare[cKDTree(found).query(patches.centres[bare])[0] > probes.spacing_m]
    spot = patches.first[bare, None] + (rng.random((len(bare), _DRAWS)) * patches.count[bare, None]).astype(np.int64)
    places, is_clear = patches.places(bare, patches.ground.spots[spot, :2], rng)
    return np.concatenate([found, places[is_clear]])


def _sides(surroundings: MeshSurroundings, probes: Probes) -> _Integers:
    """(2,) columns and rows of the grid of probes."""
    size = np.ptp(surroundings.bounds_m[:, :2], axis=0)
    return np.asarray(np.maximum(1, np.rint(size / probes.spacing_m)), dtype=np.int64)


@dataclass(frozen=True)
class _Patches:
    """The ground in parts: what is in one cell of the grid of probes, with no step between that nobody takes. The spots
    of a patch follow each other in `ground`, `count` (patch,) from `first` (patch,) on. `middles` (patch, 2) are those
    of their cells, and `centres` (patch, 3) are between the ears above their spots."""

    surroundings: MeshSurroundings
    ground: Ground
    probes: Probes
    first: _Integers
    count: _Integers
    middles: _Floats
    centres: _Floats
    keys: _Integers
    """(spot,) ascending, of the patch and the line of each."""
    spot_of_key: _Integers

    @classmethod
    def of(cls, surroundings: MeshSurroundings, ground: Ground, probes: Probes) -> "_Patches":
        low, sides = surroundings.bounds_m[0, :2], _sides(surroundings, probes)
        size = np.ptp(surroundings.bounds_m[:, :2], axis=0) / sides
        column, row = np.clip((ground.spots[:, :2] - low) // size, 0, sides - 1).astype(np.int64).T
        cell = column * sides[1] + row
        order = np.lexsort((ground.spots[:, 2], cell))
        spots, lines, cell = ground.spots[order], ground.lines[order], cell[order]
        begins = np.ones(len(spots), np.bool_)
        begins[1:] = (np.diff(cell) > 0) | (np.diff(spots[:, 2]) > STEP_M)
        first = np.flatnonzero(begins)
        count = np.diff(np.append(first, len(spots)))
        sorted_ground = Ground(spots, lines, ground.origin_m, ground.step_m)
        keys = _keys(np.cumsum(begins) - 1, lines, lines)
        by_key = np.argsort(keys)
        return cls(
            surroundings,
            sorted_ground,
            probes,
            first,
            count,
            low + (np.stack(np.divmod(cell[first], sides[1]), axis=-1) + 0.5) * size,
            raised(np.add.reduceat(spots, first) / count[:, None], float(np.mean(probes.heights_m))),
            keys[by_key],
            by_key,
        )

    def places(self, patches: _Integers, draws: _Floats, rng: np.random.Generator) -> tuple[_Floats, _Flags]:
        """(n, 3) the first place of each of n patches that is clear, of those above `draws` (n, draw, 2), and (n,)
        whether there is one."""
        places, is_clear = np.empty((len(patches), 3)), np.zeros(len(patches), np.bool_)
        for begin in range(0, len(patches), CELLS_PER_BATCH):
            some = slice(begin, begin + CELLS_PER_BATCH)
            tried, clear = self._tried(patches[some], draws[some], rng)
            first = np.argmax(clear, axis=1)
            places[some] = tried[np.arange(len(tried)), first]
            is_clear[some] = clear.any(axis=1)
        return places, is_clear

    def _tried(self, patches: _Integers, draws: _Floats, rng: np.random.Generator) -> tuple[_Floats, _Flags]:
        """(n, draw, 3) places at random heights above draws, and (n, draw) whether they are clear of surfaces and above
        the ground of their patch."""
        low_m, high_m = self.probes.heights_m
        spot, is_known = self._spots_at(patches, draws)
        ears = raised(spot, low_m)
        tops = np.concatenate([draws, ears[..., 2:]], axis=-1)
        down = self.surroundings.tree.closest(tops.reshape(-1, 3), np.array((0.0, 0.0, -1.0))).distance
        ground_m = tops[..., 2] - down.reshape(is_known.shape)
        is_clear = is_known & (np.abs(ground_m - spot[..., 2]) <= STEP_M)
        places = tops.copy()
        places[..., 2] = np.where(is_clear, ground_m, spot[..., 2]) + rng.uniform(low_m, high_m, is_known.shape)
        is_clear &= self.surroundings.tree.distance_m(places) >= self.probes.wall_clearance_m
        is_clear &= self.surroundings.contains(places) & self.surroundings.is_visible(ears, places)
        return places, is_clear

    def _spots_at(self, patches: _Integers, draws: _Floats) -> tuple[_Floats, _Flags]:
        """(n, draw, 3) the spot of each draw's patch on the line next to it, and (n, draw) whether there is one."""
        lines = np.rint((draws - self.ground.origin_m) / self.ground.step_m).astype(np.int64)
        is_on_grid = ((lines >= 0) & (lines <= self.ground.lines.max(axis=0))).all(axis=-1)
        wanted = _keys(patches[:, None], lines, self.ground.lines)
        at = np.minimum(np.searchsorted(self.keys, wanted), len(self.keys) - 1)
        return self.ground.spots[self.spot_of_key[at]], is_on_grid & (self.keys[at] == wanted)


def _keys(patch: _Integers, lines: _Integers, of_all: _Integers) -> _Integers:
    """(...,) a number for each patch and line (..., 2), which is among the columns and rows of the whole ground."""
    columns, rows = (of_all.max(axis=0) + 1).tolist()
    return np.asarray((patch * columns + lines[..., 0]) * rows + lines[..., 1])
