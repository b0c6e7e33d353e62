"""The compiled code of `server.acoustics.mesh_edges`: what stands around an edge, which bends see each other, and the
shortest ways between them."""

import math

import numpy as np
import numpy.typing as npt

from server.acoustics.mesh_tree_kernel import STACK, Tree, closest_hit, first_blocker
from server.kernels.compiled import compiled

Floats = npt.NDArray[np.float64]
Singles = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int32]
Flags = npt.NDArray[np.bool_]

# A ring of chords around an edge shows its surfaces; the angle is odd, so that no chord ends on one.
_CHORDS = 36
_FIRST_RAD = 0.0647
_HALVINGS = 10
MARGIN_M = 1e-6
"""What is nearer to one of two points does not hide them from each other: they may lie on surfaces."""
# Where a solid has less than this beyond a plane, as a share of the distance, a path does not bend.
SLACK = 1e-3


@compiled
def is_clear(tree: Tree, stack: Integers, a: Floats, b: Floats, margin_m: float) -> bool:
    """Whether nothing stands between two points, farther than a margin from both."""
    dx, dy, dz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    if length <= 2 * margin_m:
        return True
    margin = margin_m / length
    return first_blocker(tree, stack, a[0], a[1], a[2], dx, dy, dz, margin, 1 - margin, -1, -1) < 0


@compiled
def _put(spot: Floats, place: Floats, first: Floats, second: Floats, angle: float, radius_m: float) -> None:
    x, y = radius_m * math.cos(angle), radius_m * math.sin(angle)
    for axis in range(3):
        spot[axis] = place[axis] + x * first[axis] + y * second[axis]


@compiled
def _find_surface(
    tree: Tree,
    stack: Integers,
    place: Floats,
    first: Floats,
    second: Floats,
    air: float,
    behind: float,
    radius_m: float,
    one: Floats,
    other: Floats,
) -> tuple[float, bool]:
    """The angle at which a surface stands between `air` and `behind`, and whether it shows its face to the air."""
    for _ in range(_HALVINGS):
        middle = (air + behind) / 2
        _put(one, place, first, second, air, radius_m)
        _put(other, place, first, second, middle, radius_m)
        if is_clear(tree, stack, one, other, 0.0):
            air = middle
        else:
            behind = middle
    _put(one, place, first, second, air, radius_m)
    _put(other, place, first, second, 2 * behind - air, radius_m)
    dx, dy, dz = other[0] - one[0], other[1] - one[1], other[2] - one[2]
    _, _, is_face = closest_hit(tree, stack, one[0], one[1], one[2], dx, dy, dz, 0.0, 2.0, -1)
    return (air + behind) / 2, is_face


@compiled
def look_round(
    tree: Tree,
    places: Floats,
    alongs: Floats,
    aside: Floats,
    radius_m: float,
    lift_m: float,
    least_rad: float,
    facings: Floats,
    lifted: Floats,
    bends: Flags,
) -> None:
    """Look around places (point, 3) on edges that run `alongs` (point, 3), beginning `aside` (point, 3). Where more
    than half a turn and `least_rad` is air, `bends` (point,) is true, `facings` (point, side, 3) are the normals of the
    two surfaces into that air, and `lifted` (point, 3) is a place in it, `lift_m` from the edge."""
    stack = np.empty(STACK, np.int32)
    one, other, second = np.empty(3), np.empty(3), np.empty(3)
    clear = np.empty(_CHORDS, np.bool_)
    step = 2 * math.pi / _CHORDS
    for point in range(len(places)):
        place, along, first = places[point], alongs[point], aside[point]
        second[0] = along[1] * first[2] - along[2] * first[1]
        second[1] = along[2] * first[0] - along[0] * first[2]
        second[2] = along[0] * first[1] - along[1] * first[0]
        number = 0
        for chord in range(_CHORDS):
            _put(one, place, first, second, _FIRST_RAD + chord * step, radius_m)
            _put(other, place, first, second, _FIRST_RAD + (chord + 1) * step, radius_m)
            clear[chord] = is_clear(tree, stack, one, other, 0.0)
            number += clear[chord]
        bends[point] = False
        if number == _CHORDS or number <= _CHORDS // 2:
            continue
        begin, longest, run = 0, 0, 0
        for chord in range(2 * _CHORDS):
            run = run + 1 if clear[chord % _CHORDS] else 0
            if run > longest:
                longest, begin = run, chord - run + 1
        from_rad = _FIRST_RAD + begin * step
        to_rad = from_rad + longest * step
        start, start_faces = _find_surface(
            tree, stack, place, first, second, from_rad, from_rad - step, radius_m, one, other
        )
        end, end_faces = _find_surface(tree, stack, place, first, second, to_rad, to_rad + step, radius_m, one, other)
        if end - start <= math.pi + least_rad or not (start_faces or end_faces):
            continue
        bends[point] = True
        _put(lifted[point], place, first, second, (start + end) / 2, lift_m)
        for axis in range(3):
            facings[point, 0, axis] = math.cos(start) * second[axis] - math.sin(start) * first[axis]
            facings[point, 1, axis] = math.sin(end) * first[axis] - math.cos(end) * second[axis]


