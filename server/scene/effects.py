"""The names of the effects: each is an acoustic phenomenon that a scene may call for.

An effect is *called for* where leaving it out would change some audible parameter by one just-noticeable difference
(JND) or more. What each is, and how it is told beforehand whether it can be heard, is in the module of its name in
`server.planning.effects`.
"""

from collections.abc import Mapping
from enum import StrEnum

from server.core.errors import RequestError


class EffectName(StrEnum):
    """In the order in which gains of the direct sound are multiplied, and plans list them."""

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
"""On or off whatever the prediction says; effects that are not named are decided by it."""


def read_overrides(given: Mapping[str, bool]) -> dict[EffectName, bool]:
    """Overrides by an effect's name as clients and files write it. Raises RequestError `unknown_effect`."""
    return {require_effect(name): bool(is_on) for name, is_on in given.items()}


def require_effect(name: str) -> EffectName:
    """Raises RequestError `unknown_effect` with the names there are."""
    try:
        return EffectName(name)
    except ValueError:
        problem = f"there is no effect {name!r}, only {', '.join(EffectName)}"
        raise RequestError("unknown_effect", problem, field="effects") from None
