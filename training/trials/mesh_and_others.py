"""Rays in triangle meshes beside those of pyroomacoustics in the same walls.

Both are of reflected sound without air, with the same emitter and receivers. Walls mirror everything, or scatter
everything: there the two define a scattering coefficient alike (`training.trials.reverberation`). Where walls scatter,
the other's rays bring the energy of a reflection also as a mirror would, so only reverberation times are compared.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.acoustics.decibels import power_to_db
from server.scene.geometry import Geometry
from server.scene.mesh_geometry import MeshGeometry
from training.data.dataset import SPEED_OF_SOUND
from training.data.scene_file import HISTOGRAM_BIN_S
from training.simulation.mesh_rays import MeshRayTracer
from training.simulation.rays import sphere_directions
from training.trials.mesh_laws import Sizes
from training.trials.mesh_rooms import places_in
from training.trials.other_rays import OtherRays
from training.trials.reverberation import reverberation_time_s

_Floats = npt.NDArray[np.float64]

_EARLY_S = 0.050
_DEEPEST_DB = -40.0
_CLEAR_M = 0.45
"""No sphere that counts rays reaches into a wall."""


@dataclass(frozen=True)
class BesideOthers:
    """Reverberation times (run,) of both, in seconds. Of mirrors alone: mean absolute differences over receivers of
    C50, of level and of decay curves down to -40 dB, in dB, from the mean energies of all runs."""

    room: str
    scattering: float
    rays: int
    receivers: int
    ours_s: tuple[float, ...]
    others_s: tuple[float, ...]
    c50_db: float | None
    level_db: float | None
    decay_db: float | None

    @property
    def difference(self) -> float:
        """How much longer ours is, relative to the other."""
        return float(np.mean(self.ours_s) / np.mean(self.others_s) - 1)

    @property
    def error(self) -> float:
        """The standard error of `difference`."""
        errors = [np.std(each, ddof=1) / np.mean(each) / np.sqrt(len(each)) for each in (self.ours_s, self.others_s)]
        return float(np.hypot(*errors))


def beside_others(
    room: str,
    walls: Geometry | MeshGeometry,
    scattering: float,
    sizes: Sizes,
    rng: np.random.Generator,
    *,
    duration_s: float = 1.2,
) -> BesideOthers:
    """Trace a room, given as a floor plan or as a closed mesh, as a mesh and by pyroomacoustics."""
    place = walls if isinstance(walls, MeshGeometry) else MeshGeometry.of_plan(walls)
    emitter, *others = places_in(place, sizes.receivers + 1, rng, clear_m=_CLEAR_M)
    receivers = np.array(others)
    tracer = MeshRayTracer(
        place, receivers, duration_s=duration_s, image_order=0, arrival_directions=sphere_directions(1)
    )
    oracle = OtherRays(walls, receivers, image_order=0, duration_s=duration_s)
    runs = rng.spawn(2 * sizes.runs)
    ours = [tracer.trace(emitter, rays=sizes.rays, rng=each).sum(axis=(1, 2)) for each in runs[::2]]
    theirs = [oracle.energy(emitter, sizes.rays, each).sum(axis=1) for each in runs[1::2]]
    ours_s, others_s = (tuple(_time_s(energy) for energy in each) for each in (ours, theirs))
    means = [np.asarray(np.mean(each, axis=0, dtype=np.float64)) for each in (ours, theirs)]
    differences: tuple[float | None, float | None, float | None] = (None, None, None)
    if not scattering:
        onsets_s = np.linalg.norm(receivers - emitter, axis=-1) / SPEED_OF_SOUND
        clarity = [_clarity_db(each, onsets_s) for each in means]
        levels = [power_to_db(each.sum(axis=-1)) for each in means]
        curves = [_decay_db(each) for each in means]
        shallow = np.minimum(*curves) > _DEEPEST_DB
        differences = (
            float(np.abs(clarity[0] - clarity[1]).mean()),
            float(np.abs(levels[0] - levels[1]).mean()),
            float(np.abs(curves[0][shallow] - curves[1][shallow]).mean()),
        )
    return BesideOthers(room, scattering, sizes.rays, sizes.receivers, ours_s, others_s, *differences)


def _time_s(energy: npt.ArrayLike) -> float:
    """The reverberation time of energies (receiver, bin), summed."""
    return float(reverberation_time_s(np.asarray(energy).sum(axis=0)[None])[0])


def _decay_db(energy: _Floats) -> _Floats:
    """(receiver, bin) what is still to come of energies, from 0 dB."""
    remaining = np.cumsum(energy[:, ::-1], axis=-1)[:, ::-1]
    return power_to_db(remaining / remaining[:, :1])


def _clarity_db(energy: _Floats, onsets_s: _Floats) -> _Floats:
    """(receiver,) C50 of the reflected sound, from when the direct sound arrives."""
    ends_s = (np.arange(energy.shape[-1]) + 1) * HISTOGRAM_BIN_S
    until = np.cumsum(energy, axis=-1)
    early = np.array([np.interp(onset_s + _EARLY_S, ends_s, of) for onset_s, of in zip(onsets_s, until, strict=True)])
    return power_to_db(early / (until[:, -1] - early))
