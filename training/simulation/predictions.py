"""Predictions of what leaving an effect out of a simulation would change, made before it from geometry, statistical
acoustics and a trial with few rays: in just-noticeable differences, with a reason in words.

The laws here are those of floor plans (`training.simulation.plan_predictions`) and of levels
(`training.simulation.level_predictions`). Axes: (pair, band); lengths are in metres. Power is squared pressure relative
to the direct sound at one metre.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from server.acoustics.audibility import JND_THRESHOLDS
from server.acoustics.bands import OCTAVE_BANDS_HZ, bands_within
from server.acoustics.decibels import db_to_power, power_to_db
from server.acoustics.sound_path import SoundPaths
from server.planning.change import Change
from server.scene.limits import MOST_SAMPLES
from training.data.simulated_scene import SimulatedScene
from training.data.simulation_plan import SimulatedEffect
from training.simulation.trial import UNHEARD_POWER, Trial

_Floats = npt.NDArray[np.float64]

LEVEL_DB = JND_THRESHOLDS["level"].amount


@dataclass(frozen=True)
class Prediction:
    change_jnd: float
    parameter: str
    reason: str


@dataclass(frozen=True)
class Fixed:
    """An effect that is on, or off, whatever is asked for. `otherwise` is what an error says where the other is."""

    is_on: bool
    otherwise: str


@dataclass(frozen=True)
class TailNeeds:
    """What a tail that all pairs share takes: the time after emission at which it begins, its rays, and the `rays` of
    each emitter for what comes before it."""

    start_s: float
    tail_rays: int
    rays: int


@dataclass(frozen=True)
class HeardPairs:
    """Pairs of probes, with the doors of a level in one state. `paths` (pair,) are those of the direct sound, and
    `reverberant_power` (pair, band) is that of all reflections but what goes through walls."""

    paths: SoundPaths
    reverberant_power: _Floats

    @property
    def hidden(self) -> npt.NDArray[np.bool_]:
        return ~self.paths.in_sight

    @property
    def direct_power(self) -> _Floats:
        """(pair, 1) power of the direct sound along its path, round corners if necessary, without the loss at
        corners."""
        return np.asarray(self.paths.length_m[:, None] ** -2)

    @property
    def straight_power(self) -> _Floats:
        """(pair, 1) power of the direct sound along a straight line, through all obstacles."""
        return np.asarray((self.paths.length_m - self.paths.excess_m)[:, None] ** -2)

    def without_diffraction_jnd(self) -> float:
        """The largest change of level without what bends."""
        bent = db_to_power(self.paths.screen_db) * self.direct_power
        straight = np.where(self.paths.in_sight[:, None], self.direct_power, 0.0)
        beside = self.reverberant_power + UNHEARD_POWER
        changes_db = np.abs(power_to_db((bent + beside) / (straight + beside)))
        return float(np.max(changes_db, initial=0.0)) / LEVEL_DB

    def without_transmission_jnd(self, losses_db: _Floats) -> float:
        """The largest change of level without the direct sound that goes through walls, which take `losses_db` (hidden
        pair, band): infinite where they let nothing through."""
        hidden = self.hidden
        through = self.straight_power[hidden] * db_to_power(-losses_db)
        bent = db_to_power(self.paths.screen_db[hidden]) * self.direct_power[hidden]
        changes_db = power_to_db(1 + through / (bent + self.reverberant_power[hidden] + UNHEARD_POWER))
        return float(np.max(changes_db, initial=0.0)) / LEVEL_DB


class Predictions(ABC):
    """Predictions for one scene and its `probes` (probe, xyz)."""

    scene: SimulatedScene
    probes: _Floats

    @property
    @abstractmethod
    def orders(self) -> range:
        """The orders of mirrored reflections that images may give, beyond those computed from geometry."""

    @property
    def no_orders(self) -> str:
        """Why there are none."""
        return "the scene file asks for none beyond those left to geometry"

    @property
    @abstractmethod
    def trials(self) -> Mapping[str, Trial]:
        """A trial for each state of the doors, by that state in words."""

    @property
    @abstractmethod
    def longest_way_s(self) -> float:
        """The longest propagation time of direct sound between two probes or between the scene's start positions."""

    @property
    @abstractmethod
    def largest_scattering(self) -> float:
        """The largest share that any surface scatters in any band."""

    @abstractmethod
    def early_reflections(self, order: int) -> Prediction:
        """Predict the change without mirrored paths of one of the `orders`."""

    @abstractmethod
    def per_source_tail(self, *, has_rays: bool) -> Prediction:
        """Predict the change if all pairs share their late sound."""

    @abstractmethod
    def shared_tail(self) -> TailNeeds | None:
        """What the tail takes if it is shared; None if it cannot be."""

    @abstractmethod
    def diffraction(self) -> Prediction: ...

    @abstractmethod
    def transmission(self) -> Prediction: ...

    @property
    @abstractmethod
    def no_mass(self) -> str:
        """What an error says where transmission is asked for, and no wall has a mass; empty if one has."""

    @property
    def fixed(self) -> Mapping[SimulatedEffect, Fixed]:
        """The effects that nobody can ask for, or do without."""
        told = "cannot be on: probes radiate all round, and directivity is applied where emitters are rendered"
        fixed = {SimulatedEffect.DIRECTIVITY: Fixed(False, told)}
        return fixed | ({SimulatedEffect.TRANSMISSION: Fixed(False, self.no_mass)} if self.no_mass else {})

    def late_reverberation(self) -> Prediction:
        reason = "what rays bring in a trial: all but direct sound and mirrored first reflections"
        return self.largest(Trial.without_late, reason)

    def scattering(self, *, has_rays: bool) -> Prediction:
        if not has_rays:
            return Prediction(0.0, "level", "no rays are traced that could scatter")
        share = self.largest_scattering
        if not share:
            return Prediction(0.0, "level", "surfaces mirror all that they reflect")
        reason = f"surfaces scatter up to {100 * share:.0f} %, reflection after reflection; by a trial without it"
        return self.largest(Trial.without_scattering, reason)

    def air_absorption(self, *, has_rays: bool, scatters: bool) -> Prediction:
        """Predict the change without air absorption, for the other effects as planned; a trial compares all
        parameters."""
        reason = "without the air's share reverberation lasts longer, by a trial"
        if not has_rays:
            reason = "on the way of direct sound and first reflections; nothing reverberates"
        return self.largest(lambda trial: trial.without_air(has_rays=has_rays, scatters=scatters), reason)

    def largest(self, change: Callable[[Trial], Change], reason: str) -> Prediction:
        """The largest change over the trials, and the reason with the state of the doors in which it is."""
        changes = {state: change(trial) for state, trial in self.trials.items()}
        state = max(changes, key=lambda each: changes[each].jnd)
        told = f"{reason}, with {state}" if state and changes[state].jnd else reason
        return Prediction(changes[state].jnd, changes[state].parameter, told)

    @cached_property
    def reverberation_s(self) -> tuple[float, float]:
        """The longest reverberation time (60 dB) over octave bands, and the centre frequency of that band in Hz; inf if
        the trial does not show the end of the decay."""
        audible = bands_within(self.scene.simulation.sample_rate)
        of_trials = np.stack([trial.reverberation_time_s[:audible] for trial in self.trials.values()])
        times_s = np.nan_to_num(of_trials, nan=np.inf).max(axis=0)
        longest = int(np.argmax(times_s))
        return float(times_s[longest]), OCTAVE_BANDS_HZ[longest]

    @property
    def needed_s(self) -> float:
        """The duration of a response that contains 60 dB of decay for every receiver."""
        return self.longest_way_s + self.reverberation_s[0]

    def notes(self, *, has_rays: bool) -> tuple[str, ...]:
        settings, notes = self.scene.simulation, []
        lasts_s, centre_hz = self.reverberation_s
        if has_rays and self.needed_s > settings.duration_s:
            lasts = f"{lasts_s:.2g} s (T60 at {centre_hz:g} Hz)" if lasts_s < np.inf else "longer than was tried"
            needed = f"; {self.needed_s:.2f} s would hold all of it" if lasts_s < np.inf else ""
            notes.append(
                f"simulation.duration_s: reverberation lasts {lasts}, and responses end after "
                f"{settings.duration_s:g} s: reverberation times will read too short{needed}"
            )
            most_s = MOST_SAMPLES / settings.sample_rate
            if most_s < self.needed_s < np.inf:
                notes.append(
                    f"a bundle holds {most_s:g} s at {settings.sample_rate} Hz, and more at lower sample rates"
                )
        above_hz = OCTAVE_BANDS_HZ[bands_within(settings.sample_rate) :]
        if above_hz:
            bands = " and ".join(f"{centre_hz:g} Hz" for centre_hz in above_hz)
            notes.append(
                f"simulation.sample_rate: the octave band of {bands} lies above half of {settings.sample_rate} Hz, and "
                "what materials do there is not heard"
            )
        return tuple(notes)
