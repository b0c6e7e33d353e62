"""All effects: each is the `EFFECT` of the module in `server.planning.effects` that has its name."""

import importlib
from collections.abc import Iterable, Mapping

from server.planning.effect import Effect, EnergyEffect, MotionEffect, SharedEffect
from server.planning.plan import Plan
from server.responses.effect_flags import EmitterEffects, SharedEffects
from server.scene.effects import EffectName


def _load(name: EffectName) -> Effect:
    effect = importlib.import_module(f"server.planning.effects.{name.value}").EFFECT
    if not isinstance(effect, Effect) or effect.name != name:
        raise TypeError(f"server.planning.effects.{name.value}: EFFECT is not the effect {name.value}")
    return effect


CATALOGUE: Mapping[EffectName, Effect] = {name: _load(name) for name in EffectName}

ENERGY_EFFECTS = tuple(effect for effect in CATALOGUE.values() if isinstance(effect, EnergyEffect))
"""Effects of an emitter that a single moment shows."""
MOTION_EFFECTS = tuple(effect for effect in CATALOGUE.values() if isinstance(effect, MotionEffect))
SHARED_EFFECTS = tuple(
    sorted((effect for effect in CATALOGUE.values() if isinstance(effect, SharedEffect)), key=lambda each: each.title)
)

_FLAGS = {effect.name: effect.flag for effect in (*ENERGY_EFFECTS, *MOTION_EFFECTS) if effect.flag is not None}
_SHARED_FLAGS = {effect.name: effect.flag for effect in SHARED_EFFECTS if effect.flag is not None}
_PATH_GAINS = {effect.name: effect.path_gain for effect in ENERGY_EFFECTS if effect.path_gain is not None}


def emitter_effects(on: Iterable[EffectName]) -> EmitterEffects:
    """Return what to render of an emitter with these effects on and all others off."""
    on = frozenset(on)
    flags = {flag: name in on for name, flag in _FLAGS.items()}
    return EmitterEffects(**flags, path_gains=tuple(gain for name, gain in _PATH_GAINS.items() if name in on))


EVERYTHING = emitter_effects(EffectName)


def shared_effects(plan: Plan) -> SharedEffects:
    return SharedEffects(**{flag: plan.is_on(name) for name, flag in _SHARED_FLAGS.items()})


def names_on(effects: EmitterEffects) -> set[EffectName]:
    """Return the names of the effects that are on."""
    gains = effects.path_gains
    flagged = {name for name, flag in _FLAGS.items() if getattr(effects, flag)}
    return flagged | {name for name, gain in _PATH_GAINS.items() if gain in gains}
