"""What rays meet in a triangle mesh: a tree of boxes (bounding volume hierarchy) over its triangles.

A ray along an edge or through a vertex never slips between triangles. A ray in the plane of a triangle does not meet
it. Points and directions are (..., xyz) in metres, in world axes.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import Points
from server.acoustics.mesh import TriangleMesh
from server.acoustics.mesh_tree_kernel import (
    Tree,
    build,
    find_closest,
    find_distances,
    find_inside,
    find_sight,
    find_walls,
)

_Floats = npt.NDArray[np.float64]
_Integers = npt.NDArray[np.int32]
_Flags = npt.NDArray[np.bool_]

SIGHT_MARGIN_M = 1e-6
"""What stands nearer to one of two points than this does not hide them from each other: they may lie on surfaces."""
SAME_PLACE_M = 1e-6
"""Faces that a line meets within this are one: coplanar double faces, or the two triangles of an edge."""
MOST_CROSSED = 256
"""The most faces that are told apart along a line. No sound is heard through as many."""
# Planes whose normals and distances differ by less are the same.
_SAME_NORMAL, _SAME_OFFSET_M = 1e-6, 1e-6

# In these directions it is looked whether a point is in the air, and most of them decide. None lies along an axis or in
# a diagonal plane, as edges of buildings do.
_LOOKS = np.array(
    [
        (0.539, 0.273, 0.797),
        (-0.483, 0.807, 0.341),
        (-0.631, -0.742, 0.227),
        (0.827, -0.553, 0.101),
        (0.431, 0.841, -0.329),
        (-0.863, 0.137, -0.487),
        (0.193, -0.409, -0.892),
    ]
)


@dataclass(frozen=True)
class Hits:
    """What n rays meet first. `distance` (n,) in lengths of the ray's direction, infinite for nothing; `triangle` (n,),
    -1 for nothing; `faces` (n,), whether the ray comes from the side of the air."""

    distance: _Floats
    triangle: _Integers
    faces: _Flags


class MeshTree:
    """The tree over one mesh. Safe to share between threads."""

    def __init__(self, mesh: TriangleMesh) -> None:
        self.mesh = mesh
        count = len(mesh.triangles)
        bounds, links = np.empty((2 * count - 1, 6)), np.zeros((2 * count - 1, 3), np.int32)
        order = np.empty(count, np.int32)
        corners = np.array(mesh.corners_m)
        nodes = build(corners, bounds, links, order)
        self.tree = Tree(
            np.ascontiguousarray(bounds[:nodes]),
            np.ascontiguousarray(links[:nodes]),
            np.ascontiguousarray(corners[order]),
            order,
            planes_of(mesh)[order],
        )

    def closest(self, origins: Points, directions: Points, most: npt.ArrayLike = np.inf) -> Hits:
        """What rays (n, 3) meet first, within `most` lengths of their directions. A ray that starts on a surface meets
        it if it goes into it. A direction of no length meets nothing.

        Raises ValueError for origins or directions that are not finite.
        """
        given = [np.atleast_2d(np.asarray(points, dtype=np.float64)) for points in (origins, directions)]
        starts, ways = map(np.ascontiguousarray, np.broadcast_arrays(*given))
        for name, points in (("origins", starts), ("directions", ways)):
            if not np.isfinite(points).all():
                raise ValueError(f"{name}: must be finite numbers")
        count = len(starts)
        hits = Hits(np.empty(count), np.empty(count, np.int32), np.empty(count, np.bool_))
        limits = np.ascontiguousarray(np.broadcast_to(np.asarray(most, np.float64), count))
        find_closest(self.tree, starts, ways, limits, hits.distance, hits.triangle, hits.faces)
        return hits

    def is_visible(self, a: Points, b: Points) -> _Flags:
        """(...,) whether nothing stands between a and b. Surfaces on which they lie do not."""
        starts, ends, shape = _pairs(a, b)
        in_sight = np.empty(len(starts), np.bool_)
        find_sight(self.tree, starts, ends, SIGHT_MARGIN_M, in_sight)
        return in_sight.reshape(shape)

    def walls_between(self, a: Points, b: Points) -> list[_Integers]:
        """For each pair of points (n, 3), the walls that the straight line goes through, each given by the triangle
        through which it is entered from a. A wall has a face and a back, which may be the same sheet; coplanar double
        faces are one wall."""
        starts, ends, _ = _pairs(a, b)
        walls = np.empty((len(starts), MOST_CROSSED), np.int32)
        counts = np.empty(len(starts), np.int32)
        room = np.empty(MOST_CROSSED), np.empty(MOST_CROSSED, np.int32)
        find_walls(self.tree, starts, ends, SIGHT_MARGIN_M, SAME_PLACE_M, *room, walls, counts)
        return [walls[pair, :count] for pair, count in enumerate(counts)]

    def distance_m(self, points: Points) -> _Floats:
        """(...,) distance from each point to the nearest triangle."""
        places = np.asarray(points, dtype=np.float64)
        flat = np.ascontiguousarray(places.reshape(-1, 3))
        distances = np.empty(len(flat))
        find_distances(self.tree, flat, distances)
        return distances.reshape(places.shape[:-1])

    def contains(self, points: Points, *, is_open: bool = False) -> _Flags:
        """(...,) whether each point is in the air that the mesh encloses, or on its surfaces: whether in most
        directions the first triangle shows its face. A few holes or flipped triangles do not change that. Under the
        open sky, with `is_open`, a point is in the air unless triangles show it more backs than faces."""
        places = np.asarray(points, dtype=np.float64)
        flat = np.ascontiguousarray(places.reshape(-1, 3))
        inside = np.empty(len(flat), np.bool_)
        find_inside(self.tree, _LOOKS, flat, SAME_PLACE_M, is_open, inside)
        return inside.reshape(places.shape[:-1])


def _pairs(a: Points, b: Points) -> tuple[_Floats, _Floats, tuple[int, ...]]:
    starts, ends = np.broadcast_arrays(np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64))
    flat = [np.array(points.reshape(-1, 3)) for points in (starts, ends)]  # copies: what is broadcast is read-only
    return flat[0], flat[1], starts.shape[:-1]


def planes_of(mesh: TriangleMesh) -> _Integers:
    """(T,) the number of the plane in which each triangle lies, whichever side it faces. Triangles without area have
    numbers of their own."""
    normals = np.array(mesh.normals)
    # The first component that is not small is positive.
    large = np.abs(normals) > _SAME_NORMAL
    lead = np.take_along_axis(normals, np.argmax(large, axis=-1)[:, None], axis=-1)
    normals *= np.where(lead < 0, -1.0, 1.0)
    offsets = np.sum(normals * mesh.corners_m[:, 0], axis=-1, keepdims=True)
    rounded = np.rint(np.concatenate([normals / _SAME_NORMAL, offsets / _SAME_OFFSET_M], axis=-1)) + 0.0
    _, planes = np.unique(rounded, axis=0, return_inverse=True)
    planes = planes.reshape(-1)
    flat = ~np.any(mesh.normals, axis=-1)
    planes[flat] = planes.max() + 1 + np.arange(np.count_nonzero(flat))
    return np.asarray(planes, dtype=np.int32)
