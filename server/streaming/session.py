"""One listener of a stream as a state machine without input, output or waiting. Further listeners of the stream have
sessions of their own (`server.streaming.audience`).

Messages go in; messages and audio blocks come out. The direct paths of each block follow the newest poses. Reflections
and reverberation follow later: `take_request` returns the impulse responses (IRs) to compute, and the answer comes back
through `accept` between two blocks. Rendering never waits for it.

Blocks are rendered in three steps, so that one call can render those of many sessions: `begin_block`, rendering
`renderer`, `finish_blocks`.

A `Session` belongs to the thread that renders it. Positions are in metres, clocks in samples.
"""

import math
import weakref
from collections.abc import Callable, Mapping, Sequence

from server.acoustics.decibels import db_to_amplitude
from server.acoustics.directivity import OMNIDIRECTIONAL
from server.acoustics.geometry import Pose
from server.core.errors import RequestError
from server.field.fields_by_level import FieldsByLevel
from server.planning.cost import Costs
from server.planning.plan import Plan
from server.planning.planned_effects import PlannedEffects, PlanRequest
from server.planning.scene_acoustics import SceneAcoustics
from server.protocol.blocks import AudioBlock, DryBlock
from server.protocol.client_messages import (
    Acknowledge,
    AddEmitter,
    ClientMessage,
    Hello,
    ListenerPose,
    ListenerStart,
    MoveEmitter,
    RemoveEmitter,
    SetDoor,
    SetEffects,
    SetGain,
    StopEmitter,
    emitter_of,
    require_protocol,
)
from server.protocol.server_messages import (
    EmitterEnded,
    EmitterRemoved,
    Error,
    LevelReason,
    LiveStatus,
    PlanChanged,
    ServerMessage,
)
from server.protocol.snapshot import KeptEmitter, Snapshot
from server.rendering.hrtf import HeadFilters
from server.rendering.ingest import DryAudio
from server.rendering.output import Rendered
from server.rendering.renderer import DuplicateEmitterError, RendererFullError, render_all
from server.rendering.sources import ClipPlayer, FloatArray, Source
from server.responses.direct_sound import DirectSound
from server.responses.ir_request import IrRequest, IrResponse
from server.responses.radiation import reverberation_gain
from server.scene.bundle import Bundle
from server.scene.door import read_openness
from server.scene.effects import read_overrides, require_effect
from server.streaming.active_effects import ActiveEffects
from server.streaming.direct_path_tracker import DirectPathTracker
from server.streaming.doors import DoorRequest, DoorsMoved, FollowedDoors
from server.streaming.emitters import LiveInput, Stage, StreamedEmitter
from server.streaming.pacing import SendWindow
from server.streaming.plan_audit import PlanAudit, Regret
from server.streaming.quality_steps import QualityStep
from server.streaming.response_scheduler import ResponseScheduler, Scope

STOP_FADE_S = 0.01
"""The fade of a clip at its `stop_at`."""
_MOST_DOOR_INTERVAL_S = 0.1


def _start_pose(bundle: Bundle) -> Pose:
    start = bundle.manifest.start
    return Pose.from_yaw(start.listener, math.radians(start.listener_yaw_deg))


