"""The simulation of responses between the probes of a scene, emitter by emitter, by a simulation plan.

Axes: energy (direction, band, bin), responses (yaw, ear, sample); sample 0 is the emission. The same seed and plan give
the same numbers, in whatever order and process emitters are simulated.
"""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from time import process_time, thread_time

import numpy as np
import numpy.typing as npt

from server.rendering.hrtf import kemar
from training.data.dataset import GEOMETRIC_ORDER, SPEED_OF_SOUND, TAKES, OwnResponse, own_duration_s
from training.data.scene_file import SceneFile
from training.data.shared_tail import SharedTail, shared_power
from training.data.simulation_plan import SimulationPlan
from training.simulation.half_precision import to_half
from training.simulation.rays import sphere_directions
from training.simulation.synthesis import BinauralSynthesis
from training.simulation.tail_noise import draw_tail
from training.simulation.tracing import RoomTracer

_Floats = npt.NDArray[np.float64]
_Singles = npt.NDArray[np.float32]

# The shared tail's decay and directions are measured between this many probes.
_TAIL_PROBES = 8


@dataclass(frozen=True)
class PairSimulation:
    """Simulates pairs of `probes` (probe, 3) at `yaws` (yaw,), in radians. `tail` is the tail that all receivers share,
    or None if each has its own. `prepare` makes a simulation, in `prepared_s` seconds of one core. Several threads may
    use one."""

    scene: SceneFile
    probes: _Floats
    yaws: _Floats
    seed: int
    plan: SimulationPlan
    tail: SharedTail | None = None
    prepared_s: float = 0.0

    @classmethod
    def prepare(
        cls,
        scene: SceneFile,
        probes: _Floats,
        yaws: _Floats,
        *,
        seed: int,
        plan: SimulationPlan,
        most_tail_rays: int | None = None,
    ) -> "PairSimulation":
        """Prepare a simulation. With `most_tail_rays`, the tail is traced with at most this many rays, to predict how
        long all of them would take."""
        began_s = process_time()
        simulation = cls(scene, probes, yaws, seed, plan)
        if plan.tail_start_s is None:
            return simulation
        generators = [np.random.default_rng([seed, 3, take]) for take in range(len(TAKES))]
        with ThreadPoolExecutor(len(TAKES)) as pool:
            rays = min(plan.tail_rays, most_tail_rays or plan.tail_rays)
            traced = pool.map(partial(_tail_energy, scene, probes, replace(plan, tail_rays=rays)), generators)
            synthesis = simulation._synthesis  # loads the head in the meantime
            energies, seconds = zip(*traced, strict=True)
        noise = np.random.default_rng([seed, 4])
        tail = draw_tail(synthesis, np.stack(energies), start_s=plan.tail_start_s, rng=noise)
        of_the_rest_s = sum(seconds) * (plan.tail_rays / rays - 1)
        return replace(simulation, tail=tail, prepared_s=process_time() - began_s + of_the_rest_s)

    def take(
        self, emitter: int, listeners: npt.NDArray[np.integer], take: int
    ) -> Iterator[tuple[int, _Singles, _Singles]]:
        """Yield each listener, the energy from which its diffuse sound is drawn, and its late reverberation."""
        for listener, energy, own in self.own(emitter, listeners, take):
            joined = energy if self.tail is None else self.tail.join(take, energy)
            yield listener, joined, self.whole(take, own)

    def whole(self, take: int, own: OwnResponse) -> _Singles:
        """The whole response of a listener: its own part and the shared tail."""
        if self.tail is None:
            return own.samples.astype(np.float32)
        return self.tail.extend(take, own.samples, own.tail_begin)

    def own(
        self, emitter: int, listeners: npt.NDArray[np.integer], take: int
    ) -> Iterator[tuple[int, _Singles, OwnResponse]]:
        """Yield each listener with its energy and its response; with a shared tail, only the part before it.

        The takes (`dataset.TAKES`) are independent. Before the tail, the noise depends on pair and take only, so the
        responses of two plans differ only by the plans' effects.
        """
        place, receivers = self.probes[emitter], self.probes[listeners]
        images = self._tracer(receivers).images(place)
        energies = self.energies(emitter, listeners, np.random.default_rng([self.seed, 2, emitter, take]))
        onsets_s = self.scene.geometry.floor_plan.path_length_m(place, receivers) / SPEED_OF_SOUND
        for row, listener in enumerate(map(int, listeners)):
            rng = np.random.default_rng([self.seed, 5, emitter, take, listener])
            response = self._own_synthesis.specular(*images[row], receivers[row])
            if self.plan.rays:
                late = self._own_synthesis.late(energies[row], onsets_s[row], rng)
                late *= self._own_amplitude
                response += late
            begin = 0 if self.tail is None else self.tail.begin(rng)
            yield listener, energies[row], OwnResponse(to_half(response), begin)

    def energies(
        self, emitter: int, listeners: npt.NDArray[np.integer], rng: np.random.Generator
    ) -> npt.NDArray[np.float32]:
        """(listener, direction, band, bin) energies of each listener's own diffuse sound."""
        tracer = self._tracer(self.probes[listeners], self._own_s)
        return tracer.energy(self.probes[emitter], rays=self.plan.rays, rng=rng)

    def _tracer(self, receivers: _Floats, duration_s: float | None = None) -> RoomTracer:
        return RoomTracer.of(self.scene, self.plan, receivers, duration_s=duration_s, least_order=GEOMETRIC_ORDER + 1)

    @cached_property
    def _own_s(self) -> float:
        return own_duration_s(self.scene, self.plan)

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
        """(sample,) the gain of a listener's own response: one, then a fade-out at the start of the shared tail."""
        times_s = np.arange(self._own_synthesis.samples) / self.scene.simulation.sample_rate
        if self.plan.tail_start_s is None:
            return np.ones(len(times_s), dtype=np.float32)
        return np.sqrt(1 - shared_power(times_s, self.plan.tail_start_s)).astype(np.float32)


def _tail_energy(
    scene: SceneFile, probes: _Floats, plan: SimulationPlan, rng: np.random.Generator
) -> tuple[_Floats, float]:
    """The mean energy (direction, band, bin) between pairs of probes all over the room, and the time of its computation
    in seconds of one core."""
    began_s = thread_time()
    some = probes[np.unique(np.linspace(0, len(probes) - 1, _TAIL_PROBES).astype(int))]
    rays = -(-plan.tail_rays // len(some))
    means = [
        RoomTracer.of(scene, plan, np.delete(some, emitter, axis=0))
        .energy(place, rays=rays, rng=rng)
        .mean(axis=0, dtype=np.float64)
        for emitter, place in enumerate(some)
    ]
    return np.asarray(np.mean(means, axis=0)), thread_time() - began_s
