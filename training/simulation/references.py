"""Whole simulated responses: the stored reflected sound of a pair, its direct sound and its first reflections.

The last two are not stored. They follow from geometry alone, by the synthesis that the rest of the mirrored reflections
went through.
"""

from dataclasses import dataclass
from functools import cached_property

import h5py
import numpy as np
import numpy.typing as npt

from server.whole_field import kemar
from training.dataset import GEOMETRIC_ORDER, Dataset
from training.simulation.rays import sphere_directions
from training.simulation.synthesis import BinauralSynthesis
from training.simulation.tracing import RoomTracer

_Responses = npt.NDArray[np.float32]
_Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class GeometricSound:
    """What a dataset leaves to geometry, simulated for every pair of probes."""

    dataset: Dataset

    @cached_property
    def _synthesis(self) -> BinauralSynthesis:
        dataset = self.dataset
        directions = sphere_directions(dataset.scene.simulation.arrival_directions)
        return BinauralSynthesis(kemar(dataset.sample_rate), directions, dataset.yaws, dataset.samples)

    @cached_property
    def _visible(self) -> npt.NDArray[np.bool_]:
        """(emitter, listener)"""
        return self.dataset.plan.is_visible(self.dataset.probes[:, None], self.dataset.probes[None])

    @cached_property
    def _images(self) -> list[list[tuple[_Floats, _Floats]]]:
        """By emitter and listener, positions and amplitudes of the first reflections."""
        scene = self.dataset.scene
        tracer = RoomTracer(
            scene.geometry,
            scene.air,
            self.dataset.probes,
            duration_s=scene.simulation.duration_s,
            image_order=GEOMETRIC_ORDER,
            arrival_directions=self._synthesis.arrival_directions,
        )
        return [tracer.images(emitter) for emitter in self.dataset.probes]

    def direct(self, emitter: int, listener: int) -> _Responses:
        """(yaw, ear, sample); silent where a wall stands between."""
        if not self._visible[emitter, listener]:
            return np.zeros((len(self.dataset.yaws), 2, self.dataset.samples), dtype=np.float32)
        ends = self.dataset.probes[emitter], self.dataset.probes[listener]
        return self._synthesis.direct(*ends, self.dataset.scene.air)

    def first_reflections(self, emitter: int, listener: int) -> _Responses:
        """(yaw, ear, sample)"""
        return self._synthesis.specular(*self._images[emitter][listener], self.dataset.probes[listener])


class References:
    """Whole responses of an open dataset by flat pair index, emitter-major; `take` is "reflected" or "repeats"."""

    def __init__(self, dataset: Dataset, file: h5py.File, take: str = "reflected") -> None:
        self._reflected: h5py.Dataset = file[take]
        self._geometric = GeometricSound(dataset)
        self._probes = len(dataset.probes)

    def __getitem__(self, pair: int) -> _Responses:
        """(yaw, ear, sample)"""
        emitter, listener = divmod(int(pair), self._probes)
        reflected = np.asarray(self._reflected[emitter, listener], dtype=np.float32)
        geometric = self._geometric
        return reflected + geometric.direct(emitter, listener) + geometric.first_reflections(emitter, listener)
