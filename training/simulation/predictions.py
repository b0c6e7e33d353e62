"""What leaving an effect out of a simulation would change, told from geometry and statistical acoustics before
anything is simulated: in just-noticeable differences, with a reason in words.

Axes: (pair, band); metres. Power is squared pressure beside that of the direct sound at one metre.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from server.acoustics.audibility import HEARD
from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.decibels import db_to_power, power_to_db
from server.acoustics.geometry import FloorPlan
from server.acoustics.sound_path import SoundPathFinder, SoundPaths
from server.acoustics.transmission import transmission_loss_db, walls_between
from training.dataset import SPEED_OF_SOUND
from training.scene_file import HISTOGRAM_BIN_S, SceneFile
from training.simulation.diffuse_room import DiffuseRoom
from training.simulation.neighbourhoods import receiver_radii
from training.simulation.plan import SimulationPlan
from training.simulation.rays import surface_shares
from training.simulation.tracing import RoomTracer

_Floats = npt.NDArray[np.float64]

_EARLY_S = 0.050
# Rays may widen the spread of clarity over draws of the noise by a tenth.
_RAY_VARIANCE = 1.1**2 - 1
# Mean of the square over the square of the mean of chords of a sphere that parallel lines cut.
_CHORDS = 9 / 8
_LEVEL_DB = HEARD["level"].amount
_EMITTERS_TRIED = 16


@dataclass(frozen=True)
class Prediction:
    change_jnd: float
    parameter: str
    reason: str


@dataclass(frozen=True)
class Predictions:
    """Of one scene and its probes (probe, xyz)."""

    scene: SceneFile
    probes: _Floats

    @cached_property
    def room(self) -> DiffuseRoom:
        return DiffuseRoom(self.scene.geometry, self.scene.air, SPEED_OF_SOUND)

    @cached_property
    def floor_plan(self) -> FloorPlan:
        return self.scene.geometry.floor_plan

    @cached_property
    def longest_onset_s(self) -> float:
        return float(self._paths.length_m.max() / SPEED_OF_SOUND)

    @property
    def is_one_room(self) -> bool:
        """Whether from every place every other is seen."""
        return len(self.floor_plan.bend_corners) == 0

    def late_reverberation(self) -> Prediction:
        kept = self._direct_power.mean(axis=0) + self.room.reflected_power(1) - self.room.reflected_power(2)
        change = _level_change_jnd(self.room.reflected_power(2), kept)
        return Prediction(change, "level", "what follows the first reflections, by Eyring, beside what comes before it")

    def early_reflections(self, order: int) -> Prediction:
        """Of mirrored paths by so many surfaces, at the pair that they matter most to: drawn from noise of the same
        energy instead, octaves of them vary in level."""
        settings = self.scene.simulation
        everything = SimulationPlan.everything(settings.image_order, settings.rays)
        shares = []
        for at in np.unique(np.linspace(0, len(self.probes) - 1, _EMITTERS_TRIED).astype(int)):
            emitter = self.probes[at]
            receivers = np.delete(self.probes, at, axis=0)
            tracer = RoomTracer.of(self.scene, everything, receivers, image_order=order, least_order=order)
            distance = np.linalg.norm(receivers - emitter, axis=-1)
            beside = distance[:, None] ** -2 + self.room.reflected_power(1)
            power = np.array([(amplitudes**2).sum(axis=0) for _, amplitudes in tracer.images(emitter)])
            shares.append(power / beside)
        # They have all come after about one mean free path; noise of that length varies by 1 / sqrt(B T) in a band.
        lasting_s = self.room.mean_free_path_m / SPEED_OF_SOUND
        spread = 1 / np.sqrt(np.maximum(1.0, np.asarray(OCTAVE_BANDS_HZ) / np.sqrt(2) * lasting_s))
        changes_db = power_to_db(1 + np.concatenate(shares) * spread)
        over_bands = np.sqrt((changes_db**2).mean(axis=-1))
        reason = f"paths by {order} surfaces bring {100 * np.mean(shares):.0f} % of the energy on average"
        return Prediction(float(over_bands.max()) / HEARD["spectrum"].amount, "spectrum", reason)

    def scattering(self) -> Prediction:
        share = surface_shares(self.scene.geometry)[1].max()
        lost_db = -float(power_to_db(max(1 - share, 1e-6)))
        reason = f"surfaces scatter up to {100 * share:.0f} % of what they reflect"
        return Prediction(lost_db / _LEVEL_DB, "level", reason)

    def air_absorption(self) -> Prediction:
        dry = DiffuseRoom(self.scene.geometry, None, SPEED_OF_SOUND).reverberation_time_s
        percent = 100 * float(np.max(dry / self.room.reverberation_time_s - 1))
        reason = f"without air, reverberation would last up to {percent:.0f} % longer in an octave band"
        return Prediction(percent / HEARD["t60"].amount, "t60", reason)

    def per_source_tail(self) -> Prediction:
        if not self.is_one_room:
            coupling = self._passage_m2 / (self._passage_m2 + self.room.surface_m2 * self.room.absorption / 2)
            change_db = -float(power_to_db(coupling).min())
            reason = "walls part the plan, and behind them late sound is another"
            return Prediction(change_db / _LEVEL_DB, "level", reason)
        start_s = self.tail_start_s
        reflections = SPEED_OF_SOUND * start_s / self.room.mean_free_path_m
        unmixed = float(((1 - self.room.scattering) ** reflections).max())
        images = self.room.images_per_s(start_s) * HISTOGRAM_BIN_S
        change_db = float(power_to_db(1 + unmixed / np.sqrt(images)))
        reason = (
            f"in one room without corners to hide behind, places differ for {1e3 * start_s:.0f} ms "
            "(Lindau et al. 2012); from then on one tail serves all pairs"
        )
        return Prediction(change_db / _LEVEL_DB, "level", reason)

    @property
    def tail_start_s(self) -> float:
        """After emission, wherever the receiver is."""
        return self.room.mixing_time_s + self.longest_onset_s

    def diffraction(self) -> Prediction:
        paths = self._paths
        bent = db_to_power(paths.screen_db) * self._direct_power
        straight = np.where(paths.in_sight[:, None], self._direct_power, 0.0)
        hidden = float(np.mean(~paths.in_sight))
        changes = np.abs(power_to_db((bent + self._reverberant_power) / (straight + self._reverberant_power)))
        reason = f"the direct sound of {100 * hidden:.0f} % of the pairs bends round corners"
        if self.is_one_room:
            reason = "no corner stands in any way"
        return Prediction(float(changes.max()) / _LEVEL_DB, "level", reason)

    def transmission(self) -> Prediction:
        mass = self.scene.geometry.materials.walls.surface_mass_kg_m2
        hidden = ~self._paths.in_sight
        if mass is None or not hidden.any():
            reason = "every pair is in sight" if mass is not None else "walls are solid: the scene gives them no mass"
            return Prediction(0.0, "level", reason)
        walls = walls_between(self.floor_plan, *self._pairs)[hidden, None]
        loss_db = walls * transmission_loss_db(mass, OCTAVE_BANDS_HZ)
        through = self._straight_power[hidden] * db_to_power(-loss_db)
        bent = db_to_power(self._paths.screen_db[hidden]) * self._direct_power[hidden]
        change_jnd = _level_change_jnd(through, bent + self._reverberant_power[hidden])
        reason = f"walls of {mass:g} kg/m2, beside what comes round their corners and the reverberation behind them"
        return Prediction(change_jnd, "level", reason)

    def rays(self) -> int:
        """As many per emitter as keep their part in the spread of clarity small, on average over receivers, up to
        those the scene file allows.

        A ray that fills the room crosses a sphere of radius r so often per metre: pi r**2 / V.
        """
        most = self.scene.simulation.rays
        if not self.is_one_room:
            return most
        variance_db = _RAY_VARIANCE * self.room.clarity_spread_db(_EARLY_S) ** 2
        crossings = _CHORDS * (10 / np.log(10)) ** 2 / variance_db
        per_ray = SPEED_OF_SOUND * _EARLY_S * np.pi * receiver_radii(self.floor_plan, self.probes) ** 2
        rays = float(np.mean(crossings * self.room.volume_m3 / per_ray))
        return min(most, int(np.ceil(rays / 100)) * 100)

    @property
    def _pairs(self) -> tuple[_Floats, _Floats]:
        """(pair, xyz) ends, each couple of probes once."""
        first, second = np.triu_indices(len(self.probes), 1)
        return self.probes[first], self.probes[second]

    @cached_property
    def _paths(self) -> SoundPaths:
        """(pair,) in the order of `_pairs`."""
        finder = SoundPathFinder(self.floor_plan, SPEED_OF_SOUND)
        found = [finder.find(self.probes[at], self.probes[at + 1 :]) for at in range(len(self.probes) - 1)]
        return SoundPaths(
            *(np.concatenate(parts) for parts in zip(*(vars(each).values() for each in found), strict=True))
        )

    @property
    def _direct_power(self) -> _Floats:
        """(pair, 1) round corners where it must, without what they take."""
        return np.asarray(self._paths.length_m[:, None] ** -2)

    @property
    def _straight_power(self) -> _Floats:
        """(pair, 1) through whatever stands between."""
        return np.asarray((self._paths.length_m - self._paths.excess_m)[:, None] ** -2)

    @property
    def _passage_m2(self) -> float:
        """Of the openings; where none is named, of the narrowest way past a corner that stands out."""
        geometry = self.scene.geometry
        widths = [np.subtract(opening.start, opening.end) for opening in geometry.openings]
        if widths:
            return float(np.linalg.norm(widths, axis=-1).mean() * geometry.height_m)
        return float(_narrowest_m(self.floor_plan) * geometry.height_m)

    @cached_property
    def _reverberant_power(self) -> _Floats:
        """(pair, band); behind a corner that of a room coupled by the passage (Cremer & Mueller, Principles and
        Applications of Room Acoustics, vol. 1, 1982, sec. II.1): the share S / (S + A)."""
        power = np.tile(self.room.reflected_power(1), (len(self._paths.length_m), 1))
        if not self.is_one_room:
            passage, area = self._passage_m2, self.room.surface_m2 * self.room.absorption / 2
            power[~self._paths.in_sight] *= passage / (passage + area)
        return power


def _level_change_jnd(more: _Floats, other: _Floats) -> float:
    """The most that adding a power to another changes the level of."""
    return float(np.max(power_to_db(1 + more / other))) / _LEVEL_DB


def _narrowest_m(plan: FloorPlan) -> float:
    """Of the ways from corners that stand out to walls they are no end of."""
    start, end = plan.walls[:, 0], plan.walls[:, 1]
    along = end - start
    narrowest = np.inf
    for corner in plan.bend_corners:
        share = np.clip(np.sum((corner - start) * along, axis=-1) / np.sum(along**2, axis=-1), 0, 1)
        distance = np.linalg.norm(start + share[:, None] * along - corner, axis=-1)
        narrowest = min(narrowest, float(distance[distance > 1e-6].min()))
    return narrowest
