"""A server whose time is simulated: cores of given speed, workers and clients are arithmetic; what decides is real.

Real are the audio thread with its ticks and its rests, streams with what they measure, stream clocks, the request queue
and the load policy. Simulated are rendering, responses, plans and the event loop, each of which takes CPU time of a
core; sessions, which know only which pose they heard of last; and clients, who come, send poses and go. So minutes pass
within seconds, and the same happens every time.

Threads get a core in the order of their priority: the audio thread has the first core whenever it works, the event loop
the fastest that is left, and workers share what remains. Cores slow down where another tenant takes a share of them,
and stand still in a pause of the host.
"""

import heapq
import itertools
import math
from collections import Counter, deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass, field
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np

from server.field.kinds.catalogue import kind_of
from server.protocol.client_messages import AUTO, ListenerPose
from server.rendering.output import Rendered
from server.scene.manifest import QualityLevel, Reuse
from server.streaming import audio_engine
from server.streaming.admission import Admission, Place, Refusal
from server.streaming.audio_engine import AudioEngine
from server.streaming.headroom import RenderCost, StreamKind
from server.streaming.inbox import ComputedResponse
from server.streaming.load_policy import Ladder
from server.streaming.load_thresholds import THRESHOLDS, Thresholds
from server.streaming.pacing import SendWindow
from server.streaming.quality_steps import Offer
from server.streaming.response_scheduler import Scope
from server.streaming.stream import Stream, TimedBlock

BLOCK_S = 1_024 / 48_000
"""Long blocks, since many minutes are simulated."""
LEAD = 4
"""Of blocks in hand: as long as a client's usual eight of 256 samples at 24 kHz."""
_NEVER = math.inf
_SILENCE = np.zeros((2, 1), np.float32)


@dataclass(frozen=True)
class Costs:
    """CPU seconds on a core of speed 1, the EPYC core of `docs/results/speed.md`.

    There a core serves 20 streams of 16 moving emitters at two blocks at once and 24 with more, so that a block of
    5.3 ms takes 0.23 ms, of which the convolver takes 0.08; these blocks are four times as long. Of streams that share
    a tail a core serves 40. What ticks, sending and plans take are assumptions.
    """

    tick_s: float = 60e-6
    block_s: float = 0.92e-3
    shared: tuple[float, ...] = (1.0, 0.6, 0.45)
    """Share of that, for emitters that share nothing, a tail, or their reverberation."""
    early: float = 0.3
    """Share of the cost of a response of which only the early part is computed."""
    saved_by_doubling: float = 1 / 8
    exchange_s: float = 0.32e-3
    """More of a block that fades to other responses: the convolver runs twice."""
    send_s: float = 20e-6
    plan_s: float = 2e-3
    pose_s: float = 0.0
    """What a pose takes of the audio thread."""
    begin_s: float = 0.0
    begin_emitter_s: float = 0.0
    """What a stream that begins, and each of its emitters, take of the event loop."""
    walk_hz: float = 0.0
    """Requests a second at which a walk costs its mean. With fewer, more of what is kept is too far away."""
    spread: float = 0.1
    """Standard deviation of the logarithm of each cost."""


@dataclass(frozen=True)
class SimulatedLevel:
    """A quality level: `miss_ms` is what a response takes where nothing was kept, as a server measures it when it
    starts, and `walk_ms` the mean on a walk. `alone_ms` is what one takes that is asked for alone, if that is more."""

    level: QualityLevel
    miss_ms: float
    walk_ms: float
    alone_ms: float = 0.0


