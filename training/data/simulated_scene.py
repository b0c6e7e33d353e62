"""What a simulation asks of a scene, be it a floor plan (`training.data.scene_file`) or a level
(`training.data.levels.level_scene`)."""

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import Points
from server.scene.manifest import Air
from training.data.scene_file import Simulation

_Floats = npt.NDArray[np.float64]


class SimulatedScene(Protocol):
    """A scene with its settings. Several threads may use one."""

    @property
    def id(self) -> str: ...

    @property
    def air(self) -> Air: ...

    @property
    def simulation(self) -> Simulation: ...

    @property
    def effects(self) -> Mapping[str, bool]:
        """Effects that are on or off, whatever the plans of rendering and simulation say."""

    @property
    def identity(self) -> dict[str, Any]:
        """What tells the scene from any other, as JSON has it."""

    def probe_positions(self, seed: int) -> _Floats:
        """(probe, 3) positions in the air; the same for the same seed."""

    def path_length_m(self, a: Points, b: Points) -> _Floats:
        """(...,) lengths of the shortest paths of sound between points; straight ones where there is none."""
