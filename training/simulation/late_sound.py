"""Late reverberation of pairs of probes, drawn from their energies, as any head hears it.

Reflections that are mirrored more often than GEOMETRIC_ORDER are images of the emitter; the rest is noise of the given
energies. Noise depends on seed, pair and take only, and not on the head or on how it is turned.
"""

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from training.data.dataset import GEOMETRIC_ORDER, SPEED_OF_SOUND
from training.data.door_states import EmitterScenes
from training.data.simulation_plan import SimulationPlan
from training.simulation.synthesis import BinauralSynthesis
from training.simulation.tracing import RoomTracer

_Floats = npt.NDArray[np.float64]
_Singles = npt.NDArray[np.float32]
_Images = list[tuple[_Floats, _Floats]]


@dataclass(frozen=True)
class MirroredReflections:
    """The images of emitters at `probes` (probe, xyz) that a field's sound contains. Several threads may use one."""

    scenes: EmitterScenes
    plan: SimulationPlan
    probes: _Floats
    _last: dict[str, tuple[int, _Images]] = field(default_factory=dict)

    def of_pair(self, emitter: int, listener: int) -> tuple[_Floats, _Floats]:
        """Positions (image, xyz), and pressures (image, band) at the listener."""
        found = self._last.get("images")
        if found is None or found[0] != emitter:
            # Images for all listeners take as long as images for one, and pairs come in the order of emitters.
            tracer = RoomTracer.of(self.scenes.of(emitter), self.plan, self.probes, least_order=GEOMETRIC_ORDER + 1)
            found = emitter, tracer.images(self.probes[emitter])
            self._last["images"] = found
        return found[1][listener]


@dataclass(frozen=True)
class LateSound:
    """Draws the late reverberation of pairs with noise of this `seed`, through the head of `synthesis`."""

    mirrored: MirroredReflections
    seed: int
    synthesis: BinauralSynthesis

    def response(self, emitter: int, listener: int, take: int, energy: _Singles) -> _Singles:
        """(head, ear, sample) the response with `energy` (direction, band, bin)."""
        probes = self.mirrored.probes
        place = probes[listener]
        response = self.synthesis.specular(*self.mirrored.of_pair(emitter, listener), place)
        if energy.any():
            onset_m = float(self.mirrored.scenes.of(emitter).path_length_m(probes[emitter], place))
            rng = np.random.default_rng([self.seed, 5, emitter, take, listener])
            response += self.synthesis.late(energy, onset_m / SPEED_OF_SOUND, rng)
        return response

    def turned(self, heads: _Floats) -> "LateSound":
        """The same sound at other heads: yaws (head,), or orientations (head, 4)."""
        return replace(self, synthesis=replace(self.synthesis, heads=heads))
