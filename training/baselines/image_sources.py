"""A baseline without learning: image sources of the known geometry, a tail of shaped noise by reverberation theory, and
the head. It uses no training data.

The tail is that of a diffuse field. In a room of volume V, images fill space evenly. So an emitter of unit pressure
sends 4 pi c / V of energy per second, which decays by Eyring's absorption exponent and that of the air (Kuttruff, Room
Acoustics, ch. 4 and 5). The images of low order contain a part of that energy: the number of reflections up to time t
has a Poisson distribution for the mean free path 4 V / S, weighted by what they reflect. The tail has the rest. Rooms
that are coupled by a door do not have one diffuse field, which is an error of this method.

Axes: bands are `OCTAVE_BANDS_HZ`; responses (yaw, ear, sample). Metres, seconds.
"""

import threading
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.stats import poisson

from server.rendering.hrtf import kemar
from server.scene.geometry import Geometry
from server.scene.manifest import Air
from training.data.dataset import SPEED_OF_SOUND, Dataset
from training.data.scene_file import HISTOGRAM_BIN_S
from training.simulation.rays import sphere_directions, surface_shares
from training.simulation.synthesis import BinauralSynthesis
from training.simulation.tracing import Arrivals, RoomTracer

_Floats = npt.NDArray[np.float64]
_SEED = 20


@dataclass(frozen=True)
class DiffuseField:
    """Predictions of reverberation theory for a room."""

    geometry: Geometry
    air: Air

    @cached_property
    def volume_m3(self) -> float:
        return self.geometry.floor_plan.area_m2 * self.geometry.height_m

    @cached_property
    def areas_m2(self) -> _Floats:
        """(surface,) areas of walls, floor and ceiling."""
        plan = self.geometry.floor_plan
        perimeter_m = float(np.sum(np.linalg.norm(plan.walls[:, 1] - plan.walls[:, 0], axis=-1)))
        return np.array([perimeter_m * self.geometry.height_m, plan.area_m2, plan.area_m2])

    @cached_property
    def reflected(self) -> _Floats:
        """(band,) mean share of the energy that surfaces reflect."""
        return np.asarray(self.areas_m2 @ surface_shares(self.geometry)[0] / self.areas_m2.sum())

    @cached_property
    def mirrored(self) -> _Floats:
        """(band,) mean share of the reflected energy that is not scattered."""
        reflected, scattered = surface_shares(self.geometry)
        return np.asarray(self.areas_m2 @ (reflected * (1 - scattered)) / np.maximum(self.areas_m2 @ reflected, 1e-12))

    @property
    def reflections_per_s(self) -> float:
        return float(SPEED_OF_SOUND * self.areas_m2.sum() / (4 * self.volume_m3))

    @cached_property
    def decay_per_s(self) -> _Floats:
        """(band,) exponent of the decay of energy: Eyring's plus that of the air."""
        of_surfaces = -np.log(np.maximum(self.reflected, 1e-12)) * self.reflections_per_s
        of_air = self.air.absorption_db_per_m * np.log(10) / 10 * SPEED_OF_SOUND
        return np.asarray(of_surfaces + of_air)

    @property
    def reverberation_time_s(self) -> _Floats:
        """(band,)"""
        return np.asarray(6 * np.log(10) / self.decay_per_s)

    def energy_per_s(self, time_s: _Floats) -> _Floats:
        """(band, time) squared pressure per second of everything that arrives, for unit pressure one metre from the
        emitter."""
        return np.asarray(4 * np.pi * SPEED_OF_SOUND / self.volume_m3 * np.exp(-self.decay_per_s[:, None] * time_s))

    def share_beyond(self, order: int, time_s: _Floats) -> _Floats:
        """(band, time) the share of this energy that does not come from specular reflections of up to `order`."""
        expected = self.reflections_per_s * time_s * self.reflected[:, None]
        brought = [poisson.pmf(count, expected) * self.mirrored[:, None] ** count for count in range(order + 1)]
        return np.asarray(1 - np.sum(brought, axis=0))


class ImageSources:
    """Whole responses of a simulated dataset's scene from geometry alone. Several threads may use one."""

    def __init__(self, dataset: Dataset) -> None:
        settings = dataset.scene.simulation
        self._dataset = dataset
        self._directions = sphere_directions(settings.arrival_directions)
        diffuse = DiffuseField(dataset.scene.geometry, dataset.scene.air)
        bins = np.arange(round(settings.duration_s / HISTOGRAM_BIN_S)) + 0.5
        time_s = np.asarray(bins * HISTOGRAM_BIN_S, np.float64)
        tail = diffuse.energy_per_s(time_s) * diffuse.share_beyond(settings.image_order, time_s) * HISTOGRAM_BIN_S
        shape = (len(self._directions), *tail.shape)
        self._tail = np.broadcast_to(tail / len(self._directions), shape).astype(np.float32)
        self._syntheses: dict[tuple[int, ...], BinauralSynthesis] = {}
        self._lock = threading.Lock()

    def response(
        self, emitter: _Floats, listener: _Floats, yaw_indices: npt.NDArray[np.integer], number: int
    ) -> npt.NDArray[np.float32]:
        """(yaw, ear, sample) at the dataset's yaws with these indices; `number` seeds the noise of the tail."""
        dataset = self._dataset
        settings = dataset.scene.simulation
        tracer = RoomTracer(
            dataset.scene.geometry,
            dataset.scene.air,
            listener[None],
            duration_s=settings.duration_s,
            image_order=settings.image_order,
            arrival_directions=self._directions,
        )
        synthesis = self._synthesis(yaw_indices)
        onset_s = float(dataset.plan.path_length_m(emitter, listener)) / SPEED_OF_SOUND
        arrivals = Arrivals(*tracer.images(emitter)[0], self._tail)
        response = synthesis.render(arrivals, listener, onset_s, np.random.default_rng([_SEED, number]))
        if dataset.plan.is_visible(emitter, listener):
            response = response + synthesis.direct(emitter, listener, dataset.scene.air)
        return response.astype(np.float32)

    def _synthesis(self, yaw_indices: npt.NDArray[np.integer]) -> BinauralSynthesis:
        """The synthesis for these orientations, which is computed once for all pairs."""
        key = tuple(int(yaw_index) for yaw_index in yaw_indices)
        with self._lock:
            if key not in self._syntheses:
                self._syntheses[key] = BinauralSynthesis(
                    kemar(self._dataset.sample_rate),
                    self._directions,
                    self._dataset.yaws[yaw_indices],
                    self._dataset.samples,
                )
            return self._syntheses[key]
