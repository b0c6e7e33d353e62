"""The scene file (TOML) that describes a place, and the probe positions that follow from it."""

import math
import tomllib
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
import numpy.typing as npt
from pydantic import (
    AfterValidator,
    Field,
    SerializerFunctionWrapHandler,
    ValidationError,
    field_validator,
    model_serializer,
    model_validator,
)

from server.acoustics.geometry import Points
from server.core.errors import NafirError
from server.scene.effects import EffectName
from server.scene.geometry import Geometry, Strict
from server.scene.limits import HIGHEST_RATE_HZ, LOWEST_RATE_HZ, MOST_SAMPLES
from server.scene.manifest import Air, Start
from training.data.limits import FEWEST_LISTENERS, FEWEST_PROBES, FEWEST_RAYS, MOST_RAYS
from training.data.scene_openings import faults_of
from training.data.simulation_plan import SimulatedEffect

HISTOGRAM_BIN_S = 0.004

_DRAWS_PER_CELL = 32
MOST_CELLS = 100_000
"""The most cells of the grids around a place, many of which may lie outside the walls."""
CELLS_PER_BATCH = 256
LONGEST_SIDE_M, SHORTEST_SIDE_M = 1_000.0, 0.5
TALLEST_M = 200.0
"""The tallest halls have 160 m, and the longest some 500 m."""
CLEARANCE_M = 0.05


def _known_effects(effects: dict[str, bool]) -> dict[str, bool]:
    known = list(dict.fromkeys([*EffectName, *SimulatedEffect]))
    for name in effects:
        if name not in known:
            raise ValueError(f"there is no effect {name!r}, only {', '.join(known)}")
    return effects


NamedEffects = Annotated[dict[str, bool], AfterValidator(_known_effects)]
"""Effects that are on or off, whatever the plans of rendering and simulation say."""
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class SceneFileError(NafirError):
    """A scene file that cannot be used. The message names the file and the field at fault."""


class Probes(Strict):
    """A jittered grid of positions, each of which serves as listener and as emitter, and one more in the middle of each
    opening. Around each there is room for a sphere of radius CLEARANCE_M that counts rays."""

    spacing_m: Annotated[float, Field(ge=0.001, le=LONGEST_SIDE_M, allow_inf_nan=False)]
    jitter_m: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    wall_clearance_m: Annotated[float, Field(ge=CLEARANCE_M, allow_inf_nan=False)]
    heights_m: tuple[Positive, Positive]

    @model_validator(mode="after")
    def _stay_in_their_cells(self) -> Self:
        if self.jitter_m > self.spacing_m / 2:
            raise ValueError(f"jitter_m: must be at most half of spacing_m, {self.spacing_m / 2:g}")
        return self


