"""What an effect is to everybody: its words, what it changes of what is heard, what it needs, what it costs, and which
part of the renderer it switches.

There is a module for each in `server.planning.effects`, whose `EFFECT` is one of these:

- `EnergyEffect`: of an emitter; it changes energies, and a single moment tells.
- `MotionEffect`: of an emitter; only motion tells.
- `SharedEffect`: decided once for all that a listener hears.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from server.acoustics.decibels import db_to_power
from server.acoustics.sound_path import SoundPathFinder
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
    """What an effect means nothing without: any of some others. `absence` says that none is there."""

    any_of: frozenset[EffectName]
    absence: str


DIRECT_SOUND = Need(frozenset({EffectName.DIRECT_PATH}), "there is no direct sound")
RESPONSES = Need(frozenset({EffectName.EARLY_REFLECTIONS, EffectName.LATE_REVERBERATION}), "nothing is convolved")


@dataclass(frozen=True, kw_only=True)
class Effect:
    """`parameters` are names of thresholds; `without` is what is rendered where the effect is off, and `prediction`
    what tells beforehand whether that is heard. `flag` is the part of the renderer that it switches, a field of
    `EmitterEffects` or, where it is shared, of `SharedEffects`."""

    name: EffectName
    title: str
    what: str
    without: str
    parameters: tuple[str, ...]
    prediction: str
    flag: str | None = None
    needs: Need | None = None
    may_act: Callable[[Situation], bool] | None = None
    """Whether there is anything to ask: most situations have no corners, and no emitter that beams."""
    absence: Callable[[Situation, Emitter | None], str] | None = None
    """What is not there for it to act on, in words; empty where something is. Of one emitter, unless it is shared."""
    costs_in: tuple[Variant, Variant] | None = None
    """A renderer with it and one without, whose difference it costs."""
    costs_more: Callable[[Measured], Cost] | None = None
    """What that difference does not tell."""
    per_pose: PerPose | None = None
    """What is computed for emitters whenever a pose changes, and costs as long as that takes."""

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
    """What it multiplies energies by: of the direct sound along its paths, of the first reflections, and of what the
    field holds. `held` is told how much of what emitters send ahead they send everywhere, on average.

    With a `path_gain`, in decibels, that is what becomes of the direct sound: nothing else needs to know the effect.
    """

    direct: Factors[Way] = UNTOUCHED
    mirrored: Factors[Mirrored] = UNTOUCHED
    held: Factors[Floats] = UNTOUCHED
    path_gain: PathGain | None = None
    is_coherent: bool = False
    """Whether it changes how direct sound and first reflections add up."""
    leads_round: bool = False
    """Whether the direct sound goes straight through walls without it."""

    def __post_init__(self) -> None:
        gain_db = self.path_gain
        if gain_db is not None:
            object.__setattr__(self, "direct", Factors[Way](on=lambda way: db_to_power(gain_db(way.paths))))
            object.__setattr__(self, "per_pose", lambda bundle, count: _along_paths(gain_db, bundle, count))


@dataclass(frozen=True, kw_only=True)
class MotionEffect(Effect):
    """`change` is what is heard without it of the emitter of a number."""

    change: Callable[[Prediction, int], Change]


@dataclass(frozen=True, kw_only=True)
class SharedEffect(Effect):
    """`change` is what is heard without it of all emitters."""

    change: Callable[[Prediction], Change]


def _along_paths(gain_db: PathGain, bundle: Bundle, count: int) -> Callable[[], object]:
    start = bundle.manifest.start
    finder = SoundPathFinder(bundle.floor_plan, bundle.manifest.speed_of_sound)
    paths = finder.find(np.array(start.listener), np.tile(start.emitter, (count, 1)))
    return lambda: gain_db(paths)
