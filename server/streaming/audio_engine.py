"""The threads that render every stream, one per core.

A hop through an executor costs a millisecond per block; a thread that stays awake for its streams costs none. A stream
stays with the thread that was least busy when it came. Impulse responses (IRs) are computed by a pool of workers and
picked up at the next block: an audio thread waits for no field and no network.

**When blocks fall due.** Every block of a stream is due at a whole number of block durations from the stream's origin.
Were all origins arbitrary, a thread would wake for every block of every stream, and each time the interpreter's lock,
the renderer's call and the way to the event loop would cost about what rendering does; were all the same, the first
stream rendered would wait for the last. So a thread offers `PHASES` instants per block duration, evenly apart, gives a
new stream the one with the fewest others, and renders what is due at an instant in one call without the lock, or, where
it fell behind, as much of it as a tick has time for.

**Under load**, two blocks of a stream are rendered at once, or four, or eight: those after the first cost less
rendering, for much of what they read is in the caches, and hardly any of what waking, messages and the way to the event
loop cost. They are ready before they are due, so poses are heard up to so many blocks later. The streams of an instant
take turns with it, so that every instant has as much to do.

**What a stream gets.** Four times a second a thread measures what it and its streams went through, and does what the
load policy decides (`server.streaming.load_policy`): how many blocks at once, which quality, how often responses.

Messages that may call for an IR wake the thread at once, which asks for the IR and renders nothing early. Streams take
turns with that (`server.streaming.request_queue`).

Who may touch what: a `Stream` belongs to its audio thread, but for `Stream.offer`; `AudioEngine` to the event loop.
"""

import logging
import math
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from operator import attrgetter
from typing import NamedTuple, get_args

from server.protocol.server_messages import LevelReason
from server.rendering.renderer import render_all
from server.runtime.priority import become_real_time
from server.runtime.thread_watch import Watched
from server.runtime.workers import Workers
from server.streaming.load_policy import LoadState, Measurement, RenderAhead, ThreadState, decide, requests_at_once
from server.streaming.load_thresholds import THRESHOLDS, Thresholds
from server.streaming.request_queue import RequestQueue
from server.streaming.stream import Outgoing, Stream, StreamFailed

PHASES = 2
"""Four streams of 16 emitters cost their two threads 9 % less than at four, and poses are heard 0.4 ms later."""
_APART = 5
"""Places from one that is taken to the next: a number without a divisor in common with how many there are."""
_EARLY_S = 0.0002
"""Blocks due within that are rendered now: sooner than one could sleep and wake again."""
_MOST_AT_A_TICK = 1.5
"""What is rendered at a tick takes about so many blocks' time, of the shortest, or is of one stream."""
_GIVE_WAY_S = 0.001
"""How long an audio thread that would sleep less waits for the event loop at the most, about twice as long as the loop
takes. Where both have but one core, and the thread hardly sleeps, the loop got nothing of it for up to 0.1 s: blocks
were ready in time and sent too late."""
_SWITCH_S = 0.0005
"""How long another thread may keep the interpreter's lock from an audio thread. With the usual 5 ms, one that is busy
half of the time holds audio up for longer than blocks last."""
_STOP_S = 1.0
_FAILED = "a stream failed and is closed"
_logger = logging.getLogger(__name__)

Post = Callable[[Callable[[], None]], object]
"""Runs a call on the event loop (`loop.call_soon_threadsafe`)."""


