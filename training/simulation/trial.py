"""A short trial simulation of a few pairs of a scene, before the whole one: how the energy of rays and first
reflections decays, and how effects change that. The scene is a floor plan, or a level with its doors in one state.

Formulas of statistical acoustics assume a diffuse field, which many rooms do not have. Between smooth walls sound
travels back and forth for long. Under an absorbent ceiling, horizontal sound outlives all other, so that scattering
decides how fast the whole field decays (Hodgson, "Evidence of diffuse surface reflections in rooms", J. Acoust. Soc.
Am. 89, 1991). Rays show this, and a few of them suffice for decays that many pairs have in common. But in long or flat
rooms, late sound comes from the rare rays that stay horizontal for long. Too few rays include none of them, and the
reverberation time comes out at half its value. So the number of rays is multiplied by four until the reverberation
times no longer change.

Axes: (take, pair, band, bin) energies relative to that of the direct sound at one metre, in bins of HISTOGRAM_BIN_S
after emission. The takes are independent. So the product of a change in one take and the same change in the other is,
on average, the square of the true change, without the random part.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
import numpy.typing as npt

from server.acoustics.audibility import JND_THRESHOLDS, ratio_in_jnd
from server.acoustics.bands import OCTAVE_BANDS_HZ, bands_within
from server.acoustics.decibels import db_to_power, power_to_db
from server.planning.change import MOST_JND, Change
from training.data.dataset import GEOMETRIC_ORDER, SPEED_OF_SOUND
from training.data.levels.level_scene import LevelScene
from training.data.scene_file import HISTOGRAM_BIN_S, SceneFile
from training.data.simulated_scene import SimulatedScene
from training.data.simulation_plan import SimulationPlan
from training.simulation.diffuse_room import DiffuseRoom
from training.simulation.direct_paths import DirectPaths
from training.simulation.rays import sphere_directions
from training.simulation.tracing import RoomTracer

_Floats = npt.NDArray[np.float64]

UNHEARD_POWER = 1e-6
"""What is 60 dB below the direct sound at one metre is not heard: speech has some 60 dB there."""

_TAKES = 2
# The most bins of all pairs of a take together, in each band.
_MOST_BINS = 100_000
_MORE = 4
# A reverberation time counts as unchanged within this share, which is a just-noticeable difference.
_SAME_SHARE = 0.05
# With more walls of a floor plan than this, each reflection takes longer.
_FEW_WALLS = 20
# The fewest and most rays at the first number of reflections.
_FEWEST_RAYS, _MOST_RAYS = 50, 2_000
_EARLY_S = 0.050
# First duration in reverberation times by Eyring's formula, and growth factor: smooth rooms decay more slowly.
_LASTING, _LONGER, _LONGEST_S = 1.2, 2.5, 30.0
_SHORTEST_S = 0.2
_DECAY_DB = (-5.0, -35.0)
_SILENCE = 1e-14


@dataclass(frozen=True)
class Energies:
    """The energies of a trial. `direct` and `first` (first reflections) are (pair, band, bin), the same in all takes;
    `late` is (take, pair, band, bin). `onset` (pair,) is the bin of the direct sound."""

    direct: _Floats
    first: _Floats
    late: _Floats
    onset: npt.NDArray[np.int64]

    @property
    def whole(self) -> _Floats:
        return np.asarray(self.direct + self.first + self.late)


class Statistics(Protocol):
    """What statistical acoustics says about a place. How long a trial lasts, and how many rays it has, follow from
    this."""

    @property
    def mean_free_path_m(self) -> float: ...

    @property
    def reverberation_time_s(self) -> _Floats:
        """(band,) T60 in a diffuse field."""


@dataclass(frozen=True)
class Effort:
    """What a trial may compute. Hits are the reflections of all rays of an emitter in a take: `first_hits` at first,
    then four times as many until reverberation times no longer change, and at most `most_hits`."""

    emitters: int
    receivers: int
    first_hits: int
    most_hits: int


# Ten million hits take a second.
_OF_PLANS = Effort(emitters=6, receivers=12, first_hits=400_000, most_hits=6_400_000)
# A million take a second, and each state of the doors has a trial of its own.
_OF_LEVELS = Effort(emitters=4, receivers=12, first_hits=25_000, most_hits=100_000)


@dataclass(frozen=True)
class Trial:
    """A trial simulation of a scene and its probes (probe, xyz). With `through_walls`, sound goes through walls that
    have a mass. A hit counts as `hit_weight` of them, where each takes longer."""

    scene: SimulatedScene
    probes: _Floats
    room: Statistics
    effort: Effort
    hit_weight: float = 1.0
    through_walls: bool = False

    @classmethod
    def of_plan(cls, scene: SceneFile, probes: _Floats) -> "Trial":
        weight = max(1.0, len(scene.geometry.corners) / _FEW_WALLS)
        room = DiffuseRoom(scene.geometry, scene.air, SPEED_OF_SOUND)
        return cls(scene, probes, room, _OF_PLANS, weight)

    @classmethod
    def of_level(cls, level: LevelScene, probes: _Floats, room: Statistics) -> "Trial":
        return cls(level, probes, room, _OF_LEVELS, through_walls=level.has_mass)

    @cached_property
    def pairs(self) -> tuple[tuple[int, tuple[int, ...]], ...]:
        """A few emitters, each with receivers that are spread over the scene."""
        count, bins = len(self.probes), self.duration_s / HISTOGRAM_BIN_S
        receivers = int(np.clip(_MOST_BINS / (self.effort.emitters * bins), 2, self.effort.receivers))
        emitters = np.unique(np.linspace(0, count - 1, self.effort.emitters).astype(int)).tolist()
        chosen = []
        for number, emitter in enumerate(emitters):
            others = np.delete(np.arange(count), emitter)
            step = max(1, len(others) // receivers)
            chosen.append((emitter, tuple(np.roll(others, -number)[::step][:receivers].tolist())))
        return tuple(chosen)

    @cached_property
    def duration_s(self) -> float:
        """The time in which sound decays as far as reverberation times require, with and without scattering."""
        audible = bands_within(self.scene.simulation.sample_rate)
        onset_s = float(np.ptp(self.probes, axis=0).sum()) / SPEED_OF_SOUND
        lasts_s = onset_s + _LASTING * float(self.room.reverberation_time_s[:audible].max())
        longest_s = max(_LONGEST_S, self.scene.simulation.duration_s)
        duration_s = min(max(lasts_s, _SHORTEST_S), longest_s)
        while duration_s < longest_s and not self._has_decayed(duration_s):
            duration_s = min(_LONGER * duration_s, longest_s)
        return duration_s

    def _has_decayed(self, duration_s: float) -> bool:
        """Whether one emitter's sound, without scattering, has decayed at the median receiver."""
        receivers = tuple(range(1, min(len(self.probes), 1 + self.effort.receivers)))
        tracer = self._tracer(self._plan(scattering=False), receivers, duration_s)
        energy = self._traced(tracer, 0, duration_s, np.random.default_rng(0), _MORE * self.effort.first_hits)
        to_come = np.cumsum(energy[..., ::-1], axis=-1)[..., ::-1].sum(axis=0)
        last = to_come[..., -max(1, to_come.shape[-1] // 10)] / np.maximum(to_come[..., 0], _SILENCE)
        audible = bands_within(self.scene.simulation.sample_rate)
        return bool((power_to_db(last[:audible] + _SILENCE) < _DECAY_DB[1] - 5).all())

    @property
    def scattered(self) -> Energies:
        """The energies of the scene with scattering, without absorption by the air."""
        return self._settled[1]

    @property
    def parted(self) -> Energies:
        """The same but for what goes through walls."""
        return self._settled[2]

    @cached_property
    def mirrored(self) -> Energies:
        """The energies without scattering, and without absorption by the air."""
        return self._energies(self._plan(scattering=False), self._settled[0])[0]

    @cached_property
    def _settled(self) -> tuple[int, Energies, Energies]:
        """The number of reflections from which on reverberation times no longer change, and the energies with that
        number, with what goes through walls and without."""
        hits = self.effort.first_hits
        energies, parted = self._energies(self._plan(), hits)
        while hits < self.effort.most_hits:
            hits, fewer = hits * _MORE, energies
            energies, parted = self._energies(self._plan(), hits)
            if self._same_decay(fewer, energies):
                break
        return hits, energies, parted

    def _same_decay(self, fewer: Energies, more: Energies) -> bool:
        audible = bands_within(self.scene.simulation.sample_rate)
        before_s, after_s = (self._times_s(each)[:audible] for each in (fewer, more))
        is_same = np.abs(after_s - before_s) <= _SAME_SHARE * after_s
        return bool((is_same | (np.isnan(before_s) & np.isnan(after_s))).all())

    @cached_property
    def reverberation_time_s(self) -> _Floats:
        """(band,) T30 of the scene, median over the pairs that hear anything; NaN where most of them have none."""
        return self._times_s(self.scattered)

    def _times_s(self, energies: Energies) -> _Floats:
        whole = self.in_air(energies).whole
        times = decay_times_s(whole, energies.onset, *_DECAY_DB)
        times = times[:, (whole.sum(axis=(-2, -1)) > UNHEARD_POWER).all(axis=0)]
        if not times.size:
            return np.full(times.shape[-1], np.nan)
        by_band = np.moveaxis(times, -1, 0).reshape(times.shape[-1], -1)
        is_known = np.isfinite(by_band).sum(axis=-1) > by_band.shape[-1] / 2
        # With an even number of pairs, the usual median might average a time and a missing value.
        middle = np.sort(np.nan_to_num(by_band, nan=np.inf), axis=-1)[:, by_band.shape[-1] // 2]
        return np.where(is_known & np.isfinite(middle), middle, np.nan)

    def in_air(self, energies: Energies) -> Energies:
        bins_m = (np.arange(energies.late.shape[-1]) + 0.5) * HISTOGRAM_BIN_S * SPEED_OF_SOUND
        air = db_to_power(-self.scene.air.absorption_db_per_m[:, None] * bins_m)
        return Energies(energies.direct * air, energies.first * air, energies.late * air, energies.onset)

    def without_scattering(self) -> Change:
        return self.change(self.in_air(self.scattered), self.in_air(self.mirrored))

    def without_air(self, *, has_rays: bool, scatters: bool) -> Change:
        """The change without absorption by the air. In a plan without rays, only direct sound and first reflections
        count."""
        dry = self.scattered if scatters else self.mirrored
        if not has_rays:
            dry = Energies(dry.direct, dry.first, np.zeros_like(dry.late), dry.onset)
        return self.change(self.in_air(dry), dry)

    def without_transmission(self) -> Change:
        return self.change(self.in_air(self.scattered), self.in_air(self.parted))

    def reverberant_power(self) -> _Floats:
        """(pair, band) power of all reflections, with walls that let nothing through."""
        parted = self.in_air(self.parted)
        return np.asarray((parted.first + parted.late.mean(axis=0)).sum(axis=-1))

    def without_late(self) -> Change:
        whole = self.in_air(self.scattered)
        return self.change(whole, Energies(whole.direct, whole.first, np.zeros_like(whole.late), whole.onset))

    def with_one_tail(self, start_s: float) -> Change:
        """The change if, from `start_s` after emission on, all places share their mean late sound."""
        own = self.in_air(self.scattered)
        late = own.late.copy()
        first = self._bins_before(start_s)
        # The mean is taken from the other take, so that random errors of rays do not look like differences between
        # places.
        late[..., first:] = own.late[::-1, :, :, first:].mean(axis=1, keepdims=True)
        return self.change(own, Energies(own.direct, own.first, late, own.onset))

    def tail_rays(self, start_s: float, share: float) -> float:
        """The number of rays that gives the reverberation time of a shared tail, which begins `start_s` after emission,
        with a relative standard error of `share`, in the median octave band. NaN if no band has a reverberation time.
        The variance is assumed to be inversely proportional to the number of rays."""
        hits, energies, _ = self._settled
        audible = bands_within(self.scene.simulation.sample_rate)
        late = self.in_air(energies).late[..., :audible, self._bins_before(start_s) :]
        ends = np.cumsum([len(receivers) for _, receivers in self.pairs])
        of_emitters = np.stack([part.mean(axis=1) for part in np.split(late, ends[:-1], axis=1)], axis=1)
        times_s = decay_times_s(of_emitters, np.zeros(len(ends), np.int64), *_DECAY_DB)
        has_time = np.isfinite(times_s).all(axis=0)
        one_s, other_s = np.where(has_time, times_s, 1.0)
        # On average, the squared difference of two takes is twice the variance of one.
        squares = np.where(has_time, ((one_s - other_s) / (one_s + other_s)) ** 2 * 2, np.nan)
        known = has_time.any(axis=0)
        if not known.any():
            return math.nan
        variance = float(np.median(np.nanmean(squares[:, known], axis=0)))
        return self._rays(self.duration_s, hits) * variance / share**2

    def _bins_before(self, start_s: float) -> int:
        return min(math.ceil(start_s / HISTOGRAM_BIN_S), round(self.duration_s / HISTOGRAM_BIN_S))

    def change(self, reference: Energies, other: Energies) -> Change:
        """The greatest change of level, clarity, early and late decay: root mean square over pairs, in the band in
        which it is greatest. A parameter that is missing in both does not change."""
        audible = bands_within(self.scene.simulation.sample_rate)
        before, after = (parameters(each) for each in (reference, other))
        found = Change(0.0, "level")
        for name, values in before.items():
            difference = (after[name] - values)[..., :audible]
            if name in {"edt", "t60"}:
                difference = 100 * difference / values[..., :audible]
            unit = 1.0 if name == "c50" else JND_THRESHOLDS[name].amount
            jnd = min(MOST_JND, float(np.max(_root_mean_square(difference / unit), initial=0.0)))
            if jnd > found.jnd:
                found = Change(jnd, name)
        return found

    def _plan(self, *, scattering: bool = True) -> SimulationPlan:
        """A plan with images of first reflections, and without absorption by the air."""
        everything = SimulationPlan.everything(GEOMETRIC_ORDER, 1, transmission=self.through_walls)
        return replace(everything, scattering=scattering, air_absorption=False)

    def _energies(self, plan: SimulationPlan, hits: int) -> tuple[Energies, Energies]:
        """Simulate the energies by a plan, with `hits` reflections of the rays of each emitter in each take. The second
        are without what goes through walls. Both have the rest in common, with its random errors, so that their
        difference has none of these."""
        bins, parting = round(self.duration_s / HISTOGRAM_BIN_S), replace(plan, transmission=False)
        shape = sum(len(receivers) for _, receivers in self.pairs), len(OCTAVE_BANDS_HZ), bins
        (direct, parted, first), late = np.zeros((3, *shape)), np.zeros((_TAKES, *shape))
        through, onset = np.zeros_like(late), np.zeros(shape[0], np.int64)
        paths = [(parted, DirectPaths.of(self.scene, parting))]
        if plan.transmission:
            paths.append((direct, DirectPaths.of(self.scene, plan)))
        else:
            direct = parted
        row = 0
        for number, (emitter, receivers) in enumerate(self.pairs):
            place, heard_at = self.probes[emitter], self.probes[list(receivers)]
            here = slice(row, row + len(receivers))
            tracer = self._tracer(parting, receivers, self.duration_s)
            for take in range(_TAKES):
                rng = np.random.default_rng([take, number])
                late[take, here] = self._traced(tracer, emitter, self.duration_s, rng, hits)
            if plan.transmission:
                behind = self._tracer(plan, receivers, self.duration_s, only_through=True)
                for take in range(_TAKES):
                    rng = np.random.default_rng([take, number, 1])
                    through[take, here] = self._traced(behind, emitter, self.duration_s, rng, hits)
            onset[here] = np.minimum(_bin_of(self.scene.path_length_m(place, heard_at)), bins - 1)
            for receiver, mirrored in zip(heard_at, tracer.images(place), strict=True):
                found = [(target, finder.images(place, receiver)) for target, finder in paths]
                for target, (positions, amplitudes) in [*found, (first, mirrored)]:
                    arrival = _bin_of(np.linalg.norm(positions - receiver, axis=-1))
                    np.add.at(target[row].T, arrival[arrival < bins], amplitudes[arrival < bins] ** 2)
                row += 1
        return Energies(direct, first, late + through, onset), Energies(parted, first, late, onset)

    def _tracer(
        self, plan: SimulationPlan, receivers: tuple[int, ...], duration_s: float, *, only_through: bool = False
    ) -> RoomTracer:
        return RoomTracer.of(
            self.scene,
            plan,
            self.probes[list(receivers)],
            duration_s=duration_s,
            arrival_directions=sphere_directions(1),
            few_rays=True,
            only_through=only_through,
        )

    def _traced(
        self, tracer: RoomTracer, emitter: int, duration_s: float, rng: np.random.Generator, hits: int
    ) -> _Floats:
        """(receiver, band, bin) energies of rays with `hits` reflections in total."""
        energy = tracer.energy(self.probes[emitter], rays=self._rays(duration_s, hits), rng=rng)
        return energy[:, 0].astype(np.float64)

    def _rays(self, duration_s: float, hits: int) -> int:
        """The number of rays of an emitter that have `hits` reflections in total."""
        first = self.effort.first_hits
        of_ray = duration_s * SPEED_OF_SOUND / self.room.mean_free_path_m * self.hit_weight
        return int(np.clip(first / of_ray, _FEWEST_RAYS, _MOST_RAYS) * hits / first)


def _bin_of(length_m: _Floats) -> npt.NDArray[np.int64]:
    return (length_m / (SPEED_OF_SOUND * HISTOGRAM_BIN_S)).astype(np.int64)


def parameters(energies: Energies) -> dict[str, _Floats]:
    """(take, pair, band) parameters by name: level in dB, C50 in JND, EDT and T60 in seconds; NaN where a parameter is
    missing, or nothing is heard."""
    whole, bins = energies.whole, energies.late.shape[-1]
    early = np.arange(bins) <= energies.onset[:, None] + round(_EARLY_S / HISTOGRAM_BIN_S)
    early_energy = np.sum(whole * early[:, None], axis=-1) + UNHEARD_POWER
    late_energy = np.sum(whole * ~early[:, None], axis=-1) + UNHEARD_POWER
    is_heard = early_energy + late_energy > 3 * UNHEARD_POWER
    return {
        "level": power_to_db(early_energy + late_energy),
        "c50": ratio_in_jnd("c50", power_to_db(early_energy / late_energy)),
        "edt": np.where(is_heard, decay_times_s(whole, energies.onset, 0.0, -10.0), np.nan),
        "t60": np.where(is_heard, decay_times_s(whole, energies.onset, *_DECAY_DB), np.nan),
    }


def decay_times_s(energy: _Floats, onset: npt.NDArray[np.int64], from_db: float, to_db: float) -> _Floats:
    """(take, pair, band) times of a 60 dB decay, by a least-squares line through the decay curve from `from_db` to
    `to_db`. NaN where the curve does not reach `to_db` before the last tenth of the duration, or has fewer than three
    bins within the range."""
    to_come = np.cumsum(energy[..., ::-1], axis=-1)[..., ::-1]
    curve_db = power_to_db((to_come + _SILENCE**2) / (to_come[..., :1] + _SILENCE**2))
    bins = energy.shape[-1]
    number = np.arange(bins)
    within = (curve_db <= from_db) & (curve_db >= to_db) & (number >= onset[:, None, None])
    count = within.sum(axis=-1)
    time_s = number * HISTOGRAM_BIN_S
    with np.errstate(invalid="ignore", divide="ignore"):
        middle = (within * time_s).sum(axis=-1) / count
        level = np.where(within, curve_db, 0.0)
        off = np.where(within, time_s - middle[..., None], 0.0)
        slope = (off * level).sum(axis=-1) / (off**2).sum(axis=-1)
        reaches = curve_db[..., -max(1, bins // 10)] < to_db
        is_valid = (count >= 3) & reaches & (slope < 0)
        return np.where(is_valid, -60 / slope, np.nan)


def _root_mean_square(difference: _Floats) -> _Floats:
    """(band,) root mean square over pairs of differences (take, pair, band), without the random part. Pairs without a
    value are left out.

    The common difference of all pairs is known well. The differences between pairs count only as far as they exceed
    their standard error, because for few pairs and rays, chance makes the product of two takes positive as often as
    negative.
    """
    is_known = np.isfinite(difference).all(axis=0)
    count = np.maximum(1, is_known.sum(axis=0))
    common = np.where(is_known, difference, 0.0).sum(axis=1) / count
    own = np.where(is_known, difference - common[:, None], 0.0).prod(axis=0)
    variance = own.sum(axis=0) / count
    error = np.sqrt(np.where(is_known, (own - variance) ** 2, 0.0).sum(axis=0)) / count
    return np.asarray(np.sqrt(np.maximum(0.0, common.prod(axis=0)) + np.maximum(0.0, variance - error)))
