"""The simulation of late reverberation between the probes of a scene, emitter by emitter, by a simulation plan.

Axes: energy (direction, band, bin), responses (yaw, ear, sample); sample 0 is the emission. The same seed and plan give
the same numbers, in whatever order and process emitters are simulated. The takes (`dataset.TAKES`) are independent.
"""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from time import process_time, thread_time

import numpy as np
import numpy.typing as npt

from server.rendering.hrtf import kemar
from training.data.dataset import own_duration_s
from training.data.door_states import DoorStates, EmitterScenes
from training.data.shared_tail import TRAINING, SharedTail
from training.data.simulated_scene import SimulatedScene
from training.data.simulation_plan import SimulationPlan
from training.simulation.late_sound import LateSound, MirroredReflections
from training.simulation.rays import sphere_directions
from training.simulation.synthesis import BinauralSynthesis
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

    scene: SimulatedScene
    probes: _Floats
    yaws: _Floats
    seed: int
    plan: SimulationPlan
    tail: SharedTail | None = None
    prepared_s: float = 0.0
    states: DoorStates | None = None
    """How the doors stand for each emitter; as at the beginning if None."""

    @classmethod
    def prepare(
        cls,
        scene: SimulatedScene,
        probes: _Floats,
        yaws: _Floats,
        *,
        seed: int,
        plan: SimulationPlan,
        most_tail_rays: int | None = None,
        states: DoorStates | None = None,
    ) -> "PairSimulation":
        """Prepare a simulation. With `most_tail_rays`, the tail is traced with at most this many rays, to predict how
        long all of them would take."""
        began_s = process_time()
        simulation = cls(scene, probes, yaws, seed, plan, states=states)
        if plan.tail_start_s is None:
            return simulation
        generators = [np.random.default_rng([seed, 3, take]) for take in range(TRAINING + 1)]
        with ThreadPoolExecutor(len(generators)) as pool:
            rays = min(plan.tail_rays, most_tail_rays or plan.tail_rays)
            traced = pool.map(partial(_tail_energy, scene, probes, replace(plan, tail_rays=rays)), generators)
            energies, seconds = zip(*traced, strict=True)
        tail = SharedTail.of(np.stack(energies), plan.tail_start_s)
        of_the_rest_s = sum(seconds) * (plan.tail_rays / rays - 1)
        return replace(simulation, tail=tail, prepared_s=process_time() - began_s + of_the_rest_s)

    def take(
        self, emitter: int, listeners: npt.NDArray[np.integer], take: int
    ) -> Iterator[tuple[int, _Singles, _Singles]]:
        """Yield each listener, the energy from which its diffuse sound is drawn, and its late reverberation."""
        energies = self.energies(emitter, listeners, take)
        for listener, own in zip(map(int, listeners), energies, strict=True):
            energy = self.joined(own, take)
            yield listener, energy, self.late_sound.response(emitter, listener, take, energy)

    def joined(self, own: _Singles, take: int) -> _Singles:
        """The energy of a whole response from a listener's `own`, as that of a held-out pair."""
        return own if self.tail is None else self.tail.join(take, own)

    def energies(self, emitter: int, listeners: npt.NDArray[np.integer], take: int) -> npt.NDArray[np.float32]:
        """(listener, direction, band, bin) energies of each listener's own diffuse sound; with a shared tail, only of
        the part before it."""
        tracer = RoomTracer.of(
            self.scenes.of(emitter), self.plan, self.probes[listeners], duration_s=own_duration_s(self.scene, self.plan)
        )
        rng = np.random.default_rng([self.seed, 2, emitter, take])
        return tracer.energy(self.probes[emitter], rays=self.plan.rays, rng=rng)

    @cached_property
    def scenes(self) -> EmitterScenes:
        return EmitterScenes(self.scene, self.states or DoorStates.none(len(self.probes)))

    @cached_property
    def late_sound(self) -> LateSound:
        """The responses of these energies."""
        settings = self.scene.simulation
        directions = sphere_directions(settings.arrival_directions)
        samples = round(settings.duration_s * settings.sample_rate)
        synthesis = BinauralSynthesis(kemar(settings.sample_rate), directions, self.yaws, samples)
        return LateSound(MirroredReflections(self.scenes, self.plan, self.probes), self.seed, synthesis)


def _tail_energy(
    scene: SimulatedScene, probes: _Floats, plan: SimulationPlan, rng: np.random.Generator
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
