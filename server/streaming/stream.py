"""A session in time: when its blocks are due, what waits to go in, and how long things take.

A stream whose window stays full is *paused*: nothing is rendered, its sample clock stands, and both go on where they
were with the first acknowledgement that makes room.

A `Stream` and its session belong to the audio thread that renders them; only `offer` may be called from any thread.
"""

import logging
import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

from server.core.durations import DurationHistogram
from server.core.errors import RequestError
from server.field.fields_by_level import FieldsByLevel
from server.planning.plan import Plan
from server.planning.planned_effects import SHARE_OF_ALL as PLAN_SHARE
from server.planning.planned_effects import PlanRequest
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import AddEmitter, ClientMessage, ListenerPose, MoveEmitter, SetLevel
from server.protocol.server_messages import Durations, Error, LevelReason, ServerMessage, Status
from server.rendering.output import Rendered
from server.responses.ir_request import IrRequest, IrResponse, compute_irs
from server.runtime.workers import Workers
from server.streaming.load import Ladder, LoadSample, Offer, ir_interval_s
from server.streaming.pacing import StreamClock
from server.streaming.plan_audit import FIRST_S, PERIOD_S, Regret, RegretRecord, interval_s
from server.streaming.request_queue import RequestQueue
from server.streaming.session import Session

MAX_WAITING_MESSAGES = 256
PAUSE_AFTER_S = 1.0
"""How long a window may be full before nothing is rendered for it: a network that falters for less costs no sound but
that which there was no room for."""
_MAX_BEHIND_S = 0.5
_LOAD_SMOOTHING = 0.02
_COST_SMOOTHING = 0.2
_logger = logging.getLogger(__name__)
T = TypeVar("T")


@dataclass(slots=True)
class TimedBlock:
    """A block on its way out; after `deadline_s` of the audio engine's clock it is late."""

    block: AudioBlock
    deadline_s: float


@dataclass(frozen=True)
class StreamFailed:
    """Rendering raised: nothing more will come from this stream."""


Outgoing = ServerMessage | TimedBlock | StreamFailed


class PoseTimes:
    """How long poses take from their arrival to the first block that has them, or a newer one."""

    def __init__(self) -> None:
        self.durations = DurationHistogram()
        # Where a field fails, poses wait in vain; the oldest are forgotten.
        self._waiting: deque[tuple[int, float]] = deque(maxlen=1024)

    def arrive(self, pose_id: int, now_s: float) -> None:
        self._waiting.append((pose_id, now_s))

    def take_effect(self, pose_id: int, now_s: float) -> None:
        while self._waiting and self._waiting[0][0] <= pose_id:
            self.durations.add(now_s - self._waiting.popleft()[1])


