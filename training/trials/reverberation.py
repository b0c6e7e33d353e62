"""Compares the reverberation times of a scene: by our rays, by pyroomacoustics, and by Eyring's formula.

Both simulations have the same walls, air, emitters and receivers, and the same estimator: the energies of all pairs are
summed by octave band, integrated backwards (Schroeder), and a line is fitted from -5 to -35 dB (ISO 3382-2:2008,
ensemble averages of decay curves, 8.2).

The two define a scattering coefficient s between 0 and 1 differently. Ours is that of ISO 17497-1: the share s of the
energy leaves by Lambert's law, and the rest is mirrored exactly. pyroomacoustics changes the direction of every ray a
little: the new direction is s times a Lambertian one plus 1 - s times the mirrored one, with the mean of s over the
octaves (`simul_ray` in its `room.cpp`, version 0.10.1). So in ours, a part of the horizontal sound in a corridor with
an absorbent ceiling stays horizontal and decays slowly; in theirs, all of it is soon directed upwards. An experiment
showed that this is the whole difference: our tracer with their rule gives their times within 2 % in the booth, the
corridors and the courtyard of `training/scenes/own`, where the two rules differ by 7 to 23 %.

At both ends the definitions agree: for s = 0 all is mirrored, and for s = 1 every new direction is Lambertian. Both
ends are judged in every scene, with its own geometry and absorption. The scene's own scattering is judged if the field
is diffuse for any scattering of the walls, and s is the same in all octaves; otherwise the result is shown in brackets.
Eyring's formula is judged if the field is diffuse.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.acoustics.decibels import db_to_power, power_to_db
from server.scene.geometry import Geometry
from training.data.dataset import SPEED_OF_SOUND
from training.data.scene_file import HISTOGRAM_BIN_S, SceneFile
from training.simulation.diffuse_room import DiffuseRoom
from training.simulation.rays import RayTracer, sphere_directions
from training.trials.other_rays import OtherRays

_Floats = npt.NDArray[np.float64]

MOST_FROM_OTHERS = 0.05
MOST_FROM_EYRING = 0.10
_EMITTERS, _RECEIVERS = 1, 5
# Times are medians of several runs. The number of rays is increased until the runs agree.
_RUNS, _RAYS, _MOST_RAYS, _MORE = 5, 10_000, 160_000, 4
_SURE = 0.01
_FITTED_DB = -5.0, -35.0
# With less scattering than a third, the two definitions describe different rooms.
_ALIKE_SCATTERING = 1 / 3


@dataclass(frozen=True)
class Comparison:
    """Reverberation times of our rays by octave band in seconds, and relative differences."""

    ours_s: Sequence[float]
    from_others: Sequence[float]
    """From the median of pyroomacoustics, with the scene's own scattering."""
    from_mirrors: Sequence[float]
    """The same without scattering in both."""
    from_rough: Sequence[float]
    """The same with scattering 1 in both."""
    from_eyring: Sequence[float]
    judges_others: bool
    is_diffuse: bool

    def beyond(self) -> list[str]:
        """The limits that the comparison exceeds."""
        judged = (
            ("pyroomacoustics", self.from_others, MOST_FROM_OTHERS, self.judges_others),
            ("pyroomacoustics, mirrors only", self.from_mirrors, MOST_FROM_OTHERS, True),
            ("pyroomacoustics, all scattered", self.from_rough, MOST_FROM_OTHERS, True),
            ("Eyring", self.from_eyring, MOST_FROM_EYRING, self.is_diffuse),
        )
        return [
            f"{name}: {100 * worst_of(shares):.1f} %"
            for name, shares, most, counts in judged
            if counts and not worst_of(shares) <= most
        ]


def worst_of(shares: npt.ArrayLike) -> float:
    """The greatest difference over the bands in which both have a reverberation time; NaN if there is none."""
    known = np.abs(shares)[np.isfinite(shares)]
    return float(np.max(known)) if len(known) else np.nan


def compare(scene: SceneFile) -> Comparison:
    emitters, receivers = _places(scene)

    def times_s(geometry: Geometry) -> tuple[_Floats, _Floats]:
        return _ours_s(scene, geometry, emitters, receivers), _others_s(scene, geometry, emitters, receivers)

    ours, others = times_s(scene.geometry)
    mirrors, rough = (times_s(scene.geometry.with_scattering(share)) for share in (0.0, 1.0))
    room = DiffuseRoom(scene.geometry, scene.air, SPEED_OF_SOUND)
    return Comparison(
        ours_s=tuple(ours.tolist()),
        from_others=tuple((ours / others - 1).tolist()),
        from_mirrors=tuple((mirrors[0] / mirrors[1] - 1).tolist()),
        from_rough=tuple((rough[0] / rough[1] - 1).tolist()),
        from_eyring=tuple((ours / room.reverberation_time_s - 1).tolist()),
        judges_others=is_diffuse(scene.geometry) and _scatters_alike(scene.geometry),
        is_diffuse=is_diffuse(scene.geometry),
    )


