"""The edges of a triangle mesh round which sound bends, and the shortest ways between them.

An edge bends sound where more than half a turn around it is air. That is found by looking around it, so it holds for
sheets, for seams whose pieces have no common vertices, and for things that stand on others; gaps under a centimetre are
closed. Paths bend at points that are spread along these edges; a path is then drawn taut along the edges themselves
(`server.acoustics.mesh_paths`).

Axes: P points, on E edges. Points are (..., xyz) in metres, in world axes.
"""

import itertools
import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from server.acoustics.mesh import TriangleMesh
from server.acoustics.mesh_edges_kernel import (
    drop_doubles,
    find_seen,
    find_shortest,
    find_steps,
    look_round,
)
from server.acoustics.mesh_tree import MeshTree

_Floats = npt.NDArray[np.float64]
_Integers = npt.NDArray[np.int64]
_Flags = npt.NDArray[np.bool_]

MOST_POINTS = 768
"""The most points at which paths bend. Ways between all of them take six bytes a pair."""
_SPACINGS_M = (0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 4.0)
"""How far points on an edge are apart at most: the first of these that gives few enough."""
_MOST_EDGES = 8192
"""The longest edges that are looked at."""
_SHORTEST_M = 0.05
"""Round a shorter edge, sound bends as if nothing were there."""
_RADIUS_M, _LIFT_M = 0.01, 1e-3
_LEAST_RAD = math.radians(2)
_HALVINGS = 8
_INSET_M = 0.01
_SAME_VERTEX_M, _SAME_LINE_M = 1e-6, 1e-3
_PARALLEL = 1 - 1e-8
_CELL_M = 1.0
"""The least size of a cell."""
_MOST_LOOKS = 1_500_000
"""Looks from all over the place at all points, a microsecond each."""


class Bends(NamedTuple):
    """Points at which paths bend. `places` (P, 3) are on edges, which run from `starts` (P, 3) `alongs` (P, 3) for
    `extents` (P,); each stands for `portions` (P,) of an edge. `lifted` (P, 3) are a little off the edges, in the air.
    `facings` (P, 2, 3) are the normals of both surfaces. `lengths` (P, P) are the shortest ways between points, and
    `before` (P, P) the last points on the ways from the first to the second.

    Space is in cells of `cell_m` (3,) from `origin` (3,) on, `counts` (3,) along each axis. The points that are seen
    from somewhere in a cell are those of `seen` from `begins` (cell,) on.
    """

    places: _Floats
    lifted: _Floats
    facings: _Floats
    starts: _Floats
    alongs: _Floats
    extents: _Floats
    portions: _Floats
    lengths: npt.NDArray[np.float32]
    before: npt.NDArray[np.int16]
    origin: _Floats
    cell_m: _Floats
    counts: _Integers
    begins: _Integers
    seen: npt.NDArray[np.int32]


def bends_of(tree: MeshTree) -> Bends:
    """Find the points of a mesh, at most `MOST_POINTS`, and the ways between them."""
    edges = _edges(tree.mesh)
    for spacing_m in _SPACINGS_M:
        points = _points(tree, edges, spacing_m)
        if len(points.edge) <= MOST_POINTS:
            break
    points = points.only(np.arange(min(MOST_POINTS, len(points.edge))))  # of the longest edges
    count = len(points.edge)
    low, high = _reach(tree, edges, points)
    steps = np.empty((count, count), np.float32)
    find_steps(tree.tree, points.places, points.lifted, points.facings, steps)
    lengths, before = np.empty_like(steps), np.empty((count, count), np.int16)
    find_shortest(steps, lengths, before)
    alongs = np.ascontiguousarray(edges.alongs[points.edge])
    return Bends(
        points.places,
        points.lifted,
        points.facings,
        edges.starts[points.edge] + low[:, None] * alongs,
        alongs,
        high - low,
        points.portions,
        lengths,
        before,
        *_cells(tree, points.lifted),
    )


class _Edges(NamedTuple):
    """Edges that may bend sound, the longest first: starts (E, 3), directions (E, 3), lengths (E,), and directions
    across along one of their triangles (E, 3)."""

    starts: _Floats
    alongs: _Floats
    extents: _Floats
    aside: _Floats


class _Points(NamedTuple):
    """Points that bend sound: the edge of each (P,), how far along it they are (P,), for how much of it they stand
    (P,), and `Bends.places`, `facings` and `lifted`."""

    edge: _Integers
    at: _Floats
    portions: _Floats
    places: _Floats
    facings: _Floats
    lifted: _Floats

    def only(self, chosen: _Integers) -> "_Points":
        return _Points(self.edge[chosen], *(each[chosen] for each in self[1:]))


