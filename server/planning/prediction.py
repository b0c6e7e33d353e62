"""Energies of each emitter's sound at the listener, and how they change where an effect is left out: the direct sound
along the paths within reach, the first reflections, and the field's responses.

Energies add up, except where first reflections meet the direct sound: there the interference is computed. Each effect
defines its own factors on energies (`Factors`). The head is a sphere with outer ears. Axes are those of
`server.planning.reach`, and v variants, each of which leaves out some effects; bands are FILTER_BANDS_HZ. Energies are
relative to the direct sound at one metre.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from server.acoustics.audibility import JND_THRESHOLDS, ratio_in_jnd
from server.acoustics.bands import FILTER_BANDS_HZ, OCTAVE_BANDS_HZ, bands_within, in_filter_bands, in_octave_above
from server.acoustics.decibels import db_to_power, power_to_db
from server.acoustics.geometry import axes_of
from server.acoustics.sound_path import SoundPaths
from server.planning.change import MOST_JND, Change
from server.planning.reach import Reach
from server.planning.scene_acoustics import Emitter, Reverberation, SceneAcoustics, Situation
from server.scene.effects import EffectName

Floats = npt.NDArray[np.float64]
Off = frozenset[EffectName]

ALL_ON: Off = frozenset()

_SILENCE = 1e-12
_FACING_GAIN = np.array([4.0] * len(OCTAVE_BANDS_HZ) + [1.0])
"""(band,) gain of an ear that faces the sound, in power: 6 dB; heads differ, and outer ears do more at 4 kHz (Shaw, J.
Acoust. Soc. Am. 56, 1974). Above 10 kHz outer ears have notches and no gain on the whole."""
_DIRECT_S = 0.0015
_DECAY_POINTS = 48
_THIRDS_HZ = 1000 * 2 ** (np.arange(-9, 11) / 3)
_PER_THIRD = 2 ** (np.linspace(-0.5, 0.5, 7) / 3)


@dataclass(frozen=True)
class Energies:
    """Energies of the direct sound (v, n, band), the first reflections (v, e, band), the field's responses (v, e,
    band), and the first 50 ms of those responses (v, e, band)."""

    direct: Floats
    mirrored: Floats
    held: Floats
    early: Floats


@dataclass(frozen=True)
class Mirrored:
    """m paths by way of one surface, at the present poses: the index of the emitter, the length, the gains (m, band) of
    the surface and of the emitter in the direction of departure, and the direction of arrival (m, 3)."""

    owner: npt.NDArray[np.int64]
    length_m: Floats
    surface_db: Floats
    departure_db: Floats
    arrival: Floats

    @cached_property
    def departure(self) -> Floats:
        """(m, band) factor of the emitter's directivity in the direction of departure."""
        return db_to_power(self.departure_db)


@dataclass(frozen=True)
class Way:
    """The n paths of the direct sound within reach, and their factors on energy. With `goes_through`, the paths go
    straight through all obstacles."""

    place: SceneAcoustics
    paths: SoundPaths
    departure_db: Floats
    goes_through: bool

    @cached_property
    def spread(self) -> Floats:
        """(n, 1) factor of the distance."""
        return _spread(self.paths.length_m, self.place)

    @cached_property
    def air(self) -> Floats:
        """(n, band) factor of air absorption."""
        return _air(self.paths.length_m, self.place)

    @cached_property
    def departure(self) -> Floats:
        """(n, band) factor of the emitter's directivity in the direction of departure."""
        return db_to_power(in_octave_above(self.departure_db))

    @cached_property
    def screen(self) -> Floats:
        """(n, band) factor of diffraction at the edges that they pass."""
        return db_to_power(in_octave_above(self.paths.screen_db))


_Of = TypeVar("_Of")


@dataclass(frozen=True)
class Factors(Generic[_Of]):
    """The factors by which an effect multiplies energies where it is on and where it is off; None leaves energies
    unchanged."""

    on: Callable[[_Of], Floats | float] | None = None
    off: Callable[[_Of], Floats | float] | None = None


