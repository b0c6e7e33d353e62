"""The direct sound of a pair, as the renderer computes it: a straight path in sight, otherwise a path around corners,
and a path through thin walls.

Each path is given as an image source: (image, xyz) apparent positions and (image, band) pressures at the receiver.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.decibels import db_to_amplitude
from server.acoustics.mesh_reflections import MeshWallLosses
from server.acoustics.sound_path import SoundPathFinder
from server.acoustics.surroundings import PlanSurroundings, Surroundings
from server.acoustics.transmission import PlanWallLosses, WallLosses, transmission_loss_db
from server.scene.manifest import Air
from server.scene.surfaces import wall_losses_db
from training.data.dataset import SPEED_OF_SOUND
from training.data.levels.level_scene import LevelScene
from training.data.scene_file import SceneFile
from training.data.simulated_scene import SimulatedScene
from training.data.simulation_plan import SimulationPlan
from training.simulation.tracing import free_field_amplitude

_Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class DirectPaths:
    """Finds the direct sound of pairs. `finder` is None without diffraction; `walls` are None without transmission."""

    surroundings: Surroundings
    air: Air | None
    finder: SoundPathFinder | None
    walls: WallLosses | None

    @classmethod
    def of(cls, scene: SimulatedScene, plan: SimulationPlan) -> "DirectPaths":
        surroundings: Surroundings
        walls: WallLosses | None
        if isinstance(scene, LevelScene):
            surroundings = scene.surroundings
            walls = MeshWallLosses(surroundings.tree, wall_losses_db(scene.place.in_order))
        else:
            assert isinstance(scene, SceneFile)
            surroundings = PlanSurroundings(scene.geometry.floor_plan)
            mass = scene.geometry.materials.walls.surface_mass_kg_m2
            loss_db = None if mass is None else transmission_loss_db(mass, OCTAVE_BANDS_HZ)
            walls = None if loss_db is None else PlanWallLosses(scene.geometry.floor_plan, loss_db)
        return cls(
            surroundings,
            scene.air if plan.air_absorption else None,
            surroundings.sound_paths(SPEED_OF_SOUND) if plan.diffraction else None,
            walls if plan.transmission else None,
        )

    def images(self, emitter: _Floats, listener: _Floats) -> tuple[_Floats, _Floats]:
        positions, amplitudes = [], []
        is_seen = bool(self.surroundings.is_visible(emitter, listener))
        straight = free_field_amplitude(np.asarray(np.linalg.norm(emitter - listener), np.float64), self.air)
        if self.finder is not None:
            paths = self.finder.find(listener, emitter[None])
            positions.append(listener + paths.length_m[0] * paths.arrival[0])
            bent = free_field_amplitude(paths.length_m[0], self.air)
            amplitudes.append(bent * db_to_amplitude(paths.screen_db[0]))
        elif is_seen:
            positions.append(emitter)
            amplitudes.append(straight)
        if self.walls is not None and not is_seen:
            through, losses_db = self.walls.between(listener, emitter[None])
            if through[0]:
                positions.append(emitter)
                amplitudes.append(straight * db_to_amplitude(-losses_db[0]))
        shape = len(positions), len(OCTAVE_BANDS_HZ)
        return np.reshape(positions, (shape[0], 3)), np.reshape(amplitudes, shape)
