"""HRTF: each ear hears sound filtered by the head."""

from server.acoustics.geometry import axes_of
from server.planning.between_ears import LATERAL_ILD_DB, delay_s
from server.planning.change import UNCHANGED, Change, in_jnd, most
from server.planning.cost import STILL, Variant
from server.planning.effect import SharedEffect
from server.planning.prediction import Prediction
from server.planning.reasons import no_head
from server.responses.effect_flags import SharedEffects
from server.scene.effects import EffectName

_LEAST_COLOURING_DB = 3.0
"""Every head, for every direction, changes the level of some third-octave band by more than this."""


def _change(prediction: Prediction) -> Change:
    """Return the change if both ears hear the same."""
    listener = prediction.listener
    if listener.output != "headphones":
        return UNCHANGED
    energies, shares = prediction.whole, prediction.shares
    after = (energies.mirrored[0] + energies.held[0]) @ shares
    direct = energies.direct[0, : len(after)] @ shares
    # Where the field's responses hold the direct sound, they begin with it.
    is_first_heard = (direct > after / 10) | prediction.place.holds_direct_sound
    changes = [
        in_jnd("iacc", (1 - rest.late_iacc) * float(part))
        for rest, part in zip(prediction.reverberation, after / (direct + after), strict=True)
        if rest is not None
    ]
    if is_first_heard.any():
        reach = prediction.reach
        to_the_left = abs(reach.paths.arrival @ axes_of(listener.pose.orientation)[1])
        aside = 1.0 if listener.turns else float(to_the_left[is_first_heard[reach.owner]].max())
        changes += [
            in_jnd("itd", 1e6 * delay_s(aside, prediction.place.speed_of_sound)),
            in_jnd("ild", LATERAL_ILD_DB * aside),
            in_jnd("spectrum", _LEAST_COLOURING_DB),
        ]
    return most(UNCHANGED, *changes)


EFFECT = SharedEffect(
    name=EffectName.HRTF,
    title="head",
    what="each ear hears through the head",
    without="both ears hear the same",
    parameters=("itd", "ild", "spectrum", "iacc"),
    prediction=(
        "a sphere of the size of a head for the difference between the ears, and the least that outer ears colour"
    ),
    flag="head",
    change=_change,
    absence=lambda situation, _: no_head(situation.listener),
    costs_in=(STILL, Variant(shared=SharedEffects(head=False))),
)
