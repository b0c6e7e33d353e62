"""Direct path: the sound that arrives first, straight or round corners."""

from server.planning.cost import STILL, Variant
from server.planning.effect import ENERGIES, EnergyEffect
from server.planning.prediction import Factors
from server.planning.reasons import HOLDS_DIRECT_SOUND
from server.responses.effect_flags import EmitterEffects
from server.scene.effects import EffectName

EFFECT = EnergyEffect(
    name=EffectName.DIRECT_PATH,
    title="direct path",
    what="the sound that comes first, straight or round corners",
    without="reflections and reverberation alone",
    parameters=ENERGIES,
    prediction="its energy beside that of everything after it",
    flag="direct_path",
    direct=Factors(off=lambda _: 0.0),
    is_coherent=True,
    absence=lambda situation, _: HOLDS_DIRECT_SOUND if situation.place.holds_direct_sound else "",
    costs_in=(STILL, Variant(EmitterEffects(direct_path=False))),
)
