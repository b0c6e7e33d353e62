"""Messages from the server in a stream at /v1/stream."""

from typing import Annotated, Literal, Self

from pydantic import Field, TypeAdapter, ValidationError

from server.core.durations import DurationHistogram
from server.core.errors import RequestError
from server.planning.plan import Plan
from server.protocol.client_messages import PROTOCOL
from server.protocol.codecs.registry import Encoding
from server.protocol.message import Message, Position
from server.protocol.opus import OpusStreams
from server.scene.geometry import Opening
from server.scene.manifest import AcceptedLaw, Bounds, QualityLevel

LevelReason = Literal["chosen", "load", "recovered"]
"""Why the quality level changed: the client chose it, the server's load rose, or the load fell again."""


class Place(Message):
    position: Position
    yaw: float = 0.0


class DoorDescription(Message):
    """A door. A swing turns by `angle_deg` about `pivot`, counter-clockwise as seen from above, when it opens; a slide
    moves by `slide_m`. `openness` is that at the beginning, from 0, shut, to 1. `footprint` is the outline of the shut
    leaf as seen from above, between the heights `bottom_m` and `top_m`."""

    name: str
    kind: Literal["swing", "slide"]
    pivot: Position
    angle_deg: float
    slide_m: Position
    openness: float
    footprint: tuple[tuple[float, float], ...]
    bottom_m: float
    top_m: float


class Storey(Message):
    """A storey: its floor, and where the next one begins or the scene ends."""

    floor_m: float
    top_m: float


class SceneDescription(Message):
    """Description of a scene. `corners` is the floor plan, counter-clockwise, or the outline of the bounds if the walls
    are unknown. `sample_rate` is that of the scene's fields and of single responses, and a stream may have any of
    `sample_rates`. `channels` are those of the scene's responses: two ears or one microphone. `directional_levels` are
    the quality levels that know from where sound arrives, so that a stream of them may be ambisonic.

    `is_mesh` says that its surfaces are a triangle mesh, of which `corners` are the outline of the bounds. Its
    `storeys` are from below; GET /v1/scenes/{scene}/section has the lines in which a plane cuts it at a height. `doors`
    can be opened and shut; `footprint` is where the leaf stands when shut, seen from above.

    `listener` and `emitter` are the places where a visit begins. `accepted_laws` are the laws of `nafir check` that the
    scene's fields break, each with the reason why the scene is offered all the same.
    """

    id: str
    name: str
    description: str
    sample_rate: int
    sample_rates: tuple[int, ...]
    ir_samples: int
    channels: tuple[str, ...]
    speed_of_sound: float
    bounds: Bounds
    walls_known: bool
    corners: tuple[tuple[float, float], ...]
    height_m: float
    openings: tuple[Opening, ...]
    is_mesh: Annotated[bool, Field(exclude_if=lambda is_mesh: not is_mesh)] = False
    storeys: Annotated[tuple[Storey, ...], Field(exclude_if=lambda storeys: not storeys)] = ()
    doors: Annotated[tuple[DoorDescription, ...], Field(exclude_if=lambda doors: not doors)] = ()
    listener: Place
    emitter: Place
    level: str
    levels: tuple[QualityLevel, ...]
    directional_levels: tuple[str, ...] = ()
    accepted_laws: tuple[AcceptedLaw, ...]


class ResumedListener(Message):
    """A listener that a resumed stream has besides the first, and its number."""

    id: str
    index: int


class Resumed(Message):
    """Where a stream goes on. The next block has this `sample_clock` and `sequence`. `pose_id` is the newest pose, of
    listener or emitters, that had arrived before the connection was lost: send newer ones again. `handled` is how many
    other messages had: of all text messages since the `hello` other than `listener`, `move_emitter`, `acknowledge` and
    `ping`. Send those after them again. `listeners` are those beside the first, if there are any; the blocks of each go
    on with the same clock and sequence."""

    sample_clock: int
    sequence: int
    pose_id: int
    handled: int
    listeners: Annotated[tuple[ResumedListener, ...], Field(exclude_if=lambda listeners: not listeners)] = ()


