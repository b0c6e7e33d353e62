"""The listeners of a stream in time: when their blocks are due, what waits in their inbox, and how long their work
takes.

A stream whose window stays full is *paused*: nothing is rendered, and its sample clock stands still. Both continue from
there with the first acknowledgement that makes room.

A `Stream` and its session belong to the audio thread that renders them; only `offer` may be called from any thread.
"""

import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from server.core.errors import RequestError
from server.field.fields_by_level import FieldsByLevel
from server.planning.plan import Plan
from server.planning.planned_effects import PlanRequest
from server.protocol.blocks import AudioBlock, Packets
from server.protocol.client_messages import AddEmitter, ListenerPose, MoveEmitter, SetDoor, SetLevel
from server.protocol.server_messages import Durations, Error, LevelReason, ServerMessage, Status
from server.protocol.snapshot import Snapshot
from server.rendering.output import Rendered
from server.responses.ir_request import IrRequest, compute_irs
from server.runtime.workers import Workers
from server.streaming.audience import COST_SMOOTHING, Audience, Member, NewListener
from server.streaming.doors import DoorRequest, DoorsMoved
from server.streaming.inbox import ChosenSteps, ComputedResponse, Inbox, StreamMessage, TakeSnapshot
from server.streaming.load_policy import Ladder, LoadSample
from server.streaming.pacing import StreamClock
from server.streaming.pending_work import PendingWork
from server.streaming.plan_audit import FIRST_S, PERIOD_S, Regret, RegretRecord, interval_s
from server.streaming.quality_steps import Offer, QualityStep
from server.streaming.request_queue import RequestQueue
from server.streaming.response_scheduler import Scope
from server.streaming.session import Session
from server.streaming.stream_times import StreamTimes

PAUSE_AFTER_S = 1.0
"""How long a window may be full before rendering stops. If the network stalls for less, only the blocks without room in
the window are lost."""
_MAX_BEHIND_S = 0.5
_LOAD_SMOOTHING = 0.02
_MEASURED_AFTER_S = 2.0
"""Seconds of sound until a stream has its emitters, and the smoothed load has followed."""
_logger = logging.getLogger(__name__)


@dataclass(slots=True)
class TimedBlock:
    """A block to be sent; after `deadline_s` of the audio engine's clock it is late. In Opus `packets` take the place
    of its samples once they are encoded."""

    block: AudioBlock
    deadline_s: float
    packets: Packets | None = None


@dataclass(frozen=True)
class StreamFailed:
    """A message that rendering failed: no more output comes from this stream."""


@dataclass(frozen=True)
class StreamState:
    """The state of a stream whose next block plays at `plays_s` of the audio engine's clock. It is not sent as it
    is."""

    snapshot: Snapshot
    plays_s: float


Outgoing = ServerMessage | TimedBlock | StreamFailed | StreamState


@dataclass
class CpuCosts:
    """Smoothed CPU times, in seconds, of work for a stream."""

    plan_s: float = 0.0
    """CPU time of a plan of effects."""


@dataclass
class Rendering:
    """Seconds that it took to render blocks of so many seconds."""

    cost_s: float = 0.0
    duration_s: float = 0.0


@dataclass
class Requested:
    """CPU seconds that requests for impulse responses took, and seconds until workers were done with them."""

    cpu_s: float = 0.0
    duration_s: float = 0.0


@dataclass
class ShownCost:
    """What a stream has shown that it takes, as shares of a core: the highest of the last half minute or so. Readers on
    other threads may find one value newer than another."""

    rendering: float = 0.0
    """Share of an audio thread that its blocks would take at one block at once."""
    responses: float = 0.0
    """Share of a core that its impulse responses take."""
    is_live: bool = False
    """Whether it plays live samples, so that it is rendered block by block."""

    def note(self, *, rendering: float, responses: float, memory: float) -> None:
        """Note the costs of a period, after which the share `memory` of higher ones before is left."""
        self.rendering = max(rendering, rendering + memory * (self.rendering - rendering))
        self.responses = max(responses, responses + memory * (self.responses - responses))


@dataclass
class Pause:
    """Whether a stream is paused, and since when its window has been full."""

    full_since_s: float | None = None
    is_paused: bool = False


