"""Complete simulated responses: the stored late reverberation of a pair, its direct sound and its first reflections.

Direct sound and first reflections are not stored. They follow from geometry alone, by the same synthesis as the other
specular reflections.
"""

from dataclasses import dataclass
from functools import cached_property

import h5py
import numpy as np
import numpy.typing as npt

from server.rendering.hrtf import HeadFilters, kemar
from training.data.dataset import GEOMETRIC_ORDER, TAKES, Dataset, StoredResponses
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
    probes. They are heard through the dataset's own head and yaws, unless others are given."""

    dataset: Dataset
    filters: HeadFilters | None = None
    heads: _Floats | None = None
    """Yaws (head,) of level heads, or orientations (head, 4)."""

    @cached_property
    def synthesis(self) -> BinauralSynthesis:
        dataset = self.dataset
        directions = sphere_directions(dataset.scene.simulation.arrival_directions)
        filters = self.filters or kemar(dataset.sample_rate)
        heads = dataset.yaws if self.heads is None else self.heads
        return BinauralSynthesis(filters, directions, heads, dataset.samples)

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
        return self.synthesis.specular(*self._direct_paths.images(*ends), ends[1])

    def first_reflections(self, emitter: int, listener: int) -> _Responses:
        """(yaw, ear, sample) first reflections."""
        return self.synthesis.specular(*self._images[emitter][listener], self.dataset.probes[listener])

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


class ReheardReferences:
    """Complete responses of a dataset's pairs as another head hears them, or heads that are turned otherwise, by the
    flat index emitter * probes + listener. They are simulated anew from the stored energies and the images.

    Each of the TAKES has noise of its own. But a dataset stores the energies of one take only, so the difference
    between takes lacks what rays traced anew would add.
    """

    def __init__(self, dataset: Dataset, filters: HeadFilters, heads: _Floats, take: str = "reflected") -> None:
        """`heads` are yaws (head,) of level heads, or orientations (head, 4)."""
        self._dataset = dataset
        self._geometric = GeometricSound(dataset, filters, heads)
        self._take = TAKES.index(take)
        self._images: tuple[int, list[tuple[_Floats, _Floats]]] | None = None

    def __getitem__(self, pair: int) -> _Responses:
        """(head, ear, sample) the response of a pair. Raises DatasetError if the dataset has no energies."""
        dataset = self._dataset
        emitter, listener = divmod(int(pair), len(dataset.probes))
        (energy,) = dataset.read_energy(np.array([(emitter, listener)]))
        rng = np.random.default_rng([dataset.seed, 15, emitter, listener, self._take])
        response = self._geometric.synthesis.late(energy, float(dataset.onset_s[emitter, listener]), rng)
        if self._images is None or self._images[0] != emitter:
            # Images for all listeners take as long as images for one, and pairs come in the order of emitters.
            self._images = emitter, self._tracer.images(dataset.probes[emitter])
        images = self._images[1][listener]
        response += self._geometric.synthesis.specular(*images, dataset.probes[listener])
        return self._geometric.complete(emitter, listener, response)

    @cached_property
    def _tracer(self) -> RoomTracer:
        dataset = self._dataset
        return RoomTracer.of(dataset.scene, dataset.effects, dataset.probes, least_order=GEOMETRIC_ORDER + 1)


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
