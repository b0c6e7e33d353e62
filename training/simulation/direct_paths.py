"""The direct sound of a pair, as the renderer computes it: a straight path in sight, otherwise a path around corners,
and a path through thin walls.

Each path is given as an image source: (image, xyz) apparent positions and (image, band) pressures at the receiver.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.decibels import db_to_amplitude
from server.acoustics.geometry import FloorPlan
from server.acoustics.sound_path import PlanPathFinder, SoundPathFinder
from server.acoustics.transmission import transmission_loss_db, walls_between
from server.scene.manifest import Air
from training.data.dataset import SPEED_OF_SOUND
from training.data.scene_file import SceneFile
from training.data.simulation_plan import SimulationPlan
from training.simulation.tracing import free_field_amplitude

_Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class DirectPaths:
    """Finds the direct sound of pairs. `finder` is None without diffraction; `wall_loss_db` (band,) is None without
    transmission."""

    floor_plan: FloorPlan
    air: Air | None
    finder: SoundPathFinder | None
    wall_loss_db: _Floats | None

    @classmethod
    def of(cls, scene: SceneFile, plan: SimulationPlan) -> "DirectPaths":
        floor_plan = scene.geometry.floor_plan
        mass = scene.geometry.materials.walls.surface_mass_kg_m2
        return cls(
            floor_plan,
            scene.air if plan.air_absorption else None,
            PlanPathFinder(floor_plan, SPEED_OF_SOUND) if plan.diffraction else None,
            transmission_loss_db(mass, OCTAVE_BANDS_HZ) if plan.transmission and mass is not None else None,
        )

    def images(self, emitter: _Floats, listener: _Floats) -> tuple[_Floats, _Floats]:
        positions, amplitudes = [], []
        is_seen = bool(self.floor_plan.is_visible(emitter, listener))
        straight = free_field_amplitude(np.asarray(np.linalg.norm(emitter - listener), np.float64), self.air)
        if self.finder is not None:
            paths = self.finder.find(listener, emitter[None])
            positions.append(listener + paths.length_m[0] * paths.arrival[0])
            bent = free_field_amplitude(paths.length_m[0], self.air)
            amplitudes.append(bent * db_to_amplitude(paths.screen_db[0]))
        elif is_seen:
            positions.append(emitter)
            amplitudes.append(straight)
        if self.wall_loss_db is not None and not is_seen:
            walls = walls_between(self.floor_plan, emitter, listener)
            positions.append(emitter)
            amplitudes.append(straight * db_to_amplitude(-walls * self.wall_loss_db))
        shape = len(positions), len(OCTAVE_BANDS_HZ)
        return np.reshape(positions, (shape[0], 3)), np.reshape(amplitudes, shape)