def _points(tree: MeshTree, edges: _Edges, spacing_m: float) -> _Points:
    """The points, at most `spacing_m` apart, where edges bend sound."""
    numbers = np.ceil(edges.extents / spacing_m).astype(np.int64)
    edge = np.repeat(np.arange(len(numbers)), numbers)
    portions = (edges.extents / np.maximum(numbers, 1))[edge]
    at = (np.arange(len(edge)) - np.repeat(np.cumsum(numbers) - numbers, numbers) + 0.5) * portions
    places, facings, lifted, bends = _look(tree, edges, edge, at)
    chosen = np.flatnonzero(bends)
    return _Points(edge, at, portions, places, facings, lifted).only(chosen)


def _look(tree: MeshTree, edges: _Edges, edge: _Integers, at: _Floats) -> tuple[_Floats, _Floats, _Floats, _Flags]:
    """Look around places on edges. Returns the places, their surfaces, places off the edges, and whether they bend."""
    alongs = edges.alongs[edge]
    places = edges.starts[edge] + at[:, None] * alongs
    facings, lifted, bends = np.zeros((len(edge), 2, 3)), np.zeros((len(edge), 3)), np.zeros(len(edge), np.bool_)
    look_round(tree.tree, places, alongs, edges.aside[edge], _RADIUS_M, _LIFT_M, _LEAST_RAD, facings, lifted, bends)
    return places, facings, lifted, bends


def _reach(tree: MeshTree, edges: _Edges, points: _Points) -> tuple[_Floats, _Floats]:
    """From where to where along its edge each point may move (P,): as far as the edge bends sound."""
    ends = []
    for way in (-1, 1):
        last = points.at + way * points.portions / 2
        limit = np.where(way < 0, 0.0, edges.extents[points.edge])
        beyond = np.roll(points.at, -way)  # the next point on the edge, if it has no gap before
        joins = (np.roll(points.edge, -way) == points.edge) & (np.abs(beyond - points.at) < 1.5 * points.portions)
        is_last = ~joins & (np.abs(last - limit) > _SAME_LINE_M)
        # Between a place that bends sound and one that does not.
        inside, outside = points.at.copy(), np.clip(points.at + way * points.portions, 0.0, edges.extents[points.edge])
        some = np.flatnonzero(is_last)
        for _ in range(_HALVINGS):
            middle = (inside[some] + outside[some]) / 2
            bends = _look(tree, edges, points.edge[some], middle)[3]
            inside[some] = np.where(bends, middle, inside[some])
            outside[some] = np.where(bends, outside[some], middle)
        ends.append((joins, np.where(is_last, inside, limit)))
    (joins_before, low), (joins_after, high) = ends
    # Points of one run may move all along it.
    for point in range(1, len(points.edge)):
        if joins_before[point]:
            low[point] = low[point - 1]
    for point in range(len(points.edge) - 2, -1, -1):
        if joins_after[point]:
            high[point] = high[point + 1]
    # At its very end, an edge touches what it ends at, which would be in the way.
    return np.minimum(low + _INSET_M, points.at), np.maximum(high - _INSET_M, points.at)


def _edges(mesh: TriangleMesh) -> _Edges:
    _, welded = np.unique(np.rint(mesh.vertices_m / _SAME_VERTEX_M), axis=0, return_inverse=True)
    place = np.zeros((int(welded.max()) + 1, 3))
    place[welded.reshape(-1)] = mesh.vertices_m
    corners = welded.reshape(-1)[mesh.triangles]
    ends = np.stack([corners, np.roll(corners, -1, axis=1)], axis=-1).reshape(-1, 2)
    owner, opposite = np.repeat(np.arange(len(corners)), 3), np.roll(corners, 1, axis=1).reshape(-1)
    whole = (ends[:, 0] != ends[:, 1]) & np.any(mesh.normals, axis=-1)[owner]
    ends, owner, opposite = np.sort(ends[whole], axis=-1), owner[whole], opposite[whole]
    sides, first, numbers, counts = np.unique(ends, axis=0, return_index=True, return_inverse=True, return_counts=True)
    numbers = numbers.reshape(-1)
    along = place[sides[:, 1]] - place[sides[:, 0]]
    extent = np.linalg.norm(along, axis=-1)
    along /= np.where(extent > 0, extent, 1.0)[:, None]
    across = place[opposite] - place[ends[:, 0]]
    across -= np.sum(across * along[numbers], axis=-1, keepdims=True) * along[numbers]
    width = np.linalg.norm(across, axis=-1, keepdims=True)
    across /= np.where(width > 0, width, 1.0)
    # Between two triangles: flat ones bend nothing, nor do those that face each other.
    last = np.zeros(len(sides), np.int64)
    last[numbers] = np.arange(len(numbers))
    one, other = across[first], across[last]
    normal, other_normal = mesh.normals[owner[first]], mesh.normals[owner[last]]
    is_flat = np.sum(one * other, axis=-1) < -math.cos(_LEAST_RAD)
    is_hollow = (np.sum(normal * other, axis=-1) > 0) & (np.sum(other_normal * one, axis=-1) > 0)
    may_bend = ((counts != 2) | ~(is_flat | is_hollow)) & (extent > 0)
    sides, along, extent, one = (each[may_bend] for each in (sides, along, extent, one))
    longest = np.argsort(-extent, kind="stable")[:_MOST_EDGES]
    sides, along, extent, one = (each[longest] for each in (sides, along, extent, one))
    base, low, high = _joined(place, sides, along, extent)
    edge = np.flatnonzero(high - low >= _SHORTEST_M)
    edge = edge[np.argsort(-(high - low)[edge], kind="stable")]
    starts = base[edge] + low[edge, None] * along[edge]
    extents = (high - low)[edge]
    kept = np.zeros(len(edge), np.bool_)
    drop_doubles(starts + extents[:, None] / 2 * along[edge], along[edge], extents / 2, _SAME_LINE_M, kept)
    return _Edges(starts[kept], along[edge][kept], extents[kept], one[edge][kept])


