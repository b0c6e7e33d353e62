"""Laws of room acoustics, as limits of a field's predictions.

Energies have the axes of `server.health.energies`. Levels are in decibels.
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
"""This share of the whole energy is added to each band, so that changes of masked bands do not count."""
_CUT_RAD = 0.1
# Between the places of the training data, reflections arrive a little earlier or later than at those places.
_NEARBY_WINDOWS, _NEARBY_SHARE = 2, 0.1
_DATA_MARGIN_DB = 3.0
"""A field may be louder than its loudest training response by this much, since some places are nearer to a wall."""
_SILENT_ENERGY = 1e-6
"""Least energy limit: 60 dB below the direct sound at one metre, as near as a field comes to silence."""
_EMITTER_SIZE_M = 0.02
_NOTHING = float(np.finfo(np.float64).tiny)


def diffuse_energy(geometry: Geometry) -> float:
    """Energy of a room's diffuse field in the octave band of least absorption, relative to unit pressure at one metre.
    It is 16 pi / R, with the room constant R = S a / (1 - a) (Kuttruff, "Room Acoustics", 5th ed., 5.44), where `a` is
    the mean absorption of all surfaces S. For several rooms it is that of the loudest one, without losses through its
    openings."""
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
    """(pose,) energy in dB at the louder ear, relative to the limit that the walls' absorption sets.

    The limit is the diffuse energy times eight, since three walls reflect in phase in a corner, and times two, for an
    ear that faces the sound. If the fields also hold the direct sound or early reflections, the limit includes the
    direct sound and its image sources in the three walls of a corner, none of which is nearer than the emitter.
    """
    most = np.full(len(poses), diffuse_energy(geometry) * _CORNER)
    # guard: as near as the head is as near as its limit
    spread = np.maximum(np.linalg.norm(poses[:, LISTENER] - poses[:, EMITTER], axis=-1), NEAR_LIMIT_M) ** 2
    paths = (manifest.direct_sound == "field") + 3 * (manifest.image_order == 0)
    bound = np.maximum(_NEARER_EAR * (most + paths / spread), _SILENT_ENERGY)
    return power_to_db(np.max(np.sum(energies, axis=(-1, -2)), axis=-1) / bound)


def usual_excess_db(reference: DataReference | None) -> float:
    """By how much a field may exceed the energy limit: as much as its training responses do, for instance near the
    emitter in a long room, and a margin. Zero if they do not exceed it or are unknown."""
    if reference is None or reference.energy_excess_db is None:
        return 0.0
    return max(0.0, reference.energy_excess_db + _DATA_MARGIN_DB)


def window_levels_db(energies: Energies) -> Floats:
    """(pose, channel, window) levels in dB, without the last window, which may be incomplete."""
    return power_to_db(np.maximum(np.sum(energies[..., :-1], axis=-2), _NOTHING))


def decay_rise_db(energies: Energies, usual_db: Floats | float = 0.0) -> Floats:
    """(pose,) greatest rise of level in dB over all windows and ears, minus the usual rise `usual_db` (window,)."""
    rises = rises_db(energies)
    is_known = np.isfinite(energies).all(axis=(-1, -2, -3))
    return np.asarray(np.where(is_known, np.maximum(rises - usual_db, 0.0).max(axis=(-1, -2)), np.nan))


def rises_db(energies: Energies) -> Floats:
    """(pose, channel, window) rise of a window's level above the lowest earlier level, in dB. Only windows after the
    loudest count, and only levels within 60 dB of it: further below, fields and simulations are limited by how they are
    stored. The last window is left out."""
    levels_db = window_levels_db(energies)
    peak = np.argmax(levels_db, axis=-1)[..., None]
    floor_db = np.take_along_axis(levels_db, peak, axis=-1) - _DECAY_DB
    after = np.arange(levels_db.shape[-1]) >= peak
    lowest_db = np.minimum.accumulate(np.where(after, levels_db, np.inf), axis=-1)
    # guard: below the floor of storage nothing rises
    return np.maximum(np.where(after, levels_db - np.maximum(lowest_db, floor_db), 0.0), 0.0)


def usual_rises_db(reference: DataReference | None, windows: int, window_s: float) -> Floats:
    """(window,) greatest rise of the training responses in and near a window: up to two windows and a tenth of the time
    since the first sound away."""
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
    """(pose,) change of the direct sound's level in dB between poses (pose, 7), if the fields hold it: a spherical wave
    loses 20 lg r. Within the size of an emitter the level is constant."""
    if manifest.direct_sound != "field":
        return np.zeros(len(before))
    near, far = (
        np.maximum(np.linalg.norm(poses[:, LISTENER] - poses[:, EMITTER], axis=-1), _EMITTER_SIZE_M)
        for poses in (before, after)
    )
    return np.asarray(np.abs(20 * np.log10(near / far)))


def level_change_db(before: Energies, after: Energies) -> Floats:
    """(pose,) difference in dB of the levels of two responses, at the ear where it is greatest."""
    levels = [power_to_db(np.sum(energies, axis=(-1, -2)) + _NOTHING) for energies in (before, after)]
    return np.asarray(np.max(np.abs(levels[0] - levels[1]), axis=-1))


def spectral_change_db(before: Energies, after: Energies) -> Floats:
    """(pose,) difference in dB of the octave-band levels of two responses, at the ear and band where it is greatest."""
    levels = []
    for energies in (before, after):
        in_bands = np.sum(energies, axis=-1)
        whole = np.sum(in_bands, axis=-1, keepdims=True)
        levels.append(power_to_db(in_bands + _QUIET_BAND * whole + _NOTHING))
    return np.asarray(np.max(np.abs(levels[0] - levels[1]), axis=(-1, -2)))


def branch_cut_share(instantaneous_frequency: npt.NDArray[np.floating]) -> float:
    """Percentage of phase advances (..., frame) within 0.1 rad of the branch cut; zero if there are none. The first
    frame holds the absolute phase and does not count."""
    advances = np.abs(instantaneous_frequency[..., 1:])
    return 100 * float(np.mean(advances > np.pi - _CUT_RAD)) if advances.size else 0.0
