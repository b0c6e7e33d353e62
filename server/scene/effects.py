"""The catalogue of effects: each acoustic phenomenon a scene may call for, what it moves of what is heard, and how it
is told beforehand whether that can be heard here.

An effect is *called for* where leaving it out would change some audible parameter by one just-noticeable difference
(JND) or more. Thresholds, with sources, are those of `server.acoustics.audibility`.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum

from server.core.errors import RequestError


class EffectName(StrEnum):
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


@dataclass(frozen=True)
class Effect:
    """`parameters` are names of thresholds; `without` is what is rendered where the effect is off. Decided once for
    each emitter, or, with `is_shared`, once for all that a listener hears."""

    name: EffectName
    title: str
    what: str
    without: str
    parameters: tuple[str, ...]
    prediction: str
    is_shared: bool = False


_ENERGIES = ("level", "spectrum", "drr", "c50")

CATALOGUE: Mapping[EffectName, Effect] = {
    effect.name: effect
    for effect in (
        Effect(
            EffectName.DIRECT_PATH,
            "direct path",
            "the sound that comes first, straight or round corners",
            "reflections and reverberation alone",
            _ENERGIES,
            "its energy beside that of everything after it",
        ),
        Effect(
            EffectName.DISTANCE_ATTENUATION,
            "distance attenuation",
            "the direct sound falls by 6 dB with every doubling of the distance",
            "the direct sound is as loud as at one metre",
            _ENERGIES,
            "the least and the greatest distance within reach",
        ),
        Effect(
            EffectName.PROPAGATION_DELAY,
            "propagation delay",
            "the delay follows the length of the path, hence Doppler",
            "the delay stands still, as part of the impulse response",
            ("pitch", "onset", "itd"),
            "the speed along the path over that of sound, and the change of the path's length",
        ),
        Effect(
            EffectName.AIR_ABSORPTION,
            "air absorption",
            "air takes the treble of what comes from far away",
            "no loss but by distance",
            ("level", "spectrum", "drr"),
            "ISO 9613-1 over the longest path within reach",
        ),
        Effect(
            EffectName.OCCLUSION,
            "occlusion",
            "walls stand in the way of the direct sound",
            "the direct sound comes straight through walls",
            _ENERGIES,
            "whether any sight line within reach meets a wall, and what the detour round it takes",
        ),
        Effect(
            EffectName.DIRECTIVITY,
            "directivity",
            "the emitter is not equally loud in all directions",
            "it radiates all round as it does ahead",
            _ENERGIES,
            "its gains in the directions of departure within reach, and their mean over all directions",
        ),
        Effect(
            EffectName.HRTF,
            "head",
            "each ear hears through the head",
            "both ears hear the same",
            ("itd", "ild", "spectrum", "iacc"),
            "a sphere of the size of a head for the difference between the ears, and the least that outer ears colour",
            is_shared=True,
        ),
        Effect(
            EffectName.EARLY_REFLECTIONS,
            "early reflections",
            "mirror images in walls, floor and ceiling, computed from geometry",
            "the direct sound and what the field holds",
            _ENERGIES,
            "the energy of the image sources, and how they interfere with the direct sound",
        ),
        Effect(
            EffectName.LATE_REVERBERATION,
            "late reverberation",
            "what the field holds: everything after the direct sound and the reflections from geometry",
            "no field is asked and nothing is convolved",
            _ENERGIES,
            "the energy of the field's responses beside that of the direct sound",
        ),
        Effect(
            EffectName.DIFFRACTION,
            "diffraction",
            "the direct sound bends round edges, and edges near the sight line screen it",
            "behind a wall there is no direct sound; in sight all of it",
            _ENERGIES,
            "the screening of the edges within reach, beside everything that comes after the direct sound",
        ),
        Effect(
            EffectName.PER_SOURCE_TAIL,
            "own late tails",
            "each emitter's late tail is its own",
            "all emitters share the late tail of one, each at its own level",
            ("t60", "iacc"),
            "how the decays and late coherences of the emitters differ",
            is_shared=True,
        ),
        Effect(
            EffectName.HEAD_ROTATION,
            "head rotation",
            "impulse responses are those of the way the head is turned",
            "they are those of one orientation; only the direct sound turns",
            ("ild",),
            "how the field's responses differ between orientations, and from which side first reflections come",
            is_shared=True,
        ),
    )
}

OF_DIRECT_SOUND = frozenset(
    {
        EffectName.DIRECT_PATH,
        EffectName.DISTANCE_ATTENUATION,
        EffectName.PROPAGATION_DELAY,
        EffectName.OCCLUSION,
        EffectName.DIFFRACTION,
    }
)
"""What means nothing without the direct sound."""
OF_RESPONSES = frozenset({EffectName.PER_SOURCE_TAIL, EffectName.HEAD_ROTATION})
"""What means nothing where nothing is convolved."""


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


def names(effects: Iterable[EffectName]) -> str:
    """For a sentence."""
    return ", ".join(CATALOGUE[effect].title for effect in effects)
