"""A session's data of one emitter: its state, its source, the response that is playing, and which of them are out of
date."""

import math
from collections.abc import Hashable
from dataclasses import dataclass, field, replace
from enum import Enum, auto

from server.acoustics.directivity import OMNIDIRECTIONAL
from server.acoustics.geometry import Pose, Vector3
from server.core.errors import RequestError
from server.field.lattice import Neighbourhood
from server.planning.catalogue import EVERYTHING
from server.protocol.blocks import DryBlock
from server.protocol.client_messages import AddEmitter, MoveEmitter, StopEmitter
from server.protocol.server_messages import LiveStatus
from server.protocol.snapshot import KeptEmitter
from server.rendering.convolver import PartitionedIr
from server.rendering.ingest import DryAudio
from server.rendering.sources import FADE_SAMPLES, FloatArray, LiveSource, SharedSource
from server.responses.effect_flags import EmitterEffects
from server.responses.emitter_state import EmitterState

_LIVE_LEAD_BLOCKS = 2
_LIVE_QUEUE_S = 0.5


class Stage(Enum):
    """The stages of an emitter after it was added. Every emitter goes through all of them in this order."""

    UNDECIDED = auto()
    """No plan has decided about its effects yet."""
    DECIDED = auto()
    """Its effects are decided; it waits for its first impulse response, if they call for one."""
    ANNOUNCED = auto()
    """The client has been informed that it is audible."""


@dataclass
class HeardResponse:
    """The newest impulse response (IR) of an emitter that the renderer has."""

    token: int | None = None
    """The id of its pose; None before the first."""
    identity: Hashable | None = None
    """The identity of the response where poses share responses; None if it is not known to belong to a pose."""
    without_direct: PartitionedIr | None = None
    """The newest IR that leaves the direct sound to the renderer."""
    bakes_direct: bool = False
    """Whether the IR includes the direct sound."""
    validity: "Validity | None" = None
    whole: "WholeResponse | None" = None
    """The newest IR of which all parts were computed for one pose."""
    keeps_late: bool = False
    """Whether only the early part of the IR was computed for its pose, and the rest is that of `whole`."""


@dataclass(frozen=True)
class WholeResponse:
    """An IR computed for poses of listener and emitter, with the `circumstances` on which its later part depends."""

    ir: PartitionedIr
    listener: Pose
    emitter: Vector3
    circumstances: Hashable

    def age(self, listener: Pose, emitter: Vector3, reach_m: float, turn_deg: float) -> float:
        """How far its poses are from these, as a share of how far they may be: `reach_m` for listener and emitter
        together, or a turn of the head by `turn_deg`."""
        moved_m = math.dist(self.listener.position, listener.position) + math.dist(self.emitter, emitter)
        same = abs(sum(a * b for a, b in zip(self.listener.orientation, listener.orientation, strict=True)))
        turned_deg = 2 * math.degrees(math.acos(min(1.0, same)))
        return max(moved_m / reach_m, turned_deg / turn_deg)


@dataclass(frozen=True)
class Validity:
    """Where an IR stays valid: every listener in `around` has the same one while the `circumstances` stay the same."""

    circumstances: Hashable
    around: Neighbourhood

    def holds(self, circumstances: Hashable, listener: Pose) -> bool:
        return self.circumstances == circumstances and self.around.holds(listener)


@dataclass(frozen=True)
class Ramp:
    """A gain on its way to `gain_db`, which it reaches at the clock `ends_at`."""

    ends_at: int
    gain_db: float


