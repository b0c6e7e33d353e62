"""Merges triangles that sound cannot tell apart: vertices inside flat surfaces, and on straight edges, are removed.

A vertex goes if the triangles around it are of one material and nearly in one plane, or of two such groups that meet in
a nearly straight line through it; its hole is filled from one of its neighbours. Both fillings cover the same shadow on
the plane of their group, so no point moves farther than the corners around it are apart across the plane, and along the
line farther than the vertex lay off the line. Each triangle carries the sum of these distances over all that it
replaced: the bound is proved for each, not measured.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.kernels.compiled import compiled
from training.data.levels.vectors import dot

_Floats = npt.NDArray[np.float64]
_Integers = npt.NDArray[np.int64]

_MOST_PASSES = 60
_MOST_AROUND = 32
"""Vertices of more triangles than this stay."""
_ONE_PLANE = np.cos(np.radians(3.0))
_UPRIGHT = 0.95
_THINNEST = 0.02
"""A new triangle is no thinner than this share of its longest side, unless the thinnest before was thinner."""


@dataclass(frozen=True)
class Merged:
    """`triangles` (T, 3) use the vertices that were given; `kept` (T,) is the triangle given in whose place each is,
    which had the same plane and material. No point of the surface moved by more than `bound_m`."""

    triangles: _Integers
    kept: _Integers
    bound_m: float


def merge_flat(vertices: _Floats, triangles: _Integers, materials: _Integers, within_m: float) -> Merged:
    """Merge triangles where no point of the surface moves by more than `within_m`; 0 merges none."""
    kept, error = np.arange(len(triangles)), np.zeros(len(triangles))
    fixed = np.zeros(len(vertices), np.bool_)
    triangles = triangles.copy()
    for _ in range(_MOST_PASSES if within_m > 0 else 0):
        starts, around = _around(len(vertices), triangles)
        removed = _remove(vertices, triangles, materials[kept], error, starts, around, within_m, fixed)
        if not removed:
            break
        stays = triangles[:, 0] >= 0
        triangles, kept, error = triangles[stays], kept[stays], error[stays]
    return Merged(triangles, kept, float(error.max(initial=0.0)))


def _around(vertices: int, triangles: _Integers) -> tuple[_Integers, _Integers]:
    """The triangles at each vertex v: `around[starts[v]:starts[v + 1]]`."""
    flat = triangles.ravel()
    order = np.argsort(flat, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(flat, minlength=vertices))])
    return starts, order // 3


@compiled
def _remove(vertices, triangles, materials, error, starts, around, within, fixed):
    """Remove what vertices can be removed at once, none of them neighbours of each other; triangles that go get the
    vertices -1. Returns the number of vertices removed. Vertices that could not go are set in `fixed`, and are tried
    again when something near them has changed."""
    touched = np.zeros(len(triangles), np.bool_)
    ring = np.empty((_MOST_AROUND + 1, 2), np.int64)
    own = np.empty(_MOST_AROUND + 1, np.int64)
    normals = np.empty((_MOST_AROUND + 1, 3))
    group = np.empty(_MOST_AROUND + 1, np.int64)
    removed = 0
    for v in range(len(vertices)):
        count = starts[v + 1] - starts[v]
        if fixed[v] or not 2 <= count <= _MOST_AROUND:
            continue
        if _is_touched(touched, starts, around, v):
            continue
        fixed[v] = True
        is_closed, is_ring = _order(triangles, starts, around, v, ring, own)
        if not is_ring:
            continue
        for i in range(count):
            a, b, c = triangles[own[i]]
            normals[i] = _normal(vertices[a], vertices[b], vertices[c])
        first, second, groups = _groups(materials, own, normals, group, count, is_closed)
        if groups == 0:
            continue
        spread = _spread(vertices, ring, normals, group, count, groups, v)
        if groups == 1 and is_closed:
            candidates, off_line = ring[:count, 0], 0.0
        else:
            ends = np.array((first, second)) if is_closed else np.array((0, count))
            u, w = _vertex(ring, ends[0], count), _vertex(ring, ends[1], count)
            off_line = _off_line(vertices[v], vertices[u], vertices[w])
            candidates = np.array((u, w))
        worst = 0.0
        for i in range(count):
            worst = max(worst, error[own[i]])
        bound = worst + spread + off_line
        if bound > within:
            continue
        best, best_shape = -1, 0.0
        before = 1.0
        for i in range(count):
            before = min(before, _shape(vertices, v, ring[i, 0], ring[i, 1]))
        for u in candidates:
            if _is_touched(touched, starts, around, u):
                fixed[v] = False  # what is around it has just changed: later
                continue
            shape = _filling(vertices, triangles, starts, around, ring, normals, count, is_closed, u)
            if shape > best_shape:
                best, best_shape = u, shape
        if best < 0 or best_shape < min(_THINNEST, before):
            continue
        for i in range(count):
            touched[own[i]] = True
            for j in range(2):
                fixed[ring[i, j]] = False
        for i in range(starts[best], starts[best + 1]):
            touched[around[i]] = True
        for i in range(count):
            a, b = ring[i, 0], ring[i, 1]
            if best in (a, b):
                triangles[own[i]] = -1
            else:
                triangles[own[i], 0], triangles[own[i], 1], triangles[own[i], 2] = best, a, b
                error[own[i]] = bound
        removed += 1
    return removed


@compiled
def _is_touched(touched, starts, around, v):
    found = False
    for i in range(starts[v], starts[v + 1]):
        found = found or touched[around[i]]
    return found


@compiled
def _order(triangles, starts, around, v, ring, own):
    """Put the sides that face `v` one behind the other. Returns whether they form a closed ring, and whether they form
    one ring or path at all."""
    count = starts[v + 1] - starts[v]
    for i in range(count):
        t = around[starts[v] + i]
        for k in range(3):
            if triangles[t, k] == v:
                own[i] = t
                ring[i, 0], ring[i, 1] = triangles[t, (k + 1) % 3], triangles[t, (k + 2) % 3]
    # A path begins at the vertex that no side ends at.
    for i in range(count):
        begins = True
        for j in range(count):
            if ring[j, 1] == ring[i, 0]:
                begins = False
        if begins:
            _swap(ring, own, 0, i)
            break
    for i in range(1, count):
        found = False
        for j in range(i, count):
            if ring[j, 0] == ring[i - 1, 1]:
                _swap(ring, own, i, j)
                found = True
                break
        if not found:
            return False, False
    for i in range(count):
        for j in range(i):
            if ring[i, 0] == ring[j, 0] or ring[i, 1] == ring[j, 1]:
                return False, False
    return ring[count - 1, 1] == ring[0, 0], True


@compiled
def _swap(ring, own, i, j):
    a, b, t = ring[i, 0], ring[i, 1], own[i]
    ring[i, 0], ring[i, 1], own[i] = ring[j, 0], ring[j, 1], own[j]
    ring[j, 0], ring[j, 1], own[j] = a, b, t


@compiled
def _normal(a, b, c):
    cross = np.cross(b - a, c - a)
    return cross / max(np.sqrt(dot(cross, cross)), 1e-300)


@compiled
def _groups(materials, own, normals, group, count, is_closed):
    """Number the groups of one material and plane in `group`. Returns where the second and the third begin, and how
    many there are: 1, 2 in a closed ring, or 0 for more."""
    breaks = np.empty(count, np.int64)
    found = 0
    for i in range(0 if is_closed else 1, count):
        before = (i - 1) % count
        if materials[own[i]] != materials[own[before]] or dot(normals[i], normals[before]) < _ONE_PLANE:
            breaks[found] = i
            found += 1
    if found == 0:
        group[:count] = 0
        return 0, 0, 1
    if not is_closed or found != 2:
        return 0, 0, 0
    for i in range(count):
        group[i] = 1 if breaks[0] <= i < breaks[1] else 0
    return breaks[0], breaks[1], 2


@compiled
def _vertex(ring, index, count):
    return ring[index, 0] if index < count else ring[count - 1, 1]


@compiled
def _spread(vertices, ring, normals, group, count, groups, v):
    """How far apart the corners of a group are across its mean plane, of the group where that is most."""
    most = 0.0
    for g in range(groups):
        mean = np.zeros(3)
        for i in range(count):
            if group[i] == g:
                mean += normals[i]
        mean /= max(np.sqrt(dot(mean, mean)), 1e-300)
        low, high = 0.0, 0.0
        for i in range(count):
            if group[i] != g:
                continue
            if dot(mean, normals[i]) < _UPRIGHT:
                return np.inf
            for j in range(2):
                across = dot(vertices[ring[i, j]] - vertices[v], mean)
                low, high = min(low, across), max(high, across)
        most = max(most, high - low)
    return most


@compiled
def _off_line(v, u, w):
    """The distance of v from the line between u and w; infinite if it does not lie between them."""
    along = w - u
    square = dot(along, along)
    share = dot(v - u, along) / square if square > 0 else -1.0
    if not 0 < share < 1:
        return np.inf
    apart = v - u - share * along
    return np.sqrt(dot(apart, apart))


@compiled
def _shape(vertices, a, b, c):
    """Height over longest side of a triangle."""
    p, q, r = vertices[b] - vertices[a], vertices[c] - vertices[b], vertices[a] - vertices[c]
    square = max(dot(p, p), dot(q, q), dot(r, r))
    cross = np.cross(p, q)
    return np.sqrt(dot(cross, cross)) / square if square > 0 else 0.0


@compiled
def _filling(vertices, triangles, starts, around, ring, normals, count, is_closed, u):
    """The worst shape of the triangles that fill the hole of `v` from `u`; 0 if one of them faces elsewhere than that
    whose side it takes over, or if `u` and the vertex that goes are joined
    round another way too, so that surfaces would branch."""
    common = 0
    for i in range(count if is_closed else count + 1):
        n = _vertex(ring, i, count)
        if n == u:
            continue
        for k in range(starts[u], starts[u + 1]):
            t = around[k]
            if triangles[t, 0] == n or triangles[t, 1] == n or triangles[t, 2] == n:
                common += 1
                break
    if common != (2 if is_closed else 1):
        return 0.0
    worst = 1.0
    for i in range(count):
        a, b = ring[i, 0], ring[i, 1]
        if u in (a, b):
            continue
        if dot(_normal(vertices[u], vertices[a], vertices[b]), normals[i]) < _UPRIGHT:
            return 0.0
        worst = min(worst, _shape(vertices, u, a, b))
    return worst