LEVELS = (
    SimulatedLevel(
        QualityLevel(
            name="shared",
            field="any",
            reuse=Reuse(spacing_m=5.0, turn_deg=120, first_reflections="node"),
            shared_tail=True,
        ),
        0.45,
        0.013,
    ),
    SimulatedLevel(
        QualityLevel(name="nodes", field="any", reuse=Reuse(spacing_m=2.0, turn_deg=120, first_reflections="node")),
        0.43,
        0.06,
    ),
    SimulatedLevel(QualityLevel(name="lattice", field="any", reuse=Reuse(spacing_m=1.0, turn_deg=120)), 0.43, 0.19),
    SimulatedLevel(QualityLevel(name="best", field="any"), 0.55, 0.55),
)
"""Of the apartment, cheapest first (`docs/results/quality-levels.md`), at the speed of that core, where the best takes
0.55 ms (`docs/results/speed.md`); and one more that shares a tail."""
APARTMENT_COSTS = Costs(
    block_s=0.29e-3,
    early=0.7,
    saved_by_doubling=1 / 7,
    exchange_s=0.4e-3,
    send_s=72e-6,
    pose_s=80e-6,
    begin_s=4e-3,
    begin_emitter_s=0.3e-3,
    walk_hz=30.0,
)
APARTMENT = (
    SimulatedLevel(
        QualityLevel(name="turned", field="any", reuse=Reuse(spacing_m=5.0, turn_deg=360, first_reflections="node")),
        0.20,
        0.0025,
        0.48,
    ),
    SimulatedLevel(
        QualityLevel(name="5m", field="any", reuse=Reuse(spacing_m=5.0, turn_deg=120, first_reflections="node")),
        0.20,
        0.0036,
        0.51,
    ),
    SimulatedLevel(
        QualityLevel(name="2m", field="any", reuse=Reuse(spacing_m=2.0, turn_deg=120, first_reflections="node")),
        0.26,
        0.016,
        0.55,
    ),
    SimulatedLevel(QualityLevel(name="1m", field="any", reuse=Reuse(spacing_m=1.0, turn_deg=120)), 0.34, 0.086, 0.56),
    SimulatedLevel(QualityLevel(name="best", field="any"), 0.20, 0.20, 0.43),
)
"""What streams of the apartment cost as `nafir bench overload` found it on one core of an EPYC with AVX-512: a response
alone costs twice as much as one of sixteen, an early part hardly less than a whole response, and blocks little."""


@dataclass
class _Job:
    left_s: float
    finish: Callable[[], None]
    began_s: float = 0.0
    """When a worker began with it."""


class Machine:
    """Cores and a clock, which goes on only while somebody works or waits."""

    def __init__(self, speeds: tuple[float, ...], workers: int) -> None:
        self.now_s = 100.0
        self.end_s = 100.0
        self.speeds = speeds
        self.workers = workers
        self._taken = [0.0] * len(speeds)
        self._pauses = 0
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._numbers = itertools.count()
        self._loop: deque[_Job] = deque()
        self._urgent: deque[_Job] = deque()
        self._waiting: deque[_Job] = deque()
        self._running: list[_Job] = []

    def __call__(self) -> float:
        return self.now_s

    def at(self, time_s: float, call: Callable[[], None]) -> None:
        heapq.heappush(self._events, (time_s, next(self._numbers), call))

    def pause(self, time_s: float, duration_s: float) -> None:
        """Have nothing of the host run."""

        def begin() -> None:
            self._pauses += 1

        def end() -> None:
            self._pauses -= 1

        self.at(time_s, begin)
        self.at(time_s + duration_s, end)

    def occupy(self, time_s: float, duration_s: float, share: float, cores: tuple[int, ...] = (0,)) -> None:
        """Have another tenant take a share of cores."""

        def take(change: float) -> None:
            for core in cores:
                self._taken[core] += change

        self.at(time_s, lambda: take(share))
        self.at(time_s + duration_s, lambda: take(-share))

    def send(self, cost_s: float, finish: Callable[[], None]) -> None:
        """On the event loop, one after the other."""
        self._loop.append(_Job(cost_s, finish))

    def compute(self, cost_s: float, finish: Callable[[], None], *, is_urgent: bool = False) -> _Job:
        """On a worker, as soon as one is free."""
        job = _Job(cost_s, finish)
        (self._urgent if is_urgent else self._waiting).append(job)
        self._employ()
        return job

    def work(self, cost_s: float) -> None:
        """Have the audio thread work."""
        self._pass(_NEVER, work_s=cost_s)

    def wait(self, until_s: float, is_over: Callable[[], bool] = lambda: False) -> None:
        """Have the audio thread sleep."""
        self._pass(min(until_s, max(self.end_s, self.now_s)), is_over=is_over)

    def _employ(self) -> None:
        while len(self._running) < self.workers and (self._urgent or self._waiting):
            self._running.append((self._urgent or self._waiting).popleft())
            self._running[-1].began_s = self.now_s

    def _pass(self, until_s: float, *, work_s: float = _NEVER, is_over: Callable[[], bool] = lambda: False) -> None:
        is_working = work_s < _NEVER
        while work_s > 0 and self.now_s < until_s and not is_over():
            own, loop, each = self._rates(is_working=is_working)
            jobs = [(self._loop[0], loop)] if self._loop and loop else []
            jobs += [(job, each) for job in self._running] if each else []
            ends_s = [self.now_s + job.left_s / rate for job, rate in jobs]
            work_end_s = self.now_s + work_s / own if is_working and own else _NEVER
            next_s = min([until_s, work_end_s, *ends_s, *(event[0] for event in self._events[:1])])
            assert next_s < _NEVER, "nothing ever happens"
            passed_s = max(0.0, next_s - self.now_s)
            self.now_s = max(self.now_s, next_s)
            if is_working:
                work_s = 0.0 if work_end_s <= next_s else work_s - passed_s * own
            done = []
            for (job, rate), end_s in zip(jobs, ends_s, strict=True):
                job.left_s -= passed_s * rate
                if end_s <= next_s:
                    done.append(job)
            for job in done:
                self._loop.remove(job) if job in self._loop else self._running.remove(job)
                job.finish()
            self._employ()
            while self._events and self._events[0][0] <= self.now_s:
                heapq.heappop(self._events)[2]()

    def _rates(self, *, is_working: bool) -> tuple[float, float, float]:
        """How fast the audio thread, the event loop and each worker at work get on."""
        if self._pauses:
            return 0.0, 0.0, 0.0
        own, *others = [speed * max(0.0, 1 - taken) for speed, taken in zip(self.speeds, self._taken, strict=True)]
        free = sorted(others if is_working else (own, *others), reverse=True)
        loop = free.pop(0) if self._loop and free else 0.0
        each = sum(free[: len(self._running)]) / len(self._running) if self._running else 0.0
        return own, loop, each


