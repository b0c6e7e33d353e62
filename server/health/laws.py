"""Laws of rooms, as numbers that a prediction must not pass.

Energies as of `server.health.energies`; decibels.
"""

import numpy as np
import numpy.typing as npt

from server.acoustics.decibels import power_to_db
from server.health.energies import Energies
from server.health.poses import EMITTER, LISTENER, Poses
from server.rendering.direct_path import NEAR_LIMIT_M
from server.scene.geometry import Geometry, Materials
from server.scene.manifest import Manifest
from server.scene.rooms import Room, rooms_of

Floats = npt.NDArray[np.float64]

_CORNER = 8.0
_NEARER_EAR = 2.0
_DECAY_DB = 60.0
_QUIET_BAND = 1e-3
"""Bands further below the whole count as no louder than this share of it: what they do is masked."""
_CUT_RAD = 0.1
_SILENT_ENERGY = 1e-6
"""Where walls let nothing remain: 60 dB below the direct sound at one metre, as near as a field comes to silence."""
_NOTHING = float(np.finfo(np.float64).tiny)


def diffuse_energy(geometry: Geometry) -> float:
    """Energy of a room's diffuse field, in the octave band that is absorbed least, for unit pressure at one metre:
    16 pi / R, with the room constant R = S a / (1 - a) (Kuttruff, "Room Acoustics", 5th ed., 5.44), `a` the mean
    absorption of all surfaces S. Of several rooms the loudest, as if all that leaves it through its openings came
    back."""
    return max(_diffuse_energy(room, geometry.materials) for room in rooms_of(geometry))


def _diffuse_energy(room: Room, materials: Materials) -> float:
    plan = room.plan
    around_m = float(np.sum(np.linalg.norm(plan.walls[:, 1] - plan.walls[:, 0], axis=-1))) - room.passage_m
    wall_m2 = plan.height_m * around_m
    parts = (wall_m2, materials.walls), (plan.area_m2, materials.floor), (plan.area_m2, materials.ceiling)
    absorbing_m2 = np.sum([area_m2 * np.array(material.absorption) for area_m2, material in parts], axis=0)
    mean = np.maximum(absorbing_m2 / (wall_m2 + 2 * plan.area_m2), 1e-6)
    return float(np.max(16 * np.pi * (1 - mean) / absorbing_m2.clip(1e-6)))


def energy_excess_db(manifest: Manifest, geometry: Geometry, poses: Poses, energies: Energies) -> Floats:
    """(pose,) energy at the louder ear above the most that the walls let remain.

    That is the diffuse energy, eight times over in a corner, where three walls reflect in phase, and twice at an ear
    that faces it. Fields that hold what geometry computes elsewhere add to it the direct sound, and its mirror images
    in the three walls of a corner, none of which has a shorter way.
    """
    most = np.full(len(poses), diffuse_energy(geometry) * _CORNER)
    spread = np.maximum(np.linalg.norm(poses[:, LISTENER] - poses[:, EMITTER], axis=-1), NEAR_LIMIT_M) ** 2
    paths = (manifest.direct_sound == "field") + 3 * (manifest.image_order == 0)
    bound = np.maximum(_NEARER_EAR * (most + paths / spread), _SILENT_ENERGY)
    return power_to_db(np.max(np.sum(energies, axis=(-1, -2)), axis=-1) / bound)


def window_levels_db(energies: Energies) -> Floats:
    """(pose, channel, window), the last window left out, which may be cut short."""
    return power_to_db(np.maximum(np.sum(energies[..., :-1], axis=-2), _NOTHING))


def decay_rise_db(energies: Energies) -> Floats:
    """(pose,) by how much a window's level is above an earlier one's, after the loudest and within 60 dB of it, at the
    ear where that is most. Further below, fields and simulations are at the floor of their storage."""
    levels_db = window_levels_db(energies)
    peak = np.argmax(levels_db, axis=-1)[..., None]
    floor_db = np.take_along_axis(levels_db, peak, axis=-1) - _DECAY_DB
    after = np.arange(levels_db.shape[-1]) >= peak
    lowest_db = np.minimum.accumulate(np.where(after, levels_db, np.inf), axis=-1)
    rise_db = np.where(after, levels_db - np.maximum(lowest_db, floor_db), 0.0)
    is_known = np.isfinite(energies).all(axis=(-1, -2, -3))
    return np.asarray(np.where(is_known, np.maximum(rise_db, 0.0).max(axis=(-1, -2)), np.nan))


def level_change_db(before: Energies, after: Energies) -> Floats:
    """(pose,) by how much the levels of two responses differ, at the ear where that is most."""
    levels = [power_to_db(np.sum(energies, axis=(-1, -2)) + _NOTHING) for energies in (before, after)]
    return np.asarray(np.max(np.abs(levels[0] - levels[1]), axis=-1))


def spectral_change_db(before: Energies, after: Energies) -> Floats:
    """(pose,) likewise in the octave band where that is most."""
    levels = []
    for energies in (before, after):
        in_bands = np.sum(energies, axis=-1)
        whole = np.sum(in_bands, axis=-1, keepdims=True)
        levels.append(power_to_db(in_bands + _QUIET_BAND * whole + _NOTHING))
    return np.asarray(np.max(np.abs(levels[0] - levels[1]), axis=(-1, -2)))


def branch_cut_share(instantaneous_frequency: npt.NDArray[np.floating]) -> float:
    """Share, percent, of advances of phase (..., frame) within 0.1 rad of the cut; the first frame is a phase and no
    advance. Zero where there is no other."""
    advances = np.abs(instantaneous_frequency[..., 1:])
    return 100 * float(np.mean(advances > np.pi - _CUT_RAD)) if advances.size else 0.0
