"""Early reflections: mirror images of the emitter, computed from geometry."""

from server.planning.cost import Cost
from server.planning.effect import ENERGIES, EnergyEffect
from server.planning.prediction import Factors
from server.planning.scene_acoustics import Emitter, Situation
from server.scene.effects import EffectName


def _absence(situation: Situation, _: Emitter | None) -> str:
    place = situation.place
    if place.surroundings is None and place.reverberation is None:
        return "there is nothing to reflect"
    return "the field's responses hold them" if place.reflections is None else ""


EFFECT = EnergyEffect(
    name=EffectName.EARLY_REFLECTIONS,
    title="early reflections",
    what="mirror images in walls, floor and ceiling, computed from geometry",
    without="the direct sound and what the field holds",
    parameters=ENERGIES,
    prediction="the energy of the image sources, and how they interfere with the direct sound",
    flag="early",
    mirrored=Factors(off=lambda _: 0.0),
    is_coherent=True,
    may_act=lambda situation: situation.place.reflections is not None,
    absence=_absence,
    costs_more=lambda measured: Cost(moving_us=measured.early_us * measured.responses_per_block),
)
