"""The compiled code of `server.acoustics.mesh_tree`: building the tree, and following rays through it.

The tree is binary, and nodes stand in the order in which one would write them down, each before its children: the first
child of node i is i + 1. Splits are chosen by the surface area heuristic over bins of centres (Wald, "On fast
construction of SAH-based bounding volume hierarchies", IEEE Symp. Interactive Ray Tracing, 2007).

Rays and triangles meet by the watertight test of Woop, Benthin and Wald ("Watertight ray/triangle intersection", J.
Computer Graphics Techniques 2(1), 2013). It shears all corners so that the ray becomes an axis, and looks on which side
of each edge that axis is. Two triangles with a common edge compute its side from the same numbers, of opposite sign,
and rounding never changes a sign but to zero, which counts as inside: the ray meets one of them, or both. The test of
boxes errs towards meeting them (Ize, "Robust BVH ray traversal", same journal, 2(2), 2013).

Distances are in lengths of the ray's direction. Nothing here allocates but `build`; callers bring a `stack` of
`STACK` integers.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from server.kernels.compiled import compiled, compiled_in_place

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int32]

STACK = 96
"""No tree is deeper."""
_BINS = 16
_LARGEST_LEAF = 4
# Below this depth, triangles are halved by number, so that even a million of them stay within the stack.
_DEEPEST_BY_AREA = 64
# Boxes are larger than their triangles by this share of the largest coordinate, since a ray in the plane of a side has
# no reciprocal.
_PADDING = 1e-12
_LEAST_DIRECTION = 1e-300
# Of coplanar triangles, the least cosine between normals: a sliver's has little to say.
_SAME_TURN = 0.99
_ROUNDING = 1 + 1e-15
# Of two sides of a sheet that are hit within this share of the distance, the one that faces the ray is taken.
_SAME_SHARE = 1e-9
OVERLAP_M = 1e-9
"""What a ray meets nearer to its start than this is where it starts, unless it faces the ray: then rounding has put the
start just behind it."""


class Tree(NamedTuple):
    """`bounds` (node, 6): least and greatest coordinates. `links` (node, 3): of an inner node its second child, 0 and
    the axis of the split; of a leaf its first triangle, their number and 0. Of the triangles, in the order of leaves:
    `corners` (triangle, corner, 3); `numbers` (triangle,) in the mesh; `planes` (triangle,), the number of the plane
    in which each lies."""

    bounds: Floats
    links: Integers
    corners: Floats
    numbers: Integers
    planes: Integers


@compiled
def join(
    sides: npt.NDArray[np.int64],
    owners: Integers,
    corners: Floats,
    normals: Floats,
    areas: Floats,
    flat_m: float,
    labels: Integers,
) -> None:
    """Give all coplanar triangles that are joined by sides the same label. `sides` (side, 2) are sorted, `owners`
    (side,) are their triangles; `labels` (triangle,) are numbers of triangles, at first their own."""
    begin = 0
    for end in range(1, len(sides) + 1):
        if end < len(sides) and sides[end, 0] == sides[begin, 0] and sides[end, 1] == sides[begin, 1]:
            continue
        for one in range(begin, end):
            for other in range(one + 1, end):
                if _are_coplanar(corners, normals, areas, owners[one], owners[other], flat_m):
                    first, second = _root(labels, owners[one]), _root(labels, owners[other])
                    labels[max(first, second)] = min(first, second)
                    break  # the other one finds the next
        begin = end
    for triangle in range(len(labels)):
        labels[triangle] = _root(labels, triangle)


@compiled
def _are_coplanar(corners: Floats, normals: Floats, areas: Floats, one: int, other: int, flat_m: float) -> bool:
    """Whether all corners of the smaller triangle lie in the plane of the larger one, and neither is without area."""
    if areas[one] < areas[other]:
        one, other = other, one
    turn = 0.0
    for axis in range(3):
        turn += normals[one, axis] * normals[other, axis]
    if not abs(turn) > _SAME_TURN:
        return False
    for corner in range(3):
        height = 0.0
        for axis in range(3):
            height += normals[one, axis] * (corners[other, corner, axis] - corners[one, 0, axis])
        if abs(height) > flat_m:
            return False
    return True


@compiled
def _root(labels: Integers, triangle: int) -> int:
    while labels[triangle] != triangle:
        labels[triangle] = labels[labels[triangle]]
        triangle = labels[triangle]
    return triangle


@compiled
def build(corners: Floats, bounds: Floats, links: Integers, order: Integers) -> int:
    """Fill `bounds` and `links`, which need 2 T - 1 rows, and `order` (T,), the triangles in the order of leaves;
    return the number of nodes."""
    count = len(corners)
    low, high, centre = np.empty((count, 3)), np.empty((count, 3)), np.empty((count, 3))
    largest = 0.0
    for row in range(count):
        order[row] = row
        for axis in range(3):
            a, b, c = corners[row, 0, axis], corners[row, 1, axis], corners[row, 2, axis]
            low[row, axis], high[row, axis] = min(a, b, c), max(a, b, c)
            centre[row, axis] = (low[row, axis] + high[row, axis]) / 2
            largest = max(largest, -low[row, axis], high[row, axis])
    padding = _PADDING * largest
    # Of each node that waits: first triangle, number of triangles, depth, and the parent whose second child it is.
    waiting = np.empty((2 * STACK, 4), np.int64)
    waiting[0, 0], waiting[0, 1], waiting[0, 2], waiting[0, 3] = 0, count, 0, -1
    waits, nodes = 1, 0
    # The last box is the sum of others.
    boxes, counts, costs = np.empty((_BINS + 1, 6)), np.empty(_BINS, np.int64), np.empty(_BINS)
    while waits:
        waits -= 1
        first, size, depth, parent = waiting[waits, 0], waiting[waits, 1], waiting[waits, 2], waiting[waits, 3]
        node = nodes
        nodes += 1
        if parent >= 0:
            links[parent, 0] = node
        for axis in range(3):
            bounds[node, axis], bounds[node, 3 + axis] = math.inf, -math.inf
            for place in range(first, first + size):
                row = order[place]
                bounds[node, axis] = min(bounds[node, axis], low[row, axis] - padding)
                bounds[node, 3 + axis] = max(bounds[node, 3 + axis], high[row, axis] + padding)
        axis, cut, left = -1, 0.0, 0
        if size > _LARGEST_LEAF and depth < _DEEPEST_BY_AREA:
            axis, cut = _best_cut(order, first, size, low, high, centre, boxes, counts, costs)
        if axis >= 0:
            begin, end = first, first + size - 1
            while begin <= end:
                if centre[order[begin], axis] < cut:
                    begin += 1
                else:
                    order[begin], order[end] = order[end], order[begin]
                    end -= 1
            left = begin - first
        if (axis < 0 or left == 0 or left == size) and size > _LARGEST_LEAF:
            axis, left = max(axis, 0), size // 2
        if size <= _LARGEST_LEAF:
            links[node, 0], links[node, 1], links[node, 2] = first, size, 0
            continue
        links[node, 1], links[node, 2] = 0, axis
        for second in range(2):
            waiting[waits, 0] = first if second else first + left
            waiting[waits, 1] = left if second else size - left
            waiting[waits, 2], waiting[waits, 3] = depth + 1, -1 if second else node
            waits += 1
    return nodes


@compiled
def _clear(boxes: Floats, row: int) -> None:
    for axis in range(3):
        boxes[row, axis], boxes[row, 3 + axis] = math.inf, -math.inf


@compiled
def _grow(boxes: Floats, row: int, by: int) -> float:
    """Enlarge a box by another one, and return half its area."""
    for axis in range(3):
        boxes[row, axis] = min(boxes[row, axis], boxes[by, axis])
        boxes[row, 3 + axis] = max(boxes[row, 3 + axis], boxes[by, 3 + axis])
    x, y, z = boxes[row, 3] - boxes[row, 0], boxes[row, 4] - boxes[row, 1], boxes[row, 5] - boxes[row, 2]
    return float(x * y + y * z + z * x)


@compiled
def _best_cut(
    order: Integers,
    first: int,
    size: int,
    low: Floats,
    high: Floats,
    centre: Floats,
    boxes: Floats,
    counts: npt.NDArray[np.int64],
    costs: Floats,
) -> tuple[int, float]:
    """The axis, and the coordinate between centres, that make the least sum of areas times numbers of some triangles;
    -1 if all their centres are the same."""
    best, best_axis, best_cut = math.inf, -1, 0.0
    for axis in range(3):
        least, most = math.inf, -math.inf
        for place in range(first, first + size):
            least, most = min(least, centre[order[place], axis]), max(most, centre[order[place], axis])
        if not least < most or not _BINS / (most - least) < math.inf:
            continue
        scale = _BINS / (most - least)
        for each in range(_BINS):
            _clear(boxes, each)
            counts[each] = 0
        for place in range(first, first + size):
            row = order[place]
            each = min(_BINS - 1, int((centre[row, axis] - least) * scale))
            counts[each] += 1
            for side in range(3):
                boxes[each, side] = min(boxes[each, side], low[row, side])
                boxes[each, 3 + side] = max(boxes[each, 3 + side], high[row, side])
        _clear(boxes, _BINS)
        number = 0
        for each in range(_BINS - 1, 0, -1):
            area = _grow(boxes, _BINS, each)
            number += counts[each]
            costs[each] = area * number if number else math.inf
        _clear(boxes, _BINS)
        number = 0
        for each in range(1, _BINS):
            area = _grow(boxes, _BINS, each - 1)
            number += counts[each - 1]
            if number and area * number + costs[each] < best:
                best, best_axis, best_cut = area * number + costs[each], axis, least + each / scale
    return best_axis, best_cut


@compiled_in_place
def _pick(x: float, y: float, z: float, axis: int) -> float:
    return x if axis == 0 else (y if axis == 1 else z)


@compiled_in_place
def _reciprocal(component: float) -> float:
    if abs(component) < _LEAST_DIRECTION:
        return math.copysign(1 / _LEAST_DIRECTION, component)
    return 1 / component


@compiled_in_place
def _meets(
    bounds: Floats, node: int, x: float, y: float, z: float, rx: float, ry: float, rz: float, least: float, most: float
) -> bool:
    """Whether the ray from (x, y, z), with the reciprocals of its direction, meets a box between two distances."""
    t0, t1 = (bounds[node, 0] - x) * rx, (bounds[node, 3] - x) * rx
    enter, leave = min(t0, t1), max(t0, t1)
    t0, t1 = (bounds[node, 1] - y) * ry, (bounds[node, 4] - y) * ry
    enter, leave = max(enter, min(t0, t1)), min(leave, max(t0, t1))
    t0, t1 = (bounds[node, 2] - z) * rz, (bounds[node, 5] - z) * rz
    enter, leave = max(enter, min(t0, t1)), min(leave, max(t0, t1))
    # Distances of either sign are taken for a little nearer, and a little farther, than computed.
    wide = abs(leave) * (_ROUNDING - 1)
    return bool(
        enter - abs(enter) * (_ROUNDING - 1) <= leave + wide
        and enter * (2 - _ROUNDING) <= most
        and leave + wide >= least
    )


@compiled_in_place
def _sheared(dx: float, dy: float, dz: float) -> tuple[int, int, int, float, float, float]:
    """The axes, the longest last, and the shear, that turn a direction into the unit vector of the last axis."""
    ax, ay, az = abs(dx), abs(dy), abs(dz)
    last = 0 if ax >= ay and ax >= az else (1 if ay >= az else 2)
    first, second = (last + 1) % 3, (last + 2) % 3
    along = _pick(dx, dy, dz, last)
    if along < 0.0:
        first, second = second, first
    return first, second, last, _pick(dx, dy, dz, first) / along, _pick(dx, dy, dz, second) / along, 1 / along


@compiled_in_place
def _cross(
    corners: Floats,
    row: int,
    at: tuple[float, float, float],
    axes: tuple[int, int, int],
    shear: tuple[float, float, float],
) -> tuple[float, float]:
    """The distance at which a ray meets a triangle, and a number that is positive if the triangle faces it, negative if
    it shows its back, and zero if they do not meet. A ray in the plane of a triangle does not meet it."""
    first, second, last = axes
    along, across, scale = shear
    x, y, z = at
    az, bz, cz = corners[row, 0, last] - z, corners[row, 1, last] - z, corners[row, 2, last] - z
    ax, ay = corners[row, 0, first] - x - along * az, corners[row, 0, second] - y - across * az
    bx, by = corners[row, 1, first] - x - along * bz, corners[row, 1, second] - y - across * bz
    cx, cy = corners[row, 2, first] - x - along * cz, corners[row, 2, second] - y - across * cz
    u, v, w = cx * by - cy * bx, ax * cy - ay * cx, bx * ay - by * ax
    if (u < 0.0 or v < 0.0 or w < 0.0) and (u > 0.0 or v > 0.0 or w > 0.0):
        return 0.0, 0.0
    whole = u + v + w
    if whole == 0.0:
        return 0.0, 0.0
    return scale * (u * az + v * bz + w * cz) / whole, whole


@compiled_in_place
def closest_hit(
    tree: Tree,
    stack: Integers,
    x: float,
    y: float,
    z: float,
    dx: float,
    dy: float,
    dz: float,
    least: float,
    most: float,
    without: int,
) -> tuple[float, int, bool]:
    """The distance, the row in the tree (-1 for none) and whether it faces the ray, of the first triangle that a ray
    meets after `least` and before `most`. Triangles of the plane `without` are left out (-1 for none). Between -least
    and `least`, only triangles that face the ray count. Of coplanar double faces the one that faces the ray is hit."""
    best, hit, best_facing, hit_facing = most, -1, most, -1
    if not abs(dx) + abs(dy) + abs(dz) > 0.0:
        return most, -1, False
    first, second, last, along, across, scale = _sheared(dx, dy, dz)
    axes, shear = (first, second, last), (along, across, scale)
    at = _pick(x, y, z, first), _pick(x, y, z, second), _pick(x, y, z, last)
    rx, ry, rz = _reciprocal(dx), _reciprocal(dy), _reciprocal(dz)
    stack[0] = 0
    waits = 1
    while waits > 0:
        waits -= 1
        node = stack[waits]
        if not _meets(tree.bounds, node, x, y, z, rx, ry, rz, -least, best + abs(best) * _SAME_SHARE):
            continue
        count = tree.links[node, 1]
        if count == 0:
            near, far = node + 1, tree.links[node, 0]
            if _pick(dx, dy, dz, tree.links[node, 2]) < 0.0:
                near, far = far, near
            stack[waits], stack[waits + 1] = far, near
            waits += 2
            continue
        begin = tree.links[node, 0]
        for row in range(begin, begin + count):
            if tree.planes[row] == without:
                continue
            distance, facing = _cross(tree.corners, row, at, axes, shear)
            if facing > 0.0:
                if -least < distance < best_facing:
                    best_facing, hit_facing = distance, row
                    best = min(best, distance)
            elif facing < 0.0 and least < distance < best:
                best, hit = distance, row
    if hit_facing >= 0 and (hit < 0 or best_facing <= best + abs(best) * _SAME_SHARE):
        return best_facing, hit_facing, True
    return best, hit, False


@compiled_in_place
def first_blocker(
    tree: Tree,
    stack: Integers,
    x: float,
    y: float,
    z: float,
    dx: float,
    dy: float,
    dz: float,
    least: float,
    most: float,
    without: int,
    likely: int,
) -> int:
    """The row of a triangle that a ray meets between two distances, whichever is found first; -1 for none. Triangles of
    the plane `without` are left out. The triangle of the row `likely` is tried before all others (-1 for none)."""
    if not abs(dx) + abs(dy) + abs(dz) > 0.0:
        return -1
    first, second, last, along, across, scale = _sheared(dx, dy, dz)
    axes, shear = (first, second, last), (along, across, scale)
    at = _pick(x, y, z, first), _pick(x, y, z, second), _pick(x, y, z, last)
    if likely >= 0 and tree.planes[likely] != without:
        distance, facing = _cross(tree.corners, likely, at, axes, shear)
        if facing != 0.0 and least < distance < most:
            return likely
    rx, ry, rz = _reciprocal(dx), _reciprocal(dy), _reciprocal(dz)
    stack[0] = 0
    waits = 1
    while waits > 0:
        waits -= 1
        node = stack[waits]
        if not _meets(tree.bounds, node, x, y, z, rx, ry, rz, least, most):
            continue
        count = tree.links[node, 1]
        if count == 0:
            stack[waits], stack[waits + 1] = tree.links[node, 0], node + 1
            waits += 2
            continue
        begin = tree.links[node, 0]
        for row in range(begin, begin + count):
            if tree.planes[row] != without:
                distance, facing = _cross(tree.corners, row, at, axes, shear)
                if facing != 0.0 and least < distance < most:
                    return row
    return -1


@compiled_in_place
def cross_all(
    tree: Tree,
    stack: Integers,
    x: float,
    y: float,
    z: float,
    dx: float,
    dy: float,
    dz: float,
    least: float,
    most: float,
    distances: Floats,
    rows: Integers,
) -> int:
    """Write what a ray meets between two distances, in the order of distances: the row in the tree of each triangle
    that faces the ray, and -1 - row of one that shows its back. Returns their number; only as many are written as there
    is room for."""
    if not abs(dx) + abs(dy) + abs(dz) > 0.0:
        return 0
    first, second, last, along, across, scale = _sheared(dx, dy, dz)
    axes, shear = (first, second, last), (along, across, scale)
    at = _pick(x, y, z, first), _pick(x, y, z, second), _pick(x, y, z, last)
    rx, ry, rz = _reciprocal(dx), _reciprocal(dy), _reciprocal(dz)
    found = 0
    stack[0] = 0
    waits = 1
    while waits > 0:
        waits -= 1
        node = stack[waits]
        if not _meets(tree.bounds, node, x, y, z, rx, ry, rz, least, most):
            continue
        count = tree.links[node, 1]
        if count == 0:
            stack[waits], stack[waits + 1] = tree.links[node, 0], node + 1
            waits += 2
            continue
        begin = tree.links[node, 0]
        for row in range(begin, begin + count):
            distance, facing = _cross(tree.corners, row, at, axes, shear)
            if facing == 0.0 or not least < distance < most:
                continue
            if found < len(rows):
                place = found
                while place > 0 and distances[place - 1] > distance:
                    distances[place], rows[place] = distances[place - 1], rows[place - 1]
                    place -= 1
                distances[place], rows[place] = distance, row if facing > 0.0 else -1 - row
            found += 1
    return found


@compiled
def find_closest(
    tree: Tree,
    origins: Floats,
    directions: Floats,
    most: Floats,
    distances: Floats,
    numbers: Integers,
    faces: npt.NDArray[np.bool_],
) -> None:
    """Fill the last three arrays, one row for each ray; see `MeshTree.closest`."""
    stack = np.empty(STACK, np.int32)
    for row in range(len(origins)):
        x, y, z = origins[row]
        dx, dy, dz = directions[row]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        least = OVERLAP_M / length if length > 0.0 else 0.0
        distance, hit, is_facing = closest_hit(tree, stack, x, y, z, dx, dy, dz, least, most[row], -1)
        distances[row] = max(0.0, distance) if hit >= 0 else math.inf
        numbers[row] = tree.numbers[hit] if hit >= 0 else -1
        faces[row] = is_facing


@compiled
def find_inside(
    tree: Tree, looks: Floats, points: Floats, touch_m: float, is_open: bool, inside: npt.NDArray[np.bool_]
) -> None:
    """Fill the last array, one row for each point, from what is seen in the directions `looks`; see
    `MeshTree.contains`."""
    stack = np.empty(STACK, np.int32)
    for row in range(len(points)):
        x, y, z = points[row, 0], points[row, 1], points[row, 2]
        faces, backs, touches = 0, 0, False
        for look in range(len(looks)):
            dx, dy, dz = looks[look, 0], looks[look, 1], looks[look, 2]
            least = OVERLAP_M / math.sqrt(dx * dx + dy * dy + dz * dz)
            distance, hit, is_facing = closest_hit(tree, stack, x, y, z, dx, dy, dz, least, math.inf, -1)
            if hit >= 0:
                touches = touches or distance <= touch_m
                if is_facing:
                    faces += 1
                else:
                    backs += 1
        if is_open and faces == backs:
            _, hit, is_facing = closest_hit(tree, stack, x, y, z, 0.0, 0.0, -1.0, OVERLAP_M, math.inf, -1)
            inside[row] = touches or hit < 0 or is_facing
        else:
            inside[row] = touches or (faces > backs if is_open else 2 * faces > len(looks))


@compiled
def find_sight(tree: Tree, a: Floats, b: Floats, margin_m: float, in_sight: npt.NDArray[np.bool_]) -> None:
    """Fill the last array, one row for each pair of points; see `MeshTree.is_visible`."""
    stack = np.empty(STACK, np.int32)
    for row in range(len(a)):
        x, y, z = a[row]
        dx, dy, dz = b[row, 0] - x, b[row, 1] - y, b[row, 2] - z
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        in_sight[row] = True
        if length > 2 * margin_m:
            margin = margin_m / length
            in_sight[row] = first_blocker(tree, stack, x, y, z, dx, dy, dz, margin, 1 - margin, -1, -1) < 0


@compiled_in_place
def walls_met(distances: Floats, rows: Integers, backs: Integers, count: int, same: float) -> int:
    """Reduce what `cross_all` wrote to walls, and return their number: `rows` and `backs` begin with the rows in the
    tree of both faces of each, which are the same for one that has only one. From the other end, there are the same
    walls.

    A wall is entered through a face and left through the back of the next one. Another face or back is a wall by
    itself, a sheet. Faces within `same` of each other are one, and with a back there they are the two faces of one
    sheet, which is no wall between a face and the back of the next one.
    """
    walls, at = 0, 0
    entered = -1  # the wall whose face was met and no back since
    while at < count:
        end, facing, behind = at, -1, -1
        while end < count and distances[end] - distances[at] <= same:
            if rows[end] >= 0 and facing < 0:
                facing = rows[end]
            elif rows[end] < 0 and behind < 0:
                behind = -1 - rows[end]
            end += 1
        at = end
        if facing < 0 and entered >= 0:
            backs[entered] = behind
            walls, entered = entered + 1, -1
            continue
        rows[walls] = facing if facing >= 0 else behind
        backs[walls] = behind if behind >= 0 else facing
        if behind < 0:
            entered = walls
        walls += 1
    return walls


@compiled
def find_walls(
    tree: Tree,
    a: Floats,
    b: Floats,
    margin_m: float,
    same_m: float,
    distances: Floats,
    rows: Integers,
    backs: Integers,
    walls: Integers,
    counts: Integers,
) -> None:
    """Fill `walls` (n, most, 2), the numbers of the triangles on both sides of the walls between pairs of points, and
    `counts` (n,); see `MeshTree.walls_between`. `distances`, `rows` and `backs` have the same room for what is met."""
    stack = np.empty(STACK, np.int32)
    for pair in range(len(a)):
        x, y, z = a[pair]
        dx, dy, dz = b[pair, 0] - x, b[pair, 1] - y, b[pair, 2] - z
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        counts[pair] = 0
        if length <= 2 * margin_m:
            continue
        margin = margin_m / length
        met = cross_all(tree, stack, x, y, z, dx, dy, dz, margin, 1 - margin, distances, rows)
        found = walls_met(distances, rows, backs, min(met, len(rows)), same_m / length)
        counts[pair] = min(found, walls.shape[1])
        for wall in range(counts[pair]):
            walls[pair, wall, 0], walls[pair, wall, 1] = tree.numbers[rows[wall]], tree.numbers[backs[wall]]


@compiled
def _box_square(bounds: Floats, node: int, x: float, y: float, z: float) -> float:
    """The square of the distance from a point to a box."""
    dx = max(bounds[node, 0] - x, 0.0, x - bounds[node, 3])
    dy = max(bounds[node, 1] - y, 0.0, y - bounds[node, 4])
    dz = max(bounds[node, 2] - z, 0.0, z - bounds[node, 5])
    return float(dx * dx + dy * dy + dz * dz)


@compiled
def _segment_square(corners: Floats, row: int, first: int, second: int, x: float, y: float, z: float) -> float:
    """The square of the distance from a point to an edge of a triangle."""
    ax, ay, az = corners[row, first, 0], corners[row, first, 1], corners[row, first, 2]
    ex, ey, ez = corners[row, second, 0] - ax, corners[row, second, 1] - ay, corners[row, second, 2] - az
    px, py, pz = x - ax, y - ay, z - az
    square = ex * ex + ey * ey + ez * ez
    share = min(1.0, max(0.0, (px * ex + py * ey + pz * ez) / square)) if square > 0.0 else 0.0
    return float((px - share * ex) ** 2 + (py - share * ey) ** 2 + (pz - share * ez) ** 2)


@compiled
def _triangle_square(corners: Floats, row: int, x: float, y: float, z: float) -> float:
    """The square of the distance from a point to a triangle: to its plane if the point is above the triangle, and to
    the nearest edge otherwise."""
    ax, ay, az = corners[row, 0, 0], corners[row, 0, 1], corners[row, 0, 2]
    bx, by, bz = corners[row, 1, 0] - ax, corners[row, 1, 1] - ay, corners[row, 1, 2] - az
    cx, cy, cz = corners[row, 2, 0] - ax, corners[row, 2, 1] - ay, corners[row, 2, 2] - az
    px, py, pz = x - ax, y - ay, z - az
    nx, ny, nz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
    square = nx * nx + ny * ny + nz * nz
    if square > 0.0:
        of_b = (py * cz - pz * cy) * nx + (pz * cx - px * cz) * ny + (px * cy - py * cx) * nz
        of_c = (by * pz - bz * py) * nx + (bz * px - bx * pz) * ny + (bx * py - by * px) * nz
        if of_b >= 0.0 and of_c >= 0.0 and of_b + of_c <= square:
            return float((px * nx + py * ny + pz * nz) ** 2 / square)
    return min(
        _segment_square(corners, row, 0, 1, x, y, z),
        _segment_square(corners, row, 1, 2, x, y, z),
        _segment_square(corners, row, 2, 0, x, y, z),
    )


@compiled
def find_distances(tree: Tree, points: Floats, distance_m: Floats) -> None:
    """Fill the last array with the distances of points (n, 3) from the nearest triangle."""
    stack = np.empty(STACK, np.int32)
    for point in range(len(points)):
        x, y, z = points[point, 0], points[point, 1], points[point, 2]
        nearest = math.inf
        stack[0] = 0
        waits = 1
        while waits > 0:
            waits -= 1
            node = stack[waits]
            if _box_square(tree.bounds, node, x, y, z) >= nearest:
                continue
            count = tree.links[node, 1]
            if count == 0:
                near, far = node + 1, tree.links[node, 0]
                if _box_square(tree.bounds, far, x, y, z) < _box_square(tree.bounds, near, x, y, z):
                    near, far = far, near
                stack[waits], stack[waits + 1] = far, near
                waits += 2
                continue
            for row in range(tree.links[node, 0], tree.links[node, 0] + count):
                nearest = min(nearest, _triangle_square(tree.corners, row, x, y, z))
        distance_m[point] = math.sqrt(nearest)
