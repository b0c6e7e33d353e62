"""The compiled code of `server.acoustics.mesh_paths`, for one emitter after the other.

Every path is a sequence of bends. It is chosen among the points of `Bends`, and then drawn taut: the point on each edge
moves to where the path by way of it is shortest, the unfolded edge's crossing, until none moves any more, or as far as
nothing is in the way.
"""

import math

import numpy as np
import numpy.typing as npt

from server.acoustics.diffraction import CLEAR_FRESNEL_NUMBER, diffraction_gain_db
from server.acoustics.geometry import COINCIDENT_M
from server.acoustics.mesh_edges import Bends
from server.acoustics.mesh_edges_kernel import MARGIN_M, is_clear, may_bend
from server.acoustics.mesh_tree_kernel import STACK, Tree
from server.acoustics.sound_path_kernel import PENUMBRA_M, SOFTENED_M
from server.kernels.compiled import compiled

Float32 = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Integers = npt.NDArray[np.int32]

UNHEARD_DB = -100.0
"""The level of sound to which no path leads."""
MOST_BENDS = 16
"""A path with more bends is not drawn taut."""
_SWEEPS = 20
_STILL_M = 3e-4
# Where a taut path is blocked, its bends move as far as nothing is in the way, in so many steps.
_GUARDED_SWEEPS, _SHORTER_STEPS, _GUARDED_STILL_M = 2, 2, 1e-3
_UNKNOWN, _SEEN, _HIDDEN = 0, 1, 2
_FINE_M = 1.5
"""Of what is seen from somewhere in a larger cell, its corners and its middle may see nothing."""


@compiled
def _distance(a: Floats, b: Floats) -> float:
    return math.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


@compiled
def _cell(bends: Bends, place: Floats) -> int:
    """The cell of a place."""
    cell = 0
    for axis in range(3):
        step = math.floor((place[axis] - bends.origin[axis]) / bends.cell_m[axis])
        if step < 0 or step >= bends.counts[axis]:
            return _everywhere(bends)
        cell = cell * bends.counts[axis] + step
    return cell


@compiled
def _everywhere(bends: Bends) -> int:
    """The number of the cell that has all points."""
    return len(bends.begins) - 2


@compiled
def _across(bends: Bends, point: int, place: Floats) -> tuple[float, float]:
    """How far a place is along the edge of a point, from where the edge starts, and how far it is from its line."""
    along = square = 0.0
    for axis in range(3):
        offset = place[axis] - bends.starts[point, axis]
        along += offset * bends.alongs[point, axis]
        square += offset * offset
    return along, math.sqrt(max(0.0, square - along * along))


@compiled
def _taut(bends: Bends, point: int, one: Floats, other: Floats, spot: Floats) -> None:
    """Write where the shortest path from one place to another touches the edge of a point."""
    one_along, one_across = _across(bends, point, one)
    other_along, other_across = _across(bends, point, other)
    both = one_across + other_across
    at = one_along if both < COINCIDENT_M else (one_along * other_across + other_along * one_across) / both
    at = min(max(at, 0.0), bends.extents[point])
    for axis in range(3):
        spot[axis] = bends.starts[point, axis] + at * bends.alongs[point, axis]


@compiled
def _is_seen(
    tree: Tree, stack: Integers, bends: Bends, listener: Floats, point: int, sight: npt.NDArray[np.int8]
) -> bool:
    """Whether the listener sees a point; `sight` (point,) keeps what was found."""
    if sight[point] == _UNKNOWN:
        sight[point] = _SEEN if is_clear(tree, stack, listener, bends.lifted[point], MARGIN_M) else _HIDDEN
    return bool(sight[point] == _SEEN)


