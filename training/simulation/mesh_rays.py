"""Reflected energy by ray tracing in a triangle mesh: what `training.simulation.rays` does in floor plans.

Axes are those of that module. Both sides of a triangle reflect. A ray that meets nothing more, under the
open sky or beyond a hole, is lost.

Walls may let energy through, which goes on in its direction. Absorption is all that is not reflected, so what goes
through is part of it: the share of the mass law, and no more than a wall absorbs. The rest becomes heat. A wall counts
once, as it does for the direct sound: from the face at which it is entered to the back of the next surface. It lets
through what the more reluctant of its two sides does, which is the same from both.

Of all walls that a ray meets, four are drawn, by the square root of the energy that would go through. There new rays go
on, for all those that might have. For each of them one further wall is drawn, and behind that one more for every second
ray. So the work is bounded however many walls there are, and no energy is lost.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from server.acoustics.decibels import db_to_power
from server.acoustics.mesh_tree import SAME_PLACE_M, MeshTree
from server.acoustics.mesh_tree_kernel import STACK, Tree, closest_hit, cross_all, first_blocker
from server.kernels.compiled import compiled, compiled_loosely
from server.scene.mesh_geometry import MeshGeometry
from training.data.dataset import SPEED_OF_SOUND
from training.data.scene_file import HISTOGRAM_BIN_S
from training.simulation.rays import (
    BANDS,
    EVERY,
    LARGEST_RADIUS_M,
    THINNING,
    Histogram,
    add_crossings,
    cell,
    mirrored_direction,
    nearest_directions,
    sphere_directions,
    weigh,
)

_Floats = npt.NDArray[np.float64]
_Integers = npt.NDArray[np.int32]

# What is nearer to a place of reflection than this does not hide it, nor does what is as near to a receiver.
_MARGIN_M = 1e-6
# Looking beforehand which triangles are in sight as a whole takes this many steps at most: a tenth of a second.
_MOST_LOOKS = 20_000_000
# What reaches into the space between a triangle and a receiver by less than this does not.
_TOUCH_M = 1e-9
# At so many of the walls that a ray meets, new rays go on; each of these goes on through one wall more.
_DRAWN = 4
# Of the rays behind two walls, this share goes on through a third one, and so on.
_FOLLOWED = 0.5
# The most faces that are told apart in one place.
_MOST_TOGETHER = 16


class _Place(NamedTuple):
    """The surfaces that rays meet. Of the triangles, in the tree's order: `normals` (triangle, xyz) and `surfaces`
    (triangle,), their materials. `reflected` and `scattered` are (material, band)."""

    tree: Tree
    normals: _Floats
    surfaces: _Integers
    reflected: _Floats
    scattered: _Floats


class _Receivers(NamedTuple):
    """The receivers. Positions (receiver, xyz) and radii of the spheres that count rays. `nearest` is the number of the
    nearest arrival direction, by `cell`. `is_open` (receiver, triangle) says whether the whole triangle is known to be
    in sight; it is empty if nobody looked."""

    positions: _Floats
    radii: _Floats
    nearest: _Integers
    is_open: npt.NDArray[np.bool_]


class _AtWalls(NamedTuple):
    """Rays that are to go on through walls, one in each row: where they met them, at which row of the tree and whether
    at its face, and what was of them until then. `scales` are as many of the emitter's rays as each stands for."""

    positions: _Floats
    directions: _Floats
    rows: _Integers
    faces: npt.NDArray[np.bool_]
    travelled_m: _Floats
    kept: _Floats
    chance: _Floats
    scales: _Floats
    reflections: _Integers
    was_scattered: npt.NDArray[np.bool_]
    walls: _Integers


