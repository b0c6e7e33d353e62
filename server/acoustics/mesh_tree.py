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
    join,
)
from server.kernels.copying import doubles

_Floats = npt.NDArray[np.float64]
_Integers = npt.NDArray[np.int32]
_Flags = npt.NDArray[np.bool_]

SIGHT_MARGIN_M = 1e-6
"""What stands nearer to one of two points than this does not hide them from each other: they may lie on surfaces."""
SAME_PLACE_M = 1e-6
"""Faces that a line meets within this are one: coplanar double faces, or the two triangles of an edge."""
MOST_CROSSED = 256
"""The most faces that are told apart along a line. No sound is heard through as many."""
# Planes whose normals differ by less are the same, if their distances do not differ.
_SAME_NORMAL = 1e-5
# Points this near to a plane, as a share of the largest coordinate, lie in it; at least as many metres.
_FLATNESS = 1e-6
# Vertices nearer to each other than this, on a grid of that size, are one.
_SAME_VERTEX_M = 1e-6

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
        limits = np.empty(count)
        limits[:] = most
        find_closest(self.tree, starts, ways, limits, hits.distance, hits.triangle, hits.faces)
        return hits

    def is_visible(self, a: Points, b: Points) -> _Flags:
        """(...,) whether nothing stands between a and b. Surfaces on which they lie do not."""
        starts, ends, shape = _pairs(a, b)
        in_sight = np.empty(len(starts), np.bool_)
        find_sight(self.tree, starts, ends, SIGHT_MARGIN_M, in_sight)
        return in_sight.reshape(shape)

    def walls_between(self, a: Points, b: Points) -> list[_Integers]:
        """For each pair of points (n, 3), the walls (wall, 2) that the straight line goes through, each given by the
        triangles through which it is entered from a and left towards b. They are the same for a sheet of one face;
        coplanar double faces are one wall. From b to a, there are the same walls."""
        starts, ends, _ = _pairs(a, b)
        walls = np.empty((len(starts), MOST_CROSSED, 2), np.int32)
        counts = np.empty(len(starts), np.int32)
        room = np.empty(MOST_CROSSED), np.empty(MOST_CROSSED, np.int32), np.empty(MOST_CROSSED, np.int32)
        find_walls(self.tree, starts, ends, SIGHT_MARGIN_M, SAME_PLACE_M, *room, walls, counts)
        return [walls[pair, :count] for pair, count in enumerate(counts)]

    def distance_m(self, points: Points) -> _Floats:
        """(...,) distance from each point to the nearest triangle."""
        places = np.asarray(points, dtype=np.float64)
        flat = doubles(places.reshape(-1, 3))
        distances = np.empty(len(flat))
        find_distances(self.tree, flat, distances)
        return distances.reshape(places.shape[:-1])

    def contains(self, points: Points, *, is_open: bool = False) -> _Flags:
        """(...,) whether each point is in the air that the mesh encloses, or on its surfaces: whether in most
        directions the first triangle shows its face. A few holes or flipped triangles do not change that. Under the
        open sky, with `is_open`, a point is in the air if triangles show it more faces than backs. If they show as many
        of both, or if there are none, it is in the air unless what is straight below shows its back."""
        places = np.asarray(points, dtype=np.float64)
        flat = np.ascontiguousarray(places.reshape(-1, 3))
        inside = np.empty(len(flat), np.bool_)
        find_inside(self.tree, _LOOKS, flat, SAME_PLACE_M, is_open, inside)
        return inside.reshape(places.shape[:-1])


def _pairs(a: Points, b: Points) -> tuple[_Floats, _Floats, tuple[int, ...]]:
    starts, ends = np.broadcast_arrays(np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64))
    # Copies: what is broadcast is read-only, and rows follow each other.
    flat = [np.array(points.reshape(-1, 3), order="C") for points in (starts, ends)]
    return flat[0], flat[1], starts.shape[:-1]


def flatness_m(mesh: TriangleMesh) -> float:
    """How far from a plane points may be that lie in it: what single precision makes of coordinates, at least a
    micrometre."""
    return _FLATNESS * max(1.0, float(np.abs(mesh.bounds_m).max()))


def patches_of(mesh: TriangleMesh) -> _Integers:
    """(T,) the number of the patch to which each triangle belongs: a group of coplanar triangles that are joined by
    edges."""
    places = np.rint(mesh.vertices_m / _SAME_VERTEX_M)
    _, vertex = np.unique(places, axis=0, return_inverse=True)
    corners = vertex.reshape(-1)[mesh.triangles]
    sides = np.sort(np.stack([corners, np.roll(corners, -1, axis=1)], axis=-1), axis=-1).reshape(-1, 2)
    owners = np.repeat(np.arange(len(corners), dtype=np.int32), 3)
    order = np.lexsort((sides[:, 1], sides[:, 0]))
    labels = np.arange(len(corners), dtype=np.int32)
    join(
        sides[order].astype(np.int64),
        owners[order],
        np.array(mesh.corners_m),
        np.array(mesh.normals),
        np.array(mesh.areas_m2),
        flatness_m(mesh),
        labels,
    )
    _, patches = np.unique(labels, return_inverse=True)
    return np.asarray(patches.reshape(-1), dtype=np.int32)


def fitted_planes(mesh: TriangleMesh, patches: _Integers) -> tuple[_Floats, _Floats]:
    """Unit normals (patch, 3), on the side to which the largest triangle of each patch shows its face, and distances
    (patch,) of the planes from the origin. They are those of whole patches: the normal of one triangle would miss the
    other end of a wall. A patch without area has no normal."""
    largest = np.lexsort((-mesh.areas_m2, patches))
    largest = largest[np.searchsorted(patches[largest], np.arange(patches.max() + 1))]
    side = np.sign(np.sum(mesh.normals * mesh.normals[largest][patches], axis=-1, keepdims=True))
    normals, middles = np.zeros((len(largest), 3)), np.zeros((len(largest), 3))
    weights = mesh.areas_m2[:, None]
    np.add.at(normals, patches, side * mesh.normals * weights)
    np.add.at(middles, patches, mesh.corners_m.mean(axis=1) * weights)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    normals /= np.where(length > 0, length, 1.0)
    areas = np.bincount(patches, mesh.areas_m2)[:, None]
    middles /= np.where(areas > 0, areas, 1.0)
    return normals, np.asarray(np.sum(normals * middles, axis=-1))


def planes_of(mesh: TriangleMesh) -> _Integers:
    """(T,) the number of the plane in which each triangle lies, whichever side it faces. Triangles without area have
    numbers of their own."""
    patches = patches_of(mesh)
    normals, offsets = fitted_planes(mesh, patches)
    # The first component that is not small is positive.
    large = np.abs(normals) > _SAME_NORMAL
    lead = np.sign(np.take_along_axis(normals, np.argmax(large, axis=-1)[:, None], axis=-1))
    rounded = np.concatenate([lead * normals / _SAME_NORMAL, lead * offsets[:, None] / flatness_m(mesh)], axis=-1)
    _, planes = np.unique(np.rint(rounded) + 0.0, axis=0, return_inverse=True)
    planes = planes.reshape(-1)[patches]
    flat = ~np.any(mesh.normals, axis=-1)
    planes[flat] = planes.max() + 1 + np.arange(np.count_nonzero(flat))
    return np.asarray(planes, dtype=np.int32)
