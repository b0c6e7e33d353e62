"""Simulates floor plans as triangle meshes, and compares them with the plans themselves.

Of every pair, the plan is simulated in several takes, and so is the mesh: whole binaural responses, with the direct
sound and images of one surface that each finds by itself, and rays for all else. The floor is the mean difference
between two takes of the plan, and the error is that between a take of the mesh and one of the plan. If both were the
same simulation, error and floor would differ by chance only. What chance does is known from the same takes: they change
sides at random, many times.

A mesh has images of one surface. Floor plans may have those of more, as many as the scene file says, where meshes have
rays: the mesh is compared with the plan in both ways.

Parameters are those of `server.acoustics.room_parameters`, broadband. Metrics that need a direct sound are of pairs in
sight.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import thread_time
from typing import Final

import numpy as np
import numpy.typing as npt

from server.acoustics.metrics import PARAMETER_METRICS, parameter_errors
from server.acoustics.room_parameters import RoomParameters, measure
from training.data.dataset import GEOMETRIC_ORDER, SPEED_OF_SOUND
from training.data.levels.level_scene import LevelScene
from training.data.scene_file import SceneFile
from training.data.simulated_scene import SimulatedScene
from training.data.simulation_plan import SimulationPlan
from training.simulation.check import GeometricResponses
from training.simulation.pairs import PairSimulation

_Floats = npt.NDArray[np.float64]

SCENES: Final = tuple(
    Path(__file__).parents[1] / "scenes" / f"{name}.toml"
    for name in ("small1", "small2", "medium1", "medium2", "large1", "large2", "apartment")
)
_VALUES: Final[Mapping[str, Callable[[RoomParameters], _Floats]]] = {
    "t60": lambda found: 100 * np.log(found.reverberation_time_s).mean(axis=-1),
    "edt": lambda found: 1e3 * found.early_decay_time_s.mean(axis=-1),
    "c50": lambda found: found.clarity_db.mean(axis=-1),
    "drr": lambda found: found.direct_to_reverberant_db.mean(axis=-1),
    "iacc": lambda found: found.interaural_cross_correlation,
    "level": lambda found: found.level_db.mean(axis=-1),
}
"""(pair,) each parameter in the unit of its metric, the mean over both ears; percent of T60 are hundredths of its
logarithm."""
METRICS: Final = tuple(_VALUES)
_YAW: Final = 0.6


@dataclass(frozen=True)
class Sizes:
    """How much is simulated of each scene."""

    emitters: int = 3
    listeners: int = 4
    takes: int = 4
    rays: int = 10_000

    @property
    def pairs(self) -> int:
        return self.emitters * self.listeners


@dataclass(frozen=True)
class ByMetric:
    """One metric of one scene, in its unit: mean differences of takes, of a mesh from its plan (`error`) and of the
    plan from itself (`floor`), and how much more the mesh has in the mean (`shift`). `ratios` and `shifts` (draw,) are
    what they would be with takes that change sides at random."""

    pairs: int
    error: float
    floor: float
    shift: float
    ratios: _Floats
    shifts: _Floats

    @property
    def ratio(self) -> float:
        return self.error / self.floor


@dataclass(frozen=True)
class Compared:
    """One scene, whose plan has images of up to `image_order` surfaces. `plan_s` and `mesh_s` are seconds of one core
    for tracing to all probes."""

    scene: str
    image_order: int
    probes: int
    in_sight: int
    rays: int
    metrics: Mapping[str, ByMetric]
    plan_s: float
    mesh_s: float

    @property
    def times_as_long(self) -> float:
        return self.mesh_s / self.plan_s


def compare(path: Path, sizes: Sizes, *, seed: int = 0) -> tuple[Compared, Compared]:
    """Simulate the pairs of one scene as a plan and as a mesh. Returns the comparison with images of one surface in
    both, and that with the plan's images of as many as its scene file says. No sound goes through walls: in floor
    plans, reflected sound does not."""
    scene = SceneFile.read(path)
    settings = scene.simulation.model_copy(update={"rays": sizes.rays})
    scene = scene.model_copy(update={"simulation": settings})
    orders = GEOMETRIC_ORDER, GEOMETRIC_ORDER, scene.simulation.image_order
    probes = scene.probe_positions(seed)
    ends = _ends(len(probes), sizes, np.random.default_rng([seed, 20]))
    scenes: tuple[SimulatedScene, ...] = (scene, LevelScene.of_plan(scene), scene)
    simulated = [_Simulated.of(each, order, probes, seed) for each, order in zip(scenes, orders, strict=True)]
    takes = [range(sizes.takes * at, sizes.takes * (at + 1)) for at in range(len(simulated))]
    measured: list[list[list[RoomParameters]]] = [[] for _ in simulated]
    seconds = [0.0] * len(simulated)
    is_seen = []
    for emitter, listeners in ends:
        is_seen.append(scene.geometry.floor_plan.is_visible(probes[emitter], probes[listeners]))
        onsets = scene.path_length_m(probes[emitter], probes[listeners]) / SPEED_OF_SOUND * scene.simulation.sample_rate
        onset = np.repeat(np.round(onsets).astype(int)[:, None], 2, axis=-1)
        for number, (each, of_takes) in enumerate(zip(simulated, takes, strict=True)):
            responses, took_s = each.responses(emitter, listeners, of_takes)
            seconds[number] += took_s
            measured[number].append([measure(take, scene.simulation.sample_rate, onset=onset) for take in responses])
    in_sight = np.concatenate(is_seen)
    plans, meshes, others = ([_joined([found[take] for found in of]) for take in range(sizes.takes)] for of in measured)

    def against(reference: Sequence[RoomParameters], number: int) -> Compared:
        return Compared(
            scene.id,
            orders[number],
            len(probes),
            int(in_sight.sum()),
            scene.simulation.rays,
            _by_metric(reference, meshes, in_sight, sizes, np.random.default_rng([seed, 21, number])),
            seconds[number],
            seconds[1],
        )

    return against(plans, 0), against(others, 2)


@dataclass(frozen=True)
class _Simulated:
    simulation: PairSimulation
    geometric: GeometricResponses

    @classmethod
    def of(cls, scene: SimulatedScene, image_order: int, probes: _Floats, seed: int) -> "_Simulated":
        yaws = np.array([_YAW])
        plan = SimulationPlan.everything(image_order, scene.simulation.rays)
        simulation = PairSimulation.prepare(scene, probes, yaws, seed=seed, plan=plan)
        # Compiles the rays, and finds what a mesh's tracers share.
        brief = SimulationPlan.everything(GEOMETRIC_ORDER, 100)
        PairSimulation.prepare(scene, probes, yaws, seed=seed, plan=brief).energies(0, np.arange(1, 3), 0)
        return cls(simulation, GeometricResponses(scene, plan, probes, yaws))

    def responses(
        self, emitter: int, listeners: npt.NDArray[np.int64], takes: Iterable[int]
    ) -> tuple[list[npt.NDArray[np.float32]], float]:
        """For each take, the whole responses (listener, ear, sample), and the seconds of one core that tracing took, to
        all probes."""
        known = self.geometric.responses(emitter, listeners)[:, 0]
        everyone = np.delete(np.arange(len(self.simulation.probes)), emitter)
        found, seconds = [], 0.0
        for take in takes:
            began_s = thread_time()
            energies = self.simulation.energies(emitter, everyone, take)
            seconds += thread_time() - began_s
            late = [
                self.simulation.late_sound.response(
                    emitter, int(listener), take, energies[int(np.flatnonzero(everyone == listener)[0])]
                )[0]
                for listener in listeners
            ]
            found.append(np.stack(late) + known)
        return found, seconds


def _ends(probes: int, sizes: Sizes, rng: np.random.Generator) -> list[tuple[int, npt.NDArray[np.int64]]]:
    """Emitters, each with its listeners, drawn at random."""
    emitters = rng.permutation(probes)[: sizes.emitters]
    return [(int(each), rng.permutation(np.delete(np.arange(probes), each))[: sizes.listeners]) for each in emitters]


def _joined(parts: Sequence[RoomParameters]) -> RoomParameters:
    """The parameters of all pairs of a take."""
    return RoomParameters(**{name: np.concatenate([vars(part)[name] for part in parts]) for name in vars(parts[0])})


def _by_metric(
    plans: Sequence[RoomParameters],
    meshes: Sequence[RoomParameters],
    in_sight: npt.NDArray[np.bool_],
    sizes: Sizes,
    rng: np.random.Generator,
) -> dict[str, ByMetric]:
    takes = [*plans, *meshes]
    errors = [[parameter_errors(one, other) for other in takes] for one in takes]
    needs_sight = {each.name: each.needs_direct_sound for each in PARAMETER_METRICS}
    found = {}
    for metric, value in _VALUES.items():
        values = np.stack([value(each) for each in takes])
        known = np.isfinite(values).all(axis=0) & (in_sight | (not needs_sight[metric]))
        differences = np.array([[each[metric] for each in row] for row in errors])
        found[metric] = of_takes(*_by_emitter(differences, values, known, sizes), rng)
    return found


def _by_emitter(
    differences: _Floats, values: _Floats, known: npt.NDArray[np.bool_], sizes: Sizes
) -> tuple[_Floats, _Floats, npt.NDArray[np.int64]]:
    """(emitter, take, take) and (emitter, take) means over the pairs of each emitter that are known, and their
    numbers. Pairs of an emitter have rays in common, so chance is not theirs but the emitter's."""
    of_emitter = known.reshape(-1, sizes.listeners)
    counts = of_emitter.sum(axis=1)
    weights = of_emitter / np.maximum(counts, 1)[:, None]

    def mean(of_pairs: _Floats) -> _Floats:
        parted = of_pairs.reshape(*of_pairs.shape[:-1], *of_emitter.shape)
        return np.asarray(np.moveaxis(np.einsum("...el,el->...e", np.where(of_emitter, parted, 0.0), weights), -1, 0))

    both_ways = (differences + differences.swapaxes(0, 1)) / 2  # those of T60 are relative to one of the two
    return mean(both_ways), mean(values), counts


