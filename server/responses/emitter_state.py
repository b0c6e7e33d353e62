"""Where an emitter is, how it radiates, and which of its effects are heard, at one moment."""

from dataclasses import dataclass

from server.acoustics.directivity import OMNIDIRECTIONAL, Directivity
from server.acoustics.geometry import Pose, Vector3
from server.responses.effect_flags import ALL_ON, EmitterEffects


@dataclass(frozen=True)
class EmitterState:
    """What code gets that renders an emitter, asks for its response or plans its effects."""

    pose: Pose
    pattern: Directivity = OMNIDIRECTIONAL
    """How it radiates, whether or not that is heard."""
    effects: EmitterEffects = ALL_ON
    gain_db: float = 0.0

    @property
    def position(self) -> Vector3:
        return self.pose.position

    @property
    def directivity(self) -> Directivity:
        """How it is heard to radiate."""
        return self.pattern if self.effects.directivity else OMNIDIRECTIONAL