class Stream:
    """`ladder`, of the levels on `offer`, is where the session stands. `deliver` is called on the event loop with what
    the stream made, in order."""

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
        """Counted by whoever sends the blocks, since only it knows when they left."""
        self.render_times = DurationHistogram()
        self.latenesses = DurationHistogram()
        self.ir_times = DurationHistogram()
        self.pose_times = PoseTimes()
        self.reverberation_times = PoseTimes()
        self.next_block = 0
        self.due_s = math.inf
        """When that should be rendered; never before the stream has started."""
        self.load = 0.0
        """Share of a core that its blocks have taken of late."""
        self._levels = levels
        self._offer = offer
        self._request_s = 0.0
        """CPU time that a request for impulse responses has taken of late."""
        self._plan_s = 0.0
        """And a plan of effects."""
        self.wants_turn = False
        """Whether impulse responses are to be asked for as soon as it is its turn."""
        self.asked_last_s = -math.inf
        self._brings_emitter = False
        """Whether one waits among the messages."""
        self._has_asked = False
        self._asked_s: float | None = None
        """Since when it waits for them: for its turn, or for an answer."""
        self._longest_wait_s: float | None = None
        self._worst_lateness_s = 0.0
        self._lead = lead
        self._clock: StreamClock | None = None
        self._wake: Callable[[], None] = lambda: None
        self._time_s: Callable[[], float] = time.monotonic
        self._turns = RequestQueue(1)
        self._messages: deque[tuple[float, ClientMessage]] = deque()
        # Outcomes and not the futures, which hold whom they call back: this stream.
        self._answers: deque[tuple[IrRequest, _Computed | BaseException]] = deque()
        self._plans: deque[tuple[Plan, float] | BaseException] = deque()
        self._under_way: set[Future[Any]] = set()
        """What workers were given and have not answered. Whatever is answered is taken out, as it holds this stream."""
        self.regrets = RegretRecord()
        self._checks: deque[Regret | BaseException] = deque()
        self._full_since_s: float | None = None
        """Since when there has been no room in the window for a block."""
        self._is_paused = False
        self._streams = 1
        """Of the audio thread."""
        self._next_check_s: float | None = FIRST_S
        """None while one is under way."""
        self._next_status_s = 1.0

    @property
    def scene(self) -> str:
        return self._levels.bundle.id

    @property
    def awaits_irs_since_s(self) -> float | None:
        """When impulse responses were called for that have not come."""
        return self._asked_s

    @property
    def stalled_s(self) -> float:
        """For how long no block could be sent, since too many are unacknowledged; may be asked from any thread."""
        since_s = self._full_since_s
        return 0.0 if since_s is None else self._time_s() - since_s

    @property
    def deadline_s(self) -> float:
        """When its next block is late."""
        return self.clock.deadline_s(self.next_block)

    def attach(self, *, wake: Callable[[], None], time_s: Callable[[], float], turns: RequestQueue) -> None:
        """`wake` has the audio thread look at what waits; `time_s` is its clock; `turns` are those of its streams."""
        self._wake, self._time_s, self._turns = wake, time_s, turns

    def offer(self, message: ClientMessage) -> bool:
        """Leave a message for the audio thread; False, and the message refused, where too many wait already.

        What may call for an impulse response that can be asked for is looked at now, anything else with the next block.
        """
        if not self._replace_pose(message):
            if len(self._messages) >= MAX_WAITING_MESSAGES:
                return False
            self._messages.append((self._time_s(), message))
        self._brings_emitter |= isinstance(message, AddEmitter)
        # While one is computed, no other is asked for until its answer comes, and that wakes too.
        asks = isinstance(message, ListenerPose | MoveEmitter | AddEmitter) and self._asks_at_once
        if asks or self._is_paused:  # which no block would wake
            self._wake()
        return True

    def _replace_pose(self, message: ClientMessage) -> bool:
        """Have a listener's pose take the place of an older one that came directly before it and still waits."""
        if not (isinstance(message, ListenerPose) and self._messages):
            return False
        try:
            _, last = self._messages[-1]
            if not (isinstance(last, ListenerPose) and last.pose_id < message.pose_id):
                return False
            # Only here anything is appended: if the audio thread has taken it meanwhile, nothing is left at all.
            self._messages[-1] = self._time_s(), message
        except IndexError:
            return False
        return True

    def start(self, origin_s: float) -> None:
        """The next block, number 0 unless another thread has rendered some before, plays at `origin_s`."""
        first_s = origin_s - self.next_block * self.block_s
        self._clock = StreamClock(origin_s=first_s, block_s=self.block_s, lead=self._lead)
        self.due_s = self._clock.due_s(self.next_block)

    @property
    def clock(self) -> StreamClock:
        assert self._clock is not None, "the stream has not started"
        return self._clock

    @property
    def has_news(self) -> bool:
        """Whether something waits that cannot wait for the next block: for an IR to be asked for, or for an answer."""
        is_urgent = self._is_paused or self._asks_at_once
        return bool(self._answers or self._plans or (self._messages and is_urgent))

    @property
    def _asks_at_once(self) -> bool:
        """Whether it need not wait for its turn, be it since an emitter comes that is not heard yet."""
        return not self.session.awaits_irs and (self._brings_emitter or self._turns.are_left)

    @property
    def is_unanswered(self) -> bool:
        """Whether impulse responses have been asked for, and no answer has come."""
        return self._has_asked and not self._answers

    def drain_inbox(self, workers: Workers) -> list[Outgoing]:
        """Heed what waits and ask for impulse responses, or, where it is not its turn, `wants_turn` from then on."""
        outgoing: list[Outgoing] = []
        self._brings_emitter = False
        while self._answers:
            outgoing += self._take_answer(*self._answers.popleft())
        while self._plans:
            outgoing += self._take_plan(self._plans.popleft())
        for _ in range(len(self._messages)):
            arrived_s, message = self._messages.popleft()
            refused = self._choose(message) if isinstance(message, SetLevel) else self.session.receive(message)
            if isinstance(message, ListenerPose | MoveEmitter) and not refused:
                self.pose_times.arrive(message.pose_id, arrived_s)
                self.reverberation_times.arrive(message.pose_id, arrived_s)
            outgoing += refused
        while self._checks:
            self._take_regret(self._checks.popleft())
        if self._full_since_s is not None and not self.session.window.is_full:
            self._resume()
        if not self._is_paused:
            self._call_for_work(workers)
        return outgoing

    def _call_for_work(self, workers: Workers) -> None:
        self._check_plan(workers)
        # Who has not been heard yet waits for it; all others only for something better.
        if (wanted := self.session.take_plan_request()) is not None:
            plan = workers.submit(_plan_timed, wanted, kind="plan", is_urgent=wanted.is_first)
            self._await(plan, self._keep_plan)
        self._ask(workers)

    def _ask(self, workers: Workers) -> None:
        """For the impulse responses of the newest poses, if it is its turn, or for the first of an emitter."""
        request = self.session.take_request(only_first=not self._turns.may_ask(self))
        self.wants_turn = self.session.wants_irs
        if request is not None:
            self._has_asked, self.asked_last_s = True, self._time_s()
            self._turns.note(self)
            answer = workers.submit(
                _compute_timed, self._levels, request, self.session, kind="response", is_urgent=request.is_first
            )
            self._await(answer, partial(self._keep_answer, request))
        if not (self._has_asked or self.wants_turn):
            self._asked_s = None
        elif self._asked_s is None:
            self._asked_s = self._time_s()

    def _await(self, future: "Future[T]", keep: "Callable[[T | BaseException], None]") -> None:
        """Have what comes of it kept: on the worker's thread, or at once where it is done."""
        self._under_way.add(future)
        future.add_done_callback(partial(self._settle, keep))

    def _settle(self, keep: "Callable[[T | BaseException], None]", future: "Future[T]") -> None:
        self._under_way.discard(future)
        if not future.cancelled():
            outcome: T | BaseException = _outcome(future)
            keep(outcome)

    def leave(self) -> None:
        """Have nothing computed any more that this stream has asked for."""
        for future in tuple(self._under_way):
            future.cancel()

    def strain(self, now_s: float) -> LoadSample:
        """What it went through since this was asked last."""
        waiting_s = () if self._asked_s is None else (now_s - self._asked_s,)
        answered_s = () if self._longest_wait_s is None else (self._longest_wait_s,)
        strain = LoadSample(
            self._worst_lateness_s / (self._lead * self.block_s), max((*waiting_s, *answered_s), default=None)
        )
        self._worst_lateness_s, self._longest_wait_s = 0.0, None
        return strain

    def step(self, reason: LevelReason, now_s: float) -> list[Outgoing]:
        """Hear what the ladder, which has been moved, now stands on."""
        self._forget_waits(now_s)
        return [*self.session.set_quality(self.ladder.rung, reason)]

    def set_cpu_budget(self, *, streams: int, share: float) -> None:
        """Take one of `streams` equal parts of what IRs may take of a core, `share`, and of what plans of effects and
        checks of them may."""
        self._streams = streams
        self.session.space_plans(self._plan_s * streams / PLAN_SHARE)
        self.session.set_ir_interval(
            ir_interval_s(self.ladder, request_s=self._request_s, streams=streams, share=share)
        )

    def finish_blocks(
        self, sample_clock: int, rendered: Sequence[Rendered], *, cost_s: float, now_s: float
    ) -> list[Outgoing]:
        """Pass on the blocks just rendered at once, which took `cost_s` together and are ready `now_s`."""
        clock, count = self.clock, len(rendered)
        blocks = self.session.finish_blocks(sample_clock, rendered)
        outgoing: list[Outgoing] = [
            TimedBlock(block, clock.deadline_s(number)) for number, block in enumerate(blocks, self.next_block)
        ]
        if blocks:
            self.pose_times.take_effect(blocks[0].pose_id, now_s)
            self.reverberation_times.take_effect(blocks[0].reverberation_pose_id, now_s)
        each_s = cost_s / count
        self.load += (1 - (1 - _LOAD_SMOOTHING) ** count) * (each_s / self.block_s - self.load)
        self.render_times.add(each_s, count)
        if self.next_block >= self._lead:  # the first were due before the stream was
            lateness_s = max(0.0, now_s - self.due_s)  # what is early is not late
            self._worst_lateness_s = max(self._worst_lateness_s, lateness_s)
            after_due = min(count, 1 + int(lateness_s / self.block_s))
            for ahead in range(after_due):
                self.latenesses.add(lateness_s - ahead * self.block_s)
            self.latenesses.add(0.0, count - after_due)
        if clock.ahead_s(self.next_block, now_s) < -_MAX_BEHIND_S:
            clock.slip(self.next_block, now_s)
        self.next_block += count
        self.due_s = clock.due_s(self.next_block)
        if len(blocks) < count:
            self._note_full(now_s)
        if self.next_block * self.block_s >= self._next_status_s:
            self._next_status_s += 1.0
            outgoing += self.session.complaints()
            outgoing.append(self._status(now_s))
        return outgoing

    def _note_full(self, now_s: float) -> None:
        if self._full_since_s is None:
            self._full_since_s = now_s
        elif now_s - self._full_since_s >= PAUSE_AFTER_S:
            self._is_paused, self.due_s = True, math.inf
            self.wants_turn, self._asked_s = False, None

    def _resume(self) -> None:
        """There is room again: the block that is next is due now, and not when it would have been."""
        self._full_since_s = None
        if self._is_paused:
            self._is_paused = False
            self.clock.slip(self.next_block, self._time_s())
            self.due_s = self.clock.due_s(self.next_block)

    def _choose(self, message: SetLevel) -> list[ServerMessage]:
        try:
            self.ladder = self._offer.ladder(message.level, block_s=self.block_s)
        except RequestError as refusal:
            return [Error.from_refusal(refusal)]
        self._forget_waits(self._time_s())
        return self.session.set_quality(self.ladder.rung, "chosen")

    def _forget_waits(self, now_s: float) -> None:
        """What was asked for before does not tell how a new rung does."""
        self._longest_wait_s = None
        if self._asked_s is not None:
            self._asked_s = now_s

    def _keep_answer(self, request: IrRequest, computed: "_Computed | BaseException") -> None:
        self._answers.append((request, computed))
        self._wake()

    def _check_plan(self, workers: Workers) -> None:
        clock_s = self.next_block * self.block_s
        if self._next_check_s is None or clock_s < self._next_check_s:
            return
        self._next_check_s = clock_s + PERIOD_S
        if (check := self.session.take_check()) is not None:
            self._next_check_s = None
            regret = workers.submit(check.run, self._levels[check.level], kind="plan")
            self._await(regret, self._keep_regret)

    def _keep_regret(self, regret: Regret | BaseException) -> None:
        self._checks.append(regret)  # looked at with the next block

    def _take_regret(self, regret: Regret | BaseException) -> None:
        clock_s = self.next_block * self.block_s
        self._next_check_s = clock_s + PERIOD_S
        if isinstance(regret, BaseException):
            _logger.error("a plan of effects could not be checked", exc_info=regret)
            return
        self._next_check_s = clock_s + interval_s(regret.cost_s, streams=self._streams)
        self.regrets.add(regret)
        self.session.learn(regret)

    def _keep_plan(self, planned: tuple[Plan, float] | BaseException) -> None:
        self._plans.append(planned)
        self._wake()

    def _take_plan(self, planned: tuple[Plan, float] | BaseException) -> list[ServerMessage]:
        if isinstance(planned, BaseException):
            _logger.error("no plan of effects", exc_info=planned)
            return self.session.keep_effects()
        plan, cpu_s = planned
        self._plan_s = _smoothed(self._plan_s, cpu_s)
        return self.session.adopt(plan)

    def _take_answer(self, request: IrRequest, computed: "_Computed | BaseException") -> list[ServerMessage]:
        self._has_asked = False
        if self._asked_s is not None:
            self._longest_wait_s = max(self._longest_wait_s or 0.0, self._time_s() - self._asked_s)
            self._asked_s = None
        if isinstance(computed, BaseException):
            _logger.error("no impulse response for pose %d", request.pose_id, exc_info=computed)
            return self.session.give_up(request)
        self.ir_times.add(computed.duration_s)
        self._request_s = _smoothed(self._request_s, computed.cpu_s)
        return self.session.accept(computed.response)

    def _status(self, now_s: float) -> Status:
        session = self.session
        return Status(
            sample_clock=session.sample_clock,
            blocks_sent=session.window.sent,
            blocks_late=self.blocks_late,
            blocks_dropped=session.blocks_dropped,
            unacknowledged=session.window.unacknowledged,
            buffer_ms=round(self.clock.ahead_s(self.next_block, now_s) * 1000, 3),
            render_ms=Durations.of(self.render_times),
            lateness_ms=Durations.of(self.latenesses),
            ir_ms=Durations.of(self.ir_times),
            pose_ms=Durations.of(self.pose_times.durations),
            reverberation_ms=Durations.of(self.reverberation_times.durations),
            ir_exchanges=session.ir_exchanges,
            blocks_limited=session.blocks_limited,
            level=session.rung.level,
            ir_rate_hz=session.rung.ir_rate_hz,
            live=session.live_statuses(),
        )


@dataclass(frozen=True)
class _Computed:
    response: IrResponse
    duration_s: float
    cpu_s: float
    """What the thread that computed it spent."""


def _outcome(future: Future[T]) -> T | BaseException:
    """What a future that is done has come to."""
    failure = future.exception()
    return future.result() if failure is None else failure


def _smoothed(cost_s: float, newest_s: float) -> float:
    return cost_s + (_COST_SMOOTHING if cost_s else 1.0) * (newest_s - cost_s)


def _plan_timed(request: PlanRequest) -> tuple[Plan, float]:
    """With the CPU time it took."""
    started_s = time.thread_time()
    return request.plan(), time.thread_time() - started_s


def _compute_timed(levels: FieldsByLevel, request: IrRequest, session: Session) -> _Computed:
    started_s, started_cpu_s = time.perf_counter(), time.thread_time()
    response = compute_irs(levels, request, session.renderer)
    return _Computed(response, time.perf_counter() - started_s, time.thread_time() - started_cpu_s)