class MeshRayTracer:
    """Traces rays from any emitter to a fixed set of receivers (receiver, xyz). It has no state between traces."""

    def __init__(
        self,
        geometry: MeshGeometry,
        receivers: _Floats,
        *,
        duration_s: float,
        image_order: int,
        arrival_directions: _Floats,
        tree: MeshTree | None = None,
        losses_db: npt.ArrayLike | None = None,
        few_rays: bool = False,
        only_through: bool = False,
    ) -> None:
        """Prepare tracing for `duration_s`. Direct sound and specular paths of up to `image_order` reflections are left
        out, because image sources give them; those that were reflected and went through a wall are not. `tree` is the
        mesh's, if there is one already.

        `losses_db` (material, band) is what walls take from sound that goes through them, infinite where none does.
        Without it, no energy goes through walls.

        With `few_rays`, no triangles are looked for beforehand that are in sight as a whole. Energies are the same.
        With `only_through`, only what went through walls is collected. The rest is the energy without `losses_db`."""
        mesh, tree = geometry.mesh, tree or MeshTree(geometry.mesh)
        order = tree.tree.numbers
        absorbed = geometry.of_surfaces("absorption")
        through = np.zeros_like(absorbed) if losses_db is None else db_to_power(-np.asarray(losses_db, np.float64))
        through = np.minimum(through, absorbed)
        self._place = _Place(
            tree.tree,
            np.ascontiguousarray(mesh.normals[order]),
            np.ascontiguousarray(mesh.surfaces[order]),
            1 - absorbed,
            geometry.of_surfaces("scattering"),
        )
        self._through = through if through.any() else None
        self._least_walls = 1 if only_through else 0
        positions = np.ascontiguousarray(receivers, dtype=np.float64)
        radii = np.minimum(tree.distance_m(positions), LARGEST_RADIUS_M)
        looks = not few_rays and len(positions) * len(order) ** 2 <= _MOST_LOOKS
        is_open = np.zeros((len(positions), len(order) if looks else 0), np.bool_)
        _look(tree.tree, self._place.normals, positions, is_open)
        self._receivers = _Receivers(positions, radii, nearest_directions(arrival_directions), is_open)
        self._image_order = image_order
        self._directions = len(arrival_directions)
        self._bins = round(duration_s / HISTOGRAM_BIN_S)

    @property
    def shape(self) -> tuple[int, int, int]:
        """The shape (direction, band, bin) of a receiver's energy."""
        return self._directions, BANDS, self._bins

    def trace(self, emitter: _Floats, *, rays: int, rng: np.random.Generator) -> npt.NDArray[np.float32]:
        """(receiver, direction, band, bin) energies, without absorption by the air."""
        turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
        energy = np.zeros((len(self._receivers.positions), self._bins, self._directions, BANDS), dtype=np.float32)
        _trace(
            self._place,
            self._through,
            self._receivers,
            np.asarray(emitter, dtype=np.float64),
            sphere_directions(rays) @ turn,
            self._image_order,
            self._least_walls,
            rng,
            Histogram(energy, HISTOGRAM_BIN_S * SPEED_OF_SOUND),
        )
        return np.ascontiguousarray(energy.transpose(0, 2, 3, 1))