@dataclass
class StreamedEmitter:
    """One emitter of a stream. `state` follows the client and the plan; `heard` is what the renderer has. Code that
    changes the state marks here which parts of `heard` are out of date. `serial` distinguishes it from others that had
    the same id before."""

    serial: int
    state: EmitterState
    added: AddEmitter | None = None
    """The client's message that added it; None outside streams."""
    live: "LiveInput | None" = None
    clip: DryAudio | FloatArray | None = None
    """What it plays, unless it is live."""
    stage: Stage = Stage.DECIDED
    heard: HeardResponse = field(default_factory=HeardResponse)
    is_outdated: bool = True
    """Whether the IR may belong to an earlier state. If so, a new one is requested, unless the one that is playing
    turns out to be the same."""
    is_displaced: bool = True
    """Whether the renderer has the direct path of an earlier state."""
    starts_at: int = 0
    """Clock from which its clip is heard, unless it becomes audible later."""
    ends: bool = False
    """Whether it will have been heard to its end some time, of which the client is not informed yet."""
    remove_when_ended: bool = False
    ramp: "Ramp | None" = None
    since: int | None = None
    """The sample clock since which it is audible; None before."""
    stop: StopEmitter | None = None
    """When the client has its clip stop, and how; None if it has not said so since it added the emitter."""

    @classmethod
    def added_by(
        cls,
        message: AddEmitter,
        serial: int,
        live: "LiveInput | None",
        stage: Stage = Stage.DECIDED,
        *,
        since: int | None = None,
        clip: DryAudio | FloatArray | None = None,
    ) -> "StreamedEmitter":
        pattern = OMNIDIRECTIONAL if message.directivity is None else message.directivity.directivity
        state = EmitterState(message.pose, pattern, EVERYTHING, message.gain_db)
        return cls(
            serial,
            state,
            message,
            live,
            clip,
            stage,
            starts_at=message.start_at or 0,
            ends=live is None and (not message.loop or message.stop_at is not None),
            remove_when_ended=message.remove_when_ended,
            since=since,
        )

    def kept(self) -> KeptEmitter:
        """Return what an emitter like this one, at its present place, is made of. A gain on its way is there. Not
        validated, since this runs on the audio thread."""
        assert self.added is not None, "no message has added it"
        now = {
            "position": self.state.position,
            "orientation": self.state.pose.orientation,
            "yaw": None,
            "gain_db": self.state.gain_db if self.ramp is None else self.ramp.gain_db,
        }
        given = {name: getattr(self.added, name) for name in AddEmitter.model_fields}
        return KeptEmitter.model_construct(
            emitter=AddEmitter.model_construct(**{**given, **now}),
            since=self.since,
            stop=self.stop,
            ends=self.ends,
            newest_block=-1 if self.live is None else self.live.newest_sequence,
        )

    @property
    def effects(self) -> EmitterEffects:
        return self.state.effects

    @property
    def is_decided(self) -> bool:
        """Whether a plan has decided about its effects, or there are no plans."""
        return self.stage is not Stage.UNDECIDED

    @property
    def wants_baking(self) -> bool:
        """Whether the direct sound is to be baked into an IR that is otherwise up to date."""
        has_other = self.heard.without_direct is not None and not self.heard.bakes_direct
        return self.effects.bakes_direct and has_other and not self.is_outdated

    def decide(self) -> None:
        if self.stage is Stage.UNDECIDED:
            self.stage = Stage.DECIDED

    def announce(self, sample_clock: int) -> bool:
        """Note that it is heard from this clock on, unless it was before. Return whether to tell the client, which
        knows of an emitter that was heard in the stream before it was resumed."""
        is_news = self.stage is not Stage.ANNOUNCED and self.since is None
        self.stage = Stage.ANNOUNCED
        if self.since is None:
            self.since = sample_clock
        return is_news

    def move(self, message: MoveEmitter) -> None:
        # A field's response does not depend on an emitter's orientation.
        self.is_outdated |= message.position != self.state.position
        self.is_displaced = True
        pose = message.pose if message.has_front else Pose(message.position, self.state.pose.orientation)
        self.state = replace(self.state, pose=pose)

    def set_gain(self, gain_db: float, *, ramp_ends: int | None = None) -> None:
        """Note a gain, which is reached at the clock `ramp_ends` or now. During a ramp plans go by its louder end."""
        self.ramp = None if ramp_ends is None else Ramp(ramp_ends, gain_db)
        louder_db = gain_db if ramp_ends is None else max(gain_db, self.state.gain_db)
        self.state = replace(self.state, gain_db=louder_db)

    def follow_ramp(self, clock: int) -> None:
        """Note the gain of a ramp that has ended by `clock`."""
        if self.ramp is not None and self.ramp.ends_at <= clock:
            self.set_gain(self.ramp.gain_db)

    def note_stop(self, message: StopEmitter, clock: int) -> None:
        """Note that its clip is to stop, by a message that comes at this clock. Once the fade has begun no other
        counts."""
        assert self.added is not None, "no message has added it"
        before = self.added.stop_at if self.stop is None else self.stop.stop_at
        if before is None or before >= clock:
            at = clock if message.stop_at is None else max(clock, message.stop_at)
            self.stop = message.model_copy(update={"stop_at": at})

    def set_effects(self, effects: EmitterEffects) -> None:
        self.state = replace(self.state, effects=effects)

    def discard_response(self) -> None:
        """Mark the IR as wrong for every position of the emitter."""
        self.is_outdated, self.heard.identity, self.heard.whole = True, None, None


