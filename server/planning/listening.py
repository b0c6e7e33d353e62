"""What changes between the ears, in pitch and in the late tails where an effect is left out: what predictions of
energies (`server.planning.prediction`) say nothing of.

Metres, seconds; axes as there.
"""

import itertools

import numpy as np

from server.acoustics.audibility import JND_THRESHOLDS
from server.acoustics.geometry import axes_of
from server.planning.prediction import ALL_ON, MOST_JND, UNCHANGED, Change, Prediction
from server.scene.effects import EffectName

_HEAD_RADIUS_M = 0.0875
_LATERAL_ILD_DB = 6.0
"""Between the ears for sound from straight aside, over all frequencies; a head's shadow is deeper at high ones."""
_EAR_GAIN = 3.0
"""Of the energy from one side, by how much that of some third of an octave changes at an ear that turns to it: 6 dB."""
_LEAST_COLOURING_DB = 3.0
"""No direction is heard without some third of an octave being off by more, whatever head hears it."""


def _in_jnd(parameter: str, amount: float) -> Change:
    return Change(min(abs(float(amount)) / JND_THRESHOLDS[parameter].amount, MOST_JND), parameter)


def _most(*changes: Change) -> Change:
    return max(changes, key=lambda change: change.jnd)


def without_delay(prediction: Prediction, number: int) -> Change:
    """A delay that stands still while an emitter, `number`, or the listener moves or turns."""
    listener, emitter, place = prediction.listener, prediction.emitters[number], prediction.place
    if place.holds_direct_sound:
        return UNCHANGED
    speed_m_s = listener.speed_m_s + emitter.speed_m_s
    mine = prediction.reach.paths.length_m[prediction.reach.owner == number]
    shift_ms = 1e3 * float(np.ptp(mine)) / place.speed_of_sound if speed_m_s else 0.0
    turns = listener.turns and listener.output == "headphones"
    return _most(
        _in_jnd("pitch", 100 * speed_m_s / place.speed_of_sound),
        _in_jnd("onset", shift_ms),
        _in_jnd("itd", 2e6 * _interaural_delay_s(1.0, place.speed_of_sound) if turns else 0.0),
    )


def without_head(prediction: Prediction) -> Change:
    """Both ears hear the same."""
    listener = prediction.listener
    if listener.output == "mono":
        return UNCHANGED
    energies, shares = prediction.whole, prediction.shares
    after = (energies.mirrored[0] + energies.held[0]) @ shares
    direct = energies.direct[0, : len(after)] @ shares
    # What a field holds begins with the direct sound.
    is_first_heard = (direct > after / 10) | prediction.place.holds_direct_sound
    changes = [
        _in_jnd("iacc", (1 - rest.late_iacc) * float(part))
        for rest, part in zip(prediction.reverberation, after / (direct + after), strict=True)
        if rest is not None
    ]
    if is_first_heard.any():
        reach = prediction.reach
        to_the_left = np.abs(reach.paths.arrival @ axes_of(listener.pose.orientation)[1])
        aside = 1.0 if listener.turns else float(to_the_left[is_first_heard[reach.owner]].max())
        changes += [
            _in_jnd("itd", 1e6 * _interaural_delay_s(aside, prediction.place.speed_of_sound)),
            _in_jnd("ild", _LATERAL_ILD_DB * aside),
            _in_jnd("spectrum", _LEAST_COLOURING_DB),
        ]
    return _most(UNCHANGED, *changes)


def without_turning(prediction: Prediction) -> Change:
    """Responses of one orientation while the head turns."""
    listener = prediction.listener
    if not listener.turns or listener.output == "mono":
        return UNCHANGED
    if prediction.place.holds_direct_sound:
        delay_s = _interaural_delay_s(1.0, prediction.place.speed_of_sound)
        return _most(_in_jnd("itd", 1e6 * delay_s), _in_jnd("ild", _LATERAL_ILD_DB))
    energies, shares = prediction.whole, prediction.shares
    mirrored = prediction.mirrored_energies([ALL_ON])[0] @ shares
    change_db = 0.0
    for number, rest in enumerate(prediction.reverberation):
        mine = prediction.mirrored.owner == number
        # What comes from one side more than from the other, of which a head takes or adds some bands when it turns.
        sided = _EAR_GAIN * np.linalg.norm(mirrored[mine] @ prediction.mirrored.arrival[mine, :2])
        held = float(energies.held[0, number] @ shares)
        turned = sided + (0.0 if rest is None else held * (10 ** (rest.turn_db / 10) - 1))
        whole = float(energies.direct[0, number] @ shares) + float(mirrored[mine].sum()) + held
        if whole > 0:
            change_db = max(change_db, 10 * np.log10(1 + turned / whole))
    return _in_jnd("ild", change_db)


def without_own_tails(prediction: Prediction) -> Change:
    """All share the tail of one."""
    start_s, shares = prediction.place.tail_start_s, prediction.shares
    emitters = prediction.emitters
    if start_s is None or len(emitters) < 2:
        return UNCHANGED
    known = [each.reverberation for each in emitters if each.reverberation is not None]
    if len(known) < len(emitters):
        known = [*known, *prediction.place.reverberations]
        if len(known) < 2 and prediction.place.reverberation is not None:
            return Change(MOST_JND, "t60")
    changes = [UNCHANGED]
    for own, shared in itertools.permutations(known, 2):
        own_s, shared_s = (float(rest.t60_s @ shares) for rest in (own, shared))
        # T60 is the slope from -5 to -35 dB; the tail is some of it, or none.
        first_s, last_s = own_s * 5 / 60, own_s * 35 / 60
        tail = float(np.clip((last_s - start_s) / (last_s - first_s), 0, 1)) if own_s > 0 else 0.0
        changes.append(_in_jnd("t60", 100 * (shared_s / own_s - 1) * tail if own_s > 0 else 0.0))
        changes.append(_in_jnd("iacc", (own.late_iacc - shared.late_iacc) * tail))
    return _most(*changes)


def _interaural_delay_s(aside: float, speed_of_sound: float) -> float:
    """Woodworth's sphere: `aside` is the sine of the angle off the median plane."""
    return _HEAD_RADIUS_M / speed_of_sound * (float(np.arcsin(min(aside, 1.0))) + aside)


SHARED = {
    EffectName.HRTF: without_head,
    EffectName.HEAD_ROTATION: without_turning,
    EffectName.PER_SOURCE_TAIL: without_own_tails,
}
