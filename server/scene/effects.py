"""The names of the effects. Each effect is an acoustic phenomenon that a scene may call for.

An effect is *called for* if leaving it out would change some audible parameter by one just-noticeable difference (JND)
or more. The module of its name in `server.planning.effects` describes the effect, and predicts whether it is audible.
"""

from collections.abc import Mapping
from enum import StrEnum

from server.core.errors import RequestError


class EffectName(StrEnum):
    """The names of effects, in the order in which gains of the direct sound are multiplied and plans list them."""

    DIRECT_PATH = "direct_path"
    DISTANCE_ATTENUATION = "distance_attenuation"
    PROPAGATION_DELAY = "propagation_delay"
    AIR_ABSORPTION = "air_absorption"
    OCCLUSION = "occlusion"
    DIRECTIVITY = "directivity"
    HRTF = "hrtf"
    EARLY_REFLECTIONS = "early_reflections"
    LATE_REVERBERATION = "late_reverberation"
    DIFFRACTION = "diffraction"
    PER_SOURCE_TAIL = "per_source_tail"
    HEAD_ROTATION = "head_rotation"


Overrides = Mapping[EffectName, bool]
"""Effects that are on or off regardless of the prediction, which decides about all others."""


def read_overrides(given: Mapping[str, bool]) -> dict[EffectName, bool]:
    """Convert overrides with effect names as in messages and files. Raises RequestError `unknown_effect`."""
    return {require_effect(name): bool(is_on) for name, is_on in given.items()}


def require_effect(name: str) -> EffectName:
    """Convert the name of an effect. Raises RequestError `unknown_effect`, which lists the names."""
    try:
        return EffectName(name)
    except ValueError:
        problem = f"there is no effect {name!r}, only {', '.join(EffectName)}"
        raise RequestError("unknown_effect", problem, field="effects") from None