UNTOUCHED: Factors[Any] = Factors()


class EffectOnEnergies(Protocol):
    """The part of an effect that predictions use (`server.planning.effect.EnergyEffect`)."""

    @property
    def name(self) -> EffectName: ...
    @property
    def is_coherent(self) -> bool: ...
    @property
    def leads_round(self) -> bool: ...
    @property
    def direct(self) -> Factors[Way]: ...
    @property
    def mirrored(self) -> Factors[Mirrored]: ...
    @property
    def held(self) -> Factors[Floats]: ...


_Known = list[tuple[EffectName, Floats | float | None, Floats | float | None]]
"""Names of effects, each with its factor where it is on and where it is off."""


class Prediction:
    """Predicted energies, and changes without effects, for all emitters of a situation (at least one). `effects` are
    those that change energies."""

    def __init__(self, situation: Situation, effects: Sequence[EffectOnEnergies]) -> None:
        self.situation = situation
        self._effects = effects
        self._leading_round = frozenset(effect.name for effect in effects if effect.leads_round)
        self._coherent = frozenset(effect.name for effect in effects if effect.is_coherent)
        self.place, self.listener = situation.place, situation.listener
        self.emitters: list[Emitter] = list(situation.emitters.values())
        self.reach = Reach.of(situation)
        self.mirrored = self._mirror()
        self.shares = self.place.band_shares
        self.reverberation: list[Reverberation | None] = [
            each.reverberation or self.place.reverberation for each in self.emitters
        ]
        self._held = np.zeros((len(self.emitters), len(FILTER_BANDS_HZ)))
        self._early, self._diffuse = np.zeros_like(self._held), np.ones_like(self._held)
        for number, (emitter, rest) in enumerate(zip(self.emitters, self.reverberation, strict=True)):
            if not emitter.is_omnidirectional:
                self._diffuse[number] = np.mean(db_to_power(emitter.directivity.diffuse_gain_db))
            if rest is not None:
                self._held[number], self._early[number] = in_octave_above(rest.energy), rest.early
        self._facing_gain = _FACING_GAIN if self.listener.output == "headphones" else np.ones(len(FILTER_BANDS_HZ))
        self._decays = _Decays.of(self)
        self.whole = self.energies([ALL_ON])
        self._heard = self._parameters(self.whole)

    def energies(self, variants: Sequence[Off]) -> Energies:
        """Return the energies in each of v variants, which are the sets of effects left out."""
        mirror = self.mirrored_energies(variants)
        direct = np.zeros((len(variants), len(self.reach.owner), len(FILTER_BANDS_HZ)))
        mirrored = np.zeros((len(variants), *self._held.shape))
        held = np.zeros_like(mirrored)
        for variant, off in enumerate(variants):
            if not self.place.holds_direct_sound:
                direct[variant] = 1
                _multiply(direct[variant], self._straight if off & self._leading_round else self._bent, off)
            np.add.at(mirrored[variant], self.mirrored.owner, mirror[variant])
            held[variant] = self._held
            _multiply(held[variant], self._on_held, off)
        return Energies(direct, mirrored, held, held * self._early)

    def mirrored_energies(self, variants: Sequence[Off]) -> Floats:
        """Return the energies (v, m, band) of the first reflections. They include air absorption even where it is off
        for the direct sound."""
        energies = np.tile(self._mirrored_everywhere, (len(variants), 1, 1))
        for energy, off in zip(energies, variants, strict=True):
            _multiply(energy, self._on_mirrored, off)
        return energies

    @cached_property
    def _mirrored_everywhere(self) -> Floats:
        """(m, band) energies of the first reflections if all emitters were omnidirectional."""
        paths, place = self.mirrored, self.place
        return db_to_power(paths.surface_db) * _spread(paths.length_m, place) * _air(paths.length_m, place)

    @cached_property
    def _on_mirrored(self) -> _Known:
        return [_known(effect.name, effect.mirrored, self.mirrored) for effect in self._effects]

    @cached_property
    def _on_held(self) -> _Known:
        return [_known(effect.name, effect.held, self._diffuse) for effect in self._effects]

    @cached_property
    def _bent(self) -> _Known:
        """Factors on the direct sound that goes round obstacles."""
        way = Way(self.place, self.reach.paths, self.reach.departure_db, goes_through=False)
        return [_known(effect.name, effect.direct, way) for effect in self._effects]

    @cached_property
    def _straight(self) -> _Known:
        """Factors on the direct sound that goes through obstacles."""
        way = Way(self.place, self.reach.straight, self.reach.straight_departure_db, goes_through=True)
        return [_known(effect.name, effect.direct, way) for effect in self._effects]

    def changes(self, variants: Sequence[Off]) -> dict[str, Floats]:
        """Return the change (v, e) of each parameter in each variant, in JND, as the maximum within reach."""
        left = self.energies(variants)
        without = self._parameters(left)
        changes = {"spectrum": self.reach.most(self._spectral_change_db(left)) / JND_THRESHOLDS["spectrum"].amount}
        for name, heard in self._heard.items():
            if name == "edt":
                # Where a decay cannot be measured, its change counts as 0; the other parameters show the difference.
                told = (heard > 0) & (without[name] > 0)
                ratio = np.divide(without[name], heard, out=np.ones_like(without[name]), where=told)
                changes[name] = np.abs(ratio - 1) * 100 / JND_THRESHOLDS[name].amount
            else:
                difference = np.abs(without[name] - heard) / (
                    1 if name in {"drr", "c50"} else JND_THRESHOLDS[name].amount
                )
                changes[name] = self.reach.most(difference)
        for number, off in enumerate(variants):
            quiet = all(change[number].min() < 1 for change in changes.values())
            if quiet and off & self._coherent:
                beats_db = np.max(np.abs(self._thirds_db(off) - self._heard_thirds_db), axis=-1)
                changes["spectrum"][number] = np.maximum(
                    changes["spectrum"][number], beats_db / JND_THRESHOLDS["spectrum"].amount
                )
        return {name: np.minimum(change, MOST_JND) for name, change in changes.items()}

    def _parameters(self, energies: Energies) -> dict[str, Floats]:
        """Return the level (v, n) in dB, DRR and C50 (v, n) in JND, and EDT (v, e) in seconds."""
        owner = self.reach.owner
        after = energies.mirrored + energies.held
        late = (energies.held - energies.early) @ self.shares
        direct, early = energies.direct @ self.shares, (after @ self.shares) - late

        def ratio_db(above: Floats, below: Floats) -> Floats:
            return power_to_db((above + _SILENCE) / (below + _SILENCE))

        return {
            "level": power_to_db(direct + (early + late)[:, owner] + _SILENCE),
            "drr": ratio_in_jnd("drr", ratio_db(direct, (early + late)[:, owner])),
            "c50": ratio_in_jnd("c50", ratio_db(direct + early[:, owner], late[:, owner])),
            "edt": self._decays.early_decay_s(self, energies),
        }

    def _spectral_change_db(self, left: Energies) -> Floats:
        """Return the level change (v, n) in dB in the band where it is greatest, at an ear without gain for the direct
        sound or at one that faces it and receives it louder than sound from everywhere.

        The field's response is noise. In a third-octave band, noise is partly in phase with the other sound by chance,
        and more so the fewer modes it has. A decay has as many modes as its bandwidth times its duration.
        """
        owner, whole = self.reach.owner, self.whole
        within = bands_within(self.place.sample_rate, FILTER_BANDS_HZ)
        mirrored, held = whole.mirrored, whole.held
        mirrored_change = np.abs(np.sqrt(mirrored) - np.sqrt(left.mirrored))[:, owner]
        held_root = np.sqrt(held)[:, owner]
        held_change = np.abs(np.sqrt(held) - np.sqrt(left.held))[:, owner]
        after, other_after = (energies.held + energies.mirrored for energies in (whole, left))
        after, other_after = (energy[:, owner] + _SILENCE for energy in (after, other_after))
        mirrored, chance = mirrored[:, owner], 2 * self._chance[owner]

        def change(gain: Floats | float) -> Floats:
            direct, other_direct = whole.direct * gain, left.direct * gain
            amplitude = np.abs(np.sqrt(direct) - np.sqrt(other_direct)) + mirrored_change
            by_chance = amplitude * held_root + held_change * np.sqrt(direct + mirrored)
            before, without = direct + after, other_direct + other_after
            most = np.abs(before - without) + by_chance * chance
            return np.asarray((most / np.minimum(before, without))[..., :within].max(axis=-1))

        return power_to_db(1 + np.maximum(change(1.0), change(self._facing_gain)))

    @cached_property
    def _chance(self) -> Floats:
        """(e, band) greatest correlation of noise with other sound by chance, as two standard deviations."""
        third_hz = np.asarray(FILTER_BANDS_HZ) * (2 ** (1 / 6) - 2 ** (-1 / 6))
        decays_s = np.zeros((len(self.emitters), len(third_hz)))
        for number, rest in enumerate(self.reverberation):
            if rest is not None:
                decays_s[number] = in_octave_above(rest.t60_s)
        return np.asarray(2 / np.sqrt(np.maximum(third_hz * decays_s / 6.9, 4)))

    @cached_property
    def _heard_thirds_db(self) -> Floats:
        return self._thirds_db(ALL_ON)

    @cached_property
    def _phases(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.complex128]]:
        """(frequency,) octave bands of frequencies in thirds of octaves, and (m, frequency) phase factors of the delay
        of mirrored paths after the direct sound."""
        frequency = (_THIRDS_HZ[0.45 * self.place.sample_rate > _THIRDS_HZ, None] * _PER_THIRD).ravel()
        bands = np.argmin(np.abs(np.log2(frequency[:, None] / np.asarray(FILTER_BANDS_HZ))), axis=-1)
        paths, direct_m = self.mirrored, self.reach.paths.length_m
        later_s = (paths.length_m - direct_m[paths.owner]) / self.place.speed_of_sound
        return bands, np.exp(-2j * np.pi * later_s[:, None] * frequency)

    def _thirds_db(self, off: Off) -> Floats:
        """Return the spectrum (e, third) in dB at the present poses: the sum of direct sound and first reflections with
        their phases, and the energy of the field's response."""
        energies, (bands, turns) = self.energies([off]), self._phases
        count = len(self.emitters)
        wave = np.sqrt(energies.direct[0, :count])[:, bands].astype(np.complex128)
        amplitude = np.sqrt(self.mirrored_energies([off])[0])
        wave += self._decays.whose @ (amplitude[:, bands] * turns)
        power = np.abs(wave) ** 2 + energies.held[0][:, bands] + _SILENCE
        return power_to_db(power.reshape(count, -1, len(_PER_THIRD)).mean(axis=-1))

    def _mirror(self) -> Mirrored:
        bands = len(FILTER_BANDS_HZ)
        if self.place.reflections is None:
            none = np.zeros((0, bands))
            return Mirrored(np.zeros(0, np.int64), np.zeros(0), none, none, np.zeros((0, 3)))
        places = np.array([emitter.pose.position for emitter in self.emitters])
        found = self.place.reflections.find(self.listener.pose.position, places)
        departure_db = np.zeros((len(found.emitter), bands))
        for number, emitter in enumerate(self.emitters):
            if not emitter.is_omnidirectional:
                mine = found.emitter == number
                gain_db = emitter.directivity.gain_db(found.departure[mine] @ axes_of(emitter.pose.orientation).T)
                departure_db[mine] = in_octave_above(gain_db)
        return Mirrored(found.emitter, found.length_m, in_octave_above(found.gain_db), departure_db, found.arrival)


