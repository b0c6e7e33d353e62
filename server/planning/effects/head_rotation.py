"""Head rotation: impulse responses follow the orientation of the head."""

import numpy as np

from server.planning.between_ears import LATERAL_ILD_DB, delay_s
from server.planning.change import UNCHANGED, Change, in_jnd, most
from server.planning.cost import NOTHING, Cost, Measured
from server.planning.effect import RESPONSES, SharedEffect
from server.planning.prediction import ALL_ON, Prediction
from server.planning.reasons import no_head
from server.planning.scene_acoustics import Emitter, Situation
from server.scene.effects import EffectName

_EAR_GAIN = 3.0
"""Energy that an ear gains by turning to one side, in some third-octave band, as a multiple of the energy from there:
3, since it grows by up to 6 dB, to 4 times."""


def _change(prediction: Prediction) -> Change:
    """Return the change if responses keep one orientation while the head turns."""
    listener = prediction.listener
    if not listener.turns_responses:
        return UNCHANGED
    if prediction.place.holds_direct_sound:
        between_s = delay_s(1.0, prediction.place.speed_of_sound)
        return most(in_jnd("itd", 1e6 * between_s), in_jnd("ild", LATERAL_ILD_DB))
    energies, shares = prediction.whole, prediction.shares
    mirrored = prediction.mirrored_energies([ALL_ON])[0] @ shares
    change_db = 0.0
    for number, rest in enumerate(prediction.reverberation):
        mine = prediction.mirrored.owner == number
        # The excess of energy from one side, in some bands of which a head that turns adds or removes energy.
        sided = _EAR_GAIN * np.linalg.norm(mirrored[mine] @ prediction.mirrored.arrival[mine, :2])
        held = float(energies.held[0, number] @ shares)
        turned = sided + (0.0 if rest is None else held * (10 ** (rest.turn_db / 10) - 1))
        whole = float(energies.direct[0, number] @ shares) + float(mirrored[mine].sum()) + held
        if whole > 0:
            change_db = max(change_db, 10 * np.log10(1 + turned / whole))
    return in_jnd("ild", change_db)


def _absence(situation: Situation, _: Emitter | None) -> str:
    listener = situation.listener
    if listener.output == "headphones" and listener.bus is not None:
        return "a bus turns the reflected sound with the head, without new responses"
    return no_head(listener) or ("" if listener.turns else "the head keeps still")


def _responses(measured: Measured) -> Cost:
    """Return the cost of responses while only the head turns: none with a bus. A listener who walks needs new responses
    in any case, and they follow the head too."""
    if measured.has_bus:
        return NOTHING
    each_us, first_us = measured.response_us
    return Cost(turning_us=each_us, turning_first_us=first_us)


EFFECT = SharedEffect(
    name=EffectName.HEAD_ROTATION,
    title="head rotation",
    what="impulse responses are those of the way the head is turned",
    without="they are those of one orientation; only the direct sound turns",
    parameters=("ild",),
    prediction="how the field's responses differ between orientations, and from which side first reflections come",
    flag="head_rotation",
    needs=RESPONSES,
    change=_change,
    absence=_absence,
    costs_more=_responses,
)
