"""Why an effect is on or off, in words."""

from collections.abc import Sequence

from server.acoustics.audibility import JND_THRESHOLDS
from server.planning.prediction import MOST_JND, Change
from server.planning.scene_acoustics import Situation
from server.scene.effects import CATALOGUE, OF_DIRECT_SOUND, EffectName

_PARAMETERS = {
    "level": ("the level", "dB"),
    "spectrum": ("the spectrum", "dB"),
    "drr": ("the direct-to-reverberant ratio", ""),
    "c50": ("clarity", ""),
    "edt": ("the early decay", "%"),
    "t60": ("the reverberation time", "%"),
    "iacc": ("the interaural correlation", ""),
    "itd": ("the time between the ears", "µs"),
    "ild": ("the level between the ears", "dB"),
    "pitch": ("the pitch", "%"),
    "onset": ("the moment of arrival", "ms"),
}


def reason(
    situation: Situation,
    name: EffectName,
    emitter: str | None,
    change: Change,
    is_predicted: bool,
    wanted: bool | None,
    together_with: Sequence[EffectName],
) -> str:
    """A sentence without its first capital and full stop; of an override, with what was predicted."""
    if together_with:
        others = " and ".join(CATALOGUE[other].title for other in together_with)
        said = f"without it and {others}, {_amount(change)}"
    elif is_predicted:
        said = f"without it {_amount(change)}"
    else:
        said = _absence(situation, name, emitter) or _too_little(change)
    if wanted is None:
        return said
    return f"switched {'on' if wanted else 'off'} on demand; {said}"


def _amount(change: Change) -> str:
    title, unit = _PARAMETERS[change.parameter]
    if change.jnd >= MOST_JND:
        return f"{title} is another altogether"
    if not unit and change.parameter != "iacc":
        return f"{title} changes by {change.jnd:.1f} JND"
    return f"{title} changes by {change.jnd * JND_THRESHOLDS[change.parameter].amount:.3g} {unit}".rstrip()


def _too_little(change: Change) -> str:
    if change.jnd < 0.005:
        return "leaving it out changes nothing"
    return f"nobody hears that {_amount(change)} without it"


def _absence(situation: Situation, name: EffectName, emitter: str | None) -> str:
    """What is not there for the effect to act on; empty where something is."""
    place, listener = situation.place, situation.listener
    it = None if emitter is None else situation.emitters[emitter]
    match name:
        case _ if place.holds_direct_sound and name in OF_DIRECT_SOUND:
            return "the field's responses hold the direct sound"
        case EffectName.OCCLUSION | EffectName.DIFFRACTION if place.plan is None:
            return "no walls are known that could stand in the way"
        case EffectName.OCCLUSION | EffectName.DIFFRACTION if place.paths is None:
            return "the room is convex: nothing can stand in the way"
        case EffectName.DIRECTIVITY if it is not None and it.is_omnidirectional:
            return "it radiates alike in all directions"
        case EffectName.PROPAGATION_DELAY if it is not None and not it.speed_m_s and not listener.speed_m_s:
            return "neither it nor the listener moves"
        case EffectName.HRTF | EffectName.HEAD_ROTATION if listener.output == "mono":
            return "one loudspeaker plays what one microphone would hear"
        case EffectName.HEAD_ROTATION if not listener.turns:
            return "the head keeps still"
        case EffectName.EARLY_REFLECTIONS if place.plan is None and place.reverberation is None:
            return "there is nothing to reflect"
        case EffectName.EARLY_REFLECTIONS if place.reflections is None:
            return "the field's responses hold them"
        case EffectName.LATE_REVERBERATION if place.reverberation is None and (it is None or it.reverberation is None):
            return "nothing reverberates: the scene has no field"
        case EffectName.PER_SOURCE_TAIL if len(situation.emitters) < 2:
            return "there is one emitter alone"
        case EffectName.PER_SOURCE_TAIL if place.tail_start_s is None:
            return "responses are too short to have late tails"
        case _:
            return ""