class _Flag:
    """What audio threads wait for, as `threading.Event`."""

    def __init__(self, machine: Machine, *, is_set: bool = False) -> None:
        self._machine, self._is_set = machine, is_set

    def is_set(self) -> bool:
        return self._is_set

    def set(self) -> None:
        self._is_set = True

    def clear(self) -> None:
        self._is_set = False

    def wait(self, timeout_s: float | None = None) -> bool:
        until_s = _NEVER if timeout_s is None else self._machine.now_s + timeout_s
        self._machine.wait(until_s, self.is_set)
        return self._is_set


@dataclass
class _Request:
    level: str
    pose_id: int
    is_first: bool


class _Plan:
    is_first = False


class SimulatedSession:
    """Knows which pose came last and which is heard; asks as a session does, for one pose at a time."""

    runs_by_itself = True
    blocks_dropped = ir_exchanges = blocks_limited = 0

    def __init__(self, quality, emitters: int = 1) -> None:
        self.emitter_count = emitters
        self.window = SendWindow(2**40)
        self.renderer = self
        self.quality = self.wanted = quality
        self.sharing = quality.sharing
        self.sample_clock = 0
        self.newest_pose_id = self.asked_pose_id = 0
        self.answered_s: list[float] = []
        self.is_exchange = False
        self._has_asked = self._in_flight = self._is_held = False
        self._interval_s = self._next_s = self._plan_interval_s = self._next_plan_s = 0.0
        self._plans = False

    @property
    def clock_s(self) -> float:
        return self.sample_clock * BLOCK_S

    @property
    def awaits_irs(self) -> bool:
        return self._in_flight or self.clock_s < self._next_s

    @property
    def wants_irs(self) -> bool:
        return self._is_held and not self.awaits_irs

    def receive(self, message: ListenerPose) -> list:
        self.newest_pose_id = message.pose_id
        return []

    def take_request(self, scope: Scope) -> _Request | None:
        self._is_held = False
        is_outdated = self.newest_pose_id > self.asked_pose_id or self.wanted.level != self.quality.level
        if self._in_flight or not is_outdated:
            return None
        if self._has_asked and (scope is Scope.FIRST or self.clock_s < self._next_s):
            self._is_held = True
            return None
        is_first, self._has_asked, self._in_flight = not self._has_asked, True, True
        self.asked_pose_id = self.newest_pose_id
        self._next_s = self.clock_s + self._interval_s
        return _Request(self.wanted.level, self.newest_pose_id, is_first)

    def accept(self, request: _Request) -> list:
        self._in_flight, self.is_exchange = False, True
        if request.level == self.wanted.level:
            self.quality = self.wanted
        self.sharing = max(self.quality.sharing, self.wanted.sharing)
        return []

    def set_quality(self, quality, _reason: str) -> list:
        if quality.level == self.quality.level:
            self.quality = quality
        elif quality.level != self.wanted.level:
            self._next_s = 0.0
        self.wanted = quality
        self.sharing = max(self.quality.sharing, quality.sharing)
        return []

    def set_ir_interval(self, interval_s: float) -> None:
        self._interval_s = interval_s

    def space_plans(self, interval_s: float) -> None:
        self._plan_interval_s = interval_s

    def take_plan_request(self) -> _Plan | None:
        if self._plans or self.clock_s < self._next_plan_s:
            return None
        self._plans, self._next_plan_s = True, self.clock_s + max(0.5, min(2.0, self._plan_interval_s))
        return _Plan()

    levels = None

    def take_door_requests(self) -> list:
        return []

    def adopt(self, _plan: object) -> list:
        self._plans = False
        return []

    def take_check(self) -> None:
        return None

    def begin_block(self) -> None:
        pass

    def finish_blocks(self, _clock: int, rendered: list[Rendered]) -> list:
        sequences = self.window.take_sequences(len(rendered))
        pose_ids = {"pose_id": self.newest_pose_id, "reverberation_pose_id": self.asked_pose_id}
        return [SimpleNamespace(sequence=sequence, **pose_ids) for sequence in sequences]

    def follow_clock(self) -> list:
        return []

    def complaints(self) -> list:
        return []

    def live_statuses(self) -> tuple:
        return ()


