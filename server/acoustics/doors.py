"""A triangle mesh with doors: what stands still, and leaves that swing or slide.

How far doors are open is their *openness* (door,), from 0, shut, to 1. Each state has surroundings of its own, in which
everything is exact. What does not depend on doors is found once; a state of a house takes some tens of milliseconds
more, which is work for another thread.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from threading import Lock
from typing import Literal

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import Vector3
from server.acoustics.mesh import TriangleMesh
from server.acoustics.mesh_edges import Bends, StillEdges
from server.acoustics.mesh_tree import MeshTree
from server.acoustics.surroundings import MeshSurroundings, compile_meshes
from server.core.bounded_cache import BoundedCache

_Floats = npt.NDArray[np.float64]
Openness = tuple[float, ...]
"""Of each door, from 0 to 1."""
_KEPT_BYTES, _KEPT_SOON = 32 * 1024 * 1024, 8
"""Of states, some five megabytes each for a house, and how many of those that are for a moment only."""
_WAYS_OF_A_SWING = np.linspace(0.0, 1.0, 5)
_SHRUNK = 0.9
"""Leaves touch their frames; points on this share of them do not."""


@dataclass(frozen=True)
class LeafMotion:
    """How a leaf moves when its door opens: a swing turns by `angle_deg` about the upright line through `pivot`,
    counter-clockwise as seen from above; a slide moves by `slide_m`."""

    kind: Literal["swing", "slide"]
    pivot: Vector3
    angle_deg: float
    slide_m: Vector3

    def moved(self, vertices_m: _Floats, openness: float) -> _Floats:
        """(V, 3) vertices of the shut leaf where they are at an openness."""
        if self.kind == "slide":
            return np.asarray(vertices_m + openness * np.array(self.slide_m))
        angle = math.radians(openness * self.angle_deg)
        turn = np.array([(math.cos(angle), -math.sin(angle), 0), (math.sin(angle), math.cos(angle), 0), (0, 0, 1)])
        return np.asarray((vertices_m - self.pivot) @ turn.T + self.pivot, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class DoorLeaf:
    """A leaf as it is when shut, and how it moves."""

    mesh: TriangleMesh
    motion: LeafMotion

    def at(self, openness: float) -> TriangleMesh:
        """The leaf where it is at an openness."""
        mesh = self.mesh
        vertices = self.motion.moved(mesh.vertices_m, openness)
        return TriangleMesh(vertices, mesh.triangles, mesh.surfaces, mesh.materials)

    def swept(self) -> _Floats:
        """(n, 3) points on the leaf as it opens, a little inside of its outline."""
        at = [self.motion.moved(self.mesh.vertices_m, float(openness)) for openness in _WAYS_OF_A_SWING]
        return np.concatenate([middle + _SHRUNK * (each - middle) for each in at for middle in [each.mean(axis=0)]])


def compile_doors() -> None:
    """Compile the code by which meshes with doors are asked, or load it from disk."""
    compile_meshes()
    corners = np.array([(0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)])
    sheet = TriangleMesh(corners, np.arange(3, dtype=np.int32)[None], np.zeros(1, np.int32), ("sheet",))
    slide = LeafMotion("slide", (0.0, 0.0, 0.0), 0.0, (1.0, 0.0, 0.0))
    MeshWithDoors(sheet, [DoorLeaf(sheet, slide)], open_sky=True).at((0.5,))


class MeshWithDoors:
    """The states of a mesh `still` and its `leaves`. With `open_sky`, the air is not enclosed. Safe to share between
    threads.

    The surfaces of every state are numbered as in `materials`: those of the mesh, then those that only leaves have.
    """

    def __init__(self, still: TriangleMesh, leaves: Sequence[DoorLeaf], *, open_sky: bool = False) -> None:
        self.still = still
        self.leaves = tuple(leaves)
        self.materials = TriangleMesh.joined([still, *(leaf.mesh for leaf in leaves)]).materials
        self._open_sky = open_sky
        self._kept: BoundedCache[Openness, MeshSurroundings] = BoundedCache(_KEPT_BYTES)
        self._kept_soon: BoundedCache[tuple[Openness, MeshSurroundings], MeshSurroundings] = BoundedCache(_KEPT_SOON)
        self._finding = Lock()

    @cached_property
    def tree(self) -> MeshTree:
        """The tree of the mesh without the leaves of doors."""
        return MeshTree(self.still)

    @cached_property
    def _edges(self) -> StillEdges:
        return StillEdges(self.tree, [leaf.mesh for leaf in self.leaves], [leaf.swept() for leaf in self.leaves])

    def holds(self, position: Vector3) -> bool:
        """Whether a point is in the air, wherever the leaves are."""
        return bool(self.tree.contains(np.asarray(position), is_open=self._open_sky))

    def mesh_at(self, openness: Openness) -> TriangleMesh:
        """All surfaces, with the leaves where they are."""
        return TriangleMesh.joined([self.still, *self._leaves_at(openness)])

    def at(self, openness: Openness) -> MeshSurroundings:
        """The surroundings in a state, of which the last few are kept."""
        with self._finding:
            found = self._kept.get(openness)
            if found is None:
                tree = MeshTree(self.mesh_at(openness))
                moves = [
                    partial(leaf.motion.moved, openness=share)
                    for leaf, share in zip(self.leaves, openness, strict=True)
                ]
                bends = self._edges.bends_among(tree, self._leaves_at(openness), moves)
                found = self._surroundings(tree, bends)
                self._kept.put(openness, found, sum(part.nbytes for part in (*bends, *tree.tree)))
            return found

    def soon_at(self, openness: Openness, before: MeshSurroundings) -> MeshSurroundings:
        """The surroundings in a state but for the ways round edges: these are as in the state `before`. Who sees whom
        is exact, so that nothing is heard straight through a leaf. This takes a few milliseconds. The last few are
        kept, since all listeners of a stream ask for the same."""
        if (kept := self._kept.get(openness)) is not None:
            return kept
        found = self._kept_soon.get((openness, before))
        if found is None:
            found = self._surroundings(MeshTree(self.mesh_at(openness)), before.bends)
            self._kept_soon.put((openness, before), found, 1)
        return found

    def _surroundings(self, tree: MeshTree, bends: Bends) -> MeshSurroundings:
        return MeshSurroundings(tree.mesh, open_sky=self._open_sky, tree=tree, bends=bends, still=self.tree)

    def _leaves_at(self, openness: Openness) -> list[TriangleMesh]:
        return [leaf.at(of_door) for leaf, of_door in zip(self.leaves, openness, strict=True)]
