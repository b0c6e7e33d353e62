"""Where responses were measured: the geometry that a field is given before training."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import FloorPlan
from server.acoustics.sound_path import PlanPathFinder, SoundPathFinder
from training.data.dataset import SPEED_OF_SOUND
from training.data.responses import ResponseSet
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
    def throughout(cls, plan: FloorPlan) -> "Reach":
        corners = np.asarray(plan.corners, dtype=np.float64)
        return cls(np.array([*corners.min(axis=0), 0.0]), np.array([*corners.max(axis=0), plan.height_m]), _NEAREST_M)


@dataclass(frozen=True)
class Site:
    """`low` and `high` (3,) enclose all positions, in metres. `plan` is the floor plan; if it is unknown, it is a box
    around the positions, in which all points see each other. `yaws` (yaw,) are the measured head orientations,
    ascending in [0, 2 pi). `listener_axes` and `emitter_axes` are the coordinates that vary at that end; x and y are
    always among them."""

    plan: FloorPlan
    low: npt.NDArray[np.float64]
    high: npt.NDArray[np.float64]
    yaws: npt.NDArray[np.float64]
    listener_axes: tuple[int, ...]
    emitter_axes: tuple[int, ...]

    @cached_property
    def _finder(self) -> SoundPathFinder:
        return PlanPathFinder(self.plan, SPEED_OF_SOUND)

    def paths(self, listeners: npt.NDArray[np.floating], emitters: npt.NDArray[np.floating]) -> npt.NDArray[np.float32]:
        """Describe the shortest paths of pairs, (B, 3) and (B, 3), as a field is told of them."""
        return self._finder.describe(listeners, emitters).described

    @classmethod
    def of(cls, responses: ResponseSet) -> "Site":
        ends = responses.listener, responses.emitter
        positions = np.concatenate(ends)
        low, high = positions.min(axis=0), positions.max(axis=0)
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
        axes = [(0, 1, 2) if np.ptp(end[:, 2]) > _MOVES_M else (0, 1) for end in ends]
        # Rounded, so that a heading that was stored as slightly different floats counts once.
        yaws = np.unique(np.round(np.remainder(responses.yaw, 2 * np.pi), 6))
        headings = np.asarray(yaws[yaws < 2 * np.pi - 1e-5], np.float64)
        return cls(plan, low, high, headings, axes[0], axes[1])
