"""Late reverberation: the part of the response that the field computes."""

from server.planning.cost import STILL, Cost, Measured, Variant
from server.planning.effect import ENERGIES, EnergyEffect
from server.planning.prediction import Factors
from server.planning.scene_acoustics import Emitter, Situation
from server.responses.effect_flags import EmitterEffects
from server.scene.effects import EffectName


def _absence(situation: Situation, emitter: Emitter | None) -> str:
    own = None if emitter is None else emitter.reverberation
    return "" if own or situation.place.reverberation else "nothing reverberates: the scene has no field"


def _responses(measured: Measured) -> Cost:
    each_us, first_us = measured.response_us
    return Cost(moving_us=each_us, moving_first_us=first_us)


EFFECT = EnergyEffect(
    name=EffectName.LATE_REVERBERATION,
    title="late reverberation",
    what="what the field holds: everything after the direct sound and the reflections from geometry",
    without="no field is asked and nothing is convolved",
    parameters=ENERGIES,
    prediction="the energy of the field's responses beside that of the direct sound",
    flag="late",
    held=Factors(off=lambda _: 0.0),
    absence=_absence,
    costs_in=(STILL, Variant(EmitterEffects(late=False))),
    costs_more=_responses,
)