def _spread(length_m: Floats, place: SceneAcoustics) -> Floats:
    return np.asarray(np.maximum(length_m, place.nearest_m)[:, None] ** -2.0)


def _air(length_m: Floats, place: SceneAcoustics) -> Floats:
    return db_to_power(-length_m[:, None] * in_filter_bands(place.air_db_per_m))


def _known(
    name: EffectName, factors: Factors[_Of], of: _Of
) -> tuple[EffectName, Floats | float | None, Floats | float | None]:
    return name, None if factors.on is None else factors.on(of), None if factors.off is None else factors.off(of)


def _multiply(energy: Floats, factors: _Known, off: Off) -> None:
    for name, on, without in factors:
        factor = without if name in off else on
        if factor is not None:
            energy *= factor


@dataclass(frozen=True)
class _Decays:
    """Energy decay curves of all emitters at the present poses, over the times in which a decay is measured: (e, time)
    each, `held` (e, band, time) and `mirrored` (m, time) for energies of 1."""

    time_s: Floats
    held: Floats
    direct: Floats
    mirrored: Floats
    whose: Floats
    """(e, m) 1 where a mirrored path belongs to an emitter, else 0."""

    @classmethod
    def of(cls, prediction: "Prediction") -> "_Decays":
        longest, paths = np.ones((len(prediction.emitters), len(FILTER_BANDS_HZ))), prediction.mirrored
        for number, rest in enumerate(prediction.reverberation):
            if rest is not None:
                longest[number] = in_octave_above(rest.t60_s)
        time_s = (longest @ prediction.shares)[:, None] * np.linspace(0, 1 / 6, _DECAY_POINTS)
        later_s = (paths.length_m - prediction.reach.paths.length_m[paths.owner]) / prediction.place.speed_of_sound
        return cls(
            time_s,
            held=np.exp(-6 * np.log(10) * time_s[:, None] / longest[..., None]) * prediction.shares[:, None],
            direct=np.clip(1 - time_s / _DIRECT_S, 0, 1),
            mirrored=(time_s[paths.owner] < later_s[:, None]).astype(np.float64),
            whose=(paths.owner == np.arange(len(longest))[:, None]).astype(np.float64),
        )

    def early_decay_s(self, prediction: "Prediction", energies: Energies) -> Floats:
        """Return the early decay time (v, e); 0 where the direct sound alone makes up the first 10 dB, or nothing
        decays."""
        shares, paths = prediction.shares, prediction.mirrored
        count = len(self.time_s)
        curve = np.einsum("veb,ebt->vet", energies.held, self.held)
        curve += (energies.direct[:, :count] @ shares)[..., None] * self.direct
        if len(paths.owner):
            # In every variant, the paths of an emitter keep the proportions that they have with all effects on.
            energy = prediction.mirrored_energies([ALL_ON])[0] @ shares
            whole = self.whose @ energy
            steps = self.whose @ (energy[:, None] * self.mirrored) / np.maximum(whole, _SILENCE)[:, None]
            curve += (energies.mirrored @ shares)[..., None] * steps
        curve_db = power_to_db((curve + _SILENCE) / (curve[..., :1] + _SILENCE))
        first = (curve_db >= -10).astype(np.float64)
        points = first.sum(axis=-1)
        middle_s = np.sum(first * self.time_s, axis=-1) / points
        off_s = (self.time_s - middle_s[..., None]) * first
        slope = np.sum(off_s * curve_db, axis=-1) / np.maximum(np.sum(off_s**2, axis=-1), _SILENCE)
        told = (points > _DECAY_POINTS // 8) & (slope < 0) & energies.held.any(axis=-1)
        return np.where(told, -60 / np.where(told, slope, -1.0), 0.0)


def worst(changes: Mapping[str, Floats]) -> list[list[Change]]:
    """Return the largest change over all parameters, as [variant][emitter]; `changes` are (v, e) for each parameter."""
    parameters, all_changes = list(changes), np.stack(list(changes.values()))
    most, which = all_changes.max(axis=0).tolist(), all_changes.argmax(axis=0).tolist()
    return [
        [Change(jnd, parameters[number]) for jnd, number in zip(*row, strict=True)]
        for row in zip(most, which, strict=True)
    ]
