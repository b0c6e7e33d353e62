"""The edges of a triangle mesh round which sound bends, and the shortest ways between them.

An edge bends sound where more than half a turn around it is air. That is found by looking around it, so it holds for
sheets, for seams whose pieces have no common vertices, and for things that stand on others; gaps under a centimetre are
closed. Paths bend at points that are spread along these edges; a path is then drawn taut along the edges themselves
(`server.acoustics.mesh_paths`).

Where a mesh has too many edges, points are farther apart, and every stretch of an edge keeps one. Where there are too
many stretches for that, those stay that lead round what hides most places from each other, such as doors.

Axes: P points, on R stretches of E edges. Points are (..., xyz) in metres, in world axes.
"""

import heapq
import itertools
import logging
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from server.acoustics.mesh import TriangleMesh
from server.acoustics.mesh_edges_kernel import (
    SLACK,
    drop_doubles,
    find_seen,
    find_shortest,
    find_steps,
    hide_steps,
    look_round,
    renew_shortest,
)
from server.acoustics.mesh_tree import MeshTree

_Floats = npt.NDArray[np.float64]
_Integers = npt.NDArray[np.int64]
_Flags = npt.NDArray[np.bool_]

MOST_POINTS = 768
"""The most points at which paths bend. Ways between all of them take six bytes a pair."""
_SPACING_M = 0.25
"""How far points on an edge are apart at most, unless there would be too many."""
_LEAF_SPACING_M = 0.5
"""The same on leaves of doors, whose points are found anew whenever they move."""
_MOST_LEAF_EDGES, _MOST_LEAF_POINTS = 64, 48
"""The most edges of a leaf round which sound bends, the longest and sharpest, and the most points on them."""
_COARSER = 1.1
_MOST_LOOKED_ROUND = 16_384
"""The most places on edges around which it is looked, some 70 microseconds each."""
_MOST_EDGES = 8192
"""The most sides of triangles that are looked at: the longest and sharpest."""
_SHORTEST_M = 0.05
"""An edge that is shorter gets no points: paths do not bend there."""
_EYES, _ASIDE_M, _WAYS_EACH = 256, 0.3, 2
"""Of too many stretches, those are kept that lead between so many places, half of them so far beside edges, by so many
ways for each two of them."""
_RADIUS_M, _LIFT_M = 0.01, 1e-3
_LEAST_RAD = math.radians(2)
_HALVINGS = 8
_INSET_M = 0.01
_SAME_VERTEX_M, _SAME_LINE_M = 1e-6, 1e-3
_PARALLEL = 1 - 1e-8
_ROWS = 256
_CELL_M = 1.0
"""The least size of a cell."""
_AROUND_M = 4.0
"""How far from all points there are cells."""
_MOST_LOOKS = 1_500_000
"""Looks from all over the place at all points, a microsecond each."""

_logger = logging.getLogger(__name__)


