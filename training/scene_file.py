"""The scene file a person writes (TOML) and the probe positions that follow from it."""

import tomllib
from pathlib import Path
from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import Field, ValidationError, field_validator, model_validator

from server.errors import NafirError
from server.scene.effects import EffectName
from server.scene.geometry import Geometry, Strict
from server.scene.manifest import Air, Start
from training.simulation.plan import SimulatedEffect

HISTOGRAM_BIN_S = 0.004

_DRAWS_PER_CELL = 32
# Two probes make one couple, and that one is held out.
_FEWEST_PROBES = 3

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class SceneFileError(NafirError):
    """A scene file that cannot be used; names the file and the field at fault."""


class Probes(Strict):
    """A jittered grid of positions that serve as listeners and emitters alike, and one in the middle of each
    opening."""

    spacing_m: Positive
    jitter_m: Annotated[float, Field(ge=0)]
    wall_clearance_m: Positive
    heights_m: tuple[Positive, Positive]


class Simulation(Strict):
    sample_rate: Annotated[int, Field(ge=8000, le=96000)]
    duration_s: Annotated[float, Field(ge=0.25, allow_inf_nan=False)]
    yaws: Annotated[int, Field(ge=1)]
    rays: Annotated[int, Field(ge=100)]
    image_order: Annotated[int, Field(ge=1, le=6)]
    arrival_directions: Annotated[int, Field(ge=6)]
    held_out_share: Annotated[float, Field(gt=0, lt=0.5)]

    @property
    def histogram_bins(self) -> int:
        """Of the energy that rays bring, over the duration."""
        return round(self.duration_s / HISTOGRAM_BIN_S)


class SceneFile(Strict):
    """A whole scene file; see `training/scenes/` for annotated ones."""

    id: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]*$")]
    name: str
    description: str
    geometry: Geometry
    air: Air = Air()
    start: Start
    probes: Probes
    simulation: Simulation
    effects: dict[str, bool] = Field(default_factory=dict)
    """On or off, whatever a plan of rendering or simulation would decide."""

    @classmethod
    def read(cls, path: Path) -> "SceneFile":
        """Raises SceneFileError naming the file and the first field at fault."""
        try:
            return cls.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
        except OSError as exc:
            raise SceneFileError(f"{path}: cannot be read: {exc.strerror}") from exc
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as exc:
            raise SceneFileError(f"{path}: not TOML: {exc}") from exc
        except ValidationError as exc:
            first = exc.errors()[0]
            place = "".join(f"{part}: " for part in [".".join(map(str, first["loc"]))] if part)
            raise SceneFileError(f"{path}: {place}{first['msg']}") from exc

    @field_validator("effects")
    @classmethod
    def _are_effects(cls, effects: dict[str, bool]) -> dict[str, bool]:
        known = list(dict.fromkeys([*EffectName, *SimulatedEffect]))
        for name in effects:
            if name not in known:
                raise ValueError(f"there is no effect {name!r}, only {', '.join(known)}")
        return effects

    @model_validator(mode="after")
    def _fits_into_the_room(self) -> "SceneFile":
        """What would otherwise come to light only when hours of simulation and training are to be exported."""
        plan, (low, high) = self.geometry.floor_plan, self.probes.heights_m
        if not low < high < plan.height_m:
            raise ValueError("probes.heights_m: must rise, and stay below geometry.height_m")
        for name in ("listener", "emitter"):
            position = getattr(self.start, name)
            if not plan.contains(np.array(position)) or not low <= position[2] <= high:
                raise ValueError(f"start.{name}: must be in the room, at a height within probes.heights_m")
        for index, opening in enumerate(self.geometry.openings):
            if not plan.contains(np.array((*opening.centre, low))):
                raise ValueError(f"geometry.openings.{index}: its middle must be in the room")
        return self

    def probe_positions(self, seed: int) -> npt.NDArray[np.float64]:
        """(probe, 3) positions inside the walls; the same for the same seed."""
        rng = np.random.default_rng([seed, 0])
        plan, grid = self.geometry.floor_plan, self.probes
        low, high = np.min(plan.corners, axis=0), np.max(plan.corners, axis=0)
        cells = np.maximum(1, np.round((high - low) / grid.spacing_m).astype(int))
        size = (high - low) / cells
        column, row = np.meshgrid(np.arange(cells[0]), np.arange(cells[1]), indexing="ij")
        centres = low + (np.stack([column.ravel(), row.ravel()], axis=-1) + 0.5) * size
        # Several draws per cell, the first clear of the walls wins: cells along a wall keep their probe.
        draws = centres[:, None] + rng.uniform(-grid.jitter_m, grid.jitter_m, (len(centres), _DRAWS_PER_CELL, 2))
        on_floor = np.concatenate([draws, np.zeros((*draws.shape[:2], 1))], axis=-1)
        clear = plan.contains(on_floor) & (plan.wall_distance_m(on_floor) >= grid.wall_clearance_m)
        first = np.argmax(clear, axis=1)
        openings = np.asarray([opening.centre for opening in self.geometry.openings]).reshape(-1, 2)
        spots = np.concatenate([draws[np.arange(len(draws)), first][clear.any(axis=1)], openings])
        if len(spots) < _FEWEST_PROBES:
            raise SceneFileError(f"{self.id}: probes.spacing_m: fewer than {_FEWEST_PROBES} probes fit into the room")
        shuffled = rng.permutation(len(spots)) + 0.5
        heights = np.interp(shuffled / len(spots), (0, 1), grid.heights_m)
        return np.column_stack([spots, heights])
