"""Reflected energy by ray tracing: one pass of the rays of an emitter serves all receivers and all octave bands.

Axes: (receiver, direction, band, bin). Metres and seconds; energy is squared pressure where the emitter makes unit
pressure at one metre. Surfaces are numbered walls 0, floor 1, ceiling 2.

Where a ray hits, the scattered share of its energy is sent to every receiver in sight by Lambert's law ("diffuse
rain": Schroeder, "Physically based real-time auralization of interactive virtual environments", 2011, sec. 5.3.3), and
the ray goes on either way: mirrored with probability 1 - s, or scattered with probability s. Mirrored energy is
counted where a ray crosses a sphere around the receiver, by the length of its way through it.

Scattering differs between bands, and so does the chance of every way. Each ray is drawn for one band and counts in all,
weighted by the balance heuristic over the bands it might have been drawn for (Wilkie et al., "Hero wavelength spectral
sampling", 2014): no band is biased, and no weight exceeds the number of bands.
"""

import math

import numba
import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.geometry import FloorPlan
from server.scene.geometry import Geometry
from training.data.dataset import SPEED_OF_SOUND
from training.data.scene_file import HISTOGRAM_BIN_S

_Floats = npt.NDArray[np.float64]

_BANDS = len(OCTAVE_BANDS_HZ)
_LARGEST_RADIUS_M = 0.4
# Of two crossings this near to each other the one is of the wall that the ray comes from.
_OVERLAP = 1e-9
# Fewer rays are followed as their energy falls, each for more: their number falls with this power of the energy.
_THINNING = 0.1
# Every hit rains on one receiver of so many, by chance on which: of hits there are plenty, of crossings few.
_EVERY = 6
_TABLE = 64


def sphere_directions(count: int) -> _Floats:
    """(count, 3) unit vectors spread evenly (Fibonacci spiral)."""
    step = np.arange(count)
    z = 1 - (2 * step + 1) / count
    azimuth = step * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=-1)


def surface_shares(geometry: Geometry) -> tuple[_Floats, _Floats]:
    """(surface, band) energy that is reflected, and of that the share that is scattered."""
    surfaces = (geometry.materials.walls, geometry.materials.floor, geometry.materials.ceiling)
    reflected = 1 - np.array([surface.absorption for surface in surfaces])
    return reflected, np.array([surface.scattering for surface in surfaces])


def receiver_radii(plan: FloorPlan, receivers: _Floats) -> _Floats:
    """(receiver,) of the spheres that count rays: one that reached into a wall would miss a part of them."""
    heights = receivers[:, 2]
    clearance = np.minimum(plan.wall_distance_m(receivers), np.minimum(heights, plan.height_m - heights))
    return np.asarray(np.minimum(clearance, _LARGEST_RADIUS_M))


class RayTracer:
    """Traces from any emitter to a fixed set of receivers (receiver, xyz). Stateless between traces."""

    def __init__(
        self,
        geometry: Geometry,
        receivers: _Floats,
        *,
        duration_s: float,
        image_order: int,
        arrival_directions: _Floats,
    ) -> None:
        """Mirrored paths of up to `image_order` reflections, the direct one among them, are left to image sources."""
        plan = geometry.floor_plan
        self._corners = np.asarray(plan.corners, dtype=np.float64)
        self._height_m = plan.height_m
        self._blocking = not _is_convex(plan)
        self._reflected, self._scattered = surface_shares(geometry)
        self._receivers = np.ascontiguousarray(receivers, dtype=np.float64)
        self._radii = receiver_radii(plan, self._receivers)
        self._image_order = image_order
        self._directions = len(arrival_directions)
        self._nearest = _nearest_directions(arrival_directions)
        self._bins = round(duration_s / HISTOGRAM_BIN_S)

    @property
    def shape(self) -> tuple[int, int, int]:
        """(direction, band, bin) of a receiver's energy."""
        return self._directions, _BANDS, self._bins

    def trace(self, emitter: _Floats, *, rays: int, rng: np.random.Generator) -> npt.NDArray[np.float32]:
        """(receiver, direction, band, bin) energy; the air takes nothing here."""
        turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
        energy = np.zeros((len(self._receivers), self._bins, self._directions, _BANDS), dtype=np.float32)
        _trace(
            self._corners,
            self._height_m,
            self._blocking,
            self._reflected,
            self._scattered,
            np.asarray(emitter, dtype=np.float64),
            sphere_directions(rays) @ turn,
            self._receivers,
            self._radii,
            self._nearest,
            HISTOGRAM_BIN_S * SPEED_OF_SOUND,
            self._image_order,
            rng,
            energy,
        )
        return np.ascontiguousarray(energy.transpose(0, 2, 3, 1))