def of_takes(
    differences: _Floats, values: _Floats, counts: npt.NDArray[np.int64], rng: np.random.Generator, *, draws: int = 400
) -> ByMetric:
    """Compare the first half of the takes, the plan's, with the others: mean differences (emitter, take, take) and mean
    values (emitter, take), over `counts` (emitter,) of pairs."""
    emitters, takes = values.shape
    shares = counts / counts.sum()
    within = ~np.eye(takes // 2, dtype=bool)

    def of_order(order: npt.NDArray[np.int64]) -> tuple[float, float, float]:
        """`order` (emitter, take) has the takes that stand for the plan's first."""
        first, second = np.split(order, 2, axis=1)
        rows = np.arange(emitters)[:, None, None]
        error = differences[rows, first[:, :, None], second[:, None, :]].mean(axis=(1, 2)) @ shares
        floor = differences[rows, first[:, :, None], first[:, None, :]][:, within].mean(axis=1) @ shares
        means = [values[rows[:, 0], side].mean(axis=1) @ shares for side in (first, second)]
        return float(error), float(floor), float(means[1] - means[0])

    in_order = np.tile(np.arange(takes), (emitters, 1))
    error, floor, shift = of_order(in_order)
    drawn = np.array([of_order(rng.permuted(in_order, axis=1)) for _ in range(draws)])
    return ByMetric(int(counts.sum()), error, floor, shift, drawn[:, 0] / drawn[:, 1], drawn[:, 2])
