"""Reflected energy by ray tracing. One pass of an emitter's rays serves all receivers and all octave bands.

Axes: (receiver, direction, band, bin). Metres and seconds; energy is squared pressure for an emitter of unit pressure
at one metre. Surfaces are numbered: walls 0, floor 1, ceiling 2.

At each reflection, the scattered share of a ray's energy is sent to every receiver in sight by Lambert's law ("diffuse
rain": Schroeder, "Physically based real-time auralization of interactive virtual environments", 2011, sec. 5.3.3). The
ray then continues: mirrored with probability 1 - s, or scattered with probability s. Mirrored energy is counted where a
ray crosses a sphere around a receiver, by the length of its path inside.

Scattering differs between bands, and so does the probability of each path. Each ray is drawn for one band and counts in
all bands, weighted by the balance heuristic over the bands that it could have been drawn for (Wilkie et al., "Hero
wavelength spectral sampling", 2014). No band is biased, and no weight exceeds the number of bands.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.geometry import FloorPlan
from server.kernels.compiled import compiled_inline, compiled_loosely
from server.scene.geometry import Geometry
from training.data.dataset import SPEED_OF_SOUND
from training.data.scene_file import HISTOGRAM_BIN_S

_Floats = npt.NDArray[np.float64]

BANDS = len(OCTAVE_BANDS_HZ)
LARGEST_RADIUS_M = 0.4
# A crossing nearer than this to the start of a ray is the wall from which the ray comes.
_OVERLAP = 1e-9
# As energy falls, fewer rays are followed and each counts for more: their number falls with this power of the energy.
THINNING = 0.1
# Each reflection sends diffuse rain to a random sixth of the receivers: reflections are many, crossings of spheres few.
EVERY = 6
_TABLE = 64


def sphere_directions(count: int) -> _Floats:
    """(count, 3) unit vectors spread evenly (Fibonacci spiral)."""
    step = np.arange(count)
    z = 1 - (2 * step + 1) / count
    azimuth = step * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=-1)


def surface_shares(geometry: Geometry) -> tuple[_Floats, _Floats]:
    """(surface, band) the share of the energy that is reflected, and the share of the reflected energy that is
    scattered."""
    surfaces = (geometry.materials.walls, geometry.materials.floor, geometry.materials.ceiling)
    reflected = 1 - np.array([surface.absorption for surface in surfaces])
    return reflected, np.array([surface.scattering for surface in surfaces])


def receiver_radii(plan: FloorPlan, receivers: _Floats) -> _Floats:
    """(receiver,) radii of the spheres that count rays. Spheres must not reach into a wall, where no ray would cross
    them."""
    heights = receivers[:, 2]
    clearance = np.minimum(plan.wall_distance_m(receivers), np.minimum(heights, plan.height_m - heights))
    return np.asarray(np.minimum(clearance, LARGEST_RADIUS_M))


class _Room(NamedTuple):
    """The surfaces that rays meet. `edge_x` and `edge_y` (wall,) lead from each corner of the plan to the next one;
    `reflected` and `scattered` are (surface, band)."""

    corners: _Floats
    edge_x: _Floats
    edge_y: _Floats
    height_m: float
    is_convex: bool
    reflected: _Floats
    scattered: _Floats


class _Receivers(NamedTuple):
    """The receivers. Positions (receiver, xyz) and radii of the spheres that count rays. The sign of `sides` (receiver,
    wall) says on which side of a wall's line a receiver is. `nearest` is the number of the nearest arrival direction,
    by `cell`."""

    positions: _Floats
    radii: _Floats
    sides: _Floats
    nearest: npt.NDArray[np.int32]


class Histogram(NamedTuple):
    """Energies (receiver, bin, direction, band). A bin is the time in which sound travels `bin_m`."""

    energy: npt.NDArray[np.float32]
    bin_m: float


class RayTracer:
    """Traces rays from any emitter to a fixed set of receivers (receiver, xyz). It has no state between traces."""

    def __init__(
        self,
        geometry: Geometry,
        receivers: _Floats,
        *,
        duration_s: float,
        image_order: int,
        arrival_directions: _Floats,
    ) -> None:
        """Prepare tracing for `duration_s`. Direct sound and specular paths of up to `image_order` reflections are left
        out, because image sources give them."""
        plan = geometry.floor_plan
        corners = np.asarray(plan.corners, dtype=np.float64)
        edge_x, edge_y = np.ascontiguousarray((np.roll(corners, -1, axis=0) - corners).T)
        is_convex = len(plan.bend_corners) == 0
        self._room = _Room(corners, edge_x, edge_y, float(plan.height_m), is_convex, *surface_shares(geometry))
        positions = np.ascontiguousarray(receivers, dtype=np.float64)
        self._receivers = _Receivers(
            positions,
            receiver_radii(plan, positions),
            edge_x * (positions[:, None, 1] - corners[:, 1]) - edge_y * (positions[:, None, 0] - corners[:, 0]),
            nearest_directions(arrival_directions),
        )
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
            self._room,
            self._receivers,
            np.asarray(emitter, dtype=np.float64),
            sphere_directions(rays) @ turn,
            self._image_order,
            rng,
            Histogram(energy, HISTOGRAM_BIN_S * SPEED_OF_SOUND),
        )
        return np.ascontiguousarray(energy.transpose(0, 2, 3, 1))


def nearest_directions(directions: _Floats) -> npt.NDArray[np.int32]:
    """(row, column) index of the nearest of `directions`, on an octahedral map of the sphere to a square."""
    across = (np.arange(_TABLE) + 0.5) / _TABLE * 2 - 1
    u, v = np.meshgrid(across, across, indexing="ij")
    z = 1 - np.abs(u) - np.abs(v)
    x = np.where(z < 0, (1 - np.abs(v)) * np.sign(u), u)
    y = np.where(z < 0, (1 - np.abs(u)) * np.sign(v), v)
    points = np.stack([x, y, z], axis=-1)
    # The nearest direction has the greatest dot product, whatever the length of the point.
    return np.asarray(np.argmax(points @ directions.T, axis=-1), dtype=np.int32)


@compiled_inline
def cell(x, y, z):
    """The row and column in `nearest_directions` for a direction of any length."""
    scale = 1 / (abs(x) + abs(y) + abs(z))
    u, v = x * scale, y * scale
    if z < 0:
        u, v = math.copysign(1 - abs(v), u), math.copysign(1 - abs(u), v)
    half = 0.5 * _TABLE
    return min(int((u + 1) * half), _TABLE - 1), min(int((v + 1) * half), _TABLE - 1)


@compiled_loosely
def _trace(room, receivers, emitter, directions, image_order, rng, histogram):
    """Add the energy of all rays to the histogram."""
    walls, rays = len(room.corners), len(directions)
    end_m = histogram.energy.shape[1] * histogram.bin_m
    offsets = np.empty((3, walls + 1))
    kept, chance, weight = np.empty(BANDS), np.empty(BANDS), np.empty(BANDS)
    scale = 1.0 / rays
    for ray in range(rays):
        position = emitter[0], emitter[1], emitter[2]
        direction = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        kept[:] = 1.0
        chance[:] = 1.0
        weight[:] = scale
        share, travelled_m, reflections, wall = 1.0, 0.0, 0, -1  # the share of such rays that is still followed
        was_scattered, is_mirrored = False, True  # at any reflection so far; at the last one
        while True:
            length, hit = _next_surface(room, position, direction, wall)
            surface, wall = hit
            if surface < 0:
                break  # the ray left the room through a corner by rounding
            # Scattered energy reaches receivers as diffuse rain, and image sources account for the first reflections.
            if is_mirrored and (was_scattered or reflections > image_order):
                add_crossings(receivers, position, direction, length, travelled_m, weight, histogram)
            px, py, pz = position
            dx, dy, dz = direction
            position = px + length * dx, py + length * dy, pz + length * dz
            travelled_m += length
            if travelled_m >= end_m:
                break
            reflections += 1
            normal = _normal(room, surface, wall)
            for band in range(BANDS):
                weight[band] *= room.reflected[surface, band]
            first = int(rng.random() * EVERY)
            _add_rain(room, receivers, first, hit, position, normal, travelled_m, weight, offsets, histogram)
            is_scattered = rng.random() < room.scattered[surface, ray % BANDS]
            loudest = weigh(room, surface, is_scattered, kept, chance, weight)
            if loudest <= 0.0:
                break
            wanted = loudest**THINNING
            if wanted < share:
                if rng.random() * share >= wanted:
                    break
                share = wanted
            for band in range(BANDS):
                weight[band] *= scale / share
            is_mirrored = not is_scattered
            if is_scattered:
                was_scattered = True
                direction = _scattered_direction(surface, normal, rng.random(), rng.random())
            else:
                direction = mirrored_direction(direction, normal)


@compiled_inline
def _next_surface(room, position, direction, last):
    """The distance, surface and wall (-1 if none) that a ray meets next; the surface is -1 if it meets none. `last` is
    the wall from which the ray comes."""
    px, py, pz = position
    dx, dy, dz = direction
    length, surface, hit = np.inf, -1, -1
    for wall in range(len(room.corners)):
        into = dx * room.edge_y[wall] - dy * room.edge_x[wall]
        if into <= 0.0 or wall == last:
            continue  # the ray is behind the wall
        to_x, to_y = room.corners[wall, 0] - px, room.corners[wall, 1] - py
        along = (to_x * dy - to_y * dx) / into
        if along < -_OVERLAP or along > 1.0 + _OVERLAP:
            continue
        distance = (to_x * room.edge_y[wall] - to_y * room.edge_x[wall]) / into
        if -_OVERLAP < distance < length:
            length, surface, hit = distance, 0, wall
    if dz < 0.0 and -pz / dz < length:
        length, surface, hit = -pz / dz, 1, -1
    if dz > 0.0 and (room.height_m - pz) / dz < length:
        length, surface, hit = (room.height_m - pz) / dz, 2, -1
    return length, (surface, hit)


@compiled_inline
def _normal(room, surface, wall):
    """The unit vector from a surface into the room."""
    if surface == 0:
        norm = math.hypot(room.edge_x[wall], room.edge_y[wall])
        return -room.edge_y[wall] / norm, room.edge_x[wall] / norm, 0.0
    return 0.0, 0.0, 1.0 if surface == 1 else -1.0


@compiled_inline
def add_crossings(receivers, position, direction, length, travelled_m, weight, histogram):
    """Add the energy of a ray to every receiver whose sphere it crosses within `length`."""
    px, py, pz = position
    dx, dy, dz = direction
    for receiver in range(len(receivers.positions)):
        to_x, to_y, to_z = (
            receivers.positions[receiver, 0] - px,
            receivers.positions[receiver, 1] - py,
            receivers.positions[receiver, 2] - pz,
        )
        closest = to_x * dx + to_y * dy + to_z * dz
        beside = to_x * to_x + to_y * to_y + to_z * to_z - closest * closest
        radius = receivers.radii[receiver]
        if beside < radius * radius and 0.0 < closest < length:
            into_bin = int((travelled_m + closest) / histogram.bin_m)
            if into_bin < histogram.energy.shape[1]:
                chord = 2 * math.sqrt(radius * radius - beside)
                # 4 pi r**2 at one metre, times the chord over the volume of the sphere.
                gain = 3 * chord / (radius * radius * radius)
                row, column = cell(-dx, -dy, -dz)
                target = histogram.energy[receiver, into_bin, receivers.nearest[row, column]]
                for band in range(BANDS):
                    target[band] += gain * weight[band]


@compiled_inline
def _add_rain(room, receivers, first, hit, position, normal, travelled_m, weight, offsets, histogram):
    """Add the scattered energy of a reflection to every `EVERY`th receiver, from `first` on, if it is in sight."""
    walls = len(room.corners)
    surface, wall = hit
    px, py, pz = position
    nx, ny, nz = normal
    offset_x, offset_y, hit_side = offsets
    if not room.is_convex:
        for other in range(walls):
            offset_x[other], offset_y[other] = room.corners[other, 0] - px, room.corners[other, 1] - py
            hit_side[other] = room.edge_y[other] * offset_x[other] - room.edge_x[other] * offset_y[other]
        offset_x[walls], offset_y[walls] = offset_x[0], offset_y[0]
        if wall >= 0:
            hit_side[wall] = 0.0
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
        if not room.is_convex:
            crossings = 0
            for other in range(walls):
                before = to_x * offset_y[other] - to_y * offset_x[other]
                after = to_x * offset_y[other + 1] - to_y * offset_x[other + 1]
                crossings += (before * after < 0.0) & (hit_side[other] * receivers.sides[receiver, other] < 0.0)
            if crossings > 0:
                continue
        gain = 4 * EVERY * out / (distance * square)
        row, column = cell(-to_x, -to_y, -to_z)
        target = histogram.energy[receiver, into_bin, receivers.nearest[row, column]]
        for band in range(BANDS):
            target[band] += gain * weight[band] * room.scattered[surface, band]


@compiled_inline
def weigh(room, surface, is_scattered, kept, chance, weight):
    """Set the weight of each band after a reflection, and return the largest one. `kept` is the share of energy that
    all surfaces so far have reflected. `chance` is the probability of the path if the ray had been drawn for this band,
    up to a common factor."""
    total = 0.0
    for band in range(BANDS):
        kept[band] *= room.reflected[surface, band]
        chance[band] *= room.scattered[surface, band] if is_scattered else 1.0 - room.scattered[surface, band]
        total += chance[band]
    loudest = 0.0
    for band in range(BANDS):
        chance[band] *= BANDS / total
        weight[band] = kept[band] * chance[band]
        loudest = max(loudest, weight[band])
    return loudest


@compiled_inline
def _scattered_direction(surface, normal, share, turn):
    """A random direction by Lambert's law, from two uniform random numbers."""
    nx, ny, nz = normal
    azimuth = 2 * math.pi * turn
    out, side = math.sqrt(1.0 - share), math.sqrt(share)
    a, b = side * math.cos(azimuth), side * math.sin(azimuth)
    if surface == 0:
        return out * nx - a * ny, out * ny + a * nx, b
    return a, b, out * nz


@compiled_inline
def mirrored_direction(direction, normal):
    dx, dy, dz = direction
    nx, ny, nz = normal
    into = dx * nx + dy * ny + dz * nz
    return dx - 2 * into * nx, dy - 2 * into * ny, dz - 2 * into * nz