class Simulation(Strict):
    """Parameters of the simulation. `yaws` is at most 360 because listeners do not hear a head turn by less than one
    degree (Mills, J. Acoust. Soc. Am. 30, 1958). `arrival_directions` beyond the number that a head was measured in add
    nothing. The random error of `rays` falls with the square root of their number: a hundred times the usual number has
    a tenth of an error that is inaudible already. With `listeners`, each emitter is heard at so many of the other
    probes, drawn at random, in place of all."""

    sample_rate: Annotated[int, Field(ge=LOWEST_RATE_HZ, le=HIGHEST_RATE_HZ)]
    duration_s: Annotated[float, Field(ge=0.25, allow_inf_nan=False)]
    yaws: Annotated[int, Field(ge=1, le=360)]
    rays: Annotated[int, Field(ge=FEWEST_RAYS, le=MOST_RAYS)]
    image_order: Annotated[int, Field(ge=1, le=6)]
    arrival_directions: Annotated[int, Field(ge=6, le=1_000)]
    held_out_share: Annotated[float, Field(gt=0, lt=0.5)]
    listeners: Annotated[int, Field(ge=FEWEST_LISTENERS)] | None = None

    @field_validator("duration_s")
    @classmethod
    def _is_in_seconds(cls, duration_s: float) -> float:
        longest_s = MOST_SAMPLES / LOWEST_RATE_HZ
        if duration_s > longest_s:
            raise ValueError(f"at most {longest_s:g} s, and less at higher sample rates; is {duration_s:g} in ms?")
        return duration_s

    @model_validator(mode="after")
    def _fits_into_a_bundle(self) -> Self:
        if self.samples > MOST_SAMPLES:
            raise ValueError(
                f"duration_s: {self.duration_s:g} s at {self.sample_rate} Hz are {self.samples:,} samples, and a "
                f"bundle holds {MOST_SAMPLES:,}: {MOST_SAMPLES / self.sample_rate:g} s"
            )
        return self

    @model_serializer(mode="wrap")
    def _without_what_is_usual(self, serialise: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """A scene that does not say `listeners` is the same as in versions that did not know them."""
        said: dict[str, Any] = serialise(self)
        if self.listeners is None:
            said.pop("listeners", None)
        return said

    @property
    def samples(self) -> int:
        return round(self.duration_s * self.sample_rate)

    def listeners_of(self, probes: int) -> int:
        """How many listeners an emitter has among so many probes."""
        return max(0, min(probes - 1, self.listeners or probes))

    @property
    def histogram_bins(self) -> int:
        """Number of time bins in which the energy of rays is collected."""
        return round(self.duration_s / HISTOGRAM_BIN_S)


class SceneFile(Strict):
    """A whole scene file; `training/scenes/` has annotated examples."""

    id: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]*$")]
    name: str
    description: str
    geometry: Geometry
    air: Air = Air()
    start: Start
    probes: Probes
    simulation: Simulation
    effects: NamedEffects = Field(default_factory=dict)

    @property
    def identity(self) -> dict[str, Any]:
        """All that the scene says, as JSON has it."""
        return self.model_dump(mode="json")

    @classmethod
    def read(cls, path: Path) -> "SceneFile":
        """Raises SceneFileError naming the file and the first field at fault."""
        try:
            content = tomllib.loads(path.read_text(encoding="utf-8"))
            if isinstance(content.get("geometry"), dict) and "mesh" in content["geometry"]:
                raise SceneFileError(f"{path}: geometry.mesh: is an imported level, and this takes a floor plan")
            return cls.model_validate(content)
        except OSError as exc:
            raise SceneFileError(f"{path}: cannot be read: {exc.strerror}") from exc
        except ValidationError as exc:
            first = exc.errors()[0]
            place = "".join(f"{part}: " for part in [".".join(map(str, first["loc"]))] if part)
            raise SceneFileError(f"{path}: {place}{first['msg'].removeprefix('Value error, ')}") from exc
        except (ValueError, RecursionError) as exc:  # numbers of thousands of digits, and nesting without end
            raise SceneFileError(f"{path}: not TOML: {exc}") from exc

    @model_validator(mode="after")
    def _is_a_room(self) -> Self:
        """Checks that sizes are plausible in metres."""
        sides = {"corners": max(self.plan_extent_m), "height_m": self.geometry.height_m}
        for (name, side_m), longest_m in zip(sides.items(), (LONGEST_SIDE_M, TALLEST_M), strict=True):
            if side_m > longest_m:
                limit = f"{side_m:,.6g} m, and at most {longest_m:,g} m"
                raise ValueError(f"geometry.{name}: {limit}: is it in centimetres or millimetres?")
        narrowest_m = min(*self.plan_extent_m, self.geometry.height_m)
        if narrowest_m < SHORTEST_SIDE_M:
            limit = f"{narrowest_m:.3g} m from side to side, and at least {SHORTEST_SIDE_M:g} m"
            raise ValueError(f"geometry: {limit}: is it in kilometres?")
        return self

    @model_validator(mode="after")
    def _fits_into_the_room(self) -> Self:
        """Refuses here what would otherwise be found at export, after hours of simulation and training."""
        plan, (low, high) = self.geometry.floor_plan, self.probes.heights_m
        if not CLEARANCE_M <= low < high <= plan.height_m - CLEARANCE_M:
            raise ValueError(
                f"probes.heights_m: {low:g} to {high:g} m must rise, from {CLEARANCE_M:g} m at least, and stay "
                f"{CLEARANCE_M:g} m below geometry.height_m, {plan.height_m:g} m"
            )
        for name in ("listener", "emitter"):
            position = getattr(self.start, name)
            if not plan.contains(np.array((*position[:2], low))):
                raise ValueError(f"start.{name}: ({position[0]:g}, {position[1]:g}) is outside of the walls")
            if not low <= position[2] <= high:
                within = f"within probes.heights_m, {low:g} to {high:g} m"
                raise ValueError(f"start.{name}: its height, {position[2]:g} m, must be {within}")
        if not -360 <= self.start.listener_yaw_deg <= 360:
            raise ValueError("start.listener_yaw_deg: must be from -360 to 360 degrees")
        return self

    @model_validator(mode="after")
    def _opens_between_its_walls(self) -> Self:
        faults = faults_of(self.geometry)
        if faults:
            raise ValueError(f"geometry.{faults[0]}")
        return self

    def path_length_m(self, a: Points, b: Points) -> npt.NDArray[np.float64]:
        """(...,) lengths of the shortest paths of sound between points; straight ones where there is none."""
        return self.geometry.floor_plan.path_length_m(a, b)

    @property
    def plan_extent_m(self) -> tuple[float, float]:
        """Size of the floor plan along x and y."""
        x, y = np.ptp(self.geometry.corners, axis=0).tolist()
        return x, y

    @property
    def _cells(self) -> tuple[int, int]:
        columns, rows = (max(1, round(side_m / self.probes.spacing_m)) for side_m in self.plan_extent_m)
        return columns, rows

    @property
    def grid_cells(self) -> int:
        """Number of cells in the grid of probes; cells outside the walls get no probe."""
        return math.prod(self._cells)

    def probe_positions(self, seed: int) -> npt.NDArray[np.float64]:
        """(probe, 3) positions inside the walls; the same for the same seed."""
        rng = np.random.default_rng([seed, 0])
        plan, grid = self.geometry.floor_plan, self.probes
        low, high = np.min(plan.corners, axis=0), np.max(plan.corners, axis=0)
        cells = np.array(self._cells)
        size = (high - low) / cells
        column, row = np.meshgrid(np.arange(cells[0]), np.arange(cells[1]), indexing="ij")
        centres = low + (np.stack([column.ravel(), row.ravel()], axis=-1) + 0.5) * size
        # Each cell takes its first draw that is clear of the walls, so that cells along a wall have probes too.
        draws = centres[:, None] + rng.uniform(-grid.jitter_m, grid.jitter_m, (len(centres), _DRAWS_PER_CELL, 2))
        clear = np.zeros(draws.shape[:2], dtype=np.bool_)
        for begin in range(0, len(draws), CELLS_PER_BATCH):
            some = slice(begin, begin + CELLS_PER_BATCH)
            on_floor = np.concatenate([draws[some], np.zeros((*draws[some].shape[:2], 1))], axis=-1)
            clear[some] = plan.contains(on_floor) & (plan.wall_distance_m(on_floor) >= grid.wall_clearance_m)
        first = np.argmax(clear, axis=1)
        openings = np.asarray([opening.centre for opening in self.geometry.openings]).reshape(-1, 2)
        spots = np.concatenate([draws[np.arange(len(draws)), first][clear.any(axis=1)], openings])
        if len(spots) < FEWEST_PROBES:
            raise SceneFileError(
                f"{self.id}: probes.spacing_m: fewer than {FEWEST_PROBES} probes fit into the room, "
                f"{grid.spacing_m:g} m apart and {grid.wall_clearance_m:g} m from its walls (probes.wall_clearance_m)"
            )
        shuffled = rng.permutation(len(spots)) + 0.5
        heights = np.interp(shuffled / len(spots), (0, 1), grid.heights_m)
        return np.column_stack([spots, heights])
