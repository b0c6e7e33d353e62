"""Distance: the direct sound spreads over a sphere."""

from server.planning.cost import MOVING, Variant
from server.planning.effect import DIRECT_SOUND, ENERGIES, EnergyEffect
from server.planning.prediction import Factors
from server.responses.effect_flags import EmitterEffects
from server.scene.effects import EffectName

EFFECT = EnergyEffect(
    name=EffectName.DISTANCE_ATTENUATION,
    title="distance attenuation",
    what="the direct sound falls by 6 dB with every doubling of the distance",
    without="the direct sound is as loud as at one metre",
    parameters=ENERGIES,
    prediction="the least and the greatest distance within reach",
    flag="distance_attenuation",
    needs=DIRECT_SOUND,
    direct=Factors(on=lambda way: way.spread),
    is_coherent=True,
    costs_in=(MOVING, Variant(EmitterEffects(distance_attenuation=False), moves=True)),
)