@compiled
def may_bend(place: Floats, facings: Floats, point: int, other: Floats) -> bool:
    """Whether a path that comes from `other` may bend at a point: whether one of its surfaces is seen from behind."""
    dx, dy, dz = other[0] - place[point, 0], other[1] - place[point, 1], other[2] - place[point, 2]
    slack = SLACK * math.sqrt(dx * dx + dy * dy + dz * dz)
    return bool(
        facings[point, 0, 0] * dx + facings[point, 0, 1] * dy + facings[point, 0, 2] * dz <= slack
        or facings[point, 1, 0] * dx + facings[point, 1, 1] * dy + facings[point, 1, 2] * dz <= slack
    )


@compiled
def find_steps(tree: Tree, places: Floats, lifted: Floats, facings: Floats, first: int, steps: Singles) -> None:
    """Fill `steps` (point, point) with distances of bends that a path may join directly, and infinity: for the points
    from `first` on, to all others."""
    stack = np.empty(STACK, np.int32)
    for point in range(first, len(places)):
        steps[point, point] = math.inf
        for other in range(point):
            steps[point, other] = steps[other, point] = math.inf
            if (
                may_bend(places, facings, point, places[other])
                and may_bend(places, facings, other, places[point])
                and is_clear(tree, stack, lifted[point], lifted[other], MARGIN_M)
            ):
                length = math.sqrt(
                    (places[point, 0] - places[other, 0]) ** 2
                    + (places[point, 1] - places[other, 1]) ** 2
                    + (places[point, 2] - places[other, 2]) ** 2
                )
                steps[point, other] = steps[other, point] = length


@compiled
def hide_steps(tree: Tree, lifted: Floats, steps: Singles) -> None:
    """Take away those `steps` (point, point) between the first points (point, 3) in whose way something stands."""
    stack = np.empty(STACK, np.int32)
    for point in range(len(lifted)):
        for other in range(point):
            if steps[point, other] < math.inf and not is_clear(tree, stack, lifted[point], lifted[other], MARGIN_M):
                steps[point, other] = steps[other, point] = math.inf


@compiled
def _neighbours(steps: Singles) -> tuple[npt.NDArray[np.int64], Integers, Singles]:
    """For each point, the points to which there is a step, one after the other: where those of each point begin
    (point + 1,), their numbers, and the lengths of the steps."""
    count = len(steps)
    begins, number = np.zeros(count + 1, np.int64), 0
    for point in range(count):
        for other in range(count):
            number += steps[point, other] < math.inf
        begins[point + 1] = number
    to, way = np.empty(number, np.int32), np.empty(number, np.float32)
    number = 0
    for point in range(count):
        for other in range(count):
            if steps[point, other] < math.inf:
                to[number], way[number] = other, steps[point, other]
                number += 1
    return begins, to, way