@compiled
def _clearance_m(
    tree: Tree,
    stack: Integers,
    bends: Bends,
    listener: Floats,
    emitter: Floats,
    cell: int,
    cell_too: int,
    straight: float,
    most_m: float,
    sight: npt.NDArray[np.int8],
    spot: Floats,
) -> float:
    """How much longer the path over the nearest edge that both see is than the straight line, for a visible emitter,
    as `sound_path_kernel` measures it across edges; `most_m` if nothing is near. The same both ways."""
    clearance = most_m
    begin, end = bends.begins[cell], bends.begins[cell + 1]
    begin_too, end_too = bends.begins[cell_too], bends.begins[cell_too + 1]
    if cell_too == cell:
        end_too = begin_too
    for turn in range(end - begin + end_too - begin_too):
        point = bends.seen[begin + turn if turn < end - begin else begin_too + turn - (end - begin)]
        # Cheaper than what follows, and most points are farther away. Each stands for its part of an edge.
        beside = _distance(listener, bends.places[point]) + _distance(bends.places[point], emitter) - straight
        if beside > most_m + bends.portions[point]:
            continue
        _taut(bends, point, listener, emitter, spot)
        detour = max(0.0, _distance(listener, spot) + _distance(spot, emitter) - straight)
        if detour >= clearance:
            continue
        to_listener, to_emitter = _across(bends, point, listener)[1], _across(bends, point, emitter)[1]
        ahead = along_l = along_e = 0.0
        for axis in range(3):
            ahead -= (listener[axis] - spot[axis]) * (emitter[axis] - spot[axis])
            along_l += (listener[axis] - spot[axis]) * bends.alongs[point, axis]
            along_e += (emitter[axis] - spot[axis]) * bends.alongs[point, axis]
        ahead += along_l * along_e
        if to_emitter < COINCIDENT_M or to_listener < COINCIDENT_M or ahead <= 0:
            continue
        detour *= to_listener * to_emitter / ahead
        if (
            detour < clearance
            and _is_seen(tree, stack, bends, listener, point, sight)
            and is_clear(tree, stack, emitter, bends.lifted[point], MARGIN_M)
        ):
            clearance = detour
    return clearance


@compiled
def _reach(bends: Bends, listener: Floats, cell: int, reached: Integers, reach_m: Float32) -> int:
    """Write the points of a cell round which sound may bend to the listener, seen or not, and their distances; return
    their number."""
    count = 0
    for number in range(bends.begins[cell], bends.begins[cell + 1]):
        point = bends.seen[number]
        if may_bend(bends.places, bends.facings, point, listener):
            reached[count], reach_m[count] = point, _distance(listener, bends.places[point])
            count += 1
    return count


@compiled
def _sees_none(tree: Tree, stack: Integers, bends: Bends, place: Floats, cell: int) -> bool:
    """Whether a place sees none of the points of a cell, which is too large for that to mean that there are none."""
    if max(bends.cell_m[0], bends.cell_m[1], bends.cell_m[2]) <= _FINE_M or cell == _everywhere(bends):
        return False
    for number in range(bends.begins[cell], bends.begins[cell + 1]):
        if is_clear(tree, stack, place, bends.lifted[bends.seen[number]], MARGIN_M):
            return False
    return True


@compiled
def _come_to(
    bends: Bends, point: int, reached: Integers, reach_m: Float32, count: int, to_point: Float32, near_of: Integers
) -> None:
    """Write the length of the shortest way from the listener to a point, and the number of the first point on it."""
    to_point[point] = math.inf
    for near in range(count):
        length = reach_m[near] + bends.lengths[point, reached[near]]
        if length < to_point[point]:
            to_point[point], near_of[point] = length, near


@compiled
def _way_round(
    tree: Tree,
    stack: Integers,
    bends: Bends,
    listener: Floats,
    emitter: Floats,
    cell: int,
    sight: npt.NDArray[np.int8],
    reached: Integers,
    reach_m: Float32,
    count: int,
    to_point: Float32,
    near_of: Integers,
    waits: Integers,
    wait_m: Float32,
) -> int:
    """The last point on the shortest way from the listener, out of those of a cell; -1 if there is none. `to_point`
    (point,) and `near_of` keep lengths from the listener, and the numbers of the first points on these ways; negative
    lengths are not known yet.

    What is not known to be hidden is taken for seen, and looked at when a way by it is the shortest. So is the length
    of the way to a point: until then, it is taken for the straight one.
    """
    waiting = 0
    for number in range(bends.begins[cell], bends.begins[cell + 1]):
        point = bends.seen[number]
        if not may_bend(bends.places, bends.facings, point, emitter):
            continue
        length = float(to_point[point])
        if length < 0.0:  # at least as far as straight there
            length = _distance(listener, bends.places[point])
        if length < math.inf:
            waits[waiting], wait_m[waiting] = point, length + _distance(emitter, bends.places[point])
            waiting += 1
    while waiting:
        best = 0
        for place in range(1, waiting):
            if wait_m[place] < wait_m[best]:
                best = place
        point = waits[best]
        is_known = to_point[point] >= 0.0
        if is_known and not _is_seen(tree, stack, bends, listener, reached[near_of[point]], sight):
            reach_m[near_of[point]] = math.inf
            is_known = False
        if not is_known:
            _come_to(bends, point, reached, reach_m, count, to_point, near_of)
            wait_m[best] = to_point[point] + _distance(emitter, bends.places[point])
            if to_point[point] < math.inf:
                continue
        elif is_clear(tree, stack, emitter, bends.lifted[point], MARGIN_M):
            return int(point)
        waiting -= 1
        waits[best], wait_m[best] = waits[waiting], wait_m[waiting]
    return -1


