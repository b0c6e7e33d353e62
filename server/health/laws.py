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
from server.scene.manifest import DataReference, Manifest
from server.scene.rooms import Room, rooms_of

Floats = npt.NDArray[np.float64]

_CORNER = 8.0
_NEARER_EAR = 2.0
_DECAY_DB = 60.0
_QUIET_BAND = 1e-3
"""Bands further below the whole count as no louder than this share of it: what they do is masked."""
_CUT_RAD = 0.1
# Between the places of its data a field's echoes come a little sooner or later than at them.
_NEARBY_WINDOWS, _NEARBY_SHARE = 2, 0.1
_DATA_MARGIN_DB = 3.0
"""By which a field may be louder than the loudest of its data: there are places nearer to a wall than theirs."""
_SILENT_ENERGY = 1e-6
"""Where walls let nothing remain: 60 dB below the direct sound at one metre, as near as a field comes to silence."""
_EMITTER_SIZE_M = 0.02
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
    # guard: as near as the head is as near as its limit
    spread = np.maximum(np.linalg.norm(poses[:, LISTENER] - poses[:, EMITTER], axis=-1), NEAR_LIMIT_M) ** 2
    paths = (manifest.direct_sound == "field") + 3 * (manifest.image_order == 0)
    bound = np.maximum(_NEARER_EAR * (most + paths / spread), _SILENT_ENERGY)
    return power_to_db(np.max(np.sum(energies, axis=(-1, -2)), axis=-1) / bound)


def usual_excess_db(reference: DataReference | None) -> float:
    """How far above what the walls let remain a field may be: as its data are, in a long room near the emitter say, and
    a margin above them. Zero where they are not, or nothing is known of them."""
    if reference is None or reference.energy_excess_db is None:
        return 0.0
    return max(0.0, reference.energy_excess_db + _DATA_MARGIN_DB)


def window_levels_db(energies: Energies) -> Floats:
    """(pose, channel, window), the last window left out, which may be cut short."""
    return power_to_db(np.maximum(np.sum(energies[..., :-1], axis=-2), _NOTHING))


def decay_rise_db(energies: Energies, usual_db: Floats | float = 0.0) -> Floats:
    """(pose,) by how much more than is `usual_db` (window,) a window's level is above an earlier one's, in the window
    and at the ear where that is most."""
    rises = rises_db(energies)
    is_known = np.isfinite(energies).all(axis=(-1, -2, -3))
    return np.asarray(np.where(is_known, np.maximum(rises - usual_db, 0.0).max(axis=(-1, -2)), np.nan))


def rises_db(energies: Energies) -> Floats:
    """(pose, channel, window) by how much a window's level is above an earlier one's, after the loudest and within 60
    dB of it; the last window is left out. Further below, fields and simulations are at the floor of their storage."""
    levels_db = window_levels_db(energies)
    peak = np.argmax(levels_db, axis=-1)[..., None]
    floor_db = np.take_along_axis(levels_db, peak, axis=-1) - _DECAY_DB
    after = np.arange(levels_db.shape[-1]) >= peak
    lowest_db = np.minimum.accumulate(np.where(after, levels_db, np.inf), axis=-1)
    # guard: below the floor of storage nothing rises
    return np.maximum(np.where(after, levels_db - np.maximum(lowest_db, floor_db), 0.0), 0.0)


def usual_rises_db(reference: DataReference | None, windows: int, window_s: float) -> Floats:
    """(window,) by how much the data that fields learn from rise, in a window or in those nearby: in two on either side
    of it, and in as many as a tenth of the time since the first sound."""
    usual = np.zeros(windows)
    if reference is None or not reference.rises_db:
        return usual
    measured = np.asarray(reference.rises_db)
    for window in range(windows):
        near = _NEARBY_WINDOWS + int(_NEARBY_SHARE * window)
        first, last = (
            round(edge * window_s / reference.window_s) for edge in (max(0, window - near), window + near + 1)
        )
        usual[window] = np.max(measured[first:last], initial=0.0)
    return usual


def spreading_db(manifest: Manifest, before: Poses, after: Poses) -> Floats:
    """(pose,) by how much the level of the direct sound changes between poses (pose, 7), where fields hold it: a
    spherical wave has 20 lg r less of it at r metres. No emitter is a point: nearer than its own size nothing is
    gained."""
    if manifest.direct_sound != "field":
        return np.zeros(len(before))
    near, far = (
        np.maximum(np.linalg.norm(poses[:, LISTENER] - poses[:, EMITTER], axis=-1), _EMITTER_SIZE_M)
        for poses in (before, after)
    )
    return np.asarray(np.abs(20 * np.log10(near / far)))


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
