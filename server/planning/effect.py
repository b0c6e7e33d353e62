"""The description of an effect: its words, what it changes in the sound, what it needs, what it costs, and which part
of the renderer it switches.

Each module in `server.planning.effects` has one `EFFECT`, an instance of one of these classes:

- `EnergyEffect`: an effect of one emitter that changes energies, so a single moment shows it.
- `MotionEffect`: an effect of one emitter that only motion shows.
- `SharedEffect`: an effect decided once for all that a listener hears.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from server.acoustics.bands import in_octave_above
from server.acoustics.decibels import db_to_power
from server.planning.change import Change
from server.planning.cost import NOTHING, Cost, Measured, PerPose, Variant
from server.planning.prediction import UNTOUCHED, Factors, Floats, Mirrored, Prediction, Way
from server.planning.scene_acoustics import Emitter, Situation
from server.responses.effect_flags import PathGain
from server.scene.bundle import Bundle
from server.scene.effects import EffectName

ENERGIES = ("level", "spectrum", "drr", "c50")


@dataclass(frozen=True)
class Need:
    """A requirement of an effect: at least one of these other effects is on. `absence` is the reason given where none
    is."""

    any_of: frozenset[EffectName]
    absence: str


DIRECT_SOUND = Need(frozenset({EffectName.DIRECT_PATH}), "there is no direct sound")
RESPONSES = Need(frozenset({EffectName.EARLY_REFLECTIONS, EffectName.LATE_REVERBERATION}), "nothing is convolved")


@dataclass(frozen=True, kw_only=True)
class Effect:
    """An effect that can be on or off. `parameters` are names in `JND_THRESHOLDS`. `without` describes what is rendered
    where the effect is off, and `prediction` how its audibility is predicted. `flag` names the part of the renderer
    that it switches: a field of `EmitterEffects` or, for shared effects, of `SharedEffects`."""

    name: EffectName
    title: str
    what: str
    without: str
    parameters: tuple[str, ...]
    prediction: str
    flag: str | None = None
    needs: Need | None = None
    may_act: Callable[[Situation], bool] | None = None
    """Returns whether a situation has anything that the effect acts on; most have no corners and no directional
    emitter. None: every situation has."""
    absence: Callable[[Situation, Emitter | None], str] | None = None
    """Returns in words what the effect lacks to act on, or an empty string; the emitter is None for shared effects."""
    costs_in: tuple[Variant, Variant] | None = None
    """Two renderers, one with the effect and one without: the difference between them is its cost."""
    costs_more: Callable[[Measured], Cost] | None = None
    """Returns the costs that the difference of `costs_in` does not include."""
    per_pose: PerPose | None = None
    """The work that the effect adds for emitters whenever a pose changes; its time is part of the cost."""

    @property
    def is_shared(self) -> bool:
        return isinstance(self, SharedEffect)

    def cost(self, measured: Measured) -> Cost:
        cost = NOTHING
        if self.costs_in is not None:
            more, less = self.costs_in
            cost = measured.while_moving(more, less) if more.moves else measured.standing(more, less)
        cost = replace(cost, moving_us=cost.moving_us + measured.per_pose_us.get(self.name, 0.0))
        return cost if self.costs_more is None else cost + self.costs_more(measured)


@dataclass(frozen=True, kw_only=True)
class EnergyEffect(Effect):
    """An effect that multiplies energies: of the direct sound along its paths (`direct`), of the first reflections
    (`mirrored`), and of the field's responses (`held`). A factor of `held` gets the emitters' power averaged over all
    directions, relative to that ahead, (emitter, band).

    With a `path_gain`, in decibels, `direct` and `per_pose` follow from it: no other code needs to know the effect.
    """

    direct: Factors[Way] = UNTOUCHED
    mirrored: Factors[Mirrored] = UNTOUCHED
    held: Factors[Floats] = UNTOUCHED
    path_gain: PathGain | None = None
    is_coherent: bool = False
    """Whether it changes the interference of the direct sound with the first reflections."""
    leads_round: bool = False
    """Whether the direct sound goes straight through walls where the effect is off."""

    def __post_init__(self) -> None:
        gain_db = self.path_gain
        if gain_db is not None:
            factors = Factors[Way](on=lambda way: db_to_power(in_octave_above(gain_db(way.paths))))
            object.__setattr__(self, "direct", factors)
            object.__setattr__(self, "per_pose", lambda bundle, count: _along_paths(gain_db, bundle, count))


@dataclass(frozen=True, kw_only=True)
class MotionEffect(Effect):
    """An effect that only motion shows. `change` returns what leaving it out changes, for the emitter with the given
    index."""

    change: Callable[[Prediction, int], Change]


@dataclass(frozen=True, kw_only=True)
class SharedEffect(Effect):
    """An effect decided for all emitters together. `change` returns what leaving it out changes."""

    change: Callable[[Prediction], Change]


def _along_paths(gain_db: PathGain, bundle: Bundle, count: int) -> Callable[[], object]:
    start = bundle.manifest.start
    finder = bundle.surroundings.sound_paths(bundle.manifest.speed_of_sound)
    paths = finder.find(np.array(start.listener), np.tile(start.emitter, (count, 1)))
    return lambda: gain_db(paths)