def reverberation_time_s(energy: npt.ArrayLike) -> _Floats:
    """(band,) reverberation times of (band, bin) energies in bins of HISTOGRAM_BIN_S; NaN where energy does not fall by
    35 dB."""
    remaining = np.cumsum(np.asarray(energy, np.float64)[:, ::-1], axis=-1)[:, ::-1]
    upper_db, lower_db = _FITTED_DB
    times = np.full(len(remaining), np.nan)
    for band, of_band in enumerate(remaining):
        level_db = power_to_db(of_band[of_band > 0] / of_band[0])
        if not len(level_db) or level_db[-1] > lower_db:
            continue
        fitted = (level_db <= upper_db) & (level_db >= lower_db)
        slope = np.polyfit(np.flatnonzero(fitted) * HISTOGRAM_BIN_S, level_db[fitted], 1)[0]
        times[band] = -60 / slope
    return times


def is_diffuse(geometry: Geometry) -> bool:
    """Whether Eyring's formula should hold within a tenth. The room must be convex, with no side more than three times
    another (Kuttruff, Room Acoustics, 5.5). The absorption of its surfaces must differ by at most a factor of four, and
    be at most a third (above, differences of path lengths matter). At least a third of the reflected energy must be
    scattered."""
    plan, materials = geometry.floor_plan, geometry.materials
    sides = *np.ptp(np.asarray(geometry.corners), axis=0), geometry.height_m
    surfaces = (materials.walls, materials.floor, materials.ceiling)
    absorption = np.array([surface.absorption for surface in surfaces])
    scattering = np.array([surface.scattering for surface in surfaces])
    return bool(
        not len(plan.bend_corners)
        and max(sides) <= 3 * min(sides)
        and (absorption.max(axis=0) <= 4 * absorption.min(axis=0)).all()
        and absorption.max() <= _ALIKE_SCATTERING
        and scattering.min() >= _ALIKE_SCATTERING
    )


def _scatters_alike(geometry: Geometry) -> bool:
    materials = geometry.materials
    scattering = np.array([each.scattering for each in (materials.walls, materials.floor, materials.ceiling)])
    return bool((np.ptp(scattering, axis=-1) == 0).all() and scattering.min() >= _ALIKE_SCATTERING)


def _places(scene: SceneFile) -> tuple[_Floats, _Floats]:
    """Emitters and receivers (n, 3) among the probes, spread over the scene."""
    probes = scene.probe_positions(0)
    order = np.random.default_rng(0).permutation(len(probes))
    chosen = probes[order[: _EMITTERS + _RECEIVERS]]
    return chosen[:_EMITTERS], chosen[_EMITTERS:]


def _in_air(scene: SceneFile, energy: npt.ArrayLike) -> _Floats:
    """(..., band, bin) energy with what the air takes."""
    energy = np.asarray(energy, np.float64)
    bins_m = (np.arange(energy.shape[-1]) + 0.5) * HISTOGRAM_BIN_S * SPEED_OF_SOUND
    return np.asarray(energy * db_to_power(-scene.air.absorption_db_per_m[:, None] * bins_m))


def median_of_runs(times_s: Callable[[int, int], _Floats]) -> _Floats:
    """(band,) median of several runs of `times_s`, which takes the number of a run and of rays. Rays are as many as
    make the standard error of the runs' mean 1 % at most in every band in which all of them tell a time, or as may
    be."""
    rays = _RAYS
    while True:
        times = np.array([times_s(run, rays) for run in range(_RUNS)])
        is_known = np.isfinite(times).all(axis=0)
        errors = times[:, is_known].std(axis=0, ddof=1) / times[:, is_known].mean(axis=0) / np.sqrt(_RUNS)
        if (errors <= _SURE).all() or rays >= _MOST_RAYS:
            return np.asarray(np.median(times, axis=0))
        rays *= _MORE


def _ours_s(scene: SceneFile, geometry: Geometry, emitters: _Floats, receivers: _Floats) -> _Floats:
    tracer = RayTracer(
        geometry,
        receivers,
        duration_s=scene.simulation.duration_s,
        image_order=0,
        arrival_directions=sphere_directions(scene.simulation.arrival_directions),
    )

    def times_s(run: int, rays: int) -> _Floats:
        rng = np.random.default_rng([run, 10])
        energy = sum(tracer.trace(emitter, rays=rays, rng=rng).sum(axis=(0, 1)) for emitter in emitters)
        return reverberation_time_s(_in_air(scene, energy))

    return median_of_runs(times_s)


def _others_s(scene: SceneFile, geometry: Geometry, emitters: _Floats, receivers: _Floats) -> _Floats:
    others = OtherRays(geometry, receivers, image_order=0, duration_s=scene.simulation.duration_s)

    def times_s(run: int, rays: int) -> _Floats:
        rng = np.random.default_rng([run, 11])
        energy = sum(others.energy(emitter, rays, rng).sum(axis=0) for emitter in emitters)
        return reverberation_time_s(_in_air(scene, energy))

    return median_of_runs(times_s)