@compiled
def _put_in(keys: Singles, nodes: Integers, size: int, key: np.float32, node: int) -> None:
    """Put a node into a heap of `size` nodes."""
    place = size
    while place and keys[(place - 1) // 2] > key:
        keys[place], nodes[place] = keys[(place - 1) // 2], nodes[(place - 1) // 2]
        place = (place - 1) // 2
    keys[place], nodes[place] = key, node


@compiled
def _go_on(
    begins: npt.NDArray[np.int64],
    to: Integers,
    way: Singles,
    keys: Singles,
    nodes: Integers,
    size: int,
    lengths: Singles,
    before: npt.NDArray[np.int16],
) -> None:
    """Shorten the ways from one point, `lengths` (point,) and `before` (point,), by all that follows from the `size`
    points in a heap (Dijkstra's algorithm)."""
    while size:
        key, point = keys[0], nodes[0]
        size -= 1
        last_key, last_node, place = keys[size], nodes[size], 0
        while 2 * place + 1 < size:
            child = 2 * place + 1
            if child + 1 < size and keys[child + 1] < keys[child]:
                child += 1
            if keys[child] >= last_key:
                break
            keys[place], nodes[place] = keys[child], nodes[child]
            place = child
        keys[place], nodes[place] = last_key, last_node
        if key > lengths[point]:
            continue
        for edge in range(begins[point], begins[point + 1]):
            length = np.float32(key + way[edge])
            if length < lengths[to[edge]]:
                lengths[to[edge]], before[to[edge]] = length, point
                _put_in(keys, nodes, size, length, to[edge])
                size += 1


@compiled
def find_shortest(steps: Singles, lengths: Singles, before: npt.NDArray[np.int16]) -> None:
    """Fill `lengths` (point, point) with the shortest ways over steps, and `before` with the last point on the way from
    the first to the second; -1 where there is none."""
    begins, to, way = _neighbours(steps)
    keys, nodes = np.empty(len(to) + 2, np.float32), np.empty(len(to) + 2, np.int32)
    for source in range(len(steps)):
        lengths[source], before[source] = math.inf, -1
        lengths[source, source] = 0.0
        keys[0], nodes[0] = 0.0, source
        _go_on(begins, to, way, keys, nodes, 1, lengths[source], before[source])


@compiled
def renew_shortest(
    steps: Singles,
    old_lengths: Singles,
    old_before: npt.NDArray[np.int16],
    order: npt.NDArray[np.int16],
    lengths: Singles,
    before: npt.NDArray[np.int16],
) -> None:
    """Fill `lengths` and `before` as `find_shortest` does, from the ways of old (point, point) between the first of the
    points, some of whose `steps` have been taken away since; all others have been added. `order` (point, point) are the
    old points by their lengths. Most ways stay, so that this takes a fraction of the time."""
    count, old = len(steps), len(old_lengths)
    begins, to, way = _neighbours(steps)
    keys, nodes = np.empty(len(to) + count + 2, np.float32), np.empty(len(to) + count + 2, np.int32)
    for source in range(count):
        length, last = lengths[source], before[source]
        length[:], last[:] = math.inf, -1
        length[source] = 0.0
        if source >= old:
            keys[0], nodes[0] = 0.0, source
            _go_on(begins, to, way, keys, nodes, 1, length, last)
            continue
        for rank in range(old):
            point = order[source, rank]
            by = old_before[source, point]
            if by >= 0 and length[by] < math.inf and steps[by, point] < math.inf:
                length[point], last[point] = old_lengths[source, point], by
        size = 0
        for point in range(count):
            if length[point] < math.inf:
                continue
            for edge in range(begins[point], begins[point + 1]):
                far = np.float32(length[to[edge]] + way[edge])
                if far < length[point]:
                    length[point], last[point] = far, to[edge]
            if length[point] < math.inf:
                _put_in(keys, nodes, size, length[point], point)
                size += 1
        _go_on(begins, to, way, keys, nodes, size, length, last)


@compiled
def find_seen(tree: Tree, eyes: Floats, lifted: Floats, seen: Flags) -> None:
    """Fill `seen` (eye, point) with whether nothing stands between eyes (eye, 3) and bends."""
    stack = np.empty(STACK, np.int32)
    for eye in range(len(eyes)):
        for point in range(len(lifted)):
            seen[eye, point] = is_clear(tree, stack, eyes[eye], lifted[point], MARGIN_M)


@compiled
def drop_doubles(middles: Floats, alongs: Floats, halves_m: Floats, near_m: float, kept: Flags) -> None:
    """Fill `kept` (edge,): an edge whose middle lies on an edge before it, and that runs along it, is none."""
    for edge in range(len(middles)):
        kept[edge] = True
        for other in range(edge):
            if not kept[other]:
                continue
            ahead = square = turn = 0.0
            for axis in range(3):
                offset = middles[edge, axis] - middles[other, axis]
                ahead += offset * alongs[other, axis]
                square += offset * offset
                turn += alongs[edge, axis] * alongs[other, axis]
            if abs(turn) > 1 - 1e-6 and abs(ahead) <= halves_m[other] and square - ahead * ahead < near_m * near_m:
                kept[edge] = False
                break