class Welcome(Message):
    """The answer to a valid hello or resume. `window` is how many blocks may be unacknowledged before the server skips
    blocks. `sample_rate` is that of the stream, `ir_samples` the length of its longest response. `level` is the first
    quality level. `max_emitters` is how many emitters the stream may have at once. `order` is that of ambisonic
    channels; streams of other outputs do not have it. `opus` says how to decode the encoding `opus`; streams of other
    encodings do not have it. `max_listeners` is how many listeners the stream may have at once, if the `hello` said how
    many it will have. `doors` says how far each door is open; scenes without doors do not have it.

    With `resume_token` a client resumes the stream within `resume_s` seconds after its connection is lost. Keep it
    secret: whoever has it can take the stream over. `resumed` says where a resumed stream goes on; a new one does not
    have it, and `session` is the same."""

    type: Literal["welcome"] = "welcome"
    protocol: Literal[3] = PROTOCOL
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
    max_listeners: Annotated[int | None, Field(exclude_if=lambda count: count is None)] = None
    resume_token: Annotated[str | None, Field(exclude_if=lambda token: token is None)] = None
    resume_s: Annotated[float | None, Field(exclude_if=lambda seconds: seconds is None)] = None
    resumed: Annotated[Resumed | None, Field(exclude_if=lambda resumed: resumed is None)] = None
    order: Annotated[int | None, Field(exclude_if=lambda order: order is None)] = None
    opus: Annotated[OpusStreams | None, Field(exclude_if=lambda opus: opus is None)] = None
    doors: Annotated[dict[str, float] | None, Field(exclude_if=lambda doors: doors is None)] = None


class SnapshotTaken(Message):
    """The state of the stream, signed, for a client to keep: with the newest one it can resume the stream at any server
    of the same scenes and the same secret within `expires_s` seconds, even if this one is gone. It comes every few
    seconds if the `hello` asked for `snapshots`, and before `server_draining`. `pose_id` and `handled` say what it
    includes, as in `resumed`."""

    type: Literal["snapshot"] = "snapshot"
    snapshot: str
    pose_id: int
    handled: int
    expires_s: float


class EmitterAdded(Message):
    """The emitter's first impulse response is in effect. Its clip begins at `sample_clock`: with the next block or at
    the `start_at` of its `add_emitter`, if that is later. A live emitter begins then too, once enough of its samples
    wait."""

    type: Literal["emitter_added"] = "emitter_added"
    id: str
    sample_clock: int


class EmitterEnded(Message):
    """The emitter's clip is over or was stopped, and all its sound had been heard by `sample_clock`. If it was to be
    `removed` then, its id is free; no `emitter_removed` follows."""

    type: Literal["emitter_ended"] = "emitter_ended"
    id: str
    sample_clock: int
    removed: bool


class EmitterRemoved(Message):
    """The emitter was removed, and its id is free."""

    type: Literal["emitter_removed"] = "emitter_removed"
    id: str


class ListenerAdded(Message):
    """The listener is there. Its blocks have the number `index` in their headers, the first of them this
    `sample_clock`."""

    type: Literal["listener_added"] = "listener_added"
    id: str
    index: int
    hrtf: str
    sample_clock: int


class ListenerRemoved(Message):
    """The listener with this number was removed, and its id is free. No block of it follows, and blocks that still
    waited to be sent are left out."""

    type: Literal["listener_removed"] = "listener_removed"
    id: str
    index: int


class LevelChanged(Message):
    """The quality changes at `sample_clock`. Impulse responses are of `level` from then on. Each emitter gets at most
    `ir_rate_hz` of them a second or, if that is null, one for every pose. With `shared_tail` all emitters share one
    late reverberation.

    `reason` is `chosen` (by the client), `load` (the server had too much to do for the better quality) or `recovered`
    (it no longer has). `listener` is the id of the listener who hears it; without it, it is the first one.
    """

    type: Literal["level_changed"] = "level_changed"
    level: str
    reason: LevelReason
    ir_rate_hz: float | None
    shared_tail: bool
    sample_clock: int
    listener: Annotated[str | None, Field(exclude_if=lambda listener: listener is None)] = None


class EffectDecision(Message):
    """Whether one effect is on, for one emitter or, with null, for the whole stream. `change_jnd` is the predicted
    change without the effect, in just-noticeable differences, of the `parameter` that would change most. `cost_us` per
    block and `memory_bytes` are what the effect costs or saves; null if that was not measured."""

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
    """These effects are on from `sample_clock`, or are being faded in or out. Costs are microseconds per block.
    `listener` is the id of the listener who hears them; without it, it is the first one."""

    type: Literal["plan_changed"] = "plan_changed"
    decisions: tuple[EffectDecision, ...]
    cost_us: float
    saved_us: float
    sample_clock: int
    listener: Annotated[str | None, Field(exclude_if=lambda listener: listener is None)] = None

    @classmethod
    def of(cls, plan: Plan, sample_clock: int) -> "PlanChanged":
        # Not validated: a plan of many emitters is long, and this runs on the audio thread.
        decisions = tuple(
            EffectDecision.model_construct(**{**vars(each), "change_jnd": round(each.change_jnd, 3)})
            for each in plan.decisions
        )
        return cls.model_construct(
            decisions=decisions, cost_us=plan.cost_us, saved_us=plan.saved_us, sample_clock=sample_clock
        )