@compiled
def _off_edge(bends: Bends, point: int, spot: Floats, off: Floats) -> None:
    """Write the place beside a spot on the edge of a point that is as far off it as the point is lifted."""
    for axis in range(3):
        off[axis] = spot[axis] + bends.lifted[point, axis] - bends.places[point, axis]


@compiled
def _are_legs_clear(
    tree: Tree,
    stack: Integers,
    bends: Bends,
    chain: Integers,
    spots: Floats,
    count: int,
    place: int,
    spot: Floats,
    listener: Floats,
    emitter: Floats,
    ends: Floats,
) -> bool:
    """Whether nothing stands before and behind a bend that is moved to `spot`. `ends` has room for three places."""
    ends[0], ends[2] = listener, emitter
    if place > 0:
        _off_edge(bends, chain[place - 1], spots[place - 1], ends[0])
    if place < count - 1:
        _off_edge(bends, chain[place + 1], spots[place + 1], ends[2])
    _off_edge(bends, chain[place], spot, ends[1])
    return is_clear(tree, stack, ends[0], ends[1], MARGIN_M) and is_clear(tree, stack, ends[1], ends[2], MARGIN_M)


@compiled
def _draw(
    tree: Tree,
    stack: Integers,
    bends: Bends,
    listener: Floats,
    emitter: Floats,
    first: int,
    last: int,
    chain: Integers,
    spots: Floats,
    ends: Floats,
) -> tuple[float, int]:
    """Write where the path from the listener round the points from `first` to `last` bends, drawn taut as far as
    nothing is in its way; return its length and the number of bends. Of a path with more bends than there is room for,
    only the first and the last are written. Where a leaf stands in a way of before it moved, there are no bends."""
    count, point = 1, last
    while point != first:
        point = bends.before[first, point]
        count += 1
    if count > len(chain):
        spots[0], spots[1] = bends.places[first], bends.places[last]
        between = float(bends.lengths[first, last])
        return _distance(listener, spots[0]) + between + _distance(spots[1], emitter), 2
    point = last
    for place in range(count - 1, -1, -1):
        chain[place] = point
        point = bends.before[first, point]
        spots[place] = bends.places[chain[place]]
    spot = ends[3]
    for _ in range(_SWEEPS):
        moved = 0.0
        for place in range(count):
            before = listener if place == 0 else spots[place - 1]
            after = emitter if place == count - 1 else spots[place + 1]
            _taut(bends, chain[place], before, after, spot)
            moved = max(moved, _distance(spot, spots[place]))
            spots[place] = spot
        if moved < _STILL_M:
            break
    is_free = True
    for place in range(count):
        # Both legs of every other bend, and the last leg.
        if is_free and (place % 2 == 0 or place == count - 1):
            is_free = _are_legs_clear(
                tree, stack, bends, chain, spots, count, place, spots[place], listener, emitter, ends
            )
    if not is_free:
        for place in range(count):
            spots[place] = bends.places[chain[place]]
            if place > 0:
                # As `find_steps` looks: a line to and fro may differ by how it is rounded.
                one, other = max(chain[place - 1], chain[place]), min(chain[place - 1], chain[place])
                if not is_clear(tree, stack, bends.lifted[one], bends.lifted[other], MARGIN_M):
                    return 0.0, 0
        for _ in range(_GUARDED_SWEEPS):
            moved = 0.0
            for place in range(count):
                before = listener if place == 0 else spots[place - 1]
                after = emitter if place == count - 1 else spots[place + 1]
                _taut(bends, chain[place], before, after, spot)
                for _ in range(_SHORTER_STEPS):
                    if _are_legs_clear(tree, stack, bends, chain, spots, count, place, spot, listener, emitter, ends):
                        moved = max(moved, _distance(spot, spots[place]))
                        spots[place] = spot
                        break
                    for axis in range(3):
                        spot[axis] = (spot[axis] + spots[place, axis]) / 2
            if moved < _GUARDED_STILL_M:
                break
    length = _distance(spots[count - 1], emitter)
    for place in range(count):
        length += _distance(listener if place == 0 else spots[place - 1], spots[place])
    return length, count


@compiled
def _aim(direction: Floats, start: Floats, end: Floats) -> None:
    """Write the unit vector from one place to another; along x if they are the same."""
    length = _distance(start, end)
    if length < COINCIDENT_M:
        direction[0], direction[1], direction[2] = 1.0, 0.0, 0.0
        return
    for axis in range(3):
        direction[axis] = (end[axis] - start[axis]) / length


