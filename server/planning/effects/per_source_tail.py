"""Own late tails: each emitter has a late tail of its own, or all share one."""

import itertools

import numpy as np

from server.acoustics.bands import in_octave_above
from server.planning.change import MOST_JND, UNCHANGED, Change, in_jnd, most
from server.planning.cost import STILL, Variant
from server.planning.effect import RESPONSES, SharedEffect
from server.planning.prediction import Prediction
from server.planning.scene_acoustics import Emitter, Situation
from server.responses.effect_flags import SharedEffects
from server.scene.effects import EffectName


def _change(prediction: Prediction) -> Change:
    """Return the change if all emitters share the tail of one."""
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
        own_s, shared_s = (float(in_octave_above(rest.t60_s) @ shares) for rest in (own, shared))
        # T60 is the slope from -5 to -35 dB, of which the late tail makes up a part or nothing.
        first_s, last_s = own_s * 5 / 60, own_s * 35 / 60
        tail = float(np.clip((last_s - start_s) / (last_s - first_s), 0, 1)) if own_s > 0 else 0.0
        changes.append(in_jnd("t60", 100 * (shared_s / own_s - 1) * tail if own_s > 0 else 0.0))
        changes.append(in_jnd("iacc", (own.late_iacc - shared.late_iacc) * tail))
    return most(*changes)


def _absence(situation: Situation, _: Emitter | None) -> str:
    if len(situation.emitters) < 2:
        return "there is one emitter alone"
    return "responses are too short to have late tails" if situation.place.tail_start_s is None else ""


EFFECT = SharedEffect(
    name=EffectName.PER_SOURCE_TAIL,
    title="own late tails",
    what="each emitter's late tail is its own",
    without="all emitters share the late tail of one, each at its own level",
    parameters=("t60", "iacc"),
    prediction="how the decays and late coherences of the emitters differ",
    flag="own_tails",
    needs=RESPONSES,
    change=_change,
    absence=_absence,
    costs_in=(STILL, Variant(shared=SharedEffects(own_tails=False))),
)
