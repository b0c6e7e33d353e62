"""Texts that say why an effect is on or off."""

from collections.abc import Sequence

from server.acoustics.audibility import JND_THRESHOLDS
from server.planning.change import MOST_JND, Change
from server.planning.scene_acoustics import Listener, SceneAcoustics

HOLDS_DIRECT_SOUND = "the field's responses hold the direct sound"

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


def nothing_in_the_way(place: SceneAcoustics) -> str:
    """Return why nothing can block the direct sound; empty where something can."""
    if place.surroundings is None:
        return "no walls are known that could stand in the way"
    return "the room is convex: nothing can stand in the way" if place.paths is None else ""


def no_head(listener: Listener) -> str:
    """Return why an output has no head; empty for headphones."""
    match listener.output:
        case "mono":
            return "one loudspeaker plays what one microphone would hear"
        case "ambisonics":
            return "the client turns ambisonic channels and decodes them for its ears"
        case _:
            return ""


def reason(
    change: Change, *, is_predicted: bool, wanted: bool | None, absence: str = "", together_with: Sequence[str] = ()
) -> str:
    """Return the reason of a decision as a sentence without its first capital and full stop; for an override it
    includes the prediction. `absence` says why the effect has nothing to act on; `together_with` are titles of other
    effects that are left out at the same time."""
    if together_with:
        said = f"without it and {' and '.join(together_with)}, {_amount(change)}"
    elif is_predicted:
        said = f"without it {_amount(change)}"
    else:
        said = absence or _too_little(change)
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