@compiled
def find_mesh_paths(
    tree: Tree,
    bends: Bends,
    wavelengths_m: Floats,
    listener: Floats,
    emitters: Floats,
    length_m: Floats,
    arrival: Floats,
    departure: Floats,
    excess_m: Floats,
    in_sight: Flags,
    screen_db: Floats,
) -> None:
    """Fill the last six arrays, one row per emitter; see `SoundPaths` and `MeshPathFinder`."""
    points = len(bends.places)
    stack, sight = np.empty(STACK, np.int32), np.zeros(points, np.int8)
    reached, waits, near_of = np.empty(points, np.int32), np.empty(points, np.int32), np.empty(points, np.int32)
    reach_m, wait_m = np.empty(points, np.float32), np.empty(points, np.float32)
    to_point = np.full(points, np.float32(-1.0), np.float32)
    chain, spots, ends = np.empty(MOST_BENDS, np.int32), np.empty((MOST_BENDS, 3)), np.empty((4, 3))
    longest_m = 0.0
    for band in range(len(wavelengths_m)):
        longest_m = max(longest_m, wavelengths_m[band])
    most_m = -CLEAR_FRESNEL_NUMBER * longest_m / 2
    listener_cell, count = _cell(bends, listener), -1
    for row in range(len(emitters)):
        emitter = emitters[row]
        straight = _distance(listener, emitter)
        length_m[row], excess_m[row] = straight, 0.0
        in_sight[row] = is_clear(tree, stack, listener, emitter, MARGIN_M)
        _aim(arrival[row], listener, emitter)
        for axis in range(3):
            departure[row, axis] = -arrival[row, axis]
        if in_sight[row]:
            detour = -_clearance_m(
                tree,
                stack,
                bends,
                listener,
                emitter,
                listener_cell,
                _cell(bends, emitter),
                straight,
                most_m,
                sight,
                ends[3],
            )
        else:
            if count < 0:
                reached_cell = listener_cell
                if _sees_none(tree, stack, bends, listener, listener_cell):
                    reached_cell = _everywhere(bends)
                count = _reach(bends, listener, reached_cell, reached, reach_m)
            cell, last = _cell(bends, emitter), -1
            for _ in range(2):
                last = _way_round(
                    tree,
                    stack,
                    bends,
                    listener,
                    emitter,
                    cell,
                    sight,
                    reached,
                    reach_m,
                    count,
                    to_point,
                    near_of,
                    waits,
                    wait_m,
                )
                if last >= 0 or not _sees_none(tree, stack, bends, emitter, cell):
                    break
                cell = _everywhere(bends)
            if last < 0:
                for band in range(len(wavelengths_m)):
                    screen_db[row, band] = UNHEARD_DB
                continue
            first = reached[near_of[last]]
            length, corners = _draw(tree, stack, bends, listener, emitter, first, last, chain, spots, ends)
            if not corners:
                for band in range(len(wavelengths_m)):
                    screen_db[row, band] = UNHEARD_DB
                continue
            length_m[row] = length
            excess_m[row] = max(0.0, length_m[row] - straight)
            _aim(arrival[row], listener, spots[0])
            _aim(departure[row], emitter, spots[corners - 1])
            detour = excess_m[row]
        for band in range(len(wavelengths_m)):
            screen_db[row, band] = diffraction_gain_db(2 * detour / wavelengths_m[band])


@compiled
def describe_mesh_paths(
    tree: Tree, bends: Bends, listeners: Floats, emitters: Floats, length_m: Floats, described: Float32
) -> None:
    """Fill the last two arrays, one row for each listener and its emitter; see `DescribedPaths`. Sight falls with what
    the path is longer than the straight line."""
    count, no_bands = len(listeners), np.empty(0)
    arrival, departure, excess_m = np.empty((count, 3)), np.empty((count, 3)), np.empty(count)
    in_sight, screen_db = np.empty(count, np.bool_), np.empty((count, 0))
    begin = 0
    while begin < count:
        end = begin + 1
        while end < count and _distance(listeners[begin], listeners[end]) == 0.0:
            end += 1
        find_mesh_paths(
            tree,
            bends,
            no_bands,
            listeners[begin],
            emitters[begin:end],
            length_m[begin:end],
            arrival[begin:end],
            departure[begin:end],
            excess_m[begin:end],
            in_sight[begin:end],
            screen_db[begin:end],
        )
        begin = end
    for row in range(count):
        described[row, 0] = length_m[row]
        described[row, 1] = 1.0 if in_sight[row] else math.exp(-excess_m[row] / PENUMBRA_M)
        _point(arrival[row], length_m[row], described[row, 2:4])
        _point(departure[row], length_m[row], described[row, 4:6])


@compiled
def _point(way: Floats, length_m: float, direction: Float32) -> None:
    """Write the unit vector in plan of a direction; where a path is short, or nearly upright, it shrinks to nothing."""
    x, y = way[0] * length_m, way[1] * length_m
    scale = 1.0 / (math.hypot(x, y) + SOFTENED_M)
    direction[0], direction[1] = x * scale, y * scale
