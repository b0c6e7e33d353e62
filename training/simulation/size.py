"""The size of a simulation, from the numbers of its scene file: a scene that would take too much time or memory is
refused before anything is allocated."""

import math
from dataclasses import dataclass
from functools import cached_property

from server.acoustics.bands import OCTAVE_BANDS_HZ
from training.data.dataset import SPEED_OF_SOUND
from training.data.levels.level_scene import LevelScene
from training.data.limits import MOST_PROBES
from training.data.scene_file import MOST_CELLS, SceneFile, SceneFileError, Simulation

MOST_DATASET_GB = 200.0
MOST_MEMORY_GB = 8.0
"""The most memory for one emitter; each worker simulates one at a time."""
MOST_CORE_MINUTES = 14 * 24 * 60.0
MOST_WALL_SEQUENCES = 3_000_000
"""The most sequences of walls that may mirror a path one after the other; each is tested for every emitter."""

# Measured on a core of 2.5 GHz. They are right to a factor of three, which is enough to refuse a scene.
_HIT_S, _WALL_S, _RECEIVER_S = 60e-9, 3e-9, 5e-9
# Larger values are probably in another unit.
_LARGE_M = 100.0
_LONG_S = 20.0
_DATA = "probes.spacing_m, simulation.arrival_directions or duration_s"


@dataclass(frozen=True)
class SimulationSize:
    """The size of a simulation of everything that the scene file allows. A plan usually needs less."""

    scene: SceneFile

    @cached_property
    def probes(self) -> int:
        """The approximate number of probes."""
        across = self.scene.geometry.floor_plan
        box_m2 = math.prod(self.scene.plan_extent_m)
        return max(3, round(self.scene.grid_cells * across.area_m2 / box_m2) + len(self.scene.geometry.openings))

    @property
    def pairs(self) -> int:
        return _pairs(self.scene.simulation, self.probes)

    @property
    def dataset_gb(self) -> float:
        return _dataset_gb(self.scene.simulation, self.probes)

    @property
    def memory_gb(self) -> float:
        """The memory that a worker needs to simulate one emitter."""
        return _memory_gb(self.scene.simulation, self.probes)

    def sequences_of(self, order: int) -> float:
        """The number of sequences of up to `order` walls that may mirror a path. On average an image is in front of
        half of the walls."""
        walls = len(self.scene.geometry.corners)
        return float(sum(walls * ((walls - 1) / 2) ** (reflections - 1) for reflections in range(1, order + 1)))

    @property
    def wall_sequences(self) -> float:
        """The number of sequences of walls for all images of an emitter."""
        return self.sequences_of(self.scene.simulation.image_order)

    @property
    def core_minutes(self) -> float:
        return self.probes * self.tracing_s / 60

    @property
    def tracing_s(self) -> float:
        """Seconds of one core to trace the rays of one emitter, in both takes."""
        settings, geometry = self.scene.simulation, self.scene.geometry
        hits = settings.rays * settings.duration_s * SPEED_OF_SOUND / self.mean_free_path_m
        heard = settings.listeners_of(self.probes) * (1 + settings.held_out_share)
        return hits * (2 * (_HIT_S + _WALL_S * len(geometry.corners)) + _RECEIVER_S * heard)

    @property
    def mean_free_path_m(self) -> float:
        """The mean free path: four times the volume divided by the surface."""
        plan = self.scene.geometry.floor_plan
        around_m = sum(math.dist(*wall) for wall in plan.walls.tolist())
        return 4 * plan.area_m2 * plan.height_m / (2 * plan.area_m2 + around_m * plan.height_m)

    @property
    def extent(self) -> str:
        """A description of probes, pairs, data and memory."""
        return f"about {_extent(self.scene.simulation, self.probes)}"

    def __str__(self) -> str:
        minutes = self.core_minutes
        takes = f"{_rounded(minutes)} minutes" if minutes < 24 * 60 else f"{minutes / (24 * 60):,.0f} days"
        return f"{self.extent}, and up to {takes} of one core"

    def require_reasonable(self) -> None:
        """Raise SceneFileError, with the field to change, if the scene is too large."""
        checks = (
            (self.scene.grid_cells > MOST_CELLS, f"at most {MOST_CELLS:,} cells of a grid", "probes.spacing_m"),
            (self.probes > MOST_PROBES, f"at most {MOST_PROBES:,} probes", "probes.spacing_m"),
            (
                self.wall_sequences > MOST_WALL_SEQUENCES,
                f"{len(self.scene.geometry.corners)} walls in {self.wall_sequences:,.1g} orders",
                "simulation.image_order",
            ),
            (self.memory_gb > MOST_MEMORY_GB, f"at most {MOST_MEMORY_GB:g} GB of memory", self._largest),
            (self.dataset_gb > MOST_DATASET_GB, f"at most {MOST_DATASET_GB:g} GB of data", self._largest),
            (self.core_minutes > MOST_CORE_MINUTES, "at most two weeks of one core", self._longest),
        )
        for is_too_much, limit, field in checks:
            if is_too_much:
                raise SceneFileError(f"{self.scene.id}: {field}: {limit}, and this is {self}{self._hint}")

    @property
    def _largest(self) -> str:
        """The field that contributes most to the amount of data and memory."""
        settings = self.scene.simulation
        relative_sizes = {
            "probes.spacing_m": self.probes / 100,
            "simulation.arrival_directions": settings.arrival_directions / 24,
            "simulation.duration_s": settings.duration_s,
        }
        return max(relative_sizes, key=lambda name: relative_sizes[name])

    @property
    def _longest(self) -> str:
        """The field that contributes most to the time."""
        settings = self.scene.simulation
        relative_sizes = {
            "simulation.rays": settings.rays / 20_000,
            "probes.spacing_m": self.probes / 100,
            "simulation.duration_s": settings.duration_s,
        }
        return max(relative_sizes, key=lambda name: relative_sizes[name])

    @property
    def _hint(self) -> str:
        size_m = max(*self.scene.plan_extent_m, self.scene.geometry.height_m)
        hints = []
        if size_m > _LARGE_M:
            hints.append(f"a room of {size_m:,.6g} m may be in centimetres")
        if self.scene.simulation.duration_s > _LONG_S:
            hints.append("duration_s is in seconds, not milliseconds")
        return "".join(f"; {hint}" for hint in hints)


