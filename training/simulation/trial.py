"""A short simulation of a few pairs of a scene, ahead of the whole one: how the energy that rays and first reflections
bring decays, and what would change of that.

Formulas of statistical acoustics take a diffuse field for granted, and many rooms have none: between smooth walls sound
goes to and fro for long, and under an absorbent ceiling level sound outlives all other, so that how much is scattered
decides how fast all of it decays (Hodgson, "Evidence of diffuse surface reflections in rooms", J. Acoust. Soc. Am. 89,
1991). Rays tell, and for decays that many pairs have in common few of them do. In long or flat rooms the late sound is
that of the rare rays that run level for long: few rays hold none of them, and reverberation seems to be half of what it
is. So there are four times as many until the reverberation times stay.

Axes: (take, pair, band, bin) energies relative to that of the direct sound at one metre, in bins of HISTOGRAM_BIN_S
after emission. Takes are independent: what they agree on is no chance, so that the product of a change in one and the
same in the other is, on average, the square of what changes.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from server.acoustics.audibility import JND_THRESHOLDS, ratio_in_jnd
from server.acoustics.bands import OCTAVE_BANDS_HZ, bands_within
from server.acoustics.decibels import db_to_power, power_to_db
from server.scene.geometry import Geometry
from training.data.dataset import GEOMETRIC_ORDER, SPEED_OF_SOUND
from training.data.scene_file import HISTOGRAM_BIN_S, SceneFile
from training.data.simulation_plan import SimulationPlan
from training.simulation.diffuse_room import DiffuseRoom
from training.simulation.direct_paths import DirectPaths
from training.simulation.rays import sphere_directions
from training.simulation.tracing import RoomTracer

_Floats = npt.NDArray[np.float64]

_TAKES = 2
_EMITTERS, _RECEIVERS = 6, 12
# Of all pairs of a take, in each band.
_MOST_BINS = 100_000
# Reflections of all rays of an emitter and a take, at first and at most; ten million of them take about a second.
_FIRST_HITS, _MORE, _MOST_HITS = 400_000, 4, 6_400_000
# Of a reverberation time from one number of rays to the next: a just-noticeable difference.
_SAME_SHARE = 0.05
# With more of them, each takes longer.
_FEW_WALLS = 20
# Of the first number of reflections.
_FEWEST_RAYS, _MOST_RAYS = 50, 2_000
_EARLY_S = 0.050
# Of the room's reverberation time by Eyring; smooth rooms take longer, and are tried for longer.
_LASTING, _LONGER, _LONGEST_S = 1.2, 2.5, 30.0
_SHORTEST_S = 0.2
_DECAY_DB = (-5.0, -35.0)
_SILENCE = 1e-14
MOST_JND = 100.0
"""Where something is missing altogether."""


@dataclass(frozen=True)
class Change:
    """Root mean square over pairs, in the band in which it is greatest, in JND of the parameter that changes most."""

    jnd: float
    parameter: str


@dataclass(frozen=True)
class Energies:
    """`direct` and `first`, the first reflections, (pair, band, bin), the same in all takes, and `late` (take, pair,
    band, bin); `onset` (pair,) is the bin of the direct sound."""

    direct: _Floats
    first: _Floats
    late: _Floats
    onset: npt.NDArray[np.int64]

    @property
    def whole(self) -> _Floats:
        return np.asarray(self.direct + self.first + self.late)


@dataclass(frozen=True)
class Trial:
    """Of a scene and its probes (probe, xyz)."""

    scene: SceneFile
    probes: _Floats

    @cached_property
    def pairs(self) -> tuple[tuple[int, tuple[int, ...]], ...]:
        """A few emitters, each with receivers all over the place."""
        count, bins = len(self.probes), self.duration_s / HISTOGRAM_BIN_S
        receivers = int(np.clip(_MOST_BINS / (_EMITTERS * bins), 2, _RECEIVERS))
        emitters = np.unique(np.linspace(0, count - 1, _EMITTERS).astype(int)).tolist()
        chosen = []
        for number, emitter in enumerate(emitters):
            others = np.delete(np.arange(count), emitter)
            step = max(1, len(others) // receivers)
            chosen.append((emitter, tuple(np.roll(others, -number)[::step][:receivers].tolist())))
        return tuple(chosen)

    @cached_property
    def duration_s(self) -> float:
        """Until it has decayed as far as reverberation times ask for, without scattering too."""
        room = DiffuseRoom(self.scene.geometry, self.scene.air, SPEED_OF_SOUND)
        audible = bands_within(self.scene.simulation.sample_rate)
        onset_s = float(np.ptp(self.probes, axis=0).sum()) / SPEED_OF_SOUND
        lasts_s = onset_s + _LASTING * float(room.reverberation_time_s[:audible].max())
        longest_s = max(_LONGEST_S, self.scene.simulation.duration_s)
        duration_s = min(max(lasts_s, _SHORTEST_S), longest_s)
        while duration_s < longest_s and not self._has_decayed(duration_s):
            duration_s = min(_LONGER * duration_s, longest_s)
        return duration_s

    def _has_decayed(self, duration_s: float) -> bool:
        """Of one emitter's sound, at most of the receivers."""
        receivers = tuple(range(1, min(len(self.probes), 1 + _RECEIVERS)))
        geometry = self.scene.geometry.without_scattering()
        energy = self._traced(geometry, 0, receivers, duration_s, np.random.default_rng(0), _MORE * _FIRST_HITS)
        to_come = np.cumsum(energy[..., ::-1], axis=-1)[..., ::-1].sum(axis=0)
        last = to_come[..., -max(1, to_come.shape[-1] // 10)] / np.maximum(to_come[..., 0], _SILENCE)
        audible = bands_within(self.scene.simulation.sample_rate)
        return bool((power_to_db(last[:audible] + _SILENCE) < _DECAY_DB[1] - 5).all())

    @property
    def scattered(self) -> Energies:
        """As the scene is; no air yet."""
        return self._settled[1]

    @cached_property
    def mirrored(self) -> Energies:
        """Where nothing scatters; no air yet."""
        return self._energies(self.scene.geometry.without_scattering(), self._settled[0])

    @cached_property
    def _settled(self) -> tuple[int, Energies]:
        """As many reflections as reverberation times need to stay, and the energies of so many."""
        hits = _FIRST_HITS
        energies = self._energies(self.scene.geometry, hits)
        while hits < _MOST_HITS:
            hits, fewer = hits * _MORE, energies
            energies = self._energies(self.scene.geometry, hits)
            if self._rings_alike(fewer, energies):
                break
        return hits, energies

    def _rings_alike(self, fewer: Energies, more: Energies) -> bool:
        audible = bands_within(self.scene.simulation.sample_rate)
        before_s, after_s = (self._times_s(each)[:audible] for each in (fewer, more))
        is_same = np.abs(after_s - before_s) <= _SAME_SHARE * after_s
        return bool((is_same | (np.isnan(before_s) & np.isnan(after_s))).all())

    @cached_property
    def reverberation_time_s(self) -> _Floats:
        """(band,) T30 of the scene, median over pairs; NaN where it cannot be told of most of them."""
        return self._times_s(self.scattered)

    def _times_s(self, energies: Energies) -> _Floats:
        times = decay_times_s(self.in_air(energies).whole, energies.onset, *_DECAY_DB)
        by_band = np.moveaxis(times, -1, 0).reshape(times.shape[-1], -1)
        told = np.isfinite(by_band).sum(axis=-1) > by_band.shape[-1] / 2
        # An even number of pairs would have a middle between a time and none.
        middle = np.sort(np.nan_to_num(by_band, nan=np.inf), axis=-1)[:, by_band.shape[-1] // 2]
        return np.where(told & np.isfinite(middle), middle, np.nan)

    def in_air(self, energies: Energies) -> Energies:
        bins_m = (np.arange(energies.late.shape[-1]) + 0.5) * HISTOGRAM_BIN_S * SPEED_OF_SOUND
        air = db_to_power(-self.scene.air.absorption_db_per_m[:, None] * bins_m)
        return Energies(energies.direct * air, energies.first * air, energies.late * air, energies.onset)

    def without_scattering(self) -> Change:
        return self.change(self.in_air(self.scattered), self.in_air(self.mirrored))

    def without_air(self, *, has_rays: bool, scatters: bool) -> Change:
        """Of a plan that has rays or none: where it has none, of direct sound and first reflections alone."""
        dry = self.scattered if scatters else self.mirrored
        if not has_rays:
            dry = Energies(dry.direct, dry.first, np.zeros_like(dry.late), dry.onset)
        return self.change(self.in_air(dry), dry)

    def without_late(self) -> Change:
        whole = self.in_air(self.scattered)
        return self.change(whole, Energies(whole.direct, whole.first, np.zeros_like(whole.late), whole.onset))

    def with_one_tail(self, start_s: float) -> Change:
        """Where all places share their mean late sound from some time after emission on."""
        own = self.in_air(self.scattered)
        late = own.late.copy()
        first = self._bins_before(start_s)
        # Of the other take: what places differ by must not be what rays do.
        late[..., first:] = own.late[::-1, :, :, first:].mean(axis=1, keepdims=True)
        return self.change(own, Energies(own.direct, own.first, late, own.onset))

    def tail_rays(self, start_s: float, share: float) -> float:
        """How many rays it takes to know the reverberation time of a tail that all places share, which begins `start_s`
        after emission, with a standard error of such a `share` of it. In the median of octave bands; NaN where no band
        has a reverberation time. The variance is taken to be inversely proportional to the number of rays.
        """
        hits, energies = self._settled
        audible = bands_within(self.scene.simulation.sample_rate)
        late = self.in_air(energies).late[..., :audible, self._bins_before(start_s) :]
        ends = np.cumsum([len(receivers) for _, receivers in self.pairs])
        of_emitters = np.stack([part.mean(axis=1) for part in np.split(late, ends[:-1], axis=1)], axis=1)
        times_s = decay_times_s(of_emitters, np.zeros(len(ends), np.int64), *_DECAY_DB)
        told = np.isfinite(times_s).all(axis=0)
        one_s, other_s = np.where(told, times_s, 1.0)
        # On average, the square of what two takes differ by is twice the variance of one.
        squares = np.where(told, ((one_s - other_s) / (one_s + other_s)) ** 2 * 2, np.nan)
        known = told.any(axis=0)
        if not known.any():
            return math.nan
        variance = float(np.median(np.nanmean(squares[:, known], axis=0)))
        return _rays(self.scene.geometry, self.duration_s, hits) * variance / share**2

    def _bins_before(self, start_s: float) -> int:
        return min(math.ceil(start_s / HISTOGRAM_BIN_S), round(self.duration_s / HISTOGRAM_BIN_S))

    def change(self, reference: Energies, other: Energies) -> Change:
        """Of level, clarity, early and late decay; those that neither has do not change."""
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

    def _energies(self, geometry: Geometry, reflections: int) -> Energies:
        """Through no air."""
        plan = SimulationPlan(GEOMETRIC_ORDER, 1, None, 0, True, False, True, False)
        scene = self.scene.model_copy(update={"geometry": geometry})
        paths, bins = DirectPaths.of(scene, plan), round(self.duration_s / HISTOGRAM_BIN_S)
        shape = sum(len(receivers) for _, receivers in self.pairs), len(OCTAVE_BANDS_HZ), bins
        direct, first, late = np.zeros(shape), np.zeros(shape), np.zeros((_TAKES, *shape))
        onset, row = np.zeros(shape[0], np.int64), 0
        for number, (emitter, receivers) in enumerate(self.pairs):
            place, heard_at = self.probes[emitter], self.probes[list(receivers)]
            here = slice(row, row + len(receivers))
            for take in range(_TAKES):
                rng = np.random.default_rng([take, number])
                late[take, here] = self._traced(geometry, emitter, receivers, self.duration_s, rng, reflections)
            lengths_m = scene.geometry.floor_plan.path_length_m(place, heard_at)
            onset[here] = np.minimum(_bin_of(lengths_m), bins - 1)
            images = RoomTracer.of(scene, plan, heard_at, duration_s=self.duration_s).images(place)
            for receiver, mirrored in zip(heard_at, images, strict=True):
                for target, (positions, amplitudes) in (
                    (direct[row], paths.images(place, receiver)),
                    (first[row], mirrored),
                ):
                    arrival = _bin_of(np.linalg.norm(positions - receiver, axis=-1))
                    np.add.at(target.T, arrival[arrival < bins], amplitudes[arrival < bins] ** 2)
                row += 1
        return Energies(direct, first, late, onset)

    def _traced(
        self,
        geometry: Geometry,
        emitter: int,
        receivers: tuple[int, ...],
        duration_s: float,
        rng: np.random.Generator,
        reflections: int,
    ) -> _Floats:
        """(receiver, band, bin), by rays that are reflected so many times, all together."""
        tracer = RoomTracer(
            geometry,
            None,
            self.probes[list(receivers)],
            duration_s=duration_s,
            image_order=GEOMETRIC_ORDER,
            arrival_directions=sphere_directions(1),
        )
        rays = _rays(geometry, duration_s, reflections)
        return tracer.energy(self.probes[emitter], rays=rays, rng=rng)[:, 0].astype(np.float64)


def _rays(geometry: Geometry, duration_s: float, reflections: int) -> int:
    """Of an emitter, that are reflected so many times, all together."""
    room = DiffuseRoom(geometry, None, SPEED_OF_SOUND)
    hits = duration_s * SPEED_OF_SOUND / room.mean_free_path_m * max(1, len(geometry.corners) / _FEW_WALLS)
    return int(np.clip(_FIRST_HITS / hits, _FEWEST_RAYS, _MOST_RAYS) * reflections / _FIRST_HITS)


def _bin_of(length_m: _Floats) -> npt.NDArray[np.int64]:
    return (length_m / (SPEED_OF_SOUND * HISTOGRAM_BIN_S)).astype(np.int64)


def parameters(energies: Energies) -> dict[str, _Floats]:
    """(take, pair, band) level in dB, C50 in JND, EDT and T60 in seconds, NaN where there is none."""
    whole, bins = energies.whole, energies.late.shape[-1]
    early = np.arange(bins) <= energies.onset[:, None] + round(_EARLY_S / HISTOGRAM_BIN_S)
    early_energy = np.sum(whole * early[:, None], axis=-1) + _SILENCE
    late_energy = np.sum(whole * ~early[:, None], axis=-1) + _SILENCE
    return {
        "level": power_to_db(early_energy + late_energy),
        "c50": ratio_in_jnd("c50", power_to_db(early_energy / late_energy)),
        "edt": decay_times_s(whole, energies.onset, 0.0, -10.0),
        "t60": decay_times_s(whole, energies.onset, *_DECAY_DB),
    }


def decay_times_s(energy: _Floats, onset: npt.NDArray[np.int64], from_db: float, to_db: float) -> _Floats:
    """(take, pair, band) least squares line through the decay curve, extrapolated to 60 dB; NaN where the curve does
    not reach so far before the last tenth of the time, or in fewer than three bins."""
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
        told = (count >= 3) & reaches & (slope < 0)
        return np.where(told, -60 / slope, np.nan)


def _root_mean_square(difference: _Floats) -> _Floats:
    """(band,) over pairs of (take, pair, band), without what chance alone makes; pairs that cannot be told are left
    out.

    What all pairs have in common is told well; what they differ by counts as far as it is beyond its standard error:
    of few pairs and rays, products of two takes are as often positive by chance."""
    told = np.isfinite(difference).all(axis=0)
    count = np.maximum(1, told.sum(axis=0))
    common = np.where(told, difference, 0.0).sum(axis=1) / count
    own = np.where(told, difference - common[:, None], 0.0).prod(axis=0)
    variance = own.sum(axis=0) / count
    error = np.sqrt(np.where(told, (own - variance) ** 2, 0.0).sum(axis=0)) / count
    return np.asarray(np.sqrt(np.maximum(0.0, common.prod(axis=0)) + np.maximum(0.0, variance - error)))
