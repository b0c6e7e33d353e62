"""What surrounds listeners and emitters: one interface to the geometry of a place, be it a floor plan or a triangle
mesh.

It says where they can be, whether they see each other, and on which paths sound gets from one to the other. What
surfaces do to sound is given in decibels, (surface, band): for a floor plan, of its walls, floor and ceiling; for a
mesh, of its materials. Points are (..., xyz) in metres, in world axes; bands are OCTAVE_BANDS_HZ.
"""

from functools import cached_property
from typing import Protocol

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.geometry import FloorPlan, Points, Vector3
from server.acoustics.mesh import TriangleMesh
from server.acoustics.mesh_edges import Bends, bends_of
from server.acoustics.mesh_paths import MeshPathFinder
from server.acoustics.mesh_reflections import MeshReflectionFinder, MeshWallLosses, first_echo_of, mirrors_of
from server.acoustics.mesh_reflections_kernel import Patches
from server.acoustics.mesh_tree import MeshTree
from server.acoustics.reflections import FirstEcho, ReflectionFinder
from server.acoustics.sound_path import PlanPathFinder, SoundPathFinder
from server.acoustics.transmission import PathFinder, PlanWallLosses, TransmittedPaths

_Floats = npt.NDArray[np.float64]
_Flags = npt.NDArray[np.bool_]


class Surroundings(Protocol):
    """The geometry of one place. Safe to share between threads."""

    @property
    def bounds_m(self) -> _Floats:
        """(2, 3) least and greatest coordinates of all surfaces."""

    @property
    def has_obstacles(self) -> bool:
        """Whether something can stand between two points inside."""

    def contains(self, points: Points) -> _Flags:
        """(...,) whether each point is in the air, or on a surface."""

    def holds(self, position: Vector3) -> bool:
        """`contains` for one point."""

    def is_visible(self, a: Points, b: Points) -> _Flags:
        """(...,) whether nothing stands between a and b."""

    def sound_paths(self, speed_of_sound: float) -> SoundPathFinder:
        """A finder of the shortest paths that sound takes."""

    def first_reflections(self, gains_db: npt.ArrayLike, losses_db: npt.ArrayLike | None = None) -> PathFinder:
        """A finder of sound that is mirrored once, with gains of `gains_db`, and of sound that goes straight through
        walls, which take `losses_db`: infinite for those that let nothing through, None if none does."""

    def first_echo(self) -> FirstEcho:
        """A lower bound of the lengths of first reflections."""


class PlanSurroundings:
    """The walls, the floor and the ceiling of a floor plan."""

    def __init__(self, plan: FloorPlan) -> None:
        self.plan = plan

    @cached_property
    def bounds_m(self) -> _Floats:
        corners = np.asarray(self.plan.corners, dtype=np.float64)
        low, high = corners.min(axis=0), corners.max(axis=0)
        return np.array([[*low, self.plan.floor_m], [*high, self.plan.height_m]])

    @property
    def has_obstacles(self) -> bool:
        return len(self.plan.bend_corners) > 0

    def contains(self, points: Points) -> _Flags:
        return self.plan.contains(points)

    def holds(self, position: Vector3) -> bool:
        return self.plan.holds(position)

    def is_visible(self, a: Points, b: Points) -> _Flags:
        return self.plan.is_visible(a, b)

    def sound_paths(self, speed_of_sound: float) -> SoundPathFinder:
        return PlanPathFinder(self.plan, speed_of_sound)

    def first_reflections(self, gains_db: npt.ArrayLike, losses_db: npt.ArrayLike | None = None) -> PathFinder:
        finder = ReflectionFinder(self.plan, gains_db)
        walls_db = None if losses_db is None else np.asarray(losses_db, dtype=np.float64)[0]
        if walls_db is None or not np.isfinite(walls_db).all():
            return finder
        return TransmittedPaths(finder, PlanWallLosses(self.plan, walls_db))

    def first_echo(self) -> FirstEcho:
        return FirstEcho.of_plan(self.plan)


class MeshSurroundings:
    """The surfaces of a triangle mesh. With `open_sky`, the air is not enclosed.

    `tree` and `bends` are the mesh's, if they were found already. Where doors move, `still` is the tree of the surfaces
    that do not: it says what is in the air, so that no leaf shuts anybody in.
    """

    def __init__(
        self,
        mesh: TriangleMesh,
        *,
        open_sky: bool = False,
        tree: MeshTree | None = None,
        bends: Bends | None = None,
        still: MeshTree | None = None,
    ) -> None:
        self.mesh = mesh
        self.tree = MeshTree(mesh) if tree is None else tree
        self._open_sky = open_sky
        self._still = self.tree if still is None else still
        self._found = bends

    @cached_property
    def _mirrors(self) -> Patches:
        return mirrors_of(self.tree)

    @cached_property
    def bends(self) -> Bends:
        """The points round which sound bends, and the ways between them."""
        return bends_of(self.tree) if self._found is None else self._found

    @property
    def bounds_m(self) -> _Floats:
        return self.mesh.bounds_m

    @property
    def has_obstacles(self) -> bool:
        return True

    def contains(self, points: Points) -> _Flags:
        return self._still.contains(points, is_open=self._open_sky)

    def holds(self, position: Vector3) -> bool:
        return bool(self.contains(np.asarray(position)))

    def is_visible(self, a: Points, b: Points) -> _Flags:
        return self.tree.is_visible(a, b)

    def sound_paths(self, speed_of_sound: float) -> SoundPathFinder:
        return MeshPathFinder(self.tree, speed_of_sound, self.bends)

    def first_reflections(self, gains_db: npt.ArrayLike, losses_db: npt.ArrayLike | None = None) -> PathFinder:
        finder = MeshReflectionFinder(self.tree, gains_db, self._mirrors)
        if losses_db is None or not np.isfinite(losses_db).all(axis=-1).any():
            return finder
        return TransmittedPaths(finder, MeshWallLosses(self.tree, np.asarray(losses_db, dtype=np.float64)))

    def first_echo(self) -> FirstEcho:
        return first_echo_of(self._mirrors)


def compile_meshes() -> None:
    """Compile the code by which meshes are asked, or load it from disk: a quarter of a minute where it is not there."""
    corners = np.array([(0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)])
    sheet = TriangleMesh(corners, np.arange(3, dtype=np.int32)[None], np.zeros(1, np.int32), ("sheet",))
    here, there = np.array([-1.0, 0.2, 0.2]), np.array([[1.0, 0.2, 0.2]])
    surroundings = MeshSurroundings(sheet)
    surroundings.holds((-1.0, 0.2, 0.2))
    surroundings.is_visible(here, there)
    surroundings.sound_paths(343.0).find(here, there)
    silent = np.zeros((1, len(OCTAVE_BANDS_HZ)))
    surroundings.first_reflections(silent, silent).find(here, there)
    surroundings.first_echo()