@compiled_loosely
def _trace(
    place: _Place,
    let: _Floats | None,
    receivers: _Receivers,
    emitter: _Floats,
    directions: _Floats,
    image_order: int,
    least_walls: int,
    rng: np.random.Generator,
    histogram: Histogram,
) -> None:
    """Add the energy of all rays to the histogram, but for what went through fewer walls than `least_walls`. `let`
    (material, band) is the share that may go through walls of a material; None compiles code that does without."""
    tree, rays = place.tree, len(directions)
    end_m = histogram.energy.shape[1] * histogram.bin_m
    stack = np.empty(STACK, np.int32)
    blockers = np.full(len(receivers.positions), -1, np.int32)
    kept, chance, weight, through = np.empty(BANDS), np.empty(BANDS), np.empty(BANDS), np.empty(BANDS)
    at = _AtWalls(
        np.empty((_DRAWN, 3)),
        np.empty((_DRAWN, 3)),
        np.empty(_DRAWN, np.int32),
        np.empty(_DRAWN, np.bool_),
        np.empty(_DRAWN),
        np.empty((_DRAWN, BANDS)),
        np.empty((_DRAWN, BANDS)),
        np.empty(_DRAWN),
        np.empty(_DRAWN, np.int32),
        np.empty(_DRAWN, np.bool_),
        np.empty(_DRAWN, np.int32),
    )
    for ray in range(rays):
        px, py, pz = emitter[0], emitter[1], emitter[2]
        dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        scale = 1.0 / rays
        kept[:] = 1.0
        chance[:] = 1.0
        weight[:] = scale
        share, travelled_m, reflections, plane = 1.0, 0.0, 0, -1  # the share of such rays that is still followed
        was_scattered, is_mirrored = False, True  # at any reflection so far; at the last one
        walls, is_through = 0, False  # gone through so far; any after the last reflection
        wait, draws = 0, _DRAWN  # rays that wait to go on through walls; those that this one may add
        is_on = True
        while is_on:
            parts = 0.0  # of all walls that the ray meets, by which those are drawn where new rays go on
            while True:
                length, row, is_face = closest_hit(tree, stack, px, py, pz, dx, dy, dz, 1e-9, math.inf, plane)
                length = max(length, 0.0)
                # Scattered energy reaches receivers as diffuse rain, but not through walls. Image sources account for
                # the first reflections, and direct paths for what was never reflected.
                is_late = was_scattered or walls > 0 or reflections > image_order
                if reflections > 0 and walls >= least_walls and (is_through or (is_mirrored and is_late)):
                    add_crossings(receivers, (px, py, pz), (dx, dy, dz), length, travelled_m, weight, histogram)
                if row < 0:
                    break  # it left, under the open sky or through a hole
                px, py, pz = px + length * dx, py + length * dy, pz + length * dz
                travelled_m += length
                if travelled_m >= end_m:
                    break
                plane, surface = tree.planes[row], place.surfaces[row]
                if let is not None:
                    loudest = 0.0
                    for band in range(BANDS):
                        loudest = max(loudest, kept[band] * chance[band] * let[surface, band])
                    part = math.sqrt(loudest) / share
                    parts += part
                    if part > 0.0:
                        for number in range(wait, wait + draws):
                            if rng.random() * parts < part:
                                at.positions[number, 0], at.positions[number, 1], at.positions[number, 2] = px, py, pz
                                at.directions[number, 0], at.directions[number, 1] = dx, dy
                                at.directions[number, 2] = dz
                                at.rows[number], at.faces[number], at.travelled_m[number] = row, is_face, travelled_m
                                at.kept[number] = kept
                                at.chance[number] = chance
                                at.scales[number] = scale / (draws * part * share)
                                at.reflections[number], at.was_scattered[number] = reflections, was_scattered
                                at.walls[number] = walls
                reflections += 1
                side = 1.0 if is_face else -1.0
                normal = side * place.normals[row, 0], side * place.normals[row, 1], side * place.normals[row, 2]
                for band in range(BANDS):
                    weight[band] *= place.reflected[surface, band]
                first = int(rng.random() * EVERY)
                if walls >= least_walls:
                    at_wall = px, py, pz
                    _add_rain(
                        place, receivers, stack, blockers, first, row, at_wall, normal, travelled_m, weight, histogram
                    )
                is_scattered = rng.random() < place.scattered[surface, ray % BANDS]
                loudest = weigh(place, surface, is_scattered, kept, chance, weight)
                if loudest <= 0.0:
                    break
                wanted = loudest**THINNING
                if wanted < share:
                    if rng.random() * share >= wanted:
                        break
                    share = wanted
                for band in range(BANDS):
                    weight[band] *= scale / share
                is_mirrored, is_through = not is_scattered, False
                if is_scattered:
                    was_scattered = True
                    dx, dy, dz = _scattered_direction(normal, rng.random(), rng.random())
                else:
                    dx, dy, dz = mirrored_direction((dx, dy, dz), normal)
            is_on = False
            if let is not None:
                if parts > 0.0:
                    for number in range(wait, wait + draws):
                        at.scales[number] *= parts
                    wait += draws
                while wait > 0 and not is_on:
                    wait -= 1
                    scale, walls, draws = at.scales[wait], at.walls[wait] + 1, 1
                    if walls > 2:
                        if rng.random() >= _FOLLOWED:
                            continue
                        scale /= _FOLLOWED
                    length, row = _go_through(place, let, stack, at, wait, through)
                    loudest = 0.0
                    for band in range(BANDS):
                        kept[band] = at.kept[wait, band] * through[band]
                        chance[band] = at.chance[wait, band]
                        loudest = max(loudest, kept[band] * chance[band])
                    travelled_m = at.travelled_m[wait] + length
                    is_on = loudest > 0.0 and travelled_m < end_m
                    if is_on:
                        # Behind the wall, the ray is thinned anew, from as many as it stands for.
                        scale, share = scale * loudest, 1.0
                        for band in range(BANDS):
                            kept[band] /= loudest
                            weight[band] = kept[band] * chance[band] * scale
                        dx, dy, dz = at.directions[wait, 0], at.directions[wait, 1], at.directions[wait, 2]
                        px = at.positions[wait, 0] + length * dx
                        py = at.positions[wait, 1] + length * dy
                        pz = at.positions[wait, 2] + length * dz
                        plane, reflections, was_scattered = (
                            tree.planes[row],
                            at.reflections[wait],
                            at.was_scattered[wait],
                        )
                        is_through = True