def _rounded(value: float) -> str:
    """The value rounded to two digits, but not finer than hundredths."""
    return f"{max(value, 0.01):.2g}" if value < 10 else f"{value:,.0f}"


def _pair_energies(simulation: Simulation) -> int:
    """The number of energies of one pair."""
    return simulation.arrival_directions * len(OCTAVE_BANDS_HZ) * simulation.histogram_bins


def _pairs(simulation: Simulation, probes: int) -> int:
    return probes * simulation.listeners_of(probes)


def _dataset_gb(simulation: Simulation, probes: int) -> float:
    return 2 * _pairs(simulation, probes) * _pair_energies(simulation) * (1 + simulation.held_out_share) / 1e9


def _memory_gb(simulation: Simulation, probes: int) -> float:
    """The memory that a worker needs to simulate one emitter: the energies of its pairs, three times in single
    precision and once in half precision, and 24 bytes for each ray."""
    return (14 * simulation.listeners_of(probes) * _pair_energies(simulation) + 24 * simulation.rays) / 1e9


def _extent(simulation: Simulation, probes: int) -> str:
    data, memory = _rounded(_dataset_gb(simulation, probes)), _rounded(_memory_gb(simulation, probes))
    pairs = _pairs(simulation, probes)
    return f"{probes:,} probes, {pairs:,} pairs, {data} GB of data and {memory} GB of memory per worker"


def level_extent(scene: LevelScene, probes: int) -> str:
    """A description of probes, pairs, data and memory of a level's simulation. Raises SceneFileError, with the field to
    change, if that is too much."""
    limits = (
        (probes > MOST_PROBES, f"at most {MOST_PROBES:,} probes", "probes.spacing_m"),
        (_memory_gb(scene.simulation, probes) > MOST_MEMORY_GB, f"at most {MOST_MEMORY_GB:g} GB of memory", _DATA),
        (_dataset_gb(scene.simulation, probes) > MOST_DATASET_GB, f"at most {MOST_DATASET_GB:g} GB of data", _DATA),
    )
    extent = _extent(scene.simulation, probes)
    for is_too_much, limit, field in limits:
        if is_too_much:
            raise SceneFileError(f"{scene.id}: {field}: {limit}, and this is {extent}")
    return extent
