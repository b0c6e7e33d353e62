"""Propagation delay: the direct sound arrives late by the length of its path, which gives the Doppler effect."""

import numpy as np

from server.planning.between_ears import delay_s
from server.planning.change import UNCHANGED, Change, in_jnd, most
from server.planning.cost import MOVING, STILL, Cost, Measured
from server.planning.effect import DIRECT_SOUND, MotionEffect
from server.planning.prediction import Prediction
from server.planning.scene_acoustics import Emitter, Situation
from server.scene.effects import EffectName


def _change(prediction: Prediction, number: int) -> Change:
    """Return the change if the delay stays fixed while the emitter or the listener moves or turns."""
    listener, emitter, place = prediction.listener, prediction.emitters[number], prediction.place
    if place.holds_direct_sound:
        return UNCHANGED
    speed_m_s = listener.speed_m_s + emitter.speed_m_s
    mine = prediction.reach.paths.length_m[prediction.reach.owner == number]
    shift_ms = 1e3 * float(np.ptp(mine)) / place.speed_of_sound if speed_m_s else 0.0
    return most(
        in_jnd("pitch", 100 * speed_m_s / place.speed_of_sound),
        in_jnd("onset", shift_ms),
        in_jnd("itd", 2e6 * delay_s(1.0, place.speed_of_sound) if listener.hears_turns else 0.0),
    )


def _absence(situation: Situation, emitter: Emitter | None) -> str:
    moves = situation.listener.speed_m_s or (emitter is not None and emitter.speed_m_s)
    return "" if moves else "neither it nor the listener moves"


def _while_turning(measured: Measured) -> Cost:
    """Return the cost while only the head turns, which is the same as in motion."""
    each_us, first_us = measured.between(MOVING, STILL)
    return Cost(turning_us=each_us, turning_first_us=first_us)


EFFECT = MotionEffect(
    name=EffectName.PROPAGATION_DELAY,
    title="propagation delay",
    what="the delay follows the length of the path, hence Doppler",
    without="the delay stands still, as part of the impulse response",
    parameters=("pitch", "onset", "itd"),
    prediction="the speed along the path over that of sound, and the change of the path's length",
    flag="propagation_delay",
    needs=DIRECT_SOUND,
    change=_change,
    absence=_absence,
    costs_in=(MOVING, STILL),
    costs_more=_while_turning,
)
