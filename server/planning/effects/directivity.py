"""Directivity: an emitter is not equally loud in all directions."""

from collections.abc import Callable

import numpy as np

from server.acoustics.directivity import CARDIOID
from server.acoustics.geometry import Pose
from server.planning.effect import ENERGIES, EnergyEffect
from server.planning.prediction import Factors
from server.planning.scene_acoustics import Emitter, Situation
from server.responses.emitter_state import EmitterState
from server.responses.radiation import departure_gain_db
from server.scene.bundle import Bundle
from server.scene.effects import EffectName


def _gains(_: Bundle, emitters: int) -> Callable[[], object]:
    beaming, departure = EmitterState(Pose((0.0, 0.0, 0.0)), CARDIOID), np.array([0.6, 0.8, 0.0])
    return lambda: [departure_gain_db(beaming, departure) for _ in range(emitters)]


def _absence(_: Situation, emitter: Emitter | None) -> str:
    beams = emitter is None or not emitter.is_omnidirectional
    return "" if beams else "it radiates alike in all directions"


EFFECT = EnergyEffect(
    name=EffectName.DIRECTIVITY,
    title="directivity",
    what="the emitter is not equally loud in all directions",
    without="it radiates all round as it does ahead",
    parameters=ENERGIES,
    prediction="its gains in the directions of departure within reach, and their mean over all directions",
    flag="directivity",
    direct=Factors(on=lambda way: way.departure),
    mirrored=Factors(on=lambda paths: paths.departure),
    held=Factors(on=lambda diffuse: diffuse),
    is_coherent=True,
    may_act=lambda situation: any(not emitter.is_omnidirectional for emitter in situation.emitters.values()),
    absence=_absence,
    per_pose=_gains,
)