def _joined(place: _Floats, sides: _Integers, along: _Floats, extent: _Floats) -> tuple[_Floats, _Floats, _Floats]:
    """Join sides that continue each other. Of the longest of each line, its beginning, and how far the line reaches
    along it from there, before (negative) and after; others reach nowhere."""
    label = list(range(len(sides)))

    def root(edge: int) -> int:
        while label[edge] != edge:
            edge = label[edge]
        return edge

    at = np.concatenate([sides[:, 0], sides[:, 1]])
    order = np.argsort(at, kind="stable")
    bounds = np.flatnonzero(np.diff(at[order], prepend=-1, append=-2))
    for begin, end in itertools.pairwise(bounds.tolist()):
        meeting = order[begin:end]
        # Directions away from the vertex.
        away = np.where((meeting < len(sides))[:, None], 1.0, -1.0) * along[meeting % len(sides)]
        for one, other in zip(*np.nonzero(np.triu(away @ away.T < -_PARALLEL, 1)), strict=True):
            first, second = sorted((root(int(meeting[one] % len(sides))), root(int(meeting[other] % len(sides)))))
            label[second] = first  # the longer one is before
    base = place[sides[:, 0]]
    low, high = np.zeros(len(sides)), np.zeros(len(sides))
    high[:] = [length if label[edge] == edge else 0.0 for edge, length in enumerate(extent)]
    for edge in range(len(sides)):
        line = root(edge)
        if line != edge:
            reach = (place[sides[edge]] - base[line]) @ along[line]
            low[line], high[line] = min(low[line], *reach), max(high[line], *reach)
    return base, low, high


def _cells(tree: MeshTree, lifted: _Floats) -> tuple[_Floats, _Floats, _Integers, _Integers, npt.NDArray[np.int32]]:
    """The last five fields of `Bends`. What is seen from a cell is what is seen from its corners or its middle."""
    low, high = tree.mesh.bounds_m
    size_m = _CELL_M
    while True:
        counts = np.maximum(1, np.ceil((high - low) / size_m - 1e-9)).astype(np.int64)
        if 2 * int(np.prod(counts + 1)) * len(lifted) <= _MOST_LOOKS or counts.max() == 1:
            break
        size_m *= 1.25
    # Corners on the outermost surfaces would look along them.
    inset_m = np.minimum(0.05, 0.05 * (high - low))
    first, last = low + inset_m, high - inset_m
    axes = [np.linspace(first[axis], last[axis], int(counts[axis]) + 1) for axis in range(3)]
    corners = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    middles = (corners[:-1, :-1, :-1] + corners[1:, 1:, 1:]) / 2
    of_corners, of_middles = (np.zeros((eyes[..., 0].size, len(lifted)), np.bool_) for eyes in (corners, middles))
    for eyes, seen in ((corners, of_corners), (middles, of_middles)):
        find_seen(tree.tree, np.ascontiguousarray(eyes.reshape(-1, 3)), lifted, seen)
    around = of_corners.reshape(*corners.shape[:3], len(lifted))
    for x, y, z in itertools.product((slice(None, -1), slice(1, None)), repeat=3):
        of_middles |= around[x, y, z].reshape(of_middles.shape)
    cell, point = np.nonzero(of_middles)
    begins = np.searchsorted(cell, np.arange(int(counts.prod()) + 1))
    return (
        np.array(low),
        np.maximum((high - low) / counts, 1e-9),
        counts,
        begins.astype(np.int64),
        point.astype(np.int32),
    )
