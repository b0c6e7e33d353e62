"""What a session knows of one emitter: its state, what it plays, what is heard of it, and what is out of date."""

from collections.abc import Hashable
from dataclasses import dataclass, field, replace
from enum import Enum, auto

from server.acoustics.directivity import OMNIDIRECTIONAL
from server.acoustics.geometry import Pose
from server.core.errors import RequestError
from server.field.lattice import Neighbourhood
from server.planning.catalogue import EVERYTHING
from server.protocol.blocks import DryBlock
from server.protocol.client_messages import AddEmitter, MoveEmitter
from server.protocol.server_messages import LiveStatus
from server.rendering.convolver import PartitionedIr
from server.rendering.sources import LiveSource
from server.responses.effect_flags import EmitterEffects
from server.responses.emitter_state import EmitterState

_LIVE_LEAD_BLOCKS = 2
_LIVE_QUEUE_S = 0.5


class Stage(Enum):
    """How far an emitter has come since it was added. Every one goes through all stages, in this order."""

    UNDECIDED = auto()
    """No plan has said yet which of its effects are heard."""
    DECIDED = auto()
    """It waits for its first impulse response, if its effects call for one."""
    ANNOUNCED = auto()
    """The client was told that it sounds."""


@dataclass
class HeardResponse:
    """The newest impulse response (IR) of an emitter that the renderer has."""

    token: int | None = None
    """Pose id; None before the first."""
    identity: Hashable | None = None
    """Which one it is, where poses share responses; None where it is not known to be that of a pose."""
    without_direct: PartitionedIr | None = None
    """The newest that leaves the direct sound to the renderer."""
    bakes_direct: bool = False
    """Whether the direct sound is part of it."""
    validity: "Validity | None" = None


@dataclass(frozen=True)
class Validity:
    """An IR is sure to be that of a listener too who is in `around`, as long as the `circumstances` are the same."""

    circumstances: Hashable
    around: Neighbourhood

    def holds(self, circumstances: Hashable, listener: Pose) -> bool:
        return self.circumstances == circumstances and self.around.holds(listener)


@dataclass
class StreamedEmitter:
    """`state` is what the client and the plan say; `heard` is what the renderer was given last. Code that changes the
    state notes here what of that is out of date. `serial` tells it from others that had the same id before."""

    serial: int
    state: EmitterState
    live: "LiveInput | None" = None
    stage: Stage = Stage.DECIDED
    heard: HeardResponse = field(default_factory=HeardResponse)
    is_outdated: bool = True
    """Whether the IR may be of another state: one is to be asked for, unless the one that is heard is that one."""
    is_displaced: bool = True
    """Whether the renderer has the direct path of another state."""

    @classmethod
    def added_by(
        cls, message: AddEmitter, serial: int, live: "LiveInput | None", stage: Stage = Stage.DECIDED
    ) -> "StreamedEmitter":
        pattern = OMNIDIRECTIONAL if message.directivity is None else message.directivity.directivity
        return cls(serial, EmitterState(message.pose, pattern, EVERYTHING, message.gain_db), live, stage)

    @property
    def effects(self) -> EmitterEffects:
        return self.state.effects

    @property
    def is_decided(self) -> bool:
        """Whether a plan has said which effects are heard, or there is none."""
        return self.stage is not Stage.UNDECIDED

    @property
    def wants_baking(self) -> bool:
        """Whether the direct sound is to become part of an IR that is otherwise up to date."""
        has_other = self.heard.without_direct is not None and not self.heard.bakes_direct
        return self.effects.bakes_direct and has_other and not self.is_outdated

    def decide(self) -> None:
        if self.stage is Stage.UNDECIDED:
            self.stage = Stage.DECIDED

    def announce(self) -> bool:
        """Whether the client is still to be told that it sounds."""
        is_news, self.stage = self.stage is not Stage.ANNOUNCED, Stage.ANNOUNCED
        return is_news

    def move(self, message: MoveEmitter) -> None:
        # Turning on the spot leaves what a field says as it is.
        self.is_outdated |= message.position != self.state.position
        self.is_displaced = True
        pose = message.pose if message.has_front else Pose(message.position, self.state.pose.orientation)
        self.state = replace(self.state, pose=pose)

    def set_gain(self, gain_db: float) -> None:
        self.state = replace(self.state, gain_db=gain_db)

    def set_effects(self, effects: EmitterEffects) -> None:
        self.state = replace(self.state, effects=effects)

    def discard_response(self) -> None:
        """The IR is no longer right, wherever the emitter is."""
        self.is_outdated, self.heard.identity = True, None


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