class Stream:
    """The listeners of a stream with their clock, inbox and load: `session` is that of the first one. `ladder` is their
    position among the levels on `offer`. `deliver` is called on the event loop with the stream's output, in order."""

    def __init__(
        self,
        session: Session,
        levels: FieldsByLevel,
        *,
        offer: Offer,
        ladder: Ladder,
        block_s: float,
        lead: int,
        deliver: Callable[[list[Outgoing]], None],
    ) -> None:
        self.session = session
        self.ladder = ladder
        self.block_s = block_s
        self.deliver = deliver
        self.blocks_late = 0
        """Late blocks, counted by the sender, since only it knows when they left."""
        self.times = StreamTimes()
        """Of the blocks of all listeners, and of the poses and responses of the first."""
        self.audience = Audience(session, self.times)
        self.regrets = RegretRecord()
        self.load = 0.0
        """Smoothed share of a core that its blocks take."""
        self.encoding_load = 0.0
        """Share of a core that encoding its blocks takes, on a thread of its own; the sender writes it."""
        self.expected_load = 0.0
        """Share of a core that its blocks are expected to take until they have shown what they take."""
        self.next_block = 0
        self.due_s = math.inf
        """When the next block should be rendered; infinite before the start and in a pause."""
        self._costs = CpuCosts()
        self.shown = ShownCost()
        self._rendered = Rendering()
        """Blocks of this period."""
        self._requested = Requested()
        """Requests that were answered in this period."""
        self._inbox = Inbox()
        self._checking = PendingWork()
        self._pause = Pause()
        self._levels = levels
        self._offer = offer
        self._lead = lead
        self._clock: StreamClock | None = None
        self._wake: Callable[[], None] = lambda: None
        self._time_s: Callable[[], float] = time.monotonic
        self._turns = RequestQueue(1)
        self.company = 1
        """The number of streams on the audio thread, including this one."""
        self._began_s = -math.inf
        """When the first block since the start plays."""
        self._worst_lateness_s = 0.0
        self._worst_sent_s = 0.0
        """The longest time from a block's due time until it was sent, since the last measurement; the sender writes
        it."""
        self._ir_interval_s = 0.0
        self._next_check_s: float | None = FIRST_S
        """Seconds of sound at which the next check of a plan is due; None during a check."""
        self._next_status_s = 1.0
        self._checks = 0

    @property
    def levels(self) -> FieldsByLevel:
        """The levels of its scene, at its sample rate."""
        return self._levels

    @property
    def scene(self) -> str:
        return self._levels.bundle.id

    @property
    def sample_rate(self) -> int:
        """The sample rate of its blocks and of live samples, in Hz."""
        return self._levels.default.sample_rate

    @property
    def awaits_irs_since_s(self) -> float | None:
        """Since when the stream waits for impulse responses; None if it does not."""
        return min((since for each in self.audience.members if (since := each.wait.since_s) is not None), default=None)

    @property
    def stalled_s(self) -> float:
        """How long no block could be sent because too many are unacknowledged. Any thread may call this."""
        since_s = self._pause.full_since_s
        return 0.0 if since_s is None else self._time_s() - since_s

    @property
    def deadline_s(self) -> float:
        """The time after which the next block is late."""
        return self.clock.deadline_s(self.next_block)

    def attach(self, *, wake: Callable[[], None], time_s: Callable[[], float], turns: RequestQueue) -> None:
        """Attach the stream to an audio thread: `wake` makes it process the inbox, `time_s` is its clock, `turns` are
        those of its streams."""
        self._wake, self._time_s, self._turns = wake, time_s, turns

    def steps(self, level: str) -> tuple[QualityStep, ...]:
        """Return the quality steps of a level, or of auto. Raises RequestError unknown_level."""
        return self._offer.steps(level, block_s=self.block_s)

    def offer(self, message: StreamMessage) -> bool:
        """Queue a message for the audio thread; return False, and refuse it, if too many are waiting. TakeSnapshot is
        never refused, and answered by a StreamState.

        A message that calls for an impulse response, if one can be requested now, wakes the thread; all others wait for
        the next block.
        """
        if not self._inbox.put_message(message, self._time_s()):
            return False
        # While a request is unanswered there is no other, and the answer wakes the thread too.
        asks = isinstance(message, ListenerPose | MoveEmitter | AddEmitter) and self._asks_at_once
        if (
            asks or isinstance(message, SetDoor) or self._inbox.asks_for_state or self._pause.is_paused
        ):  # a paused stream has no blocks that would wake the thread
            self._wake()
        return True

    def start(self, origin_s: float) -> None:
        """Start the clock: the next block, which is number 0 unless another thread has rendered some, plays at
        `origin_s`."""
        self._began_s = origin_s
        first_s = origin_s - self.next_block * self.block_s
        self._clock = StreamClock(origin_s=first_s, block_s=self.block_s, lead=self._lead)
        self.due_s = self._clock.due_s(self.next_block)

    def change_thread(self, early_s: float, now_s: float) -> None:
        """Continue on another thread, which renders blocks `early_s` before the others of their clock: so deadlines
        stay as they are. A block that so would have been due in the past is due now."""
        self.clock.early_s = early_s
        if not self._pause.is_paused:
            self.due_s = max(self.clock.due_s(self.next_block), now_s)

    @property
    def is_measured(self) -> bool:
        """Whether the stream plays for so long that `load` is what it takes."""
        return self.next_block * self.block_s >= _MEASURED_AFTER_S

    @property
    def clock(self) -> StreamClock:
        assert self._clock is not None, "the stream has not started"
        return self._clock

    @property
    def has_news(self) -> bool:
        """Whether an item in the inbox cannot wait for the next block: an answer, or a message that asks for the state
        or lets an IR be requested."""
        is_urgent = self._pause.is_paused or self._inbox.asks_for_state or self._asks_at_once
        return self._inbox.has_answers or (self._inbox.has_messages and is_urgent)

    @property
    def _asks_at_once(self) -> bool:
        """Whether the stream may request IRs at once: turns are left, or a new emitter needs its first IR."""
        return not self.audience.awaits_irs and (self._inbox.brings_emitter or self._turns.are_left)

    @property
    def is_unanswered(self) -> bool:
        """Whether a request for impulse responses is unanswered."""
        return any(member.is_unanswered for member in self.audience.members)

    @property
    def wants_turn(self) -> bool:
        """Whether a listener waits for its turn to request impulse responses."""
        return any(member.wants_turn for member in self.audience.members)

    def drain_inbox(self, workers: Workers) -> list[Outgoing]:
        """Process the inbox and request impulse responses; if it is not the stream's turn, set `wants_turn`."""
        outgoing: list[Outgoing] = []
        inbox = self._inbox
        inbox.brings_emitter = inbox.asks_for_state = False
        while inbox.responses:
            outgoing += self._take_answer(*inbox.responses.popleft())
        while inbox.plans:
            outgoing += self._take_plan(*inbox.plans.popleft())
        while inbox.doors:
            outgoing += self._take_doors(*inbox.doors.popleft())
        for arrived_s, message in inbox.take_messages():
            if isinstance(message, TakeSnapshot):
                outgoing.append(self._state(message))
                continue
            if isinstance(message, SetLevel | ChosenSteps):
                refused = self._choose(message)
            elif isinstance(message, NewListener):
                refused = [self.audience.join(message, self.ladder.step)]
            else:
                refused = self.audience.receive(message)
            if isinstance(message, ListenerPose) and not refused:
                self.audience.member_of(message).times.arrive(message.pose_id, arrived_s)
            elif isinstance(message, MoveEmitter) and not refused:
                for member in self.audience.members:
                    member.times.arrive(message.pose_id, arrived_s)
            outgoing += refused
        while inbox.regrets:
            self._take_regret(*inbox.regrets.popleft())
        if self._pause.full_since_s is not None and not self.audience.has_no_room:
            self._resume()
        if not self._pause.is_paused:
            self._call_for_work(workers)
        return outgoing

    def _call_for_work(self, workers: Workers) -> None:
        self._check_plan(workers)
        # New emitters wait for a plan to become audible, so it is urgent; for others it only improves the effects.
        for member in self.audience.members:
            if (wanted := member.session.take_plan_request()) is not None:
                plan = workers.submit(_plan_timed, wanted, kind="plan", is_urgent=wanted.is_first)
                member.pending.keep_outcome(plan, partial(self._keep_plan, member))
            for door in member.session.take_door_requests():
                moved = workers.submit(door.prepare, kind="ways" if door.before is None else "response", is_urgent=True)
                member.pending.keep_outcome(moved, partial(self._keep_doors, member, door))
            self._ask(workers, member)

    def _ask(self, workers: Workers, member: Member) -> None:
        """Request the impulse responses for the newest poses if it is a listener's turn, or else the first ones of
        emitters."""
        session = member.session
        request = session.take_request(Scope.ALL if self._turns.may_ask(member) else Scope.FIRST)
        member.wants_turn = session.wants_irs
        if request is not None:
            member.has_asked, member.asked_last_s = True, self._time_s()
            self._turns.note(member)
            answer = workers.submit(
                _compute_timed, session.levels, request, session, kind="response", is_urgent=request.is_first
            )
            member.pending.keep_outcome(answer, partial(self._keep_answer, member, request))
        member.wait.note(member.has_asked or member.wants_turn, self._time_s())

    def leave(self) -> None:
        """Cancel all work requested by this stream."""
        self._checking.cancel()
        for member in self.audience.members:
            member.pending.cancel()

    @property
    def request_s(self) -> float:
        """The smoothed CPU time of a request for impulse responses of every listener; 0 before the first answer."""
        return sum(member.request_s for member in self.audience.members)

    def note_cost(self, *, period_s: float, saving: float, memory: float) -> Requested:
        """Note what the stream took in the last `period_s`, in which its blocks took the share `saving` of what they
        take one at a time; return what its requests took."""
        self.shown.is_live = not self.audience.runs_by_itself
        rendering = self.load / (1.0 if self.shown.is_live else saving)
        requested, self._requested = self._requested, Requested()
        self.shown.note(rendering=rendering, responses=requested.cpu_s / period_s, memory=memory)
        return requested

    def sample_load(self, now_s: float) -> LoadSample:
        """Return the load of this stream since the last call. Its wait for IRs does not count before `is_measured`: its
        first responses come when it is their turn, and to step down would only have all of them computed anew."""
        lateness_s = max(self._worst_lateness_s, self._worst_sent_s)
        self._worst_lateness_s = self._worst_sent_s = 0.0
        lateness = lateness_s / (self._lead * self.block_s)
        waits_s = [member.wait.take_longest_s(now_s) for member in self.audience.members]
        longest_s = max((wait_s for wait_s in waits_s if wait_s is not None), default=None)
        rendered, self._rendered = self._rendered, Rendering()
        return LoadSample(
            lateness,
            longest_s if self.is_measured else None,
            self.request_s,
            self._costs.plan_s,
            rendering=rendered.cost_s / rendered.duration_s if rendered.duration_s else self.load,
            is_in_effect=all(member.session.quality == self.ladder.step for member in self.audience.members),
            ir_interval_s=self._ir_interval_s,
        )

    def note_sent(self, deadline_s: float, now_s: float) -> bool:
        """Note that a block is sent now; return whether it is late. The sender calls this: a block that is ready in
        time is of no use while the sender has no time."""
        ahead_s = self._lead * self.block_s
        if deadline_s >= self._began_s + ahead_s:  # the first blocks were due before the stream started
            self._worst_sent_s = max(self._worst_sent_s, now_s - deadline_s + ahead_s)
        return now_s > deadline_s

    def follow_ladder(self, reason: LevelReason, now_s: float) -> list[Outgoing]:
        """Set the session to the present step of the ladder, which has been moved."""
        self._restart_waits(now_s)
        return [*self.audience.set_quality(self.ladder.step, reason)]

    def _restart_waits(self, now_s: float) -> None:
        """Forget how long earlier requests took, which do not show how a new step performs."""
        for member in self.audience.members:
            member.wait.restart(now_s)

    def set_intervals(self, ir_s: float, plan_s: float) -> None:
        """Set the least time between requests for IRs, and between plans of effects."""
        self._ir_interval_s = ir_s
        for member in self.audience.members:
            member.session.space_plans(plan_s)
            member.session.set_ir_interval(ir_s)

    def finish_blocks(
        self, sample_clock: int, rendered: Sequence[Rendered], *, cost_s: float, now_s: float
    ) -> list[Outgoing]:
        """Return the blocks just rendered together, equally many of each listener and one listener after the other.
        They took `cost_s` and are ready at `now_s`. Messages that are due come with them."""
        clock, members = self.clock, self.audience.members
        count = len(rendered) // len(members)
        made: list[list[AudioBlock]] = []
        for place, member in enumerate(members):
            blocks = member.session.finish_blocks(sample_clock, rendered[place * count : (place + 1) * count])
            made.append(blocks)
            if blocks:
                member.times.pose.take_effect(blocks[0].pose_id, now_s)
                member.times.reverberation.take_effect(blocks[0].reverberation_pose_id, now_s)
        outgoing: list[Outgoing] = [
            TimedBlock(blocks[number], clock.deadline_s(self.next_block + number))
            for number in range(count)
            for blocks in made
            if number < len(blocks)
        ]
        each_s = cost_s / count
        self._rendered.cost_s += cost_s
        self._rendered.duration_s += count * self.block_s
        self.load += (1 - (1 - _LOAD_SMOOTHING) ** count) * (each_s / self.block_s - self.load)
        self.times.render.add(each_s, count)
        if self.next_block >= self._lead:  # the first blocks were due before the stream started
            lateness_s = max(0.0, now_s - self.due_s)  # an early block has no lateness
            self._worst_lateness_s = max(self._worst_lateness_s, lateness_s)
            after_due = min(count, 1 + int(lateness_s / self.block_s))
            for ahead in range(after_due):
                self.times.lateness.add(lateness_s - ahead * self.block_s)
            self.times.lateness.add(0.0, count - after_due)
        if clock.ahead_s(self.next_block, now_s) < -_MAX_BEHIND_S:
            clock.slip(self.next_block, now_s)
        self.next_block += count
        self.due_s = clock.due_s(self.next_block)
        if all(len(blocks) < count for blocks in made):
            self._note_full(now_s)
        outgoing += self.audience.follow_clock()
        if self.next_block * self.block_s >= self._next_status_s:
            self._next_status_s += 1.0
            outgoing += self.session.complaints()
            outgoing += [self._status(member, now_s) for member in members]
        return outgoing

    def _note_full(self, now_s: float) -> None:
        if self._pause.full_since_s is None:
            self._pause.full_since_s = now_s
        elif now_s - self._pause.full_since_s >= PAUSE_AFTER_S:
            self._pause.is_paused, self.due_s = True, math.inf
            for member in self.audience.members:
                member.wants_turn = False
                member.wait.note(False, now_s)

    def _resume(self) -> None:
        """End a pause, since there is room again: the next block is due now instead of at its old time."""
        was_paused, self._pause = self._pause.is_paused, Pause()
        if was_paused:
            self.clock.slip(self.next_block, self._time_s())
            self.due_s = self.clock.due_s(self.next_block)

    def _choose(self, chosen: SetLevel | ChosenSteps) -> list[ServerMessage]:
        """Change to the first step of a level, or to the step that was chosen for it."""
        try:
            if isinstance(chosen, SetLevel):
                chosen = ChosenSteps(chosen.level, self.steps(chosen.level), 0)
        except RequestError as refusal:
            return [Error.from_refusal(refusal)]
        self.ladder = Ladder(chosen.steps, chosen.at, let_in_at=chosen.at)
        self.session.chosen_level = chosen.level
        self._restart_waits(self._time_s())
        return self.audience.set_quality(self.ladder.step, "chosen")

    def _state(self, asked: TakeSnapshot) -> StreamState:
        # In a pause the clock stands still, while the sound that is lost would have gone on.
        snapshot = self.audience.snapshot(session=asked.session, handled=asked.handled)
        return StreamState(snapshot, self.deadline_s)

    def _keep_answer(self, member: Member, request: IrRequest, computed: ComputedResponse | BaseException) -> None:
        self._inbox.responses.append((member, request, computed))
        member.is_answered = True
        self._wake()

    def _check_plan(self, workers: Workers) -> None:
        clock_s = self.next_block * self.block_s
        if self._next_check_s is None or clock_s < self._next_check_s:
            return
        self._next_check_s = clock_s + PERIOD_S
        self._checks += 1
        member = self.audience.members[self._checks % len(self.audience.members)]
        if (check := member.session.take_check()) is not None:
            self._next_check_s = None
            regret = workers.submit(check.run, member.session.levels[check.level], kind="plan")
            self._checking.keep_outcome(regret, partial(self._keep_regret, member))

    def _keep_regret(self, member: Member, regret: Regret | BaseException) -> None:
        self._inbox.regrets.append((member, regret))  # processed with the next block

    def _take_regret(self, member: Member, regret: Regret | BaseException) -> None:
        clock_s = self.next_block * self.block_s
        self._next_check_s = clock_s + PERIOD_S
        if isinstance(regret, BaseException):
            _logger.error("a plan of effects could not be checked", exc_info=regret)
            return
        self._next_check_s = clock_s + interval_s(regret.cost_s, streams=self.company)
        self.regrets.add(regret)
        member.session.learn(regret)

    def _keep_plan(self, member: Member, planned: tuple[Plan, float] | BaseException) -> None:
        self._inbox.plans.append((member, planned))
        self._wake()

    def _take_plan(self, member: Member, planned: tuple[Plan, float] | BaseException) -> list[ServerMessage]:
        if member not in self.audience.members:
            return []  # it has left
        if isinstance(planned, BaseException):
            _logger.error("no plan of effects", exc_info=planned)
            return self.audience.keep_effects(member)
        plan, cpu_s = planned
        self._costs.plan_s = _smoothed(self._costs.plan_s, cpu_s)
        return self.audience.adopt(member, plan)

    def _keep_doors(self, member: Member, request: DoorRequest, moved: DoorsMoved | BaseException) -> None:
        self._inbox.doors.append((member, request, moved))
        self._wake()

    def _take_doors(
        self, member: Member, request: DoorRequest, moved: DoorsMoved | BaseException
    ) -> list[ServerMessage]:
        if member not in self.audience.members:
            return []  # it has left
        if isinstance(moved, BaseException):
            _logger.error("doors could not be moved", exc_info=moved)
            return self.audience.collect(member, member.session.leave_doors(request))
        member.session.adopt_doors(moved)
        return []

    def _take_answer(
        self, member: Member, request: IrRequest, computed: ComputedResponse | BaseException
    ) -> list[ServerMessage]:
        member.has_asked = member.is_answered = False
        member.wait.end(self._time_s())
        if isinstance(computed, BaseException):
            _logger.error("no impulse response for pose %d", request.pose_id, exc_info=computed)
            return self.audience.give_up(member, request) if member in self.audience.members else []
        member.times.response.add(computed.duration_s)
        member.note_request(computed.cpu_s, is_first=request.is_first)
        self._requested.cpu_s += computed.cpu_s
        self._requested.duration_s += computed.duration_s
        return self.audience.accept(member, computed.response) if member in self.audience.members else []

    def _status(self, member: Member, now_s: float) -> Status:
        session, times = member.session, member.times
        return Status(
            sample_clock=session.sample_clock,
            blocks_sent=session.window.sent,
            blocks_late=self.blocks_late,
            blocks_dropped=session.blocks_dropped,
            unacknowledged=session.window.unacknowledged,
            buffer_ms=round(self.clock.ahead_s(self.next_block, now_s) * 1000, 3),
            render_ms=Durations.of(self.times.render),
            lateness_ms=Durations.of(self.times.lateness),
            ir_ms=Durations.of(times.response),
            pose_ms=Durations.of(times.pose.durations),
            reverberation_ms=Durations.of(times.reverberation.durations),
            ir_exchanges=session.ir_exchanges,
            blocks_limited=session.blocks_limited,
            level=session.quality.level,
            ir_rate_hz=session.quality.ir_rate_hz,
            live=session.live_statuses() if member is self.audience.first else (),
            listener=member.id,
        )


def _smoothed(cost_s: float, newest_s: float) -> float:
    return cost_s + (COST_SMOOTHING if cost_s else 1.0) * (newest_s - cost_s)


def _plan_timed(request: PlanRequest) -> tuple[Plan, float]:
    """Make a plan and return it with its CPU time."""
    started_s = time.thread_time()
    return request.plan(), time.thread_time() - started_s


def _compute_timed(levels: FieldsByLevel, request: IrRequest, session: Session) -> ComputedResponse:
    started_s, started_cpu_s = time.perf_counter(), time.thread_time()
    response = compute_irs(levels, request, session.renderer)
    return ComputedResponse(response, time.perf_counter() - started_s, time.thread_time() - started_cpu_s)