@compiled_loosely
def _go_through(
    place: _Place, let: _Floats, stack: _Integers, at: _AtWalls, number: int, through: _Floats
) -> tuple[float, int]:
    """Set the share (band,) that goes through the wall that a ray meets. Returns the way inside the wall, and the row
    in the tree of the triangle where the ray leaves it."""
    tree, row, is_face = place.tree, at.rows[number], at.faces[number]
    surface, plane = place.surfaces[row], place.tree.planes[row]
    px, py, pz = at.positions[number, 0], at.positions[number, 1], at.positions[number, 2]
    dx, dy, dz = at.directions[number, 0], at.directions[number, 1], at.directions[number, 2]
    for band in range(BANDS):
        through[band] = let[surface, band]
    # Coplanar double faces are one sheet. `cross_all` tells faces from backs by the sign.
    distances, rows = np.empty(_MOST_TOGETHER), np.empty(_MOST_TOGETHER, np.int32)
    met = cross_all(tree, stack, px, py, pz, dx, dy, dz, -SAME_PLACE_M, SAME_PLACE_M, distances, rows)
    for other in range(min(met, _MOST_TOGETHER)):
        if (rows[other] >= 0) != is_face:
            surface = place.surfaces[rows[other] if rows[other] >= 0 else -1 - rows[other]]
            for band in range(BANDS):
                through[band] = min(through[band], let[surface, band])
            return 0.0, row
    if not is_face:
        return 0.0, row
    length, leaves, is_next_face = closest_hit(tree, stack, px, py, pz, dx, dy, dz, 1e-9, math.inf, plane)
    if leaves < 0 or is_next_face:
        return 0.0, row
    for band in range(BANDS):
        through[band] = min(through[band], let[place.surfaces[leaves], band])
    return max(length, 0.0), leaves


@compiled_loosely
def _add_rain(
    place: _Place,
    receivers: _Receivers,
    stack: _Integers,
    blockers: _Integers,
    first: int,
    row: int,
    position: tuple[float, float, float],
    normal: tuple[float, float, float],
    travelled_m: float,
    weight: _Floats,
    histogram: Histogram,
) -> None:
    """Add the scattered energy of a reflection to every `EVERY`th receiver, from `first` on, if it is in sight.
    `blockers` (receiver,) are the triangles that hid receivers last: most often they still do."""
    px, py, pz = position
    nx, ny, nz = normal
    tree, plane, surface = place.tree, place.tree.planes[row], place.surfaces[row]
    for receiver in range(first, len(receivers.positions), EVERY):
        to_x, to_y, to_z = (
            receivers.positions[receiver, 0] - px,
            receivers.positions[receiver, 1] - py,
            receivers.positions[receiver, 2] - pz,
        )
        out = to_x * nx + to_y * ny + to_z * nz
        if out <= 0.0:
            continue
        square = to_x * to_x + to_y * to_y + to_z * to_z
        distance = math.sqrt(square)
        into_bin = int((travelled_m + distance) / histogram.bin_m)
        if into_bin >= histogram.energy.shape[1]:
            continue
        if receivers.is_open.shape[1] == 0 or not receivers.is_open[receiver, row]:
            margin = _MARGIN_M / distance
            blocker = first_blocker(
                tree, stack, px, py, pz, to_x, to_y, to_z, margin, 1.0 - margin, plane, blockers[receiver]
            )
            if blocker >= 0:
                blockers[receiver] = blocker
                continue
        gain = 4 * EVERY * out / (distance * square)
        line, column = cell(-to_x, -to_y, -to_z)
        target = histogram.energy[receiver, into_bin, receivers.nearest[line, column]]
        for band in range(BANDS):
            target[band] += gain * weight[band] * place.scattered[surface, band]


