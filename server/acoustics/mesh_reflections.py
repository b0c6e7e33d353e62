"""Early reflections in a triangle mesh: sound that is reflected once, by a planar patch.

A patch is a group of coplanar triangles that are joined by edges. It mirrors on both sides, with the material of the
triangle that is met. Points and unit vectors are (..., xyz) in world coordinates, in metres. Bands are OCTAVE_BANDS_HZ.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.acoustics.mesh_reflections_kernel import Patches, find_patch_reflections
from server.acoustics.mesh_tree import MeshTree, fitted_planes, flatness_m, patches_of
from server.acoustics.mesh_tree_kernel import STACK
from server.acoustics.reflections import FirstEcho, Reflections

_Floats = npt.NDArray[np.float64]
_Integers = npt.NDArray[np.int32]

MOST_REFLECTIONS = 64
"""The most reflections of an emitter that are found. Larger patches are tried first."""
# A patch with less area than this mirrors nothing that is heard.
_LEAST_M2 = 1e-4


class MeshReflectionFinder:
    """Finds the early reflections in one mesh. `gains_db` (material, band) are the specular gains of its materials, in
    their order. `patches` are the mesh's, if they were made already. Safe to share between threads."""

    def __init__(self, tree: MeshTree, gains_db: npt.ArrayLike, patches: Patches | None = None) -> None:
        self._tree = tree.tree
        self._gains_db = np.array(gains_db, dtype=np.float64)
        self._surfaces = tree.mesh.surfaces
        self._patches = mirrors_of(tree) if patches is None else patches
        # Compile here, so that the first pose need not wait for it.
        self.find(np.zeros(3), np.zeros((1, 3)))

    def find(self, listener: npt.ArrayLike, emitters: npt.ArrayLike) -> Reflections:
        """Find the reflections at `listener` (3,) from `emitters` (n, 3)."""
        listener = np.ascontiguousarray(listener, dtype=np.float64)
        emitters = np.ascontiguousarray(emitters, dtype=np.float64)
        room = len(emitters) * min(MOST_REFLECTIONS, len(self._patches.offsets))
        emitter, triangle = np.empty(room, np.int64), np.empty(room, np.int32)
        length_m, arrival, departure = np.empty(room), np.empty((room, 3)), np.empty((room, 3))
        count = find_patch_reflections(
            self._tree,
            self._patches,
            np.empty(STACK, np.int32),
            listener,
            emitters,
            min(MOST_REFLECTIONS, len(self._patches.offsets)),
            emitter,
            triangle,
            length_m,
            arrival,
            departure,
        )
        surfaces = self._surfaces[triangle[:count]]
        return Reflections(
            emitter[:count], length_m[:count], arrival[:count], departure[:count], self._gains_db[surfaces]
        )


@dataclass(frozen=True)
class MeshWallLosses:
    """The walls of a mesh. `losses_db` (material, band) is what a wall of each material takes, infinite where it lets
    no sound through."""

    tree: MeshTree
    losses_db: _Floats

    def between(self, listener: npt.ArrayLike, emitters: npt.ArrayLike) -> tuple[npt.NDArray[np.bool_], _Floats]:
        """As `server.acoustics.transmission.WallLosses` says. A wall counts once, with the material of the side that
        takes more: it is at least as heavy as either side says, and a light lining takes nothing from its mass. So the
        loss is the same in both directions."""
        walls = self.tree.walls_between(np.asarray(listener, np.float64), np.asarray(emitters, np.float64))
        surfaces = self.tree.mesh.surfaces
        losses_db = np.array([self.losses_db[surfaces[each]].max(axis=1).sum(axis=0) for each in walls]).reshape(
            len(walls), self.losses_db.shape[1]
        )
        lets_through = np.isfinite(losses_db).all(axis=-1)
        return lets_through & np.array([len(each) > 0 for each in walls], np.bool_), losses_db


def first_echo_of(patches: Patches) -> FirstEcho:
    """The lower bound of first reflections over the planes of all patches, which mirror on both sides."""
    normals = patches.normals.T
    return FirstEcho(np.concatenate([normals, -normals]), np.concatenate([-patches.offsets, patches.offsets]))


def mirrors_of(tree: MeshTree) -> Patches:
    """The patches that are large enough to mirror sound, the largest first."""
    mesh, of_triangle = tree.mesh, patches_of(tree.mesh)
    areas = np.bincount(of_triangle, mesh.areas_m2)
    kept = np.argsort(-areas, kind="stable")[: np.count_nonzero(areas >= _LEAST_M2)]
    kept = kept if len(kept) else np.argsort(-areas, kind="stable")[:1]
    low, high = np.full((len(areas), 3), np.inf), np.full((len(areas), 3), -np.inf)
    np.minimum.at(low, of_triangle, mesh.corners_m.min(axis=1))
    np.maximum.at(high, of_triangle, mesh.corners_m.max(axis=1))
    normals, offsets = fitted_planes(mesh, of_triangle)
    numbers = np.full(len(areas), -1, np.int32)
    numbers[kept] = np.arange(len(kept))
    return Patches(
        np.ascontiguousarray(normals[kept].T),
        np.ascontiguousarray(offsets[kept]),
        np.ascontiguousarray(np.concatenate([low, high], axis=1)[kept].T),
        numbers[of_triangle][tree.tree.numbers],
        flatness_m(mesh),
    )
