"""How triangles hang together: welding, copies, edges, holes, and patches that face one way."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

_Floats = npt.NDArray[np.float64]
_Integers = npt.NDArray[np.int64]
_Flags = npt.NDArray[np.bool_]

WELD_M = 1e-4
"""Vertices nearer to each other than this become one. A gap of a tenth of a millimetre is no opening to sound."""
SLIVER = 0.005
"""A triangle is a sliver if its height over its longest side is less than this share of that side."""


def weld(vertices: _Floats, triangles: _Integers) -> tuple[_Floats, _Integers]:
    """Vertices and triangles with vertices closer than WELD_M made one, each the first of its group."""
    if not len(vertices):
        return vertices, triangles
    exact, same = np.unique(vertices + 0.0, axis=0, return_inverse=True)
    pairs = np.asarray(cKDTree(exact).query_pairs(WELD_M, output_type="ndarray"), dtype=np.int64)
    group = _components(len(exact), pairs[:, 0], pairs[:, 1])
    first = np.full(group.max() + 1, len(exact))
    np.minimum.at(first, group, np.arange(len(exact)))
    return exact[first], group[same.ravel()][triangles]


def is_degenerate(vertices: _Floats, triangles: _Integers) -> _Flags:
    """(T,) whether a triangle has less height than WELD_M, or two corners at one vertex."""
    return _heights_and_sides(vertices, triangles)[0] < WELD_M


def is_sliver(vertices: _Floats, triangles: _Integers) -> _Flags:
    """(T,) whether a triangle's height over its longest side is less than the share SLIVER of it."""
    height, longest = _heights_and_sides(vertices, triangles)
    return height < SLIVER * longest


def _heights_and_sides(vertices: _Floats, triangles: _Integers) -> tuple[_Floats, _Floats]:
    corners = vertices[triangles]
    sides = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=-1)
    longest = sides.max(axis=1, initial=0.0)
    double_area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    height = np.divide(double_area, longest, out=np.zeros_like(longest), where=longest > 0)
    return height, longest


def copies(triangles: _Integers) -> tuple[_Flags, _Flags]:
    """(T,) whether an earlier triangle has the same corners and the same front, and (T,) whether one has the same
    corners and the opposite front."""
    order = np.sort(triangles, axis=1)
    turns = np.argmin(triangles, axis=1)
    rolled = np.take_along_axis(triangles, (turns[:, None] + np.arange(3)) % 3, axis=1)
    _, group = np.unique(order, axis=0, return_inverse=True)
    group = group.ravel()
    first = np.full(group.max() + 1 if len(group) else 0, len(triangles))
    np.minimum.at(first, group, np.arange(len(triangles)))
    later = first[group] < np.arange(len(triangles))
    same = rolled[:, 1] == rolled[first[group], 1] if len(group) else later
    return later & same, later & ~same


def _components(count: int, first: _Integers, second: _Integers) -> _Integers:
    """(count,) the number of each one's group, where `first` and `second` hang together."""
    ones = np.ones(len(first), np.int8)
    _, labels = connected_components(coo_array((ones, (first, second)), shape=(count, count)), directed=False)
    return np.asarray(labels, dtype=np.int64)


@dataclass(frozen=True)
class Hole:
    """Open edges that hang together. `edges` are indices among all edges."""

    edges: _Integers
    centre_m: _Floats
    length_m: float
    extent_m: float


@dataclass(frozen=True)
class Topology:
    """Edges of a welded mesh."""

    vertices: _Floats
    triangles: _Integers

    @cached_property
    def _sides(self) -> tuple[_Integers, _Integers, _Integers]:
        """(3T, 2) directed sides, of which 3t to 3t + 2 are triangle t's; (E, 2) edges; (3T,) the edge of each side."""
        sides = np.stack([self.triangles, np.roll(self.triangles, -1, axis=1)], axis=-1).reshape(-1, 2)
        low, high = sides.min(axis=1), sides.max(axis=1)
        keys, edge = np.unique(low * len(self.vertices) + high, return_inverse=True)
        edges = np.stack([keys // len(self.vertices), keys % len(self.vertices)], axis=1)
        return sides, edges, edge.ravel()

    @property
    def edges(self) -> _Integers:
        """(E, 2) vertices of each edge."""
        return self._sides[1]

    @cached_property
    def uses(self) -> _Integers:
        """(E,) how many triangles share each edge: one at a hole, more than two where surfaces branch."""
        return np.bincount(self._sides[2], minlength=len(self.edges))

    @cached_property
    def open_triangles(self) -> _Integers:
        """(E,) for an open edge its triangle, else -1."""
        found = np.full(len(self.edges), -1)
        found[self._sides[2]] = np.arange(3 * len(self.triangles)) // 3
        return np.where(self.uses == 1, found, -1)

    @cached_property
    def neighbours(self) -> tuple[_Integers, _Flags]:
        """(n, 2) triangles that share an edge with each other and no third, and (n,) whether both face the same way."""
        sides, _, edge = self._sides
        order = np.argsort(edge, kind="stable")
        order = order[self.uses[edge[order]] == 2]
        one, two = order[0::2], order[1::2]
        return np.stack([one // 3, two // 3], axis=1), sides[one, 0] != sides[two, 0]

    @cached_property
    def patches(self) -> tuple[_Integers, _Flags, int]:
        """(T,) the patch of each triangle: those connected over edges of two triangles; (T,) whether a triangle faces
        against its patch; and how many triangles are in patches of one side only, as a Moebius strip is."""
        count = len(self.triangles)
        pairs, same = self.neighbours
        one, two = pairs[:, 0], pairs[:, 1]
        # Each triangle twice: as it is, and turned. What faces the same way hangs together as it is.
        first = np.concatenate([one, one + count])
        second = np.concatenate([np.where(same, two, two + count), np.where(same, two + count, two)])
        label = _components(2 * count, first, second)
        as_it_is, turned = label[:count], label[count:]
        patch = np.minimum(as_it_is, turned)
        return patch, as_it_is != patch, int(np.sum(as_it_is == turned))

    def holes(self, is_seam: _Flags) -> list[Hole]:
        """The holes, the largest first, of open edges that are no seams (E,)."""
        chosen = np.flatnonzero((self.uses == 1) & ~is_seam)
        ends = self.edges[chosen]
        group = _components(len(self.vertices), ends[:, 0], ends[:, 1])[ends[:, 0]]
        holes = []
        for label in np.unique(group):
            own = chosen[group == label]
            corners = self.vertices[self.edges[own]]
            lengths = np.linalg.norm(corners[:, 0] - corners[:, 1], axis=-1)
            middles = corners.mean(axis=1)
            extent = float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0)))
            centre = np.average(middles, axis=0, weights=lengths)
            holes.append(Hole(own, centre, float(lengths.sum()), extent))
        return sorted(holes, key=lambda hole: -hole.extent_m)