@dataclass(eq=False)
class Client:
    """Somebody who listens to `emitters` from `opened_s` to `closed_s`."""

    emitters: int
    opened_s: float
    closed_s: float = _NEVER
    stream: Stream | None = None
    sent_s: list[float] = field(default_factory=list)
    late_s: list[float] = field(default_factory=list)
    """When blocks arrived that were late."""
    moves: list[tuple[float, int]] = field(default_factory=list)
    """When its stream moved to which step; 0 is the best."""
    answers_s: list[float] = field(default_factory=list)
    """When responses came."""
    asked_s: float = -_NEVER
    """When responses were last asked for."""
    began_at: int = 0
    """The step on which the server let it in."""
    refused: Refusal | None = None
    answered_s: float = _NEVER
    """When it was let in or refused."""
    place: Place | None = None


@dataclass(frozen=True)
class Look:
    """What is seen of a server at one time."""

    time_s: float
    busy: float
    blocks_at_once: int
    steps: tuple[int, ...]
    """On which each open stream stands."""
    lateness: float
    """The worst of the blocks that arrived since the look before, as a share of what clients have in hand."""


class SimulatedServer:
    """One audio thread, and a worker less than there are cores, but at least one. Times are seconds from its start."""

    def __init__(
        self,
        *,
        speeds: tuple[float, ...] = (1.0, 1.0),
        thresholds: Thresholds = THRESHOLDS,
        costs: Costs = Costs(),
        levels: tuple[SimulatedLevel, ...] = LEVELS,
        poses_hz: float = 30.0,
        seed: int = 0,
        admits: bool = False,
    ) -> None:
        self.threads = max(1, len(speeds) - 1)
        """Of workers."""
        self.machine = Machine(speeds, self.threads)
        self.began_s = self.machine.now_s
        self.clients: list[Client] = []
        self.looks: list[Look] = []
        self._costs, self._levels, self._poses_hz = costs, {each.level.name: each for each in levels}, poses_hz
        self._thresholds = thresholds
        self._rng = np.random.default_rng(seed)
        self._luck: Iterator[float] = iter(())
        self._rendered = self._poses = 0
        self._busy_s = 0.0
        self._worst = 0.0
        self._by_session: dict[SimulatedSession, Client] = {}
        here_ms = {each.level.name: max(each.alone_ms, each.miss_ms) / speeds[-1] for each in levels}
        self._offer = Offer(tuple(each.level for each in levels), here_ms)
        self.engine = AudioEngine(self._post, self, thresholds=thresholds, time_s=self.machine)
        (self.thread,) = self.engine.threads
        self.thread._wake = _Flag(self.machine)
        self.thread._has_arrived = _Flag(self.machine, is_set=True)
        self._loop_s = 0.0
        """CPU time of the event loop."""
        self.admission = Admission(
            self.engine,
            most_streams=1_000,
            cores=len(speeds),
            is_on=admits,
            thresholds=thresholds,
            time_s=self.machine,
            loop_cpu_s=lambda: self._loop_s,
            luck=lambda: float(self._rng.random()),
            call_later=lambda seconds, call: self.machine.at(self.machine.now_s + seconds, call),
        )
        self._kind = self._measured_kind(speeds[0]) if admits else None
        if self._kind is not None:
            self.admission.offer(self._kind, self._offer.steps(AUTO, block_s=BLOCK_S)[-1])
        self._period = itertools.count(1)
        self._look_again()

    @property
    def now_s(self) -> float:
        return self.machine.now_s - self.began_s

    def open(self, count: int, *, at_s: float = 0.0, until_s: float = _NEVER, emitters: int = 32) -> list[Client]:
        """Have clients come, one a second."""
        come = [Client(emitters, at_s + number, closed_s=until_s) for number in range(count)]
        for client in come:
            self.clients.append(client)
            self.machine.at(self.began_s + client.opened_s, lambda client=client: self._open(client))
            if until_s < _NEVER:
                self.machine.at(self.began_s + until_s, lambda client=client: self.engine.close(client.stream))
        return come

    def arrive(
        self,
        count: int,
        *,
        at_s: float = 0.0,
        every_s: float = 0.0,
        until_s: float = _NEVER,
        emitters: int = 32,
        announces: bool = True,
        come_back_until_s: float = 0.0,
    ) -> list[Client]:
        """Have clients come and be let in or refused; some of them say how many emitters they have. Those who are
        refused come back when they were told to."""
        come = [Client(emitters, at_s + number * every_s, closed_s=until_s) for number in range(count)]
        for client in come:
            self.clients.append(client)
            self.machine.at(
                self.began_s + client.opened_s, lambda client=client: self._ask(client, announces, come_back_until_s)
            )
            if until_s < _NEVER:
                self.machine.at(self.began_s + until_s, lambda client=client: self._leave(client))
        return come

    def pause(self, at_s: float, duration_s: float) -> None:
        self.machine.pause(self.began_s + at_s, duration_s)

    def occupy(self, at_s: float, duration_s: float, share: float, cores: tuple[int, ...] = (0,)) -> None:
        self.machine.occupy(self.began_s + at_s, duration_s, share, cores)

    def run(self, until_s: float) -> "SimulatedServer":
        self.machine.end_s = self.began_s + until_s
        with patch.object(audio_engine, "render_all", self._render):
            while self.machine.now_s < self.machine.end_s:
                self.thread._rest(self.thread.tick())
        return self

    def utilisation(
        self, streams: int, *, emitters: int = 32, step: int = -1, blocks_at_once: int | None = None
    ) -> float:
        """Share of its core that the audio thread takes for so many streams on a step, and the event loop for their
        blocks, where they share it."""
        costs, numbers = self._costs, self._thresholds.blocks_at_once
        quality = self._offer.steps(AUTO, block_s=BLOCK_S)[step]
        count = blocks_at_once or numbers[-1]
        block_s = costs.block_s * emitters / 16 * costs.shared[quality.sharing]
        saved = (1 - costs.saved_by_doubling) ** numbers.index(count)
        exchange_s = costs.exchange_s * emitters / 16 * min(quality.ir_rate_hz or self._poses_hz, self._poses_hz)
        ticks_s = costs.tick_s * audio_engine.PHASES / BLOCK_S / (2 if count == numbers[-1] else 1)
        send_s = costs.send_s / BLOCK_S if len(self.machine.speeds) == 1 else 0.0
        return (streams * (block_s * saved / BLOCK_S + exchange_s + send_s) + ticks_s) / self.machine.speeds[0]

    # What the audio engine asks of what is around it.

    @property
    def has_urgent(self) -> bool:
        """As workers: whether urgent work waits."""
        return bool(self.machine._urgent)

    def _measured_kind(self, speed: float) -> StreamKind:
        """What a server measures when it starts: costs of one stream alone."""
        each_s, exchange_s = self._costs.block_s / 16 / speed, self._costs.exchange_s / 16 / speed
        render = {}
        for name, level in self._levels.items():
            sharing = kind_of(level.level).sharing
            render[name] = RenderCost(
                self._costs.tick_s / speed,
                self._costs.shared[sharing] * each_s,
                exchange_s,
                response_s=level.miss_ms / 1000 / self.machine.speeds[-1],
                early_share=1.0 if level.level.reuse else self._costs.early,
                sharing=sharing,
            )
        walk = {name: level.walk_ms / level.miss_ms for name, level in self._levels.items()}
        return StreamKind(("simulated", 24_000, 1_024, None), BLOCK_S, render, walk)

    def _ask(self, client: Client, announces: bool, come_back_until_s: float = 0.0) -> None:
        def refuse(refusal: Refusal) -> None:
            client.refused, client.answered_s, client.place = refusal, min(client.answered_s, self.now_s), None
            if self.now_s + refusal.retry_after_s < come_back_until_s:
                again_s = self.machine.now_s + refusal.retry_after_s
                self.machine.at(again_s, lambda: self._ask(client, announces, come_back_until_s))

        def begin(missed: Refusal | None) -> None:
            if missed is not None:
                refuse(missed)
                return
            client.answered_s = min(client.answered_s, self.now_s)
            self._open(client)

        steps = self._offer.steps(AUTO, block_s=BLOCK_S)
        answer = self.admission.turn_away()
        if answer is None:
            answer = self.admission.admit(self._kind, steps, client.emitters if announces else None)
        if isinstance(answer, Refusal):
            refuse(answer)
            return
        client.place, client.began_at = answer, steps.index(answer.step)
        self.admission.await_turn(answer, begin)

    def _leave(self, client: Client) -> None:
        if client.stream is not None:
            self.engine.close(client.stream)
        if client.place is not None:
            self.admission.leave(client.place)

    def _open(self, client: Client) -> None:
        ladder = Ladder(self._offer.steps(AUTO, block_s=BLOCK_S), client.began_at, let_in_at=client.began_at)
        session = SimulatedSession(ladder.step, client.emitters)
        self._by_session[session] = client
        client.stream = Stream(
            session,
            SimpleNamespace(bundle=SimpleNamespace(id="simulated")),
            offer=self._offer,
            ladder=ladder,
            block_s=BLOCK_S,
            lead=LEAD,
            deliver=lambda made: self._deliver(client, made),
        )
        if client.place is not None:
            self.admission.open(client.place, client.stream)
            self._take_loop(self._costs.begin_s + client.emitters * self._costs.begin_emitter_s)
            for _ in range(client.emitters):
                assert self.admission.add_emitter(client.place, is_live=False) is None
        self.engine.open(client.stream)
        self._move(client, self.machine.now_s, 1)

    def _move(self, client: Client, first_s: float, pose_id: int) -> None:
        if self.now_s >= client.closed_s:
            return
        self._poses += 1
        client.stream.offer(ListenerPose.model_construct(pose_id=pose_id))
        self.machine.at(first_s + pose_id / self._poses_hz, lambda: self._move(client, first_s, pose_id + 1))

    def submit(self, _function: object, *arguments: object, kind: str, is_urgent: bool = False) -> Future:
        """As workers: have a plan made, or responses computed."""
        future: Future = Future()
        if kind == "plan":
            cost_s = self._costs.plan_s * self._chance()
            self._compute(future, cost_s, lambda _: (SimpleNamespace(), cost_s), is_urgent=False)
            return future
        _, request, session = arguments
        client, level = self._by_session[session], self._levels[request.level]
        # The first response of each emitter finds nothing kept.
        each_ms = level.miss_ms
        if not request.is_first:
            since_s = self.now_s - client.asked_s
            each_ms = min(each_ms, level.walk_ms * max(1.0, since_s * self._costs.walk_hz))
        client.asked_s = self.now_s
        whole = client.emitters
        if session.quality.late_reach_m and not (request.is_first or kind_of(level.level).reuses_responses):
            whole = min(whole, THRESHOLDS.whole_at_once)
        responses = whole + (client.emitters - whole) * self._costs.early
        cost_s = responses * each_ms / 1000 * self._chance()
        self._compute(
            future,
            cost_s,
            lambda duration_s: ComputedResponse(request, duration_s, cost_s / self.machine.speeds[-1]),
            is_urgent=is_urgent,
            note=lambda: self._note_answer(client),
        )
        return future

    def _compute(
        self,
        future: Future,
        cost_s: float,
        result: Callable[[float], object],
        *,
        is_urgent: bool,
        note: Callable[[], None] = lambda: None,
    ) -> None:
        """Have a worker come to a result, which may depend on how long that took."""

        def finish() -> None:
            if future.set_running_or_notify_cancel():
                future.set_result(result(self.machine.now_s - job.began_s))
                note()

        job = self.machine.compute(cost_s, finish, is_urgent=is_urgent)

    def _note_answer(self, client: Client) -> None:
        client.answers_s.append(self.now_s)

    def _chance(self) -> float:
        """What a cost is multiplied with."""
        luck = next(self._luck, None)
        if luck is None:
            self._luck = iter(np.exp(self._costs.spread * self._rng.standard_normal(4_096)).tolist())
            luck = next(self._luck)
        return luck

    def _render(self, sessions: list[SimulatedSession]) -> list[Rendered]:
        """As `render_all`: the blocks of one session come one after the other."""
        costs, blocks = self._costs, []
        cost_s, self._poses = costs.tick_s + self._poses * costs.pose_s, 0
        for session, count in Counter(sessions).items():
            emitters = self._by_session[session].emitters
            share = costs.shared[session.sharing] * emitters / 16
            saved = (1 - costs.saved_by_doubling) ** (math.log2(count))
            cost_s += count * costs.block_s * share * saved + session.is_exchange * costs.exchange_s * emitters / 16
            blocks += [Rendered(_SILENCE, session.is_exchange and number == 0, False) for number in range(count)]
            session.is_exchange = False
            session.sample_clock += count
        cost_s *= self._chance()
        self._rendered = len(sessions)
        began_s = self.machine.now_s
        self.machine.work(cost_s)
        self._busy_s += self.machine.now_s - began_s
        return blocks

    def _post(self, call: Callable[[], None]) -> None:
        """As the event loop, for which each block is work."""
        cost_s, self._rendered = self._costs.send_s * max(1, self._rendered) * self._chance(), 0
        self._take_loop(cost_s, call)

    def _take_loop(self, cost_s: float, call: Callable[[], None] = lambda: None) -> None:
        self._loop_s += cost_s / max(self.machine.speeds)
        self.machine.send(cost_s, call)

    def _deliver(self, client: Client, made: list) -> None:
        now_s = self.machine.now_s
        for item in made:
            if isinstance(item, TimedBlock):
                client.sent_s.append(self.now_s)
                self._worst = max(self._worst, 1 + (now_s - item.deadline_s) / (LEAD * BLOCK_S))
                if now_s > item.deadline_s:
                    client.late_s.append(self.now_s)

    def _look_again(self) -> None:
        """Four times a second, note what is to be seen."""
        streams = [client for client in self.clients if client.stream in self.engine.streams]
        for client in streams:
            at = client.stream.ladder.at
            if at != (client.moves[-1][1] if client.moves else client.began_at):
                client.moves.append((self.now_s, at))
        self.admission.measure()
        period_s = THRESHOLDS.period_s
        steps = tuple(client.stream.ladder.at for client in streams)
        busy, self._busy_s = self._busy_s / period_s, 0.0
        self.looks.append(Look(self.now_s, busy, self.thread.blocks_at_once, steps, max(0.0, self._worst)))
        self._worst = 0.0
        self.machine.at(self.began_s + next(self._period) * period_s, self._look_again)
