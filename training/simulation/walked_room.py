"""Statistical acoustics of a level: its mean free path, and how much its surfaces absorb, from walks through it.

A walk begins at a probe and goes on from each surface by Lambert's law, so that surfaces are met as often as in a
diffuse field. No volume is needed, so holes and an open sky do no harm: a walk that leaves is absorbed.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.scene.manifest import Air
from training.data.dataset import SPEED_OF_SOUND
from training.data.levels.level_scene import LevelScene
from training.simulation.diffuse_room import eyring_time_s

_Floats = npt.NDArray[np.float64]

_WALKS, _STEPS = 400, 24
# The first way is from a probe, and not from a surface.
_SKIPPED = 1
_OFF_SURFACE_M = 1e-5


@dataclass(frozen=True)
class WalkedRoom:
    """A place whose sound field is assumed to be diffuse. `absorption` (band,) is the mean over surfaces as often as
    they are met."""

    mean_free_path_m: float
    absorption: _Floats
    air: Air

    @classmethod
    def of(cls, level: LevelScene, probes: _Floats) -> "WalkedRoom":
        """Walk through a level from its probes (probe, xyz); the same for the same level and probes."""
        tree, rng = level.surroundings.tree, np.random.default_rng(0)
        absorbed, surfaces = level.place.of_surfaces("absorption"), tree.mesh.surfaces
        places = probes[np.arange(_WALKS) % len(probes)]
        directions = _unit(rng.standard_normal((_WALKS, 3)))
        lengths_m, shares = [], []
        for step in range(_STEPS):
            hits = tree.closest(places, directions)
            met = hits.triangle >= 0
            shares.append(np.where(met[:, None], absorbed[surfaces[hits.triangle]], 1.0))
            places, directions, triangles = places[met], directions[met], hits.triangle[met]
            if step >= _SKIPPED:
                lengths_m.append(hits.distance[met])
            if not len(places):
                break
            normals = np.where(hits.faces[met, None], 1.0, -1.0) * tree.mesh.normals[triangles]
            places = places + hits.distance[met, None] * directions + _OFF_SURFACE_M * normals
            directions = _unit(normals + _unit(rng.standard_normal(normals.shape)))
        ways_m = np.concatenate([*lengths_m, np.zeros(0)])
        # Where every way leaves, sound is not reflected twice, and any length serves.
        mean_m = float(ways_m.mean()) if len(ways_m) else float(np.ptp(level.surroundings.bounds_m, axis=0).max())
        return cls(mean_m, np.concatenate(shares).mean(axis=0), level.air)

    @property
    def reverberation_time_s(self) -> _Floats:
        """(band,) T60 by Eyring, with absorption by the air."""
        return eyring_time_s(self.mean_free_path_m, self.absorption, self.air, SPEED_OF_SOUND)


def _unit(vectors: _Floats) -> _Floats:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
