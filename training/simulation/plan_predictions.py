"""Predictions for floor plans: where rays and images need no trial, from statistical acoustics of one room.

Axes are those of `training.simulation.predictions`.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from server.acoustics.audibility import JND_THRESHOLDS
from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.decibels import power_to_db
from server.acoustics.geometry import FloorPlan
from server.acoustics.sound_path import PlanPathFinder, SoundPaths
from server.acoustics.transmission import transmission_loss_db, walls_between
from server.planning.change import Change
from training.data.dataset import GEOMETRIC_ORDER, SPEED_OF_SOUND
from training.data.scene_file import SceneFile
from training.data.shared_tail import FADE_S
from training.data.simulation_plan import SimulationPlan
from training.simulation.diffuse_room import DiffuseRoom
from training.simulation.predictions import LEVEL_DB, HeardPairs, Prediction, Predictions, TailNeeds
from training.simulation.rays import receiver_radii, surface_shares
from training.simulation.size import SimulationSize
from training.simulation.tracing import RoomTracer
from training.simulation.trial import Trial

_Floats = npt.NDArray[np.float64]

_EARLY_S = 0.050
# A limited number of rays may increase the standard deviation of clarity between draws of the noise by a tenth.
_RAY_VARIANCE = 1.1**2 - 1
# For chords of a sphere along parallel lines: the mean of the square over the square of the mean.
_CHORDS = 9 / 8
_EMITTERS_TRIED = 16
# Allowed standard error of a shared tail's reverberation time, relative: one just-noticeable difference.
_TAIL_ERROR = JND_THRESHOLDS["t60"].amount / 100
# Limit of the rays of a shared tail, as a multiple of the rays of one emitter.
_MOST_TAIL_RAYS = 16
# Limits of tests: of sequences of walls for each receiver, and of paths round corners for each wall.
_MOST_IMAGE_TESTS, _MOST_PATH_TESTS = 30_000_000, 20_000_000


@dataclass(frozen=True)
class PlanPredictions(Predictions):
    """Predictions for one floor plan and its probes (probe, xyz)."""

    scene: SceneFile
    probes: _Floats

    @property
    def orders(self) -> range:
        return range(GEOMETRIC_ORDER + 1, self.scene.simulation.image_order + 1)

    @property
    def largest_scattering(self) -> float:
        return float(surface_shares(self.scene.geometry)[1].max())

    @property
    def no_mass(self) -> str:
        return "needs geometry.materials.walls.surface_mass_kg_m2" if self._mass_kg_m2 is None else ""

    @property
    def _mass_kg_m2(self) -> float | None:
        return self.scene.geometry.materials.walls.surface_mass_kg_m2

    @cached_property
    def room(self) -> DiffuseRoom:
        return DiffuseRoom(self.scene.geometry, self.scene.air, SPEED_OF_SOUND)

    @cached_property
    def floor_plan(self) -> FloorPlan:
        return self.scene.geometry.floor_plan

    @cached_property
    def longest_onset_s(self) -> float:
        """The longest propagation time of direct sound between two probes."""
        return float(self._paths.length_m.max() / SPEED_OF_SOUND)

    @cached_property
    def longest_way_s(self) -> float:
        """The longest propagation time of direct sound between two probes or between the scene's start positions."""
        start = self.scene.start
        start_m = self.floor_plan.path_length_m(np.array(start.emitter), np.array(start.listener))
        return max(self.longest_onset_s, float(start_m) / SPEED_OF_SOUND)

    @property
    def is_one_room(self) -> bool:
        """Whether every place is in sight of every other."""
        return len(self.floor_plan.bend_corners) == 0

    @cached_property
    def trial(self) -> Trial:
        return Trial.of_plan(self.scene, self.probes)

    @property
    def trials(self) -> dict[str, Trial]:
        return {"": self.trial}

    def early_reflections(self, order: int) -> Prediction:
        """Predict the change without mirrored paths of this order, for the pair of probes with the largest change:
        noise of the same energy would replace them, and its octave levels vary."""
        settings = self.scene.simulation
        everything = SimulationPlan.everything(settings.image_order, settings.rays)
        shares = []
        tests = SimulationSize(self.scene).sequences_of(order) * len(self.probes)
        tried = int(np.clip(_MOST_IMAGE_TESTS / tests, 1, _EMITTERS_TRIED))
        step = max(1, int(tests / _MOST_IMAGE_TESTS))
        for at in np.unique(np.linspace(0, len(self.probes) - 1, tried).astype(int)):
            emitter = self.probes[at]
            receivers = np.delete(self.probes, at, axis=0)[::step]
            tracer = RoomTracer.of(self.scene, everything, receivers, image_order=order, least_order=order)
            distance = np.linalg.norm(receivers - emitter, axis=-1)
            beside = distance[:, None] ** -2 + self.room.reflected_power(1)
            power = np.array([(amplitudes**2).sum(axis=0) for _, amplitudes in tracer.images(emitter)])
            shares.append(power / beside)
        # These paths arrive within about one mean free path; noise of that length varies by 1 / sqrt(B T) in a band.
        lasting_s = self.room.mean_free_path_m / SPEED_OF_SOUND
        spread = 1 / np.sqrt(np.maximum(1.0, np.asarray(OCTAVE_BANDS_HZ) / np.sqrt(2) * lasting_s))
        changes_db = power_to_db(1 + np.concatenate(shares) * spread)
        over_bands = np.sqrt((changes_db**2).mean(axis=-1))
        reason = f"paths by {order} surfaces bring {100 * np.mean(shares):.0f} % of the energy on average"
        return Prediction(float(over_bands.max()) / JND_THRESHOLDS["spectrum"].amount, "spectrum", reason)

    def per_source_tail(self, *, has_rays: bool) -> Prediction:
        if not has_rays:
            return Prediction(0.0, "level", "no rays are traced, so there is no late tail")
        if self.ends_before_tail:
            return Prediction(0.0, "level", "responses end before all places sound alike")
        one_for_all = self.trial.with_one_tail(self.tail_start_s)
        if not self.is_one_room:
            coupling = self._passage_m2 / (self._passage_m2 + self.room.surface_m2 * self.room.absorption / 2)
            change_db = -float(power_to_db(coupling).min())
            reason = "walls part the plan, and behind them late sound is another"
            by_coupling = Change(change_db / LEVEL_DB, "level")
            return _told(max(by_coupling, one_for_all, key=lambda each: each.jnd), reason)
        reason = (
            f"in one room without corners to hide behind, places differ for {1e3 * self.tail_start_s:.0f} ms "
            "(Lindau et al. 2012), and from then on by this much, by a trial"
        )
        return _told(one_for_all, reason)

    @property
    def tail_start_s(self) -> float:
        """The time after emission at which the shared tail begins, for every receiver."""
        return self.room.mixing_time_s + self.longest_onset_s

    @property
    def ends_before_tail(self) -> bool:
        return self.tail_start_s + FADE_S >= self.scene.simulation.duration_s

    def shared_tail(self) -> TailNeeds | None:
        return None if self.ends_before_tail else TailNeeds(self.tail_start_s, self.tail_rays(), self.rays())

    def diffraction(self) -> Prediction:
        pairs = self._heard
        reason = f"the direct sound of {100 * np.mean(pairs.hidden):.0f} % of the pairs bends round corners"
        if self.is_one_room:
            reason = "no corner stands in any way"
        return Prediction(pairs.without_diffraction_jnd(), "level", reason)

    def transmission(self) -> Prediction:
        mass, pairs = self._mass_kg_m2, self._heard
        if mass is None or not pairs.hidden.any():
            reason = "every pair is in sight" if mass is not None else "walls are solid: the scene gives them no mass"
            return Prediction(0.0, "level", reason)
        walls = walls_between(self.floor_plan, *self._pairs)[pairs.hidden, None]
        change_jnd = pairs.without_transmission_jnd(walls * transmission_loss_db(mass, OCTAVE_BANDS_HZ))
        reason = f"walls of {mass:g} kg/m2, beside what comes round their corners and the reverberation behind them"
        return Prediction(change_jnd, "level", reason)

    def rays(self) -> int:
        """Return the number of rays per emitter that keeps their part in the spread of clarity small, on average over
        receivers; at most the number in the scene file.

        If rays fill the room evenly, one crosses a sphere of radius r pi r**2 / V times per metre.
        """
        most = self.scene.simulation.rays
        if not self.is_one_room:
            return most
        variance_db = _RAY_VARIANCE * self.room.clarity_spread_db(_EARLY_S) ** 2
        crossings = _CHORDS * (10 / np.log(10)) ** 2 / variance_db
        per_ray = SPEED_OF_SOUND * _EARLY_S * np.pi * receiver_radii(self.floor_plan, self.probes) ** 2
        rays = float(np.mean(crossings * self.room.volume_m3 / per_ray))
        return min(most, int(np.ceil(rays / 100)) * 100)

    def tail_rays(self) -> int:
        """Return the number of rays of a shared tail: that of one emitter, or more if the reverberation time needs
        them.

        The tail is part of every response. So its random error is the same for all pairs, and does not average out over
        them.
        """
        rays = self.scene.simulation.rays
        needed = self.trial.tail_rays(self.tail_start_s, _TAIL_ERROR)
        return int(np.clip(math.ceil(np.nan_to_num(needed, nan=rays)), rays, _MOST_TAIL_RAYS * rays))

    @cached_property
    def _ends(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """(pair,) indices of the probes at both ends: each couple once or, where walls and probes are many, the couples
        of some probes."""
        count = len(self.probes)
        tried = int(_MOST_PATH_TESTS / (count * len(self.floor_plan.corners)))
        if tried >= count:
            first, second = np.triu_indices(count, 1)
            return first, second
        some = np.unique(np.linspace(0, count - 1, max(2, tried)).astype(np.int64))
        first, second = np.repeat(some, count), np.tile(np.arange(count), len(some))
        return first[first != second], second[first != second]

    @property
    def _pairs(self) -> tuple[_Floats, _Floats]:
        """(pair, xyz) positions of both ends."""
        first, second = self._ends
        return self.probes[first], self.probes[second]

    @cached_property
    def _paths(self) -> SoundPaths:
        """(pair,) paths of the direct sound in the order of `_pairs`."""
        finder, (first, second) = PlanPathFinder(self.floor_plan, SPEED_OF_SOUND), self._ends
        found = [finder.find(self.probes[at], self.probes[second[first == at]]) for at in np.unique(first)]
        return SoundPaths(
            *(np.concatenate(parts) for parts in zip(*(vars(each).values() for each in found), strict=True))
        )

    @cached_property
    def _heard(self) -> HeardPairs:
        return HeardPairs(self._paths, self._reverberant_power)

    @property
    def _passage_m2(self) -> float:
        """The mean area of the openings; without any, the area of the narrowest gap beside a convex corner of the
        walls."""
        geometry = self.scene.geometry
        widths = [np.subtract(opening.start, opening.end) for opening in geometry.openings]
        if widths:
            return float(np.linalg.norm(widths, axis=-1).mean() * geometry.height_m)
        return float(_narrowest_m(self.floor_plan) * geometry.height_m)

    @property
    def _reverberant_power(self) -> _Floats:
        """(pair, band) power of the reverberation. For pairs not in sight it is that of a coupled room, reduced by the
        share S / (S + A) of the passage (Cremer & Mueller, Principles and Applications of Room Acoustics, vol. 1, 1982,
        sec. II.1)."""
        power = np.tile(self.room.reflected_power(1), (len(self._paths.length_m), 1))
        if not self.is_one_room:
            passage, area = self._passage_m2, self.room.surface_m2 * self.room.absorption / 2
            power[~self._paths.in_sight] *= passage / (passage + area)
        return power


def _told(change: Change, reason: str) -> Prediction:
    return Prediction(change.jnd, change.parameter, reason)


def _narrowest_m(plan: FloorPlan) -> float:
    """Return the narrowest gap from a corner that sound bends round to a wall that does not end there."""
    start, end = plan.walls[:, 0], plan.walls[:, 1]
    along = end - start
    narrowest = np.inf
    for corner in plan.bend_corners:
        share = np.clip(np.sum((corner - start) * along, axis=-1) / np.sum(along**2, axis=-1), 0, 1)
        distance = np.linalg.norm(start + share[:, None] * along - corner, axis=-1)
        narrowest = min(narrowest, float(distance[distance > 1e-6].min()))
    return narrowest
