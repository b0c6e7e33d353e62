"""What arrives where: image sources and ray tracing by pyroomacoustics, one emitter and all its receivers at a time."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pyroomacoustics as pra
from scipy.stats import poisson

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.decibels import db_to_amplitude, db_to_power
from server.scene.geometry import Geometry, Material
from server.scene.manifest import Air
from training.dataset import SPEED_OF_SOUND

HISTOGRAM_BIN_S = 0.004

# Nothing is sampled here, but pyroomacoustics derives from its rate the octave bands (at this one, exactly
# OCTAVE_BANDS_HZ) and rounds the bins of its histograms to whole samples (at this one, exactly HISTOGRAM_BIN_S).
_ENGINE_RATE = 24_000
_RECEIVER_RADIUS_M = 0.4
# Rays are followed down to -120 dB; pyroomacoustics' default of -70 dB per ray truncates decays at about -45 dB.
_ENERGY_THRESHOLD = 1e-12


@dataclass(frozen=True)
class Arrivals:
    """What the room sends from one emitter to one receiver, at unit pressure one metre from the emitter: all but the
    direct sound.

    `image_positions` (image, xyz) are apparent emitter positions of the specular reflections that reach the receiver,
    none where every path is blocked; `image_amplitudes` (image, band) is their pressure there. `energy` (direction,
    band, bin) is the squared pressure that rays bring per bin of HISTOGRAM_BIN_S, by direction of arrival.
    """

    image_positions: npt.NDArray[np.float64]
    image_amplitudes: npt.NDArray[np.float64]
    energy: npt.NDArray[np.float64]


def sphere_directions(count: int) -> npt.NDArray[np.float64]:
    """(count, 3) unit vectors spread evenly (Fibonacci spiral)."""
    step = np.arange(count)
    z = 1 - (2 * step + 1) / count
    azimuth = step * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=-1)


def counted_twice(geometry: Geometry, *, image_order: int, bins: int) -> npt.NDArray[np.float64]:
    """(band, bin) factor by which pyroomacoustics' rays bring too much energy where surfaces scatter.

    At every wall its engine sends the scattered share s to the receivers and then follows the ray on with all of its
    energy, not 1 - s of it, so that 1 + s arrives of 1. Arrivals of up to `image_order` reflections are spared: there
    the ray itself is left to the image sources. How many reflections an arrival has had by a time is Poisson, after
    the mean free path 4 V / S of a diffuse field (Kuttruff, Room Acoustics, ch. 5).
    """
    plan, materials = geometry.floor_plan, geometry.materials
    perimeter_m = float(np.sum(np.linalg.norm(plan.walls[:, 1] - plan.walls[:, 0], axis=-1)))
    areas = np.array([perimeter_m * geometry.height_m, plan.area_m2, plan.area_m2])
    surfaces = (materials.walls, materials.floor, materials.ceiling)
    reflected = areas[:, None] * (1 - np.array([surface.absorption for surface in surfaces]))
    scattering = np.array([surface.scattering for surface in surfaces])
    mean_scattering = np.sum(reflected * scattering, axis=0) / np.maximum(np.sum(reflected, axis=0), 1e-9)
    mean_free_path_m = 4 * plan.area_m2 * geometry.height_m / float(np.sum(areas))
    reflections = (np.arange(bins) + 0.5) * HISTOGRAM_BIN_S * SPEED_OF_SOUND / mean_free_path_m
    return np.asarray(1 + mean_scattering[:, None] * poisson.sf(image_order, reflections))


def free_field_amplitude(distance_m: npt.NDArray[np.float64], air: Air) -> npt.NDArray[np.float64]:
    """(..., band) pressure at (...,) distances from an emitter of unit pressure at one metre: its wave spreads, and the
    air takes its share."""
    distance = np.asarray(distance_m)[..., None]
    return np.asarray(db_to_amplitude(-distance * air.absorption_db_per_m) / distance)


def _material(material: Material) -> pra.Material:
    def banded(coefficients: tuple[float, ...]) -> dict[str, list[float]]:
        return {"coeffs": list(coefficients), "center_freqs": list(OCTAVE_BANDS_HZ)}

    return pra.Material(banded(material.absorption), banded(material.scattering))


class RoomTracer:
    """Traces from any emitter to a fixed set of receivers (receiver, xyz), all of them in one pass of the rays."""

    def __init__(
        self,
        geometry: Geometry,
        air: Air,
        receivers: npt.NDArray[np.float64],
        *,
        duration_s: float,
        image_order: int,
        arrival_directions: npt.NDArray[np.float64],
    ) -> None:
        self._receivers = receivers
        self._bins = round(duration_s / HISTOGRAM_BIN_S)
        corners = np.asarray(geometry.corners, dtype=np.float64).T
        room = pra.Room.from_corners(
            corners,
            fs=_ENGINE_RATE,
            # Its rays bring reflections of this very order as its images do: they are asked for one order more, and
            # those images are left out.
            max_order=image_order + 1,
            materials=_material(geometry.materials.walls),
            ray_tracing=True,
        )
        caps = {"floor": _material(geometry.materials.floor), "ceiling": _material(geometry.materials.ceiling)}
        room.extrude(geometry.height_m, materials=caps)
        room.set_ray_tracing(
            receiver_radius=_RECEIVER_RADIUS_M,
            energy_thres=_ENERGY_THRESHOLD,
            time_thres=duration_s,
            hist_bin_size=HISTOGRAM_BIN_S,
        )
        room.add_microphone_array(receivers.T)
        # The engine underneath the public class: where every path is blocked, its `compute_rir` draws the direct one
        # through the wall, and it knows no direction of arrival for omnidirectional receivers.
        self._engine = room.room_engine
        for microphone in self._engine.microphones:
            microphone.set_directions(arrival_directions.astype(np.float32))
        self._bands: int = room.octave_bands.n_bands
        self._air = air
        self._image_order = image_order
        self._counted_twice = counted_twice(geometry, image_order=image_order, bins=self._bins)

    def trace(self, emitter: npt.NDArray[np.float64], *, rays: int, seed: int) -> list[Arrivals]:
        """One entry per receiver. The same seed gives the same arrivals."""
        images, amplitudes, visible = self._images(emitter)
        energy = self._energy(emitter, rays, seed)
        return [Arrivals(images[seen], amplitudes[index, seen], energy[index]) for index, seen in enumerate(visible)]

    def _images(
        self, emitter: npt.NDArray[np.float64]
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
        """Image positions (image, xyz), amplitudes (receiver, image, band) and visibility (receiver, image)."""
        count = self._engine.image_source_model(emitter.astype(np.float32))
        if count == 0:
            none = np.zeros((len(self._receivers), 0))
            return np.zeros((0, 3)), np.zeros((*none.shape, self._bands)), none.astype(bool)
        orders = np.array(self._engine.orders)
        wanted = (orders > 0) & (orders <= self._image_order)
        images = np.array(self._engine.sources.T, dtype=np.float64)[wanted]
        damping = np.array(self._engine.attenuations.T, dtype=np.float64)[wanted]
        distance = np.linalg.norm(images - self._receivers[:, None], axis=-1)
        amplitudes = damping * free_field_amplitude(distance, self._air)
        return images, amplitudes, np.array(self._engine.visible_mics, dtype=bool)[:, wanted]

    def _energy(self, emitter: npt.NDArray[np.float64], rays: int, seed: int) -> npt.NDArray[np.float64]:
        """(receiver, direction, band, bin) squared pressure."""
        rng = np.random.default_rng(seed)
        turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
        pra.random.seed(seed)
        directions = (sphere_directions(rays) @ turn).astype(np.float32)
        self._engine.ray_tracing(directions, np.ones((rays, self._bands), np.float32), emitter.astype(np.float32))
        energy = np.stack([self._read(microphone) for microphone in self._engine.microphones])
        self._engine.reset_mics()
        distance = (np.arange(self._bins) + 0.5) * HISTOGRAM_BIN_S * SPEED_OF_SOUND
        kept = db_to_power(-self._air.absorption_db_per_m[:, None] * distance)
        return np.asarray(energy * kept / self._counted_twice)

    def _read(self, microphone: pra.libroom.Microphone) -> npt.NDArray[np.float64]:
        energy = np.zeros((len(microphone.histograms), self._bands, self._bins))
        for direction, histogram in enumerate(microphone.histograms):
            counted = histogram.get_hist()[:, : self._bins]
            energy[direction, :, : counted.shape[1]] = counted
        return energy
