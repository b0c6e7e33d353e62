"""Air absorption: air attenuates the treble of distant sound (ISO 9613-1)."""

from server.planning.cost import MOVING, Variant
from server.planning.effect import EnergyEffect
from server.planning.prediction import Factors
from server.responses.effect_flags import EmitterEffects
from server.scene.effects import EffectName

EFFECT = EnergyEffect(
    name=EffectName.AIR_ABSORPTION,
    title="air absorption",
    what="air takes the treble of what comes from far away",
    without="no loss but by distance",
    parameters=("level", "spectrum", "drr"),
    prediction="ISO 9613-1 over the longest path within reach",
    flag="air_absorption",
    direct=Factors(on=lambda way: way.air),
    costs_in=(MOVING, Variant(EmitterEffects(air_absorption=False), moves=True)),
)