class AudioEngine:
    """Renders streams until stopped.

    `workers` computes IRs; each stream has at most one request with it. `thresholds` are those of the load policy.
    `is_real_time` asks the system to schedule audio threads before all others. Its threads are watched
    (`server.runtime.thread_watch`).
    """

    patience_s = 1.0
    """How long a tick may take; it takes milliseconds."""

    def __init__(
        self,
        post: Post,
        workers: Workers,
        *,
        threads: int = 1,
        is_real_time: bool = False,
        thresholds: Thresholds = THRESHOLDS,
        time_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._workers = workers
        self._thresholds = thresholds
        self.threads = [
            AudioThread(post, workers, number=number, is_real_time=is_real_time, thresholds=thresholds, time_s=time_s)
            for number in range(threads)
        ]
        self._thread_of: dict[Stream, AudioThread] = {}
        self._switch_s_before = sys.getswitchinterval()

    def start(self) -> None:
        sys.setswitchinterval(_SWITCH_S)
        for thread in self.threads:
            thread.start()

    def stop(self) -> None:
        """Return once the threads have ended, which takes one tick; of one that is stuck, without that."""
        for thread in self.threads:
            thread.stop()
        until_s = time.monotonic() + _STOP_S
        for thread in self.threads:
            thread.join(max(0.0, until_s - time.monotonic()))
        sys.setswitchinterval(self._switch_s_before)

    @property
    def streams(self) -> tuple[Stream, ...]:
        """Those open, in the order they came."""
        return tuple(self._thread_of)

    @property
    def steps(self) -> Counter[LevelReason]:
        """How often streams were moved to other quality, by reason."""
        return sum((thread.steps for thread in self.threads), Counter())

    def open(self, stream: Stream) -> None:
        """Start a stream now, on the thread that is least busy."""
        loads = dict.fromkeys(self.threads, 0.0)
        for other, thread in self._thread_of.items():
            loads[thread] += max(self._thresholds.presumed_load, other.load)
        thread = min(self.threads, key=loads.__getitem__)
        self._thread_of[stream] = thread
        self._share_workers()
        thread.open(stream)

    def close(self, stream: Stream) -> None:
        """Stop rendering a stream; what it made before may still be delivered. Closing twice does no harm."""
        thread = self._thread_of.pop(stream, None)
        if thread is not None:
            self._share_workers()
            thread.close(stream)

    def replace(self, dead: Watched) -> None:
        """Start a thread in the place of one that died. Its streams go on there, unless it died at work on them: nobody
        knows their state then, and they have failed."""
        number, thread = next((number, each) for number, each in enumerate(self.threads) if each is dead)
        successor = self.threads[number] = thread.successor()
        for stream in self._streams_of(thread):
            self._thread_of[stream] = successor
            if thread.work_number is None:
                successor.open(stream)
            else:
                stream.deliver([StreamFailed()])
        self._share_workers()
        successor.start()

    def give_up(self, stuck: Watched) -> None:
        """Tell the streams of a thread that is stuck that they have failed."""
        for stream in self._streams_of(stuck):
            stream.deliver([StreamFailed()])

    def _streams_of(self, thread: Watched) -> list[Stream]:
        return [stream for stream, its_thread in self._thread_of.items() if its_thread is thread]

    def _share_workers(self) -> None:
        """Have threads with streams keep as many of them busy as each other."""
        sharing = set(self._thread_of.values())
        for thread in sharing:
            thread.turns.requests = requests_at_once(
                self._thresholds, workers=self._workers.threads, threads=len(sharing)
            )


class AudioThread:
    """Ticks its streams; `tick` is all that happens on it."""

    def __init__(
        self,
        post: Post,
        workers: Workers,
        *,
        number: int,
        is_real_time: bool,
        thresholds: Thresholds,
        time_s: Callable[[], float],
    ) -> None:
        self._post = post
        self._workers = workers
        self.turns = RequestQueue(1)
        """Of its streams, to ask for IRs."""
        self._number = number
        self._is_real_time = is_real_time
        self._thresholds = thresholds
        self._time_s = time_s
        # All reasons from the start: a reader on another thread must not find it growing.
        self.steps: Counter[LevelReason] = Counter(dict.fromkeys(get_args(LevelReason), 0))
        """Times that streams were moved to other quality."""
        self._load = ThreadState()
        self._busy_s = 0.0
        self._looked_s = time_s()
        self._streams: dict[Stream, int] = {}
        """With the place of each: its phase, and with which block it begins to be rendered several at once."""
        self._arrivals: deque[tuple[Stream, bool]] = deque()
        self._origin_s: float | None = None
        self._wake = threading.Event()
        self._has_arrived = threading.Event()
        """What was handed to the event loop."""
        self._has_arrived.set()
        self._is_stopping = False
        self._ticks = 0
        self._is_ticking = False
        self._thread = threading.Thread(target=self._run, name=f"nafir-audio-{number}", daemon=True)

    @property
    def blocks_at_once(self) -> int:
        """How many blocks of a stream it renders together."""
        return self._load.ahead.blocks

    @property
    def name(self) -> str:
        return self._thread.name

    @property
    def is_dead(self) -> bool:
        """Whether it has ended by itself."""
        return self._thread.ident is not None and not (self._thread.is_alive() or self._is_stopping)

    @property
    def work_number(self) -> int | None:
        """Which tick it is at; None between two. Of a thread that died, where it died."""
        return self._ticks if self._is_ticking else None

    def start(self) -> None:
        self._thread.start()

    def successor(self) -> "AudioThread":
        """One without streams, that counts on."""
        thread = AudioThread(
            self._post,
            self._workers,
            number=self._number,
            is_real_time=self._is_real_time,
            thresholds=self._thresholds,
            time_s=self._time_s,
        )
        thread.steps = self.steps
        return thread

    def stop(self) -> None:
        self._is_stopping = True
        self._wake.set()
        self._has_arrived.set()

    def join(self, timeout_s: float) -> None:
        if self._thread.ident is not None:
            self._thread.join(timeout_s)

    def open(self, stream: Stream) -> None:
        stream.attach(wake=self._wake.set, time_s=self._time_s, turns=self.turns)
        self._arrivals.append((stream, True))
        self._wake.set()

    def close(self, stream: Stream) -> None:
        self._arrivals.append((stream, False))
        self._wake.set()

    def tick(self) -> float | None:
        """Heed what waits, render what is due, and hand over what was made.

        Seconds until the next is due, None where no stream is to be rendered.
        """
        now_s = self._time_s()
        self._admit(now_s)
        made: dict[Stream, list[Outgoing]] = {}
        due: list[_Due] = []
        blocks_of = self._due(now_s)
        self.turns.deal(self._streams)
        for stream in tuple(self._streams):
            blocks = blocks_of.get(stream)
            if blocks is None and not stream.has_news and not self.turns.is_next(stream):
                continue
            try:
                made[stream] = stream.drain_inbox(self._workers)
                if blocks is not None:
                    began_s = self._time_s()
                    stream.session.begin_block()
                    # Of what it has just heard, something may have to be looked after block by block.
                    due.append(_Due(stream, min(blocks, self._blocks_of(stream)), self._time_s() - began_s))
            except Exception:
                _logger.exception(_FAILED)
                self._fail(stream, made)
        if due:
            self._render(due, made)
            self._busy_s += self._time_s() - now_s
        if now_s - self._looked_s >= self._thresholds.period_s:
            self._look(now_s, made)
        if any(made.values()):
            self._has_arrived.clear()
            self._post(lambda: self._deliver(made))
        next_s = min((stream.due_s for stream in self._streams), default=math.inf)
        return None if next_s == math.inf else next_s - self._time_s()

    def _due(self, now_s: float) -> dict[Stream, int]:
        """Whose blocks to render now, and how many: of all that are due those that are late soonest, as many as a tick
        has time for. A thread that fell behind has the first of them sent before it goes on."""
        soon_s = now_s + _EARLY_S
        due = sorted((stream for stream in self._streams if stream.due_s <= soon_s), key=attrgetter("deadline_s"))
        if due and self.blocks_at_once == self._thresholds.blocks_at_once[-1]:
            due += [stream for stream in self._streams if stream.due_s > soon_s and self._may_come_along(stream, now_s)]
        blocks_of: dict[Stream, int] = {}
        left_s = _MOST_AT_A_TICK * min((stream.block_s for stream in due), default=0.0)
        for stream in due:
            blocks = self._blocks_of(stream)
            left_s -= blocks * stream.load * stream.block_s
            if blocks_of and left_s < 0:
                break
            blocks_of[stream] = blocks
        return blocks_of

    def _may_come_along(self, stream: Stream, now_s: float) -> bool:
        """With the most blocks at once, those of the next instant are rendered together with this one's: half as many
        ticks, and hardly earlier than they are anyway."""
        early_s = stream.block_s / PHASES + _EARLY_S
        return stream.due_s <= now_s + early_s and stream.session.renderer.runs_by_itself

    def _blocks_of(self, stream: Stream) -> int:
        """How many blocks of a stream that is due are rendered now."""
        count = self.blocks_at_once
        if count == 1 or not stream.session.renderer.runs_by_itself:
            return 1
        assert self._origin_s is not None
        since_origin = math.floor((stream.due_s - self._origin_s) / stream.block_s + 0.5 / PHASES)
        return count - (since_origin - self._streams[stream] // PHASES) % count

    def _render(self, due: list["_Due"], made: dict[Stream, list[Outgoing]]) -> None:
        began_s = self._time_s()
        clocks = [each.stream.session.sample_clock for each in due]
        renderers = [each.stream.session.renderer for each in due for _ in range(each.blocks)]
        try:
            blocks = iter(render_all(renderers))
        except Exception:  # whose block it was shows when each is rendered alone
            _logger.exception("%d blocks rendered together failed", len(renderers))
            for each in due:
                if len(renderers) == 1:
                    self._fail(each.stream, made)
                else:
                    self._render([each._replace(blocks=1)], made)
            return
        now_s = self._time_s()
        each_s = (now_s - began_s) / len(renderers)
        for (stream, count, cost_s), clock in zip(due, clocks, strict=True):
            rendered = list(islice(blocks, count))
            try:
                made[stream] += stream.finish_blocks(clock, rendered, cost_s=cost_s + count * each_s, now_s=now_s)
            except Exception:
                _logger.exception(_FAILED)
                self._fail(stream, made)

    def _look(self, now_s: float, made: dict[Stream, list[Outgoing]]) -> None:
        """Measure what the thread and its streams went through, and do what the load policy decides."""
        busy, self._busy_s = self._busy_s / (now_s - self._looked_s), 0.0
        self._looked_s = now_s
        state = LoadState(self._load, {stream: stream.ladder for stream in self._streams})
        measurement = Measurement(now_s, busy, {stream: stream.sample_load(now_s) for stream in self._streams})
        state, decision = decide(self._thresholds, state, measurement)
        self._load = state.thread
        for stream, ladder in state.ladders.items():
            stream.ladder = ladder
        for stream, reason in decision.moved.items():
            made.setdefault(stream, []).extend(stream.follow_ladder(reason, now_s))
            self.steps[reason] += 1
        for stream in self._streams:
            stream.set_intervals(decision.ir_intervals_s[stream], decision.plan_intervals_s[stream])
            stream.company = len(self._streams)

    def _fail(self, stream: Stream, made: dict[Stream, list[Outgoing]]) -> None:
        """The boundary between streams: one that breaks leaves the others sounding."""
        del self._streams[stream]
        made.setdefault(stream, []).append(StreamFailed())

    def _admit(self, now_s: float) -> None:
        while self._arrivals:
            stream, is_opening = self._arrivals.popleft()
            if is_opening:
                if not self._streams:
                    self._load = replace(self._load, ahead=RenderAhead())
                place = self._freest_place(stream.block_s)
                stream.start(self._origin_of(place % PHASES, stream.block_s, now_s))
                self._streams[stream] = place
            else:
                self._streams.pop(stream, None)
                stream.leave()

    def _freest_place(self, block_s: float) -> int:
        """Where the fewest streams are of those with blocks as long: of its phase, and of those that would be rendered
        with it, two at once or more. Of equal ones, one that lies apart from those taken before: where one instant has
        more to do, the next is to have less, or neither the event loop nor IRs get anything for long."""
        taken = [place for stream, place in self._streams.items() if stream.block_s == block_s]
        *periods, cycle = [PHASES * count for count in self._thresholds.blocks_at_once]

        def company(place: int) -> list[int]:
            alike = [sum((other - place) % period == 0 for other in taken) for period in periods]
            # With the most at once, all phases of a block are rendered together.
            return [*alike, sum(other // PHASES == place // PHASES for other in taken), taken.count(place)]

        return min((number * _APART % cycle for number in range(cycle)), key=company)

    def _origin_of(self, phase: int, block_s: float, now_s: float) -> float:
        """The next instant of `phase` that lies a block ahead at least, so that the first has time to be rendered."""
        if self._origin_s is None:
            self._origin_s = now_s
        first_s = self._origin_s + phase / PHASES * block_s
        return first_s + math.ceil((now_s - first_s) / block_s + 1) * block_s

    def _run(self) -> None:
        if self._is_real_time and (reason := become_real_time()) is not None and self._number == 0:
            _logger.warning("audio threads run at ordinary priority: %s", reason)
        while not self._is_stopping:
            self._ticks += 1
            self._is_ticking = True
            wait_s = self.tick()
            self._is_ticking = False
            self._rest(wait_s)

    def _rest(self, wait_s: float | None) -> None:
        """Sleep until the next stream is due. Where there is no time for that, let the event loop have the core as long
        as it takes to send what was made: before that, nobody hears it."""
        if wait_s is not None and wait_s < _GIVE_WAY_S and not (self._is_stopping or self._has_arrived.is_set()):
            began_s = self._time_s()
            # Of several at once, all but the first are early.
            self._has_arrived.wait(_GIVE_WAY_S if wait_s <= 0 or self.blocks_at_once > 1 else wait_s)
            if wait_s < 0:
                self._busy_s += self._time_s() - began_s
            return
        if wait_s is None or wait_s > 0:
            self._wake.wait(wait_s)
        self._wake.clear()

    def _deliver(self, made: dict[Stream, list[Outgoing]]) -> None:
        """On the event loop."""
        try:
            for stream, outgoing in made.items():
                stream.deliver(outgoing)
        finally:
            self._has_arrived.set()


class _Due(NamedTuple):
    """So many blocks of a stream, which have cost `cost_s` so far."""

    stream: Stream
    blocks: int
    cost_s: float
