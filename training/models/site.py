"""Where responses were measured: the geometry that a field is given before training."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import FloorPlan
from server.acoustics.mesh_plan import floors_of
from server.acoustics.sound_path import DESCRIPTION, SoundPathFinder
from server.acoustics.surroundings import PlanSurroundings, Surroundings
from training.data.dataset import SPEED_OF_SOUND
from training.data.door_states import EmitterScenes, alike
from training.data.levels.level_scene import LevelScene
from training.data.responses import ResponseSet
from training.models.doorways import Doorways
from training.simulation.responses import SimulatedResponses

_MARGIN_M = 0.5
_MOVES_M = 0.01
_NEAREST_M = 0.25


@dataclass(frozen=True)
class Reach:
    """The poses that a field is valid for: positions between `low` and `high` (3,), and listener and emitter at least
    `nearest_m` from each other. Metres."""

    low: npt.NDArray[np.float64]
    high: npt.NDArray[np.float64]
    nearest_m: float

    @classmethod
    def of(cls, responses: ResponseSet) -> "Reach":
        listener, emitter = responses.listener[~responses.held_out], responses.emitter[~responses.held_out]
        positions, distances_m = np.concatenate([listener, emitter]), np.linalg.norm(listener - emitter, axis=-1)
        return cls(positions.min(axis=0), positions.max(axis=0), max(float(distances_m.min()), _NEAREST_M))

    @classmethod
    def throughout(cls, extent: "Extent") -> "Reach":
        return cls(extent.low, extent.high, _NEAREST_M)


@dataclass(frozen=True)
class Extent:
    """The box of a place from `low` to `high` (3,), in metres. `floors_m` are the heights of its floors, where a field
    is to tell storeys apart; empty for a floor plan. `hides` says whether places are hidden from each other."""

    low: npt.NDArray[np.float64]
    high: npt.NDArray[np.float64]
    hides: bool
    floors_m: tuple[float, ...] = ()
    doors: int = 0
    """The number of doors whose openness a field is told."""
    doorways: Doorways | None = None
    """Which of these doors are between which places."""

    @classmethod
    def of_plan(cls, plan: FloorPlan) -> "Extent":
        corners = np.asarray(plan.corners, dtype=np.float64)
        low, high = corners.min(axis=0), corners.max(axis=0)
        return cls(np.array([*low, 0.0]), np.array([*high, plan.height_m]), len(plan.bend_corners) > 0)

    @classmethod
    def of_level(cls, level: LevelScene, doors: int = 0) -> "Extent":
        low, high = level.surroundings.bounds_m
        has_obstacles = level.surroundings.has_obstacles
        doorways = Doorways.of_level(level) if doors else None
        return cls(low, high, has_obstacles, tuple(floors_of(level.place.mesh)), doors, doorways)


@dataclass(frozen=True)
class Site:
    """`low` and `high` (3,) enclose all positions, in metres. `extent` and `surroundings` are those of the place; if it
    is unknown, it is a box around the positions, in which all points see each other. `yaws` (yaw,) are the measured
    head orientations, ascending in [0, 2 pi). `listener_axes` and `emitter_axes` are the coordinates that vary at that
    end; x and y are always among them."""

    extent: Extent
    surroundings: Surroundings
    low: npt.NDArray[np.float64]
    high: npt.NDArray[np.float64]
    yaws: npt.NDArray[np.float64]
    listener_axes: tuple[int, ...]
    emitter_axes: tuple[int, ...]
    scenes: EmitterScenes | None = None
    """The place in other states of its doors, if these move."""

    @cached_property
    def _finder(self) -> SoundPathFinder:
        return self.surroundings.sound_paths(SPEED_OF_SOUND)

    def paths(
        self,
        listeners: npt.NDArray[np.floating],
        emitters: npt.NDArray[np.floating],
        openness: npt.NDArray[np.floating] | None = None,
    ) -> npt.NDArray[np.float32]:
        """Describe the shortest paths of pairs, (B, 3) and (B, 3), as a field is told of them: with doors open so far,
        (B, door), or as at the beginning."""
        if openness is None or self.scenes is None:
            return self._finder.describe(listeners, emitters).described
        described = np.empty((len(listeners), DESCRIPTION), np.float32)
        for here in alike(openness):
            scene = self.scenes.at(openness[here[0]])
            assert isinstance(scene, LevelScene)
            described[here] = scene.sound_paths.describe(listeners[here], emitters[here]).described
        return described

    @classmethod
    def of(cls, responses: ResponseSet) -> "Site":
        ends = responses.listener, responses.emitter
        positions = np.concatenate(ends)
        low, high = positions.min(axis=0), positions.max(axis=0)
        scenes = None
        if isinstance(responses, SimulatedResponses) and isinstance(responses.dataset.place, LevelScene):
            level = responses.dataset.place
            has_doors = len(responses.dataset.doors) > 0
            extent = Extent.of_level(level, len(responses.dataset.doors))
            scenes = responses.dataset.scenes if has_doors else None
            surroundings: Surroundings = level.surroundings
            low[:2], high[:2] = extent.low[:2], extent.high[:2]
        else:
            if isinstance(responses, SimulatedResponses):
                plan = responses.dataset.plan
                corners = np.asarray(plan.corners)
                low[:2], high[:2] = corners.min(axis=0), corners.max(axis=0)
            else:
                # guard: places on a line have room around them
                (x, y), (right, top) = low[:2] - _MARGIN_M, high[:2] + _MARGIN_M
                # guard: places on the floor have room above them
                plan = FloorPlan(((x, y), (right, y), (right, top), (x, top)), max(float(high[2]), 0.0) + _MARGIN_M)
                low[:2], high[:2] = (x, y), (right, top)
            extent, surroundings = Extent.of_plan(plan), PlanSurroundings(plan)
        axes = [(0, 1, 2) if np.ptp(end[:, 2]) > _MOVES_M else (0, 1) for end in ends]
        # Rounded, so that a heading that was stored as slightly different floats counts once.
        yaws = np.unique(np.round(np.remainder(responses.yaw, 2 * np.pi), 6))
        headings = np.asarray(yaws[yaws < 2 * np.pi - 1e-5], np.float64)
        return cls(extent, surroundings, low, high, headings, axes[0], axes[1], scenes)
