"""Complete simulated responses: the stored late reverberation of a pair, its direct sound and its first reflections.

Direct sound and first reflections are not stored. They follow from geometry alone, by the same synthesis as the other
specular reflections.
"""

from dataclasses import dataclass
from functools import cached_property

import h5py
import numpy as np
import numpy.typing as npt

from server.rendering.hrtf import kemar
from training.data.dataset import GEOMETRIC_ORDER, Dataset, StoredResponses
from training.data.responses import SimulatedResponses
from training.simulation.direct_paths import DirectPaths
from training.simulation.rays import sphere_directions
from training.simulation.synthesis import BinauralSynthesis
from training.simulation.tracing import RoomTracer

_Responses = npt.NDArray[np.float32]
_Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class GeometricSound:
    """Simulates the direct sound and the first reflections, which a dataset does not store, for every pair of
    probes."""

    dataset: Dataset

    @cached_property
    def _synthesis(self) -> BinauralSynthesis:
        dataset = self.dataset
        directions = sphere_directions(dataset.scene.simulation.arrival_directions)
        return BinauralSynthesis(kemar(dataset.sample_rate), directions, dataset.yaws, dataset.samples)

    @cached_property
    def _direct_paths(self) -> DirectPaths:
        return DirectPaths.of(self.dataset.scene, self.dataset.effects)

    @cached_property
    def _images(self) -> list[list[tuple[_Floats, _Floats]]]:
        """The positions and amplitudes of the first reflections, by emitter and listener."""
        dataset = self.dataset
        tracer = RoomTracer.of(dataset.scene, dataset.effects, dataset.probes, image_order=GEOMETRIC_ORDER)
        return [tracer.images(emitter) for emitter in dataset.probes]

    def direct(self, emitter: int, listener: int) -> _Responses:
        """(yaw, ear, sample) direct sound. Behind walls it bends around corners, or is silent if the plan has no
        diffraction."""
        ends = self.dataset.probes[emitter], self.dataset.probes[listener]
        return self._synthesis.specular(*self._direct_paths.images(*ends), ends[1])

    def first_reflections(self, emitter: int, listener: int) -> _Responses:
        """(yaw, ear, sample) first reflections."""
        return self._synthesis.specular(*self._images[emitter][listener], self.dataset.probes[listener])

    def complete(self, emitter: int, listener: int, stored: _Responses) -> _Responses:
        """(yaw, ear, sample) the complete response, from the stored late reverberation."""
        return stored + self.direct(emitter, listener) + self.first_reflections(emitter, listener)


class References:
    """The complete responses of an open dataset, by the flat index emitter * probes + listener; `take` is one of the
    TAKES."""

    def __init__(self, dataset: Dataset, file: h5py.File, take: str = "reflected") -> None:
        self._stored = StoredResponses(dataset, file, take)
        self._geometric = GeometricSound(dataset)
        self._probes = len(dataset.probes)

    def __getitem__(self, pair: int) -> _Responses:
        """(yaw, ear, sample) the response of a pair."""
        emitter, listener = divmod(int(pair), self._probes)
        return self._geometric.complete(emitter, listener, self._stored[emitter, listener])


class WholeResponses(SimulatedResponses):
    """The responses of a simulated dataset with direct sound and first reflections, like measured ones."""

    def __init__(self, dataset: Dataset) -> None:
        super().__init__(dataset)
        self._geometric = GeometricSound(dataset)

    def read(self, rows: npt.ArrayLike) -> _Responses:
        """(n, ear, sample) the responses of these rows."""
        responses = super().read(rows)
        for response, row in zip(responses, np.asarray(rows, dtype=np.int64), strict=True):
            emitter, listener = self.ends(row)
            yaw = row % len(self.dataset.yaws)
            response += self._geometric.direct(emitter, listener)[yaw]
            response += self._geometric.first_reflections(emitter, listener)[yaw]
        return responses