@dataclass
class LiveInput:
    """The live source of emitter `id`, which all listeners of a stream share, and the sequence number of its newest
    block."""

    id: str
    source: LiveSource
    newest_sequence: int = -1
    blocks_lost: int = field(default=0, init=False)
    samples_concealed: int = field(default=0, init=False)
    _gated_told: int = field(default=0, init=False)
    shared: SharedSource = field(init=False)
    """Its source for the renderers of several listeners."""

    def __post_init__(self) -> None:
        self.shared = SharedSource(self.source)

    @classmethod
    def opened(
        cls, identifier: str, *, sample_rate: int, block_size: int, jitter_ms: float | None = None
    ) -> "LiveInput":
        """Samples wait for `jitter_ms` before they play, by default for two blocks."""
        lead = _LIVE_LEAD_BLOCKS * block_size if jitter_ms is None else round(jitter_ms / 1000 * sample_rate)
        lead = max(lead, FADE_SAMPLES + 1)
        capacity = max(round(_LIVE_QUEUE_S * sample_rate), 2 * lead)
        return cls(identifier, LiveSource(capacity=capacity, lead=lead))

    def push(self, block: DryBlock) -> None:
        """Queue a block. Raises RequestError stale_block for one that is not newer than those before."""
        if block.sequence <= self.newest_sequence:
            problem = f"block {block.sequence} of emitter {self.id!r} is not newer than {self.newest_sequence}"
            raise RequestError("stale_block", problem, field="sequence")
        lost = block.sequence - self.newest_sequence - 1 if self.newest_sequence >= 0 else 0
        self.newest_sequence = block.sequence
        self.blocks_lost += lost
        if lost and not block.concealed:
            self.source.lose(lost * block.samples.size)
        self.samples_concealed += block.concealed
        self.source.push(block.samples)

    @property
    def status(self) -> LiveStatus:
        source = self.source
        return LiveStatus(
            id=self.id,
            samples_queued=source.queued,
            samples_dropped=source.samples_dropped,
            samples_gated=source.samples_gated,
            samples_concealed=self.samples_concealed,
            underruns=source.underruns,
            blocks_lost=self.blocks_lost,
            samples_awaited=source.target,
        )

    def complaint(self) -> RequestError | None:
        """Return the error about invalid samples since the last call, or None."""
        gated = self.source.samples_gated - self._gated_told
        self._gated_told += gated
        if not gated:
            return None
        problem = f"{gated} samples of emitter {self.id!r} were not audio (not finite, or beyond 1e6): silence now"
        return RequestError("bad_samples", problem, field="samples")