@compiled_loosely
def _scattered_direction(normal: tuple[float, float, float], share: float, turn: float) -> tuple[float, float, float]:
    """A random direction by Lambert's law, from two uniform random numbers. The axes beside the normal are those of
    Duff et al. ("Building an orthonormal basis, revisited", J. Computer Graphics Techniques 6(1), 2017)."""
    nx, ny, nz = normal
    azimuth = 2 * math.pi * turn
    out, side = math.sqrt(1.0 - share), math.sqrt(share)
    a, b = side * math.cos(azimuth), side * math.sin(azimuth)
    sign = math.copysign(1.0, nz)
    p = -1.0 / (sign + nz)
    q = nx * ny * p
    return (
        out * nx + a * (1.0 + sign * nx * nx * p) + b * q,
        out * ny + a * sign * q + b * (sign + ny * ny * p),
        out * nz - a * sign * nx - b * ny,
    )


@compiled
def _look(tree: Tree, normals: _Floats, positions: _Floats, is_open: npt.NDArray[np.bool_]) -> None:
    """Fill the last array (receiver, triangle) with whether no other triangle reaches into the space between a receiver
    and the triangle."""
    corners = tree.corners
    outwards = np.empty((3, 3))
    for receiver in range(is_open.shape[0]):
        x, y, z = positions[receiver, 0], positions[receiver, 1], positions[receiver, 2]
        for row in range(is_open.shape[1]):
            above = _height(corners, normals, row, x, y, z)
            # The planes through the receiver and the sides of the triangle.
            for side in range(3):
                after = (side + 1) % 3
                ax, ay, az = corners[row, side, 0] - x, corners[row, side, 1] - y, corners[row, side, 2] - z
                bx, by, bz = corners[row, after, 0] - x, corners[row, after, 1] - y, corners[row, after, 2] - z
                nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
                # They point outwards if the triangle shows its face, whose corners run counter-clockwise.
                scale = math.copysign(1.0, above) / max(math.sqrt(nx * nx + ny * ny + nz * nz), _TOUCH_M)
                outwards[side, 0], outwards[side, 1], outwards[side, 2] = nx * scale, ny * scale, nz * scale
            is_open[receiver, row] = abs(above) > _TOUCH_M
            for other in range(is_open.shape[1]):
                if tree.planes[other] != tree.planes[row] and not _is_apart(
                    corners, normals, row, other, above, x, y, z, outwards
                ):
                    is_open[receiver, row] = False
                    break


@compiled
def _height(corners: _Floats, normals: _Floats, row: int, x: float, y: float, z: float) -> float:
    """How far a point is in front of the plane of a triangle."""
    return float(
        normals[row, 0] * (x - corners[row, 0, 0])
        + normals[row, 1] * (y - corners[row, 0, 1])
        + normals[row, 2] * (z - corners[row, 0, 2])
    )


@compiled
def _is_apart(
    corners: _Floats,
    normals: _Floats,
    row: int,
    other: int,
    above: float,
    x: float,
    y: float,
    z: float,
    outwards: _Floats,
) -> bool:
    """Whether a plane of one of the two divides the triangle `other` from the space between a receiver and `row`."""
    least = most = _height(corners, normals, other, x, y, z)
    behind = True
    for corner in range(3):
        at = corners[row, corner]
        height = _height(corners, normals, other, at[0], at[1], at[2])
        least, most = min(least, height), max(most, height)
        at = corners[other, corner]
        behind = behind and _height(corners, normals, row, at[0], at[1], at[2]) * math.copysign(1.0, above) <= _TOUCH_M
    if behind or least >= -_TOUCH_M or most <= _TOUCH_M:
        return True
    for side in range(3):
        nearest = math.inf
        for corner in range(3):
            at = corners[other, corner]
            height = outwards[side, 0] * (at[0] - x) + outwards[side, 1] * (at[1] - y) + outwards[side, 2] * (at[2] - z)
            nearest = min(nearest, height)
        if nearest >= -_TOUCH_M:
            return True
    return False