class Bends(NamedTuple):
    """Points at which paths bend. `places` (P, 3) are on edges, which run from `starts` (P, 3) `alongs` (P, 3) for
    `extents` (P,); each stands for `portions` (P,) of an edge. `lifted` (P, 3) are a little off the edges, in the air.
    `facings` (P, 2, 3) are the normals of both surfaces. `lengths` (P, P) are the shortest ways between points, and
    `before` (P, P) the last points on the ways from the first to the second.

    Space around the points is in cells of `cell_m` (3,) from `origin` (3,) on, `counts` (3,) along each axis. The
    points that are seen from somewhere in a cell are those of `seen` from `begins` (cell,) on, but for some that are
    seen from a corner of it only. After the last cell there is one more, with all points, for what lies outside.
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
    """Find the points of a mesh, at most `MOST_POINTS`, and the ways between them. Logs a warning if edges are left
    out for being too many."""
    spots = _spots(tree, _edges(tree.mesh), _SPACING_M)
    steps = _steps(tree, spots)
    lengths, before = _shortest(steps)
    return Bends(*spots, lengths, before, *_cells(tree, spots.lifted, steps))


class StillEdges:
    """The edges of a mesh in which `leaves` of doors move, which are given shut. What does not depend on where they are
    is found once; `swept`, for each leaf, are points (n, 3) on it all along its way."""

    def __init__(self, tree: MeshTree, leaves: Sequence[TriangleMesh], swept: Sequence[_Floats]) -> None:
        self._of_leaves = [_edges(leaf).longest(_MOST_LEAF_EDGES) for leaf in leaves]
        self._spots = _spots(tree, _edges(tree.mesh), _SPACING_M)
        self._steps = _steps(tree, self._spots)
        with ThreadPoolExecutor(1) as beside:
            shortest = beside.submit(_shortest, self._steps)
            self._cells = _cells(tree, self._spots.lifted, self._steps)
            self._near = [_cells_in_sight(tree, self._cells, points) for points in swept]
        self._lengths, self._before = shortest.result()
        self._order = np.argsort(self._lengths, axis=-1, kind="stable").astype(np.int16)

    def bends_among(
        self, tree: MeshTree, leaves: Sequence[TriangleMesh], moves: Sequence[Callable[[_Floats], _Floats]]
    ) -> Bends:
        """The points, and the ways between them, with the `leaves` where they are in `tree`: `moves` are how points
        (n, 3) of each have moved since it was shut. Points on their edges are added, and ways that they stand in are
        taken away."""
        still = len(self._spots.places)
        of_leaves = [
            _spots(tree, edges.moved(move), _LEAF_SPACING_M, _MOST_LEAF_POINTS)
            for edges, move in zip(self._of_leaves, moves, strict=True)
        ]
        spots = _Spots(*(np.concatenate(parts) for parts in zip(self._spots, *of_leaves, strict=True)))
        steps = np.full((len(spots.places), len(spots.places)), np.inf, np.float32)
        steps[:still, :still] = self._steps
        hide_steps(MeshTree(TriangleMesh.joined(leaves)).tree, self._spots.lifted, steps)
        find_steps(tree.tree, spots.places, spots.lifted, spots.facings, still, steps)
        ends = still + np.cumsum([len(each.places) for each in of_leaves])
        points = [np.arange(end - len(each.places), end) for each, end in zip(of_leaves, ends, strict=True)]
        lengths, before = np.empty_like(steps), np.empty(steps.shape, np.int16)
        renew_shortest(steps, self._lengths, self._before, self._order, lengths, before)
        return Bends(*spots, lengths, before, *self._cells.with_points(self._near, points))


class _Spots(NamedTuple):
    """The first seven fields of `Bends`."""

    places: _Floats
    lifted: _Floats
    facings: _Floats
    starts: _Floats
    alongs: _Floats
    extents: _Floats
    portions: _Floats


class _Cells(NamedTuple):
    """The last five fields of `Bends`."""

    origin: _Floats
    cell_m: _Floats
    counts: _Integers
    begins: _Integers
    seen: npt.NDArray[np.int32]

    def with_points(self, cells: Sequence[_Flags], points: Sequence[_Integers]) -> "_Cells":
        """The cells with further points, group by group: each in those of the cells whose flag (cell,) is true, and in
        the last."""
        lists = [self.seen[begin:end] for begin, end in itertools.pairwise(self.begins)]
        for flags, more in zip(cells, points, strict=True):
            for cell in (*np.flatnonzero(flags), len(lists) - 1):
                lists[cell] = np.concatenate([lists[cell], more])
        begins = np.cumsum([0, *map(len, lists)])
        return self._replace(begins=begins.astype(np.int64), seen=np.concatenate(lists).astype(np.int32))


def _spots(tree: MeshTree, edges: "_Edges", spacing_m: float, most: int = MOST_POINTS) -> _Spots:
    """At most so many points on edges of the mesh of `tree`, or of a part of it."""
    points = _points(tree, edges, spacing_m)
    runs = _runs(points)
    kept = np.arange(len(runs.first))
    if len(kept) > MOST_POINTS:
        kept = _most_useful(tree, points, runs)
        _warn(len(runs.first), MOST_POINTS)
    if len(kept) > most:  # of a leaf
        kept = np.sort(np.argsort(-runs.counts * runs.spacings, kind="stable")[:most])
    runs = runs.only(kept)
    low, high = _reach(tree, edges, points, runs)
    chosen, run, portions = _spread(runs, spacing_m, most)
    points = points.only(chosen)
    # At its very end, an edge touches what it ends at, which would be in the way.
    low, high = np.minimum(low[run] + _INSET_M, points.at), np.maximum(high[run] - _INSET_M, points.at)
    alongs = np.ascontiguousarray(edges.alongs[points.edge])
    starts = edges.starts[points.edge] + low[:, None] * alongs
    return _Spots(points.places, points.lifted, points.facings, starts, alongs, high - low, portions)


def _steps(tree: MeshTree, spots: _Spots) -> npt.NDArray[np.float32]:
    """(P, P) distances of points that a path may join directly, and infinity."""
    steps = np.empty((len(spots.places), len(spots.places)), np.float32)
    find_steps(tree.tree, spots.places, spots.lifted, spots.facings, 0, steps)
    return steps


def _shortest(steps: npt.NDArray[np.float32]) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int16]]:
    """`Bends.lengths` and `before`."""
    lengths, before = np.empty_like(steps), np.empty(steps.shape, np.int16)
    find_shortest(steps, lengths, before)
    return lengths, before


def _warn(number: int, most: int) -> None:
    _logger.warning(
        "sound bends round %d of %d edges of the mesh, and the others are left out; simplify the mesh", most, number
    )


class _Edges(NamedTuple):
    """Edges that may bend sound, the longest first: starts (E, 3), directions (E, 3), lengths (E,), and directions
    across along one of their triangles (E, 3)."""

    starts: _Floats
    alongs: _Floats
    extents: _Floats
    aside: _Floats

    def longest(self, most: int) -> "_Edges":
        return _Edges(*(each[:most] for each in self))

    def moved(self, move: Callable[[_Floats], _Floats]) -> "_Edges":
        """The same where a rigid motion of points (n, 3) takes them."""
        starts = move(self.starts)
        alongs, aside = (np.ascontiguousarray(move(self.starts + way) - starts) for way in (self.alongs, self.aside))
        return _Edges(np.ascontiguousarray(starts), alongs, self.extents, aside)


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


class _Runs(NamedTuple):
    """Stretches of edges that bend sound: the numbers of the first and the last point on each (R,), and how far points
    on it are apart (R,)."""

    first: _Integers
    last: _Integers
    spacings: _Floats

    @property
    def counts(self) -> _Integers:
        return self.last - self.first + 1

    def only(self, chosen: _Integers) -> "_Runs":
        return _Runs(self.first[chosen], self.last[chosen], self.spacings[chosen])


def _points(tree: MeshTree, edges: _Edges, least_m: float) -> _Points:
    """The points, at most `_MOST_LOOKED_ROUND` and at least so far apart, where edges bend sound."""
    spacing_m = max(least_m, float(edges.extents.sum()) / (_MOST_LOOKED_ROUND - len(edges.extents)))
    numbers = np.ceil(edges.extents / spacing_m).astype(np.int64)
    edge = np.repeat(np.arange(len(numbers)), numbers)
    portions = (edges.extents / np.maximum(numbers, 1))[edge]
    at = (np.arange(len(edge)) - np.repeat(np.cumsum(numbers) - numbers, numbers) + 0.5) * portions
    places, facings, lifted, bends = _look(tree, edges, edge, at)
    chosen = np.flatnonzero(bends)
    return _Points(edge, at, portions, places, facings, lifted).only(chosen)


def _runs(points: _Points) -> _Runs:
    """The stretches on which points follow each other without a gap."""
    follows = (np.diff(points.edge) == 0) & (np.diff(points.at) < 1.5 * points.portions[1:])
    first = np.flatnonzero(np.concatenate([[True], ~follows])[: len(points.edge)])
    last = np.append(first[1:], len(points.edge))[: len(first)] - 1
    return _Runs(first, last, points.portions[first])


def _spread(runs: _Runs, spacing_m: float, most: int) -> tuple[_Integers, _Integers, _Floats]:
    """At most so many points, spread evenly over at most as many stretches: their numbers, those of their
    stretches, and for how much of an edge each stands, in metres."""
    counts, extents = runs.counts, runs.counts * runs.spacings
    numbers = counts
    while numbers.sum() > most:
        spacing_m *= _COARSER
        numbers = np.minimum(counts, np.ceil(extents / spacing_m).astype(np.int64))
    run = np.repeat(np.arange(len(counts)), numbers)
    place = np.arange(len(run)) - np.repeat(np.cumsum(numbers) - numbers, numbers)
    chosen = runs.first[run] + (2 * place + 1) * counts[run] // (2 * numbers[run])
    return chosen, run, (extents / numbers)[run]


def _most_useful(tree: MeshTree, points: _Points, runs: _Runs) -> _Integers:
    """The numbers of the `MOST_POINTS` stretches that lead round what hides most places from each other, and of the
    longest if these are fewer. Sharp edges count more: of a ground in the open, there are many that are nearly flat.
    Places are in the air beside edges and all over the box around them, at random."""
    middles = points.only((runs.first + runs.last) // 2)
    extents = runs.counts * runs.spacings
    sharpness = np.arccos(np.clip(np.sum(middles.facings[:, 0] * middles.facings[:, 1], axis=-1), -1, 1)) + _LEAST_RAD
    rng = np.random.default_rng(0)
    drawn = rng.choice(len(extents), _EYES // 2, replace=False, p=sharpness**2 / np.sum(sharpness**2))
    near, away = middles.lifted[drawn], (middles.lifted - middles.places)[drawn]
    far = near + _ASIDE_M * away / np.linalg.norm(away, axis=-1, keepdims=True)
    beside = np.where(tree.is_visible(near, far)[:, None], far, near)
    low, high = middles.lifted.min(axis=0), middles.lifted.max(axis=0)
    eyes = np.concatenate([beside, rng.uniform(low, high, (_EYES - len(beside), 3))])
    seen, in_sight = np.empty((_EYES, len(middles.lifted)), np.bool_), np.empty((_EYES, _EYES), np.bool_)
    find_seen(tree.tree, eyes, middles.lifted, seen)
    find_seen(tree.tree, eyes, eyes, in_sight)
    for eye in range(_EYES):
        away = eyes[eye] - middles.places
        slack = SLACK * np.linalg.norm(away, axis=-1, keepdims=True)
        seen[eye] &= np.any(np.sum(middles.facings * away[:, None], axis=-1) <= slack, axis=-1)
    # How many ways each two places that do not see each other still lack.
    lack = np.where(in_sight & in_sight.T, 0, _WAYS_EACH)
    of_run = seen.T.astype(np.float32)
    gains = np.sum((of_run @ (lack > 0).astype(np.float32)) * of_run, axis=-1) * sharpness
    # What a stretch adds never grows: what was the best, and still is when it is counted anew, is the best of all.
    waits = [(-gain, -extent, run) for run, (gain, extent) in enumerate(zip(gains, extents, strict=True)) if gain > 0]
    heapq.heapify(waits)
    chosen: list[int] = []
    while waits and len(chosen) < MOST_POINTS:
        _, extent, run = heapq.heappop(waits)
        between = np.ix_(seen[:, run], seen[:, run])
        gain = np.count_nonzero(lack[between]) * sharpness[run]
        if gain and (not waits or gain >= -waits[0][0]):
            chosen.append(run)
            lack[between] -= lack[between] > 0
        elif gain:
            heapq.heappush(waits, (-gain, extent, run))
    others = np.setdiff1d(np.argsort(-extents * sharpness, kind="stable"), chosen, assume_unique=True)
    return np.sort(np.concatenate([np.array(chosen, np.int64), others[: MOST_POINTS - len(chosen)]]))


def _look(tree: MeshTree, edges: _Edges, edge: _Integers, at: _Floats) -> tuple[_Floats, _Floats, _Floats, _Flags]:
    """Look around places on edges. Returns the places, their surfaces, places off the edges, and whether they bend."""
    alongs = edges.alongs[edge]
    places = edges.starts[edge] + at[:, None] * alongs
    facings, lifted, bends = np.zeros((len(edge), 2, 3)), np.zeros((len(edge), 3)), np.zeros(len(edge), np.bool_)
    look_round(tree.tree, places, alongs, edges.aside[edge], _RADIUS_M, _LIFT_M, _LEAST_RAD, facings, lifted, bends)
    return places, facings, lifted, bends


def _reach(tree: MeshTree, edges: _Edges, points: _Points, runs: _Runs) -> tuple[_Floats, _Floats]:
    """From where to where along its edge each stretch bends sound (R,), both in metres."""
    edge, ends = points.edge[runs.first], []
    for way, outermost, limit in ((-1, runs.first, np.zeros(len(edge))), (1, runs.last, edges.extents[edge])):
        # Between a place that bends sound and one that does not.
        inside = points.at[outermost]
        outside = np.clip(inside + way * runs.spacings, 0.0, edges.extents[edge])
        some = np.flatnonzero(np.abs(inside + way * runs.spacings / 2 - limit) > _SAME_LINE_M)
        for _ in range(_HALVINGS):
            middle = (inside[some] + outside[some]) / 2
            bends = _look(tree, edges, edge[some], middle)[3]
            inside[some] = np.where(bends, middle, inside[some])
            outside[some] = np.where(bends, outside[some], middle)
        reach = np.array(limit)
        reach[some] = inside[some]
        ends.append(reach)
    return ends[0], ends[1]


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
    may_bend = np.flatnonzero(((counts != 2) | ~(is_flat | is_hollow)) & (extent > 0))
    if len(may_bend) > _MOST_EDGES:
        _warn(len(may_bend), _MOST_EDGES)
        # Of a fine ground, most sides are nearly flat.
        turn_rad = np.where(counts == 2, math.pi - np.arccos(np.clip(np.sum(one * other, axis=-1), -1, 1)), math.pi)
        may_bend = may_bend[np.argsort(-(extent * turn_rad)[may_bend], kind="stable")[:_MOST_EDGES]]
    longest = may_bend[np.argsort(-extent[may_bend], kind="stable")]
    sides, along, extent, one = sides[longest], along[longest], extent[longest], one[longest]
    base, low, high = _joined(place, sides, along, extent)
    edge = np.flatnonzero(high - low >= _SHORTEST_M)
    edge = edge[np.argsort(-(high - low)[edge], kind="stable")]
    starts = base[edge] + low[edge, None] * along[edge]
    extents = (high - low)[edge]
    kept = np.zeros(len(edge), np.bool_)
    drop_doubles(starts + extents[:, None] / 2 * along[edge], along[edge], extents / 2, _SAME_LINE_M, kept)
    return _Edges(starts[kept], along[edge][kept], extents[kept], one[edge][kept])


def _joined(place: _Floats, sides: _Integers, along: _Floats, extent: _Floats) -> tuple[_Floats, _Floats, _Floats]:
    """Join sides that continue each other to lines. Returns where each side begins (E, 3), and how far the line goes
    on from there along the side, to before it (negative) and to after it (E,): for the longest side of each line. For
    its other sides both are zero."""
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
        for row in range(0, len(meeting), _ROWS):
            goes_on = away[row : row + _ROWS] @ away.T < -_PARALLEL
            # One is enough: sides that go on in the same direction from here join the same ones.
            for one in np.flatnonzero(goes_on.any(axis=-1)):
                other = int(np.argmax(goes_on[one]))
                both = root(int(meeting[row + one] % len(sides))), root(int(meeting[other] % len(sides)))
                label[max(both)] = min(both)  # the longer one is before
    base = place[sides[:, 0]]
    low, high = np.zeros(len(sides)), np.zeros(len(sides))
    high[:] = [length if label[edge] == edge else 0.0 for edge, length in enumerate(extent)]
    for edge in range(len(sides)):
        line = root(edge)
        if line != edge:
            reach = (place[sides[edge]] - base[line]) @ along[line]
            low[line], high[line] = min(low[line], *reach), max(high[line], *reach)
    return base, low, high


def _cells(tree: MeshTree, lifted: _Floats, steps: npt.NDArray[np.float32]) -> _Cells:
    """Divide space into cells. Each has the points of `lifted` that are seen from its corners, from its middle or from
    a point in it. One more cell at the end has all points."""
    if not len(lifted):
        return _Cells(np.zeros(3), np.ones(3), np.ones(3, np.int64), np.zeros(3, np.int64), np.zeros(0, np.int32))
    low, high = tree.mesh.bounds_m
    low = np.maximum(low, lifted.min(axis=0) - _AROUND_M)
    size = np.maximum(np.minimum(high, lifted.max(axis=0) + _AROUND_M) - low, 1e-9)
    size_m = _CELL_M
    while True:
        cells = np.maximum(1.0, np.ceil(size / size_m - 1e-9))
        if 2 * np.prod(cells + 1) * len(lifted) <= _MOST_LOOKS or cells.max() == 1:
            break
        size_m *= 1.25
    counts, cell_m = cells.astype(np.int64), size / cells
    of_cells = _in_sight(tree, low, cell_m, counts, lifted)
    within = np.clip((lifted - low) // cell_m, 0, counts - 1).astype(np.int64)
    for point, cell in enumerate(np.ravel_multi_index(tuple(within.T), tuple(counts))):
        of_cells[cell] |= steps[point] < np.inf
        of_cells[cell, point] = True
    cells_seen, point_seen = np.nonzero(of_cells)
    begins = np.searchsorted(cells_seen, np.arange(len(of_cells) + 1))
    begins = np.append(begins, begins[-1] + len(lifted)).astype(np.int64)
    return _Cells(low, cell_m, counts, begins, np.concatenate([point_seen, np.arange(len(lifted))]).astype(np.int32))


def _cells_in_sight(tree: MeshTree, cells: _Cells, points: _Floats) -> _Flags:
    """(cell,) whether a corner or the middle of each cell, but for the last, sees one of the points (n, 3), or has one
    in it."""
    sees: _Flags = np.any(_in_sight(tree, cells.origin, cells.cell_m, cells.counts, points), axis=-1)
    place = np.floor((points - cells.origin) / cells.cell_m)
    within = np.clip(place, 0, cells.counts - 1).astype(np.int64)
    sees[np.ravel_multi_index(tuple(within.T), tuple(cells.counts))] = True
    return sees


def _in_sight(tree: MeshTree, low: _Floats, cell_m: _Floats, counts: _Integers, points: _Floats) -> _Flags:
    """(cell, point) whether a corner or the middle of a cell sees a point (n, 3)."""
    # Corners on the outermost surfaces would look along them.
    size = counts * cell_m
    inset_m = np.minimum(0.05, 0.05 * size)
    axes = [
        np.linspace(inset, side - inset, count + 1) for inset, side, count in zip(inset_m, size, counts, strict=True)
    ]
    corners = low + np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    middles = (corners[:-1, :-1, :-1] + corners[1:, 1:, 1:]) / 2
    of_corners, of_cells = (np.zeros((eyes[..., 0].size, len(points)), np.bool_) for eyes in (corners, middles))
    for eyes, seen in ((corners, of_corners), (middles, of_cells)):
        find_seen(tree.tree, np.ascontiguousarray(eyes.reshape(-1, 3)), np.ascontiguousarray(points), seen)
    around = of_corners.reshape(*corners.shape[:3], len(points))
    for x, y, z in itertools.product((slice(None, -1), slice(1, None)), repeat=3):
        of_cells |= around[x, y, z].reshape(of_cells.shape)
    return of_cells
