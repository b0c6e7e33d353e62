"""The state of an emitter at one moment: its pose, its directivity, and its effects."""

from dataclasses import dataclass

from server.acoustics.directivity import OMNIDIRECTIONAL, Directivity
from server.acoustics.geometry import Pose, Vector3
from server.responses.effect_flags import ALL_ON, EmitterEffects


@dataclass(frozen=True)
class EmitterState:
    """The state from which an emitter is rendered, its responses are computed and its effects are planned."""

    pose: Pose
    pattern: Directivity = OMNIDIRECTIONAL
    """The emitter's directivity, whether or not that effect is on."""
    effects: EmitterEffects = ALL_ON
    gain_db: float = 0.0

    @property
    def position(self) -> Vector3:
        return self.pose.position

    @property
    def directivity(self) -> Directivity:
        """The directivity that is rendered: omnidirectional if the effect is off."""
        return self.pattern if self.effects.directivity else OMNIDIRECTIONAL
