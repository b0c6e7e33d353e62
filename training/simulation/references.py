"""Complete simulated responses: the late reverberation of a pair, its direct sound and its first reflections.

Late reverberation is drawn from the energies of a dataset; direct sound and first reflections follow from geometry
alone, by the same synthesis as the other specular reflections.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from server.rendering.hrtf import HeadFilters, kemar
from training.data.dataset import GEOMETRIC_ORDER, TAKES, Dataset
from training.simulation.direct_paths import DirectPaths
from training.simulation.late_sound import LateSound, MirroredReflections
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
        directions = sphere_directions(dataset.place.simulation.arrival_directions)
        filters = self.filters or kemar(dataset.sample_rate)
        heads = dataset.yaws if self.heads is None else self.heads
        return BinauralSynthesis(filters, directions, heads, dataset.samples)

    @cached_property
    def _direct_paths(self) -> dict[int, DirectPaths]:
        """The direct paths from each emitter, by its probe."""
        dataset = self.dataset
        found: dict[int, DirectPaths] = {}
        for one, emitters in dataset.scenes.groups(np.arange(len(dataset.probes))).items():
            paths = DirectPaths.of(dataset.scenes.of(one), dataset.effects)
            found |= dict.fromkeys(emitters.tolist(), paths)
        return found

    @cached_property
    def _images(self) -> list[list[tuple[_Floats, _Floats]]]:
        """The positions and amplitudes of the first reflections, by emitter and listener."""
        dataset = self.dataset
        found: dict[int, list[tuple[_Floats, _Floats]]] = {}
        for one, emitters in dataset.scenes.groups(np.arange(len(dataset.probes))).items():
            scene = dataset.scenes.of(one)
            tracer = RoomTracer.of(scene, dataset.effects, dataset.probes, image_order=GEOMETRIC_ORDER)
            found |= {int(emitter): tracer.images(dataset.probes[emitter]) for emitter in emitters}
        return [found[emitter] for emitter in range(len(found))]

    def direct(self, emitter: int, listener: int) -> _Responses:
        """(yaw, ear, sample) direct sound. Behind walls it bends around corners, or is silent if the plan has no
        diffraction."""
        ends = self.dataset.probes[emitter], self.dataset.probes[listener]
        return self.synthesis.specular(*self._direct_paths[emitter].images(*ends), ends[1])

    def first_reflections(self, emitter: int, listener: int) -> _Responses:
        """(yaw, ear, sample) first reflections."""
        return self.synthesis.specular(*self._images[emitter][listener], self.dataset.probes[listener])

    def complete(self, emitter: int, listener: int, late: _Responses) -> _Responses:
        """(yaw, ear, sample) the complete response, from the late reverberation."""
        return late + self.direct(emitter, listener) + self.first_reflections(emitter, listener)


class References:
    """The responses of a dataset's pairs in one of the TAKES. They are heard through the dataset's own head and yaws,
    unless others are given: `heads` are yaws (head,) of level heads, or orientations (head, 4). Several threads may use
    one."""

    def __init__(
        self,
        dataset: Dataset,
        take: str = TAKES[0],
        *,
        filters: HeadFilters | None = None,
        heads: _Floats | None = None,
    ) -> None:
        self._dataset = dataset
        self.take = take
        self._geometric = GeometricSound(dataset, filters, heads)
        mirrored = MirroredReflections(dataset.scenes, dataset.effects, dataset.probes)
        self._late = LateSound(mirrored, dataset.seed, self._geometric.synthesis)

    def reflected(self, emitter: int, listener: int) -> _Responses:
        """(head, ear, sample) the late reverberation, which a field predicts."""
        (energy,) = self._dataset.read_energy(np.array([(emitter, listener)]), self.take)
        return self._late.response(emitter, listener, TAKES.index(self.take), energy)

    def complete(self, emitter: int, listener: int) -> _Responses:
        """(head, ear, sample) the late reverberation with direct sound and first reflections."""
        return self._geometric.complete(emitter, listener, self.reflected(emitter, listener))

    def ends(self, pair: int) -> tuple[int, int]:
        """Probe numbers of the emitter and the listener of a pair, by its flat index emitter * probes + listener."""
        return divmod(int(pair), len(self._dataset.probes))

    def geometric(self, pair: int) -> _Responses:
        """(head, ear, sample) direct sound and first reflections of a pair, by its flat index."""
        ends = self.ends(pair)
        return self._geometric.direct(*ends) + self._geometric.first_reflections(*ends)

    def __getitem__(self, pair: int) -> _Responses:
        """(head, ear, sample) the complete response of a pair, by its flat index."""
        return self.complete(*self.ends(pair))