class Session:
    """The state of one listener of a stream: poses, emitters, a renderer and the window of unacknowledged blocks.

    `levels` are the scene's, at any rate, and `quality` is the first one to render. The stream has the sample rate that
    the hello asks for, or the scene's own. `filters` are those of the listener's head at the stream's rate, and
    `field_filters` at the scene's, if that is another. `load_clip` returns audio at the stream's rate; it has to be
    fast, since it is called on the rendering thread. Raises RequestError for a hello that cannot be served, such as
    unsupported_sample_rate or no_directions, and ValueError for filters of another rate. `index` is the listener's
    number in its stream, and `listener` its pose if it is not that of the hello.
    """

    def __init__(
        self,
        hello: Hello,
        levels: FieldsByLevel,
        filters: HeadFilters,
        load_clip: Callable[[str], DryAudio],
        *,
        quality: QualityStep,
        max_emitters: int = 16,
        shared_tail: bool = False,
        window: int = 40,
        place: SceneAcoustics | None = None,
        costs: Callable[[int | None], Costs] = lambda _: {},
        field_filters: HeadFilters | None = None,
        listener: Pose | None = None,
        index: int = 0,
    ) -> None:
        require_protocol(hello)
        levels = levels.at_rate(hello.sample_rate)
        field = levels.default
        if filters.sample_rate != field.sample_rate:
            raise ValueError(
                f"the head is filtered for {filters.sample_rate} Hz, the stream for {field.sample_rate} Hz"
            )
        self.window = SendWindow(window)
        self.chosen_level = hello.level
        """The level that the client chose last."""
        self.ir_exchanges = 0
        self.blocks_dropped = 0
        self.blocks_limited = 0
        self.index = index
        self._hello = hello
        self._bundle = levels.bundle
        self._sample_rate = field.sample_rate
        self._load_clip = load_clip
        order = hello.ambisonic_order
        if order is not None:
            levels = levels.with_directions()
        self._output = hello.output
        self._direct_sound = DirectSound.of(self._bundle, filters, order=order, field_filters=field_filters)
        if listener is None:
            self._listener = _start_pose(self._bundle) if hello.listener is None else hello.listener.pose
            self._bundle.require_inside(self._listener.position, "listener.position")
        else:
            self._listener = listener
            self._bundle.require_inside(listener.position, "position")
        planned = None
        if place is not None:
            scene, own = self._bundle.manifest.effects, read_overrides(hello.effects)
            planned = PlannedEffects(place, self._listener, output=hello.output, scene=scene, own=own, costs=costs)
        self.renderer = self._direct_sound.renderer(
            block_size=hello.block_size,
            ir_samples=max(level.ir_samples for level in levels.values()),
            sample_rate=field.sample_rate,
            max_emitters=max_emitters,
            shared_tail=shared_tail,
            switches_tail=planned is not None or any(field.kind.shares_tail for field in levels.values()),
            outputs=1 if hello.output == "mono" else 2,
            has_head=planned is None or planned.shared.head,
            buses=levels.buses,
        )
        self._effects = ActiveEffects(
            self.renderer,
            planned,
            sample_rate=field.sample_rate,
            has_early=self._direct_sound.early_reflections is not None,
            has_late=bool(self._bundle.manifest.fields),
        )
        self._emitters: dict[str, StreamedEmitter] = {}
        self._aim = DirectPathTracker(self._direct_sound, self.renderer, self._emitters)
        self._responses = ResponseScheduler(
            self.renderer,
            self._effects,
            self._emitters,
            levels=levels,
            direct_sound=self._direct_sound,
            quality=quality,
        )
        self._doors: FollowedDoors | None = None
        self._door_interval_s, self._next_door_clock = 0.0, 0
        if self._bundle.moving is not None:
            self._doors = FollowedDoors(self._bundle.moving, levels, self._direct_sound, hello.doors)
        else:
            read_openness((), hello.doors)
        self._next_serial = 0
        self._followed_pose_id = 0  # the pose of the direct paths
        self._checked = 0

    @property
    def sample_clock(self) -> int:
        """The number of samples rendered so far, which is the clock of the next block's first frame."""
        return self.renderer.sample_clock

    @property
    def emitter_count(self) -> int:
        """The number of emitters. Any thread may read it."""
        return len(self._emitters)

    @property
    def emitters(self) -> Mapping[str, StreamedEmitter]:
        """The emitters by id, which nobody else changes."""
        return self._emitters

    @property
    def listener(self) -> Pose:
        """The newest pose of the listener."""
        return self._listener

    @property
    def newest_pose_id(self) -> int:
        """The id of the newest pose, of the listener or of emitters."""
        return self._responses.newest_pose_id

    @property
    def quality(self) -> QualityStep:
        """The quality that is playing."""
        return self._responses.heard

    @property
    def awaits_irs(self) -> bool:
        """Whether a request is unanswered, or it is too soon for the next. Any thread may call this."""
        return self._responses.are_awaited

    def set_quality(self, quality: QualityStep, reason: LevelReason) -> list[ServerMessage]:
        """Change to another quality step: from now on, or for another level when its IRs have arrived."""
        return self._responses.set_quality(quality, reason)

    def set_ir_interval(self, interval_s: float) -> None:
        """Set the least time between requests for IRs; an emitter that waits for its first IR is not affected. Doors
        are followed as often, and never more seldom than ten times a second."""
        self._responses.space(interval_s)
        self._door_interval_s = min(interval_s, _MOST_DOOR_INTERVAL_S)

    def space_plans(self, interval_s: float) -> None:
        """Set the least time between plans of effects; changes that need a plan at once are not affected."""
        if self._effects.planned is not None:
            self._effects.planned.space(interval_s)

    def receive(self, message: ClientMessage) -> list[ServerMessage]:
        """Process one message; if it is invalid, return an `Error` and change nothing."""
        try:
            match message:
                case ListenerPose():
                    self._move_listener(message)
                case MoveEmitter():
                    self._move_emitter(message)
                case AddEmitter():
                    self._add_emitter(message)
                case SetGain():
                    self._set_gain(message)
                case StopEmitter():
                    self._stop_emitter(message)
                case DryBlock():
                    self._push(message)
                case SetEffects():
                    self._wish(message)
                case SetDoor():
                    self._set_door(message)
                case RemoveEmitter():
                    return self._remove_emitter(message)
                case Acknowledge():
                    self.window.acknowledge(message.sequence)
                case _:
                    raise RequestError(f"unexpected_{message.type}", f"{message.type} has no place in a running stream")
        except RequestError as refusal:
            return [Error.from_refusal(refusal, emitter_of(message))]
        return []

    @property
    def wants_irs(self) -> bool:
        """Whether the last `take_request` found IRs to request, and it is time to request them."""
        return self._responses.are_wanted

    def take_request(self, scope: Scope = Scope.ALL) -> IrRequest | None:
        """Return the IRs to compute now; None while a request is unanswered, if every IR is up to date, or if none is
        in `scope`. There are none before doors are as the stream began."""
        if self._doors is not None and not self._doors.is_heard:
            return None
        return self._responses.take_request(self._listener, scope)

    def accept(self, response: IrResponse) -> list[ServerMessage]:
        """Put the answer to the last request into effect, from the next block on."""
        return self._responses.accept(response)

    def give_up(self, request: IrRequest) -> list[ServerMessage]:
        """Note that a request failed: playing IRs stay in use until a pose or an emitter changes."""
        return self._responses.give_up(request)

    def take_plan_request(self) -> PlanRequest | None:
        """Return the plan of effects to make now; None while a request is unanswered or if nothing has changed."""
        planned = self._effects.planned
        if planned is None:
            return None
        states = {name: emitter.state for name, emitter in self._emitters.items()}
        return planned.take_request(self._listener, states, self._effects.clock_s)

    def adopt(self, plan: Plan) -> list[ServerMessage]:
        """Put the plan requested last into effect, from the next block on."""
        planned = self._effects.planned
        assert planned is not None
        is_other = planned.accept(plan)
        events = self._responses.enforce_plan()
        return [*events, PlanChanged.of(plan, self.sample_clock)] if is_other else events

    @property
    def levels(self) -> FieldsByLevel:
        """The levels by which responses are computed now."""
        return self._responses.levels

    @property
    def doors(self) -> dict[str, float] | None:
        """How far each door is open; None if there are none."""
        return None if self._doors is None else self._doors.by_name

    def take_door_requests(self) -> list[DoorRequest]:
        """Return the states of doors to prepare now."""
        if self._doors is None or self.sample_clock < self._next_door_clock:
            return []
        requests = self._doors.take_requests()
        if requests:
            rate_hz = self._responses.levels.default.sample_rate
            self._next_door_clock = self.sample_clock + round(self._door_interval_s * rate_hz)
        return requests

    def adopt_doors(self, moved: DoorsMoved) -> None:
        """Hear with doors as they were prepared, from the next block on: straight and bent sound at once, mirrored
        sound when its responses have arrived."""
        assert self._doors is not None
        if not self._doors.accept(moved):
            return
        self._direct_sound = moved.direct_sound
        self._aim.hear_by(moved.direct_sound)
        for identifier, emitter in self._emitters.items():
            self._effects.unbake(identifier, emitter)
        self._responses.hear_by(moved.direct_sound, moved.levels)
        if self._effects.planned is not None:
            self._effects.planned.move_to(moved.surroundings)

    def leave_doors(self, request: DoorRequest) -> list[ServerMessage]:
        """Note that a state of doors could not be prepared: they stay as they are heard."""
        assert self._doors is not None
        self._doors.give_up(request)
        return [Error(code="door_failure", message="doors could not be moved, and stay as they were")]

    def take_check(self) -> PlanAudit | None:
        """Return a check of the active plan, for each emitter in turn; None if everything is on."""
        planned = self._effects.planned
        if planned is None or planned.plan is None:
            return None
        named = [name for name, emitter in self._emitters.items() if emitter.is_decided]
        if not named:
            return None
        self._checked += 1
        emitter = self._emitters[named[self._checked % len(named)]]
        whole, head = self._effects.whole()
        # A bus is heard by two ears: how it differs from responses of ears is the quality level's affair.
        is_by_bus = self.renderer.order is None and self.renderer.channels > 2
        channels = 2 if is_by_bus else self.renderer.channels
        check = PlanAudit(
            self.quality.level,
            self._listener,
            emitter.state,
            whole,
            channels,
            2 if head else channels,
            self._direct_sound,
        )
        return check if check.finds_anything else None

    def learn(self, regret: Regret) -> None:
        """Correct the plan by the result of a check."""
        if regret.corrections and self._effects.planned is not None:
            self._effects.planned.correct(regret.corrections)

    def keep_effects(self) -> list[ServerMessage]:
        """Note that the request for a plan failed: effects stay as they are, and new emitters have all of them on."""
        planned = self._effects.planned
        assert planned is not None
        planned.give_up()
        for emitter in self._emitters.values():
            emitter.decide()
        self._responses.retry()
        return [Error(code="plan_failure", message="no plan of effects could be made")]

    def begin_block(self) -> None:
        """Set the direct paths of the next block from the newest poses."""
        self._aim.follow(self._listener)
        self.renderer.set_orientation(self._listener.orientation)
        self._followed_pose_id = self._responses.newest_pose_id

    def finish_blocks(self, sample_clock: int, rendered: Sequence[Rendered]) -> list[AudioBlock]:
        """Return the blocks just rendered together, the first of which began at `sample_clock`; only the first of them
        if the window is full.

        A block that is not sent was rendered all the same: clips and reverberation stay in step with the clock.
        """
        self._responses.follow_renderer()
        sequences = self.window.take_sequences(len(rendered))
        self.blocks_dropped += len(rendered) - len(sequences)
        pose_ids = self._followed_pose_id, self._responses.applied_pose_id
        size = self.renderer.block_size
        clocks = range(sample_clock, sample_clock + len(rendered) * size, size)
        blocks = []
        for number, (samples, is_exchange, is_limited) in enumerate(rendered):
            self.ir_exchanges += is_exchange
            self.blocks_limited += is_limited
            if number < len(sequences):
                place = sequences[number], clocks[number]
                # guard: a block says that it was turned down
                flags = {"is_exchange": is_exchange, "is_limited": is_limited}
                blocks.append(AudioBlock(*place, *pose_ids, samples, **flags, listener=self.index))
        return blocks

    def render_block(self) -> AudioBlock | None:
        """Run all three steps for this session alone."""
        self.begin_block()
        sample_clock = self.sample_clock
        return next(iter(self.finish_blocks(sample_clock, render_all([self.renderer]))), None)

    def follow_clock(self) -> list[ServerMessage]:
        """Note what has come to its end by the next block; remove the emitters that were to be removed then."""
        events: list[ServerMessage] = []
        self.follow_ramps()
        for identifier in tuple(self._emitters):
            if self.has_ended(identifier):
                events += self.end_emitter(identifier)
        return events

    def follow_ramps(self) -> None:
        """Note the gains of ramps that have come to their ends."""
        for emitter in self._emitters.values():
            emitter.follow_ramp(self.sample_clock)

    def has_ended(self, identifier: str) -> bool:
        """Whether an emitter's clip has been heard to its end, of which the client is not informed yet."""
        return self._emitters[identifier].ends and self.renderer.has_ended(identifier)

    def end_emitter(self, identifier: str) -> list[ServerMessage]:
        """Note that an emitter's clip is over, and remove the emitter if it was to be removed then."""
        emitter = self._emitters[identifier]
        emitter.ends = False
        is_removed = emitter.remove_when_ended
        ended = EmitterEnded(id=identifier, sample_clock=self.sample_clock, removed=is_removed)
        return [ended, *(self.forget_emitter(identifier) if is_removed else [])]

    def live_statuses(self) -> tuple[LiveStatus, ...]:
        return tuple(emitter.live.status for emitter in self._emitters.values() if emitter.live)

    def complaints(self) -> list[ServerMessage]:
        """Return errors about live samples since the last call."""
        refusals = {name: emitter.live.complaint() for name, emitter in self._emitters.items() if emitter.live}
        return [Error.from_refusal(refusal, name) for name, refusal in refusals.items() if refusal]

    def snapshot(self, *, session: str, handled: int) -> Snapshot:
        """Return the state before the next block. Not validated, since this runs on the audio thread."""
        planned = self._effects.planned
        now = {
            "listener": ListenerStart.model_construct(
                position=self._listener.position, orientation=self._listener.orientation, yaw=None
            ),
            "level": self.chosen_level,
            "output": self._output,
            "emitters": len(self._emitters),
        }
        if self._doors is not None:
            now["doors"] = self._doors.by_name
        if planned is not None:
            now["effects"] = {name.value: is_on for name, is_on in planned.wishes.items()}
        given = {name: getattr(self._hello, name) for name in Hello.model_fields}
        return Snapshot.model_construct(
            session=session,
            hello=Hello.model_construct(**{**given, **now}),
            sample_clock=self.sample_clock,
            sequence=self.window.next_sequence,
            pose_id=self._responses.newest_pose_id,
            handled=handled,
            emitters=tuple(emitter.kept() for emitter in self._emitters.values()),
        )

    def restore(self, snapshot: Snapshot) -> list[ServerMessage]:
        """Continue a stream as `snapshot` has it, in a new session for its hello. Return an `Error` for each emitter
        that cannot be had here."""
        self._responses.continue_from(snapshot.pose_id)
        self._followed_pose_id = snapshot.pose_id
        self.continue_at(snapshot.sample_clock, snapshot.sequence)
        errors: list[ServerMessage] = []
        for kept in snapshot.emitters:
            try:
                self._restore_emitter(kept)
            except RequestError as refusal:
                errors.append(Error.from_refusal(refusal, kept.emitter.id))
        return errors

    def join(self, other: "Session", quality: QualityStep, sequence: int) -> None:
        """Begin where the session of another listener of the stream is: at its clock and quality, with what the client
        wishes by now, and with its emitters, which fade in where they are. The first block has this `sequence`."""
        self._responses.continue_from(other.newest_pose_id)
        self._followed_pose_id = other.newest_pose_id
        self.continue_at(other.sample_clock, sequence)
        self._output = other._output
        if self._effects.planned is not None and other._effects.planned is not None:
            self._effects.planned.wish_as(other._effects.planned)
        if self._doors is not None and other._doors is not None:
            self._doors.follow(other._doors)
        for emitter in other.emitters.values():
            self._restore_emitter(emitter.kept(), emitter)
        self.set_quality(quality, "chosen")

    def share_emitter(self, identifier: str, other: "Session") -> None:
        """Add an emitter that the session of another listener of the stream has just added. Raises RequestError
        too_many_emitters if earlier ones ring out in every slot."""
        emitter = other.emitters[identifier]
        assert emitter.added is not None
        self._add_emitter(emitter.added, like=emitter)

    def _restore_emitter(self, kept: KeptEmitter, like: StreamedEmitter | None = None) -> None:
        self._add_emitter(kept.emitter, since=kept.since, like=like)
        identifier = kept.emitter.id
        emitter = self._emitters[identifier]
        if emitter.live is not None:
            emitter.live.newest_sequence = kept.newest_block
        elif kept.stop is not None and kept.stop.stop_at is not None:
            emitter.stop = kept.stop
            self.renderer.stop_emitter(identifier, kept.stop.stop_at, fade=self._fade_samples(kept.stop))
        emitter.ends = kept.ends

    def continue_at(self, sample_clock: int, sequence: int) -> None:
        """Set the clock and the number of the first block, before it is rendered. What began at an earlier clock is
        then where it would be."""
        self.renderer.skip_to(sample_clock)
        self.window = SendWindow(self.window.size, sequence)

    def _follow(self, identifier: str, emitter: StreamedEmitter) -> None:
        if self._effects.planned is not None:
            self._effects.planned.follow_emitter(identifier, emitter.state.pose, self._effects.clock_s)

    def _wish(self, message: SetEffects) -> None:
        output = message.output or self._output
        if output != self._output and "ambisonics" in (output, self._output):
            problem = f"output: a stream for {self._output} cannot become one for {output}; open another stream"
            raise RequestError("fixed_output", problem, field="output", status=409)
        if self._effects.planned is not None:
            wishes = {require_effect(name): is_on for name, is_on in message.effects.items()}
            self._effects.planned.wish(wishes, message.output)
        self._output = output

    def _set_door(self, message: SetDoor) -> None:
        if self._doors is None:
            read_openness((), {message.door: message.openness})
        else:
            self._doors.set(message.door, message.openness)

    def _move_listener(self, message: ListenerPose) -> None:
        pose = message.pose
        # guard: a listener stays inside
        self._bundle.require_inside(pose.position, "position")
        self._responses.advance(message.pose_id)
        moves, turns = pose.position != self._listener.position, pose.orientation != self._listener.orientation
        has_head, turns_ask = self._effects.shared.head, self._effects.turns_ask
        for identifier, emitter in self._emitters.items():
            emitter.is_outdated |= moves or (turns and turns_ask)
            if moves or (turns and has_head):
                self._effects.unbake(identifier, emitter)
        self._listener = pose
        if self._effects.planned is not None:
            self._effects.planned.follow_listener(pose, self._effects.clock_s)

    def _move_emitter(self, message: MoveEmitter) -> None:
        emitter = self._require_emitter(message.id)
        self._bundle.require_inside(message.position, "position")
        self._responses.advance(message.pose_id)
        before = emitter.state.pose.orientation
        emitter.move(message)
        # A field's response does not depend on an emitter's orientation, but the gain of a mirrored path does.
        is_mirrored = self._direct_sound.early_reflections is not None and emitter.state.directivity != OMNIDIRECTIONAL
        emitter.is_outdated |= is_mirrored and emitter.state.pose.orientation != before
        self._effects.unbake(message.id, emitter)
        self._follow(message.id, emitter)

    def _add_emitter(
        self, message: AddEmitter, *, since: int | None = None, like: StreamedEmitter | None = None
    ) -> None:
        """Add an emitter, with the sound of one that it is `like`."""
        self._bundle.require_inside(message.position, "position")
        if self._bundle.manifest.direct_sound == "field" and message.directivity is not None:
            problem = f"scene {self._bundle.id} holds the direct sound, with how its emitters beamed; leave it out"
            raise RequestError("fixed_directivity", problem, field="directivity")
        live, clip = self._open_sound(message) if like is None else (like.live, like.clip)
        source = self._open_clip(message, clip) if clip is not None else self._tap(live)
        try:
            self.renderer.add_emitter(message.id, source, gain=float(db_to_amplitude(message.gain_db)), since=since)
        except DuplicateEmitterError as exc:
            raise RequestError("duplicate_emitter", f"emitter {message.id!r} is already there", field="id") from exc
        except RendererFullError as exc:
            raise RequestError("too_many_emitters", str(exc)) from exc
        stage = Stage.DECIDED if self._effects.planned is None else Stage.UNDECIDED
        emitter = StreamedEmitter.added_by(message, self._next_serial, live, stage, since=since, clip=clip)
        if emitter.state.directivity != OMNIDIRECTIONAL:
            self.renderer.set_reverberation_gain(message.id, reverberation_gain(emitter.state.directivity))
        self._emitters[message.id] = emitter
        self._follow(message.id, emitter)
        self._next_serial += 1
        self._responses.retry()

    def _open_sound(self, message: AddEmitter) -> tuple[LiveInput | None, DryAudio | FloatArray | None]:
        if message.clip is not None:
            return None, self._load_clip(message.clip)
        live = LiveInput.opened(
            message.id,
            sample_rate=self._sample_rate,
            block_size=self.renderer.block_size,
            jitter_ms=message.jitter_ms,
        )
        return live, None

    def _tap(self, live: LiveInput | None) -> Source:
        assert live is not None, "an emitter plays a clip or is live"
        # A renderer holds its sources. One that held it in turn would be a cycle, which only the collector frees.
        renderer = weakref.proxy(self.renderer)
        return live.shared.tap(lambda: renderer.sample_clock)

    def _open_clip(self, message: AddEmitter, clip: DryAudio | FloatArray) -> ClipPlayer:
        """Raises RequestError outside_clip."""

        def samples(seconds: float) -> int:
            return round(seconds * self._sample_rate)

        end = clip.size if message.loop_end_s is None else samples(message.loop_end_s)
        places = (
            ("loop_end_s", end <= clip.size),
            ("loop_start_s", samples(message.loop_start_s) < end),
            ("offset_s", samples(message.offset_s) < end),
        )
        for field, is_inside in places:
            if not is_inside:
                lasts = f"clip {message.clip!r} lasts {clip.size / self._sample_rate:g} s"
                problem = f"{field}: {getattr(message, field):g} s is no place in what is played: {lasts}"
                if field != "loop_end_s" and message.loop_end_s is not None:
                    problem += f", and the loop ends at {message.loop_end_s:g} s"
                raise RequestError("outside_clip", problem, field=field)
        player = ClipPlayer(
            clip,
            loop=message.loop,
            offset=samples(message.offset_s),
            loop_start=samples(message.loop_start_s),
            loop_end=end,
            starts_at=message.start_at or 0,
        )
        if message.stop_at is not None:
            player.stop(message.stop_at, samples(STOP_FADE_S))
        return player

    def _set_gain(self, message: SetGain) -> None:
        emitter, ramp = self._require_emitter(message.id), round(message.ramp_s * self._sample_rate)
        self.renderer.set_gain(message.id, float(db_to_amplitude(message.gain_db)), ramp=ramp)
        emitter.set_gain(message.gain_db, ramp_ends=self.sample_clock + ramp if ramp else None)

    def _stop_emitter(self, message: StopEmitter) -> None:
        emitter = self._require_emitter(message.id)
        if emitter.live is not None:
            raise RequestError("is_live", f"emitter {message.id!r} is live: remove it", field="id")
        clock = self.sample_clock if message.stop_at is None else message.stop_at
        self.renderer.stop_emitter(message.id, clock, fade=self._fade_samples(message))
        emitter.note_stop(message, self.sample_clock)
        emitter.ends |= not self.renderer.has_ended(message.id)

    def _fade_samples(self, message: StopEmitter) -> int:
        return max(1, round(message.fade_s * self._sample_rate))

    def _push(self, block: DryBlock) -> None:
        live = self._require_emitter(block.id).live
        if live is None:
            raise RequestError("not_live", f"emitter {block.id!r} plays a clip", field="id")
        live.push(block)

    def _remove_emitter(self, message: RemoveEmitter) -> list[ServerMessage]:
        self._require_emitter(message.id)
        return [EmitterRemoved(id=message.id), *self.forget_emitter(message.id)]

    def forget_emitter(self, identifier: str) -> list[ServerMessage]:
        """Remove an emitter without a word to the client."""
        del self._emitters[identifier]
        if self._effects.planned is not None:
            self._effects.planned.forget_emitter(identifier)
        self.renderer.remove_emitter(identifier)
        self._responses.retry()
        return self._responses.change_quality_unheard()

    def _require_emitter(self, identifier: str) -> StreamedEmitter:
        if identifier not in self._emitters:
            raise RequestError("unknown_emitter", f"there is no emitter {identifier!r}", field="id", status=404)
        return self._emitters[identifier]
