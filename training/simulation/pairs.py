"""Responses between the probes of a scene, emitter by emitter, by the plan of what its simulation calls for.

Axes: energy (direction, band, bin), responses (yaw, ear, sample), sample 0 is emission. The same seed and plan give the
same numbers, in whatever order and process emitters are simulated.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from server.whole_field import kemar
from training.dataset import GEOMETRIC_ORDER, SPEED_OF_SOUND
from training.scene_file import HISTOGRAM_BIN_S, SceneFile
from training.simulation.half_precision import to_half
from training.simulation.plan import SimulationPlan
from training.simulation.rays import sphere_directions
from training.simulation.shared_tail import FADE_S, SharedTail, joined, shared_power
from training.simulation.synthesis import BinauralSynthesis
from training.simulation.tracing import RoomTracer

_Floats = npt.NDArray[np.float64]
_Singles = npt.NDArray[np.float32]
_Halves = npt.NDArray[np.float16]

# So many tell how late sound decays, and where it comes from.
_TAIL_PROBES = 8
TAKES = 2
"""The second is for the repeatability of the first."""


@dataclass(frozen=True)
class PairSimulation:
    """`probes` (probe, 3) and `yaws` (yaw,), radians; `tails` (take, direction, band, bin) is the late energy that all
    receivers share, None where each has its own. `prepare` traces it."""

    scene: SceneFile
    probes: _Floats
    yaws: _Floats
    seed: int
    plan: SimulationPlan
    tails: _Floats | None

    @classmethod
    def prepare(
        cls, scene: SceneFile, probes: _Floats, yaws: _Floats, *, seed: int, plan: SimulationPlan
    ) -> "PairSimulation":
        tails = None
        if plan.tail_start_s is not None:
            generators = (np.random.default_rng([seed, 3, take]) for take in range(TAKES))
            tails = np.stack([_tail_energy(scene, probes, plan, rng) for rng in generators])
        return cls(scene, probes, yaws, seed, plan, tails)

    def take(
        self, emitter: int, listeners: npt.NDArray[np.integer], take: int
    ) -> Iterator[tuple[int, _Singles, _Halves]]:
        """Each listener with the energy that its diffuse sound is drawn from, and its response without what is left to
        geometry. The TAKES takes are independent. The noise is that of the pair and the take, whatever the plan, until
        a shared tail sets in: what a plan changes there is told from its own doing, and not from two draws."""
        place, receivers = self.probes[emitter], self.probes[listeners]
        images = self._tracer(receivers).images(place)
        energies = self.energies(emitter, listeners, np.random.default_rng([self.seed, 2, emitter, take]))
        tail = self._tail
        onsets_s = self.scene.geometry.floor_plan.path_length_m(place, receivers) / SPEED_OF_SOUND
        for row, listener in enumerate(map(int, listeners)):
            rng = np.random.default_rng([self.seed, 5, emitter, take, listener])
            energy = energies[row]
            response = self._synthesis.specular(*images[row], receivers[row])
            if self.plan.rays:
                own = self._own_synthesis.late(energy, onsets_s[row], rng)
                own *= self._own_amplitude
                response[..., : own.shape[-1]] += own
            if tail is not None:
                tail.add(take, response, rng)
                energy = joined(energy, tail.energies[take], tail.start_s)
            yield listener, energy, to_half(response)

    def energies(
        self, emitter: int, listeners: npt.NDArray[np.integer], rng: np.random.Generator
    ) -> npt.NDArray[np.float32]:
        """(listener, direction, band, bin) of the diffuse sound that is each listener's own."""
        tracer = self._tracer(self.probes[listeners], self._own_s)
        return tracer.energy(self.probes[emitter], rays=self.plan.rays, rng=rng)

    def _tracer(self, receivers: _Floats, duration_s: float | None = None) -> RoomTracer:
        return RoomTracer.of(self.scene, self.plan, receivers, duration_s=duration_s, least_order=GEOMETRIC_ORDER + 1)

    @cached_property
    def _own_s(self) -> float:
        """How much of a receiver's diffuse sound is its own, in whole bins."""
        start_s, duration_s = self.plan.tail_start_s, self.scene.simulation.duration_s
        if start_s is None:
            return duration_s
        return HISTOGRAM_BIN_S * math.ceil((start_s + FADE_S) / HISTOGRAM_BIN_S)

    @cached_property
    def _synthesis(self) -> BinauralSynthesis:
        settings = self.scene.simulation
        directions = sphere_directions(settings.arrival_directions)
        samples = round(settings.duration_s * settings.sample_rate)
        return BinauralSynthesis(kemar(settings.sample_rate), directions, self.yaws, samples)

    @cached_property
    def _own_synthesis(self) -> BinauralSynthesis:
        samples = round(self._own_s * self.scene.simulation.sample_rate)
        return replace(self._synthesis, samples=samples)

    @cached_property
    def _own_amplitude(self) -> _Singles:
        """(sample,) one until the shared tail sets in."""
        times_s = np.arange(self._own_synthesis.samples) / self.scene.simulation.sample_rate
        if self.plan.tail_start_s is None:
            return np.ones(len(times_s), dtype=np.float32)
        return np.sqrt(1 - shared_power(times_s, self.plan.tail_start_s)).astype(np.float32)

    @cached_property
    def _tail(self) -> SharedTail | None:
        if self.plan.tail_start_s is None or self.tails is None:
            return None
        rng = np.random.default_rng([self.seed, 4])
        return SharedTail(self._synthesis, self.tails, start_s=self.plan.tail_start_s, rng=rng)


def _tail_energy(scene: SceneFile, probes: _Floats, plan: SimulationPlan, rng: np.random.Generator) -> _Floats:
    """(direction, band, bin) mean over pairs of probes all over the room."""
    some = probes[np.unique(np.linspace(0, len(probes) - 1, _TAIL_PROBES).astype(int))]
    rays = -(-plan.tail_rays // len(some))
    means = [
        RoomTracer.of(scene, plan, np.delete(some, emitter, axis=0))
        .energy(place, rays=rays, rng=rng)
        .mean(axis=0, dtype=np.float64)
        for emitter, place in enumerate(some)
    ]
    return np.asarray(np.mean(means, axis=0))
