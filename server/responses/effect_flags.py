"""What a plan of effects means to whoever renders: which parts of a listener's sound there are."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

from server.scene.effects import EffectName
from server.scene.plan import Plan

PARTS: Mapping[EffectName, str] = {
    EffectName.DIRECT_PATH: "direct_path",
    EffectName.DISTANCE_ATTENUATION: "distance_attenuation",
    EffectName.AIR_ABSORPTION: "air_absorption",
    EffectName.OCCLUSION: "occlusion",
    EffectName.DIFFRACTION: "diffraction",
    EffectName.DIRECTIVITY: "directivity",
    EffectName.EARLY_REFLECTIONS: "early",
    EffectName.LATE_REVERBERATION: "late",
}
"""Which part of `EmitterEffects` an effect is, of those that a single moment tells."""


@dataclass(frozen=True)
class EmitterEffects:
    """Of one emitter. `early` are the first reflections from geometry, `late` is what the field holds."""

    direct_path: bool = True
    propagation_delay: bool = True
    distance_attenuation: bool = True
    air_absorption: bool = True
    occlusion: bool = True
    diffraction: bool = True
    directivity: bool = True
    early: bool = True
    late: bool = True
    holds_still: bool = False
    """Whether the delay is to stand still even while something moves."""

    @classmethod
    def of(cls, plan: Plan, emitter: str, *, has_early: bool, has_late: bool) -> Self:
        """`has_early` and `has_late` say what there is in the scene."""

        def is_on(name: EffectName) -> bool:
            return plan.is_on(name, emitter)

        return cls(
            direct_path=is_on(EffectName.DIRECT_PATH),
            propagation_delay=is_on(EffectName.PROPAGATION_DELAY),
            distance_attenuation=is_on(EffectName.DISTANCE_ATTENUATION),
            air_absorption=is_on(EffectName.AIR_ABSORPTION),
            occlusion=is_on(EffectName.OCCLUSION),
            diffraction=is_on(EffectName.DIFFRACTION),
            directivity=is_on(EffectName.DIRECTIVITY),
            early=has_early and is_on(EffectName.EARLY_REFLECTIONS),
            late=has_late and is_on(EffectName.LATE_REVERBERATION),
        )

    @property
    def has_response(self) -> bool:
        return self.early or self.late

    @property
    def bakes_direct(self) -> bool:
        """Whether the direct sound stands still and is part of the impulse response."""
        return self.direct_path and not self.propagation_delay and self.has_response


ALL_ON = EmitterEffects()


@dataclass(frozen=True)
class SharedEffects:
    """Of all that a listener hears: through a `head` or with one ear without; every emitter with a tail of its own;
    responses anew when the head turns."""

    head: bool = True
    own_tails: bool = True
    head_rotation: bool = True

    @classmethod
    def of(cls, plan: Plan) -> Self:
        return cls(
            head=plan.is_on(EffectName.HRTF),
            own_tails=plan.is_on(EffectName.PER_SOURCE_TAIL),
            head_rotation=plan.is_on(EffectName.HEAD_ROTATION),
        )

    @property
    def channels(self) -> int:
        return 2 if self.head else 1
