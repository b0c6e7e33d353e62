"""What a session knows of one emitter: where it is, how it radiates, what it plays, and what is out of date."""

from collections.abc import Hashable
from dataclasses import dataclass, field

from server.acoustics.directivity import OMNIDIRECTIONAL, Directivity
from server.acoustics.geometry import Pose, Vector3
from server.core.errors import RequestError
from server.field.lattice import Neighbourhood
from server.planning.catalogue import EVERYTHING
from server.protocol.blocks import DryBlock
from server.protocol.client_messages import AddEmitter, MoveEmitter
from server.protocol.server_messages import LiveStatus
from server.rendering.convolver import PartitionedIr
from server.rendering.sources import LiveSource
from server.responses.effect_flags import EmitterEffects

_LIVE_LEAD_BLOCKS = 2
_LIVE_QUEUE_S = 0.5


@dataclass
class Emitter:
    """Sounds from `pose`; `serial` tells it from others that had the same id before."""

    serial: int
    pose: Pose
    pattern: Directivity = OMNIDIRECTIONAL
    """How it radiates, whether or not that is heard."""
    live: "LiveInput | None" = None
    gain_db: float = 0.0
    effects: EmitterEffects = EVERYTHING
    is_decided: bool = True
    """Whether `effects` are those called for, or nobody has told yet."""
    is_announced: bool = False
    """Whether the client was told that it sounds."""
    is_outdated: bool = True
    """Whether its impulse response is of another pose."""
    is_displaced: bool = True
    """Whether its direct path is of another pose of its own, or of other effects."""
    identity: Hashable | None = None
    """Of its impulse response, where poses share responses."""
    found_for: Hashable | None = None
    around: Neighbourhood | None = None
    """Listeners who hear that response for certain, as long as everything else is as it was `found_for`."""
    ir_without_direct: PartitionedIr | None = None
    """The newest impulse response in effect that leaves the direct sound to the renderer."""
    is_baked: bool = False
    """Whether the response in effect holds the direct sound."""
    token: int | None = None
    """Pose id of the newest impulse response handed to the renderer; None before the first."""

    @classmethod
    def added_by(cls, message: AddEmitter, serial: int, live: "LiveInput | None") -> "Emitter":
        pattern = message.directivity
        radiates = OMNIDIRECTIONAL if pattern is None else pattern.directivity
        return cls(serial, message.pose, radiates, live, message.gain_db)

    @property
    def directivity(self) -> Directivity:
        """The one that is heard."""
        return self.pattern if self.effects.directivity else OMNIDIRECTIONAL

    @property
    def is_live(self) -> bool:
        return self.live is not None

    @property
    def wants_baking(self) -> bool:
        """Whether the direct sound is to become part of a response that is otherwise up to date."""
        return (
            self.effects.bakes_direct and self.ir_without_direct is not None and not (self.is_baked or self.is_outdated)
        )

    @property
    def position(self) -> Vector3:
        return self.pose.position

    def move(self, message: MoveEmitter) -> None:
        # Turning on the spot leaves what a field says as it is.
        self.is_outdated |= message.position != self.position
        self.is_displaced = True
        self.pose = message.pose if message.has_front else Pose(message.position, self.pose.orientation)


@dataclass
class LiveInput:
    """The live source of emitter `id`, and which of its blocks came last."""

    id: str
    source: LiveSource
    newest_sequence: int = -1
    _gated_told: int = field(default=0, init=False)

    @classmethod
    def opened(cls, identifier: str, *, sample_rate: int, block_size: int) -> "LiveInput":
        lead = _LIVE_LEAD_BLOCKS * block_size
        capacity = max(round(_LIVE_QUEUE_S * sample_rate), 2 * lead)
        return cls(identifier, LiveSource(capacity=capacity, lead=lead))

    def push(self, block: DryBlock) -> None:
        """Raises RequestError stale_block."""
        if block.sequence <= self.newest_sequence:
            problem = f"block {block.sequence} of emitter {self.id!r} is not newer than {self.newest_sequence}"
            raise RequestError("stale_block", problem, field="sequence")
        self.newest_sequence = block.sequence
        self.source.push(block.samples)

    @property
    def status(self) -> LiveStatus:
        source = self.source
        return LiveStatus(
            id=self.id,
            samples_queued=source.queued,
            samples_dropped=source.samples_dropped,
            samples_gated=source.samples_gated,
            underruns=source.underruns,
        )

    def complaint(self) -> RequestError | None:
        """What was wrong with the samples that came since it was asked last."""
        gated = self.source.samples_gated - self._gated_told
        self._gated_told += gated
        if not gated:
            return None
        problem = f"{gated} samples of emitter {self.id!r} were not audio (not finite, or beyond 1e6): silence now"
        return RequestError("bad_samples", problem, field="samples")
