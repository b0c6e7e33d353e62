"""Occlusion: walls block the direct sound, which goes round them."""

from collections.abc import Callable

import numpy as np

from server.planning.effect import DIRECT_SOUND, ENERGIES, EnergyEffect
from server.planning.reasons import nothing_in_the_way
from server.scene.bundle import Bundle
from server.scene.effects import EffectName


def _find_paths(bundle: Bundle, emitters: int) -> Callable[[], object]:
    start = bundle.manifest.start
    finder = bundle.surroundings.sound_paths(bundle.manifest.speed_of_sound)
    listener, places = np.array(start.listener), np.tile(start.emitter, (emitters, 1))
    return lambda: finder.find(listener, places)


EFFECT = EnergyEffect(
    name=EffectName.OCCLUSION,
    title="occlusion",
    what="walls stand in the way of the direct sound",
    without="the direct sound comes straight through walls",
    parameters=ENERGIES,
    prediction="whether any sight line within reach meets a wall, and what the detour round it takes",
    flag="occlusion",
    needs=DIRECT_SOUND,
    leads_round=True,
    may_act=lambda situation: situation.place.paths is not None,
    absence=lambda situation, _: nothing_in_the_way(situation.place),
    per_pose=_find_paths,
)