def _is_convex(plan: FloorPlan) -> bool:
    return len(plan.bend_corners) == 0


def _nearest_directions(directions: _Floats) -> npt.NDArray[np.int32]:
    """(row, column) nearest of `directions`, by the octahedral map of the sphere onto a square."""
    across = (np.arange(_TABLE) + 0.5) / _TABLE * 2 - 1
    u, v = np.meshgrid(across, across, indexing="ij")
    z = 1 - np.abs(u) - np.abs(v)
    x = np.where(z < 0, (1 - np.abs(v)) * np.sign(u), u)
    y = np.where(z < 0, (1 - np.abs(u)) * np.sign(v), v)
    points = np.stack([x, y, z], axis=-1)
    # The nearest is that of the greatest dot product, whatever the length of the point.
    return np.asarray(np.argmax(points @ directions.T, axis=-1), dtype=np.int32)


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _cell(x, y, z):
    """Row and column of `_nearest_directions` for a direction of any length."""
    scale = 1 / (abs(x) + abs(y) + abs(z))
    u, v = x * scale, y * scale
    if z < 0:
        u, v = math.copysign(1 - abs(v), u), math.copysign(1 - abs(u), v)
    half = 0.5 * _TABLE
    return min(int((u + 1) * half), _TABLE - 1), min(int((v + 1) * half), _TABLE - 1)


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "arcp", "reassoc", "nsz"})
def _trace(
    corners,
    height_m,
    blocking,
    reflected,
    scattered,
    emitter,
    directions,
    receivers,
    radii,
    nearest,
    bin_m,
    image_order,
    rng,
    energy,
):
    walls, rays, bins = len(corners), len(directions), energy.shape[1]
    end_m = bins * bin_m
    edge_x, edge_y = np.empty(walls), np.empty(walls)
    for wall in range(walls):
        following = (wall + 1) % walls
        edge_x[wall] = corners[following, 0] - corners[wall, 0]
        edge_y[wall] = corners[following, 1] - corners[wall, 1]
    # On which side of a wall's line a receiver is, and where the ray hits: (receiver, wall) and (wall,).
    receiver_side = np.empty((len(receivers), walls))
    for receiver in range(len(receivers)):
        for wall in range(walls):
            receiver_side[receiver, wall] = edge_x[wall] * (receivers[receiver, 1] - corners[wall, 1]) - edge_y[
                wall
            ] * (receivers[receiver, 0] - corners[wall, 0])
    hit_side, offset_x, offset_y = np.empty(walls), np.empty(walls + 1), np.empty(walls + 1)
    kept, chance, weight = np.empty(_BANDS), np.empty(_BANDS), np.empty(_BANDS)
    scale = 1.0 / rays

    for ray in range(rays):
        px, py, pz = emitter[0], emitter[1], emitter[2]
        dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        kept[:] = 1.0  # of the energy in each band, by all surfaces so far
        chance[:] = 1.0  # of this way, had the ray been drawn for each band; common factors left out
        weight[:] = scale
        thinned, travelled_m, reflections, last = 1.0, 0.0, 0, -1
        was_scattered, is_mirrored = False, True  # at any reflection; at the last one
        while True:
            # The nearest wall that faces the ray, or the floor or the ceiling.
            length, surface, hit = np.inf, -1, -1
            for wall in range(walls):
                into = dx * edge_y[wall] - dy * edge_x[wall]
                if into <= 0.0 or wall == last:
                    continue
                to_x, to_y = corners[wall, 0] - px, corners[wall, 1] - py
                along = (to_x * dy - to_y * dx) / into
                if along < -_OVERLAP or along > 1.0 + _OVERLAP:
                    continue
                distance = (to_x * edge_y[wall] - to_y * edge_x[wall]) / into
                if -_OVERLAP < distance < length:
                    length, surface, hit = distance, 0, wall
            if dz < 0.0 and -pz / dz < length:
                length, surface, hit = -pz / dz, 1, -1
            if dz > 0.0 and (height_m - pz) / dz < length:
                length, surface, hit = (height_m - pz) / dz, 2, -1
            if surface < 0:
                break  # out through a corner, by rounding

            # Receivers have had scattered energy when it was scattered, images are to bring the first mirrored paths.
            if is_mirrored and (was_scattered or reflections > image_order):
                for receiver in range(len(receivers)):
                    to_x, to_y, to_z = (
                        receivers[receiver, 0] - px,
                        receivers[receiver, 1] - py,
                        receivers[receiver, 2] - pz,
                    )
                    closest = to_x * dx + to_y * dy + to_z * dz
                    beside = to_x * to_x + to_y * to_y + to_z * to_z - closest * closest
                    radius = radii[receiver]
                    if beside < radius * radius and 0.0 < closest < length:
                        into_bin = int((travelled_m + closest) / bin_m)
                        if into_bin < bins:
                            chord = 2 * math.sqrt(radius * radius - beside)
                            # 4 pi r**2 at one metre, times the chord over the volume of the sphere.
                            gain = 3 * chord / (radius * radius * radius)
                            row, column = _cell(-dx, -dy, -dz)
                            target = energy[receiver, into_bin, nearest[row, column]]
                            for band in range(_BANDS):
                                target[band] += gain * weight[band]

            px, py, pz = px + length * dx, py + length * dy, pz + length * dz
            travelled_m += length
            if travelled_m >= end_m:
                break
            reflections += 1
            last = hit
            nx, ny, nz = 0.0, 0.0, 1.0 if surface == 1 else -1.0
            if surface == 0:
                norm = math.hypot(edge_x[hit], edge_y[hit])
                nx, ny, nz = -edge_y[hit] / norm, edge_x[hit] / norm, 0.0

            if blocking:
                for wall in range(walls):
                    offset_x[wall], offset_y[wall] = corners[wall, 0] - px, corners[wall, 1] - py
                    hit_side[wall] = edge_y[wall] * offset_x[wall] - edge_x[wall] * offset_y[wall]
                offset_x[walls], offset_y[walls] = offset_x[0], offset_y[0]
                if hit >= 0:
                    hit_side[hit] = 0.0
            for band in range(_BANDS):
                weight[band] *= reflected[surface, band]
            for receiver in range(int(rng.random() * _EVERY), len(receivers), _EVERY):
                to_x, to_y, to_z = receivers[receiver, 0] - px, receivers[receiver, 1] - py, receivers[receiver, 2] - pz
                out = to_x * nx + to_y * ny + to_z * nz
                if out <= 0.0:
                    continue
                square = to_x * to_x + to_y * to_y + to_z * to_z
                distance = math.sqrt(square)
                into_bin = int((travelled_m + distance) / bin_m)
                if into_bin >= bins:
                    continue
                if blocking:
                    crossings = 0
                    for wall in range(walls):
                        before = to_x * offset_y[wall] - to_y * offset_x[wall]
                        after = to_x * offset_y[wall + 1] - to_y * offset_x[wall + 1]
                        crossings += (before * after < 0.0) & (hit_side[wall] * receiver_side[receiver, wall] < 0.0)
                    if crossings > 0:
                        continue
                gain = 4 * _EVERY * out / (distance * square)
                row, column = _cell(-to_x, -to_y, -to_z)
                target = energy[receiver, into_bin, nearest[row, column]]
                for band in range(_BANDS):
                    target[band] += gain * weight[band] * scattered[surface, band]

            is_scattered = rng.random() < scattered[surface, ray % _BANDS]
            total = 0.0
            for band in range(_BANDS):
                kept[band] *= reflected[surface, band]
                chance[band] *= scattered[surface, band] if is_scattered else 1.0 - scattered[surface, band]
                total += chance[band]
            loudest = 0.0
            for band in range(_BANDS):
                chance[band] *= _BANDS / total
                weight[band] = kept[band] * chance[band]
                loudest = max(loudest, weight[band])
            if loudest <= 0.0:
                break
            wanted = loudest**_THINNING
            if wanted < thinned:
                if rng.random() * thinned >= wanted:
                    break
                thinned = wanted
            for band in range(_BANDS):
                weight[band] *= scale / thinned

            is_mirrored = not is_scattered
            if is_scattered:
                was_scattered = True
                share, azimuth = rng.random(), 2 * math.pi * rng.random()
                out, side = math.sqrt(1.0 - share), math.sqrt(share)
                a, b = side * math.cos(azimuth), side * math.sin(azimuth)
                if surface == 0:
                    dx, dy, dz = out * nx - a * ny, out * ny + a * nx, b
                else:
                    dx, dy, dz = a, b, out * nz
            else:
                into = dx * nx + dy * ny + dz * nz
                dx, dy, dz = dx - 2 * into * nx, dy - 2 * into * ny, dz - 2 * into * nz
