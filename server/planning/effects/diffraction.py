"""Diffraction: the direct sound bends round edges, and edges near the sight line screen it."""

from server.planning.effect import DIRECT_SOUND, ENERGIES, EnergyEffect
from server.planning.prediction import Factors, Floats, Way
from server.planning.reasons import nothing_in_the_way
from server.scene.effects import EffectName


def _screened(way: Way) -> Floats | float:
    return 1.0 if way.goes_through else way.screen


def _hidden(way: Way) -> Floats | float:
    return 1.0 if way.goes_through else way.paths.in_sight[:, None].astype(float)


EFFECT = EnergyEffect(
    name=EffectName.DIFFRACTION,
    title="diffraction",
    what="the direct sound bends round edges, and edges near the sight line screen it",
    without="behind a wall there is no direct sound; in sight all of it",
    parameters=ENERGIES,
    prediction="the screening of the edges within reach, beside everything that comes after the direct sound",
    flag="diffraction",
    needs=DIRECT_SOUND,
    direct=Factors(on=_screened, off=_hidden),
    is_coherent=True,
    may_act=lambda situation: situation.place.paths is not None,
    absence=lambda situation, _: nothing_in_the_way(situation.place),
    # The path search of occlusion also returns the loss at edges, so diffraction costs nothing more.
)