class Durations(Message):
    """Quantiles of durations in milliseconds: the median, 99 % and 99.9 %. Null before the first duration."""

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
    """Counts of a live emitter's samples: `samples_queued` wait, `samples_dropped` came while too many waited,
    `samples_gated` were not audio and became silence, and `samples_concealed` stand for blocks in Opus that were lost.
    `blocks_lost` counts the numbers missing between its blocks. `samples_awaited` have to wait before it plays, and
    more after each underrun. `underruns` counts how often too few waited."""

    id: str
    samples_queued: int
    samples_dropped: int
    samples_gated: int
    samples_concealed: int = 0
    underruns: int
    blocks_lost: int = 0
    samples_awaited: int = 0


class Status(Message):
    """Statistics of the stream, sent once a second for each listener: with the id `listener` for those beside the
    first. Counts and durations run from the start of the stream or of the listener; `blocks_late`, `buffer_ms`,
    `render_ms`, `lateness_ms` and `live` are of the whole stream.

    `buffer_ms` is how far the stream is ahead of real time. `render_ms` is the time to render a block, or its share of
    the time if several streams were rendered together. `lateness_ms` is the time from when a block was due until it
    could be sent; it includes rendering and the late waking of the audio thread. `pose_ms` and `reverberation_ms` run
    from the arrival of a pose until the first block could be sent whose direct sound, or reflected field, is of that
    pose. `level` is the present quality level, and `ir_rate_hz` the most impulse responses an emitter gets per second.
    `blocks_limited` counts blocks that would have been too loud and were turned down.
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
    listener: Annotated[str | None, Field(exclude_if=lambda listener: listener is None)] = None


class Pong(Message):
    """The answer to the ping with this id."""

    type: Literal["pong"] = "pong"
    id: int


class Error(Message):
    """Says what was wrong with a message. The stream goes on, unless the message was the hello. `emitter` is the id of
    the emitter that the message was about, if it was about one and its id could be read; `listener` that of a listener
    beside the first.

    What a server refuses because it has too much to do (`server_busy`) may be asked for again after `retry_after_s`
    seconds. `level` is the quality level at which a stream that insists on another would fit now, if there is one.
    """

    type: Literal["error"] = "error"
    code: str
    message: str
    field: str | None = None
    retry_after_s: Annotated[int | None, Field(exclude_if=lambda seconds: seconds is None)] = None
    level: Annotated[str | None, Field(exclude_if=lambda level: level is None)] = None
    emitter: Annotated[str | None, Field(exclude_if=lambda emitter: emitter is None)] = None
    listener: Annotated[str | None, Field(exclude_if=lambda listener: listener is None)] = None

    @classmethod
    def from_refusal(cls, refusal: RequestError, emitter: str | None = None, listener: str | None = None) -> Self:
        return cls(
            code=refusal.code,
            message=str(refusal),
            field=refusal.field,
            retry_after_s=refusal.retry_after_s,
            level=refusal.level,
            emitter=emitter,
            listener=listener,
        )


ServerMessage = (
    Welcome
    | SnapshotTaken
    | EmitterAdded
    | EmitterEnded
    | EmitterRemoved
    | ListenerAdded
    | ListenerRemoved
    | LevelChanged
    | PlanChanged
    | Status
    | Pong
    | Error
)
_SERVER: TypeAdapter[ServerMessage] = TypeAdapter(Annotated[ServerMessage, Field(discriminator="type")])


class UnknownMessage(Message):
    """A message type of a newer server, which a client of this version ignores."""

    type: str


def parse_server_message(data: str) -> ServerMessage | UnknownMessage:
    """Read a text message as a client does: unknown fields are ignored. Raises pydantic.ValidationError for an invalid
    message."""
    try:
        return _SERVER.validate_json(data, extra="ignore")
    except ValidationError as exc:
        if exc.errors()[0]["type"] != "union_tag_invalid":
            raise
        return UnknownMessage.model_validate_json(data, extra="ignore")
