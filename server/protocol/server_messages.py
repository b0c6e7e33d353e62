"""Messages from the server in a stream at /v1/stream (`server.protocol.client_messages`)."""

from typing import Annotated, Literal, Self

from pydantic import Field, TypeAdapter, ValidationError

from server.core.durations import DurationHistogram
from server.core.errors import RequestError
from server.protocol.blocks import Encoding
from server.protocol.client_messages import PROTOCOL
from server.protocol.message import Message, Position
from server.scene.geometry import Opening
from server.scene.manifest import AcceptedLaw, Bounds, QualityLevel
from server.scene.plan import Plan

LevelReason = Literal["chosen", "load", "recovered"]
"""Why a stream has another quality level: its client chose it, or the server's load rose or fell."""


class Place(Message):
    position: Position
    yaw: float = 0.0


class SceneDescription(Message):
    """What a client needs to know of a scene; `corners` is the floor plan, counter-clockwise, or where no walls are
    known the outline of the bounds. Of `channels` a scene has two ears or one microphone; a stream always has two.

    `listener` and `emitter` are where to put a visitor and what he hears first. `accepted_laws` are those of
    `nafir check` that the scene's fields break, with the reason why it is offered all the same.
    """

    id: str
    name: str
    description: str
    sample_rate: int
    ir_samples: int
    channels: tuple[str, ...]
    speed_of_sound: float
    bounds: Bounds
    walls_known: bool
    corners: tuple[tuple[float, float], ...]
    height_m: float
    openings: tuple[Opening, ...]
    listener: Place
    emitter: Place
    level: str
    levels: tuple[QualityLevel, ...]
    accepted_laws: tuple[AcceptedLaw, ...]


class Welcome(Message):
    """Answer to a good hello. `window` is how many blocks may be unacknowledged before the server skips ahead. `level`
    is the quality level heard at first. `max_emitters` is how many emitters the stream may have at once; servers up to
    0.1 do not say."""

    type: Literal["welcome"] = "welcome"
    protocol: Literal[2] = PROTOCOL
    session: str
    scene: SceneDescription
    sample_rate: int
    block_size: int
    channels: int
    encoding: Encoding
    buffer_blocks: int
    window: int
    ir_samples: int
    hrtf: str
    level: str
    max_emitters: int | None = None


class EmitterAdded(Message):
    """The emitter's first IR is in effect: its clip begins at `sample_clock`, in the block that follows, and so does
    what was sent live, once enough of it waits."""

    type: Literal["emitter_added"] = "emitter_added"
    id: str
    sample_clock: int


class EmitterRemoved(Message):
    """The emitter is gone, and its id free."""

    type: Literal["emitter_removed"] = "emitter_removed"
    id: str


class LevelChanged(Message):
    """From `sample_clock` on another quality is heard: impulse responses of `level`, at most `ir_rate_hz` a second for
    each emitter or, where that is null, one with every pose; with `shared_tail` all emitters share one late tail.

    `reason` is chosen (by the client), load (there is too much to do for what was heard before) or recovered (there no
    longer is).
    """

    type: Literal["level_changed"] = "level_changed"
    level: str
    reason: LevelReason
    ir_rate_hz: float | None
    shared_tail: bool
    sample_clock: int


class EffectDecision(Message):
    """One effect on or off, of an emitter or, with null, of all that is heard. `change_jnd` is by how many
    just-noticeable differences the `parameter` that changes most would change without it; `cost_us` per block and
    `memory_bytes` are what it costs, or saves, null where that was not measured."""

    name: str
    emitter: str | None
    called_for: bool
    change_jnd: float
    parameter: str
    cost_us: float | None
    memory_bytes: int | None
    reason: str
    overridden: bool


class PlanChanged(Message):
    """From `sample_clock` on these effects are heard, or their change is under way. Microseconds per block."""

    type: Literal["plan_changed"] = "plan_changed"
    decisions: tuple[EffectDecision, ...]
    cost_us: float
    saved_us: float
    sample_clock: int

    @classmethod
    def of(cls, plan: Plan, sample_clock: int) -> "PlanChanged":
        # Not validated: a plan of many emitters is long, and this is made on the audio thread.
        decisions = tuple(
            EffectDecision.model_construct(**{**vars(each), "change_jnd": round(each.change_jnd, 3)})
            for each in plan.decisions
        )
        return cls.model_construct(
            decisions=decisions, cost_us=plan.cost_us, saved_us=plan.saved_us, sample_clock=sample_clock
        )


class Durations(Message):
    """Milliseconds that a half, 99 % and 99.9 % did not exceed; null before the first."""

    p50: float | None
    p99: float | None
    p99_9: float | None

    @classmethod
    def of(cls, durations: DurationHistogram) -> Self:
        p50, p99, p99_9 = (
            None if quantile_s is None else round(1000 * quantile_s, 3)
            for quantile_s in durations.quantiles_s(0.5, 0.99, 0.999)
        )
        return cls(p50=p50, p99=p99, p99_9=p99_9)


class LiveStatus(Message):
    """What became of a live emitter's samples: waiting, dropped because too many waited, silenced because they were no
    audio; and how often there were too few."""

    id: str
    samples_queued: int
    samples_dropped: int
    samples_gated: int
    underruns: int


class Status(Message):
    """How the stream does, once a second. Counts and durations run from the start of the stream.

    `buffer_ms` is how far ahead of real time it is. `render_ms` is what a block costs; of blocks rendered together with
    other streams', its share. `lateness_ms` is how long after it was due a block was ready to be sent: what it cost,
    what was rendered with it, and how late the audio thread woke. `pose_ms` and `reverberation_ms` run from the arrival
    of a pose to the first block, ready to be sent, whose direct sound and whose reverberation has it. `level` is the
    quality level heard, and `ir_rate_hz` how many impulse responses an emitter gets per second at most.
    `blocks_limited` would have been too loud, and were turned down.
    """

    type: Literal["status"] = "status"
    sample_clock: int
    blocks_sent: int
    blocks_late: int
    blocks_dropped: int
    unacknowledged: int
    buffer_ms: float
    render_ms: Durations
    lateness_ms: Durations
    ir_ms: Durations
    pose_ms: Durations
    reverberation_ms: Durations
    ir_exchanges: int
    blocks_limited: int
    level: str
    ir_rate_hz: float | None
    live: tuple[LiveStatus, ...] = ()


class Pong(Message):
    """Answer to the ping of this id."""

    type: Literal["pong"] = "pong"
    id: int


class Error(Message):
    """What was wrong with a message; the stream goes on unless it was the hello."""

    type: Literal["error"] = "error"
    code: str
    message: str
    field: str | None = None

    @classmethod
    def from_refusal(cls, refusal: RequestError) -> Self:
        return cls(code=refusal.code, message=str(refusal), field=refusal.field)


ServerMessage = Welcome | EmitterAdded | EmitterRemoved | LevelChanged | PlanChanged | Status | Pong | Error
_SERVER: TypeAdapter[ServerMessage] = TypeAdapter(Annotated[ServerMessage, Field(discriminator="type")])


class UnknownMessage(Message):
    """What a newer server says, and a client of this version ignores."""

    type: str


def parse_server_message(data: str) -> ServerMessage | UnknownMessage:
    """A text message as a client receives it, which ignores fields that it does not know. Raises
    pydantic.ValidationError for what no server says."""
    try:
        return _SERVER.validate_json(data, extra="ignore")
    except ValidationError as exc:
        if exc.errors()[0]["type"] != "union_tag_invalid":
            raise
        return UnknownMessage.model_validate_json(data, extra="ignore")
