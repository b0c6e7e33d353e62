"""The threads that render every stream, one per core.

A hop through an executor costs a millisecond per block; a thread that stays awake for its streams costs none. A stream
opens on the least busy thread. Impulse responses (IRs) are computed by a pool of workers and picked up at the next
block: an audio thread never waits for a field or for the network.

**When blocks fall due.** Every block of a stream is due at a whole number of block durations from the stream's origin.
With arbitrary origins, a thread would wake for every block of every stream, and each time the interpreter's lock, the
call of the renderer and the way to the event loop would cost about as much as rendering does. With equal origins, the
first stream rendered would wait for the last. So a thread offers `PHASES` instants per block duration, evenly spaced,
and gives a new stream the instant with the fewest others. It renders all blocks due at an instant in one call without
the lock or, if it fell behind, as many of them as a tick has time for.

**Under load**, two, four or eight blocks of a stream are rendered at once. The blocks after the first cost less
rendering, since much of their data is in the caches, and hardly any of the cost of waking, messages and the way to the
event loop. They are ready before they are due, so poses take effect up to that many blocks later. The streams of an
instant render their groups of blocks at different times, so that every instant has equal work.

**What a stream gets.** Four times a second a thread measures its load and that of its streams, and carries out the
decision of the load policy (`server.streaming.load_policy`): how many blocks at once, which quality, how often
responses.

**Moves.** If threads become uneven, a stream moves from one to another (`server.streaming.balance`). The old thread
lets go of it when it has just rendered a block of it, so that nearly a whole block is left until the next is due, and
the event loop hands it to the new thread. Its samples and deadlines stay as they were. Its blocks are rendered at an
instant of the new thread, less than a block earlier than before.

A message that may call for an IR wakes the thread at once. The thread then requests the IR, but renders nothing early.
Streams take turns with requests (`server.streaming.request_queue`).

Thread safety: a `Stream` belongs to its audio thread, except for `Stream.offer`; an `AudioEngine` belongs to the event
loop.
"""

import logging
import math
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Set
from dataclasses import replace
from functools import partial
from itertools import islice
from operator import attrgetter
from typing import NamedTuple, get_args

from server.protocol.server_messages import LevelReason
from server.rendering.renderer import render_all
from server.runtime.priority import become_real_time
from server.runtime.thread_watch import Watched
from server.runtime.workers import Workers
from server.streaming.balance import BalanceState, ThreadLoad, balance
from server.streaming.headroom import LIMITS, saving
from server.streaming.load_policy import (
    LoadState,
    Measurement,
    RenderAhead,
    ThreadState,
    decide,
    longest_wait,
    requests_at_once,
)
from server.streaming.load_thresholds import THRESHOLDS, Thresholds
from server.streaming.request_queue import RequestQueue
from server.streaming.stream import Outgoing, Stream, StreamFailed

PHASES = 2
"""Instants per block duration. With two, four streams of 16 emitters cost their two threads 9 % less than with four,
and poses take effect 0.4 ms later."""
_APART = 5
"""Step from one place taken to the next: a number that has no divisor in common with the number of places."""
_EARLY_S = 0.0002
"""Blocks due within this time are rendered now: sleeping and waking again would take longer."""
_MOST_AT_A_TICK = 1.5
"""Rendering in one tick takes at most about this many durations of the shortest block, unless it is for a single
stream."""
_GIVE_WAY_S = 0.001
"""How long an audio thread with no time to sleep waits for the event loop at most, about twice as long as the loop
takes. When both shared one core and the thread hardly slept, the loop got no time for up to 0.1 s: blocks were ready in
time and sent too late."""
_SWITCH_S = 0.0005
"""How long another thread may keep the interpreter's lock from an audio thread. With the usual 5 ms, a thread that is
busy half of the time delays audio by more than a block."""
_STOP_S = 1.0
_STALE_S = 1.0
"""Age from which on a measurement says nothing of a thread. One that works measures four times a second."""
_FAILED = "a stream failed and is closed"
_logger = logging.getLogger(__name__)

Post = Callable[[Callable[[], None]], object]
"""Runs a call on the event loop (`loop.call_soon_threadsafe`)."""


class AudioEngine:
    """Renders streams until stopped.

    `workers` compute IRs; each stream has at most one request with them. `thresholds` are those of the load policy.
    `is_real_time` asks the system to schedule audio threads before all others. The threads are watched
    (`server.runtime.thread_watch`).
    """

    patience_s = 1.0
    """How long a tick may take before its thread counts as stuck; it usually takes milliseconds."""

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
        self._time_s = time_s
        self.threads = [
            AudioThread(
                post,
                workers,
                number=number,
                is_real_time=is_real_time,
                thresholds=thresholds,
                time_s=time_s,
                after_look=self._balance if threads > 1 else None,
            )
            for number in range(threads)
        ]
        self.moves = 0
        """How often a stream was moved to another thread."""
        self._thread_of: dict[Stream, AudioThread] = {}
        self._balance_state: BalanceState[Stream] = BalanceState()
        self._balanced_s = -math.inf
        self._switch_s_before = sys.getswitchinterval()

    def start(self) -> None:
        sys.setswitchinterval(_SWITCH_S)
        for thread in self.threads:
            thread.start()

    def stop(self) -> None:
        """Stop the threads and wait until they have ended, which takes one tick; give up on a stuck one after a
        second."""
        for thread in self.threads:
            thread.stop()
        until_s = time.monotonic() + _STOP_S
        for thread in self.threads:
            thread.join(max(0.0, until_s - time.monotonic()))
        sys.setswitchinterval(self._switch_s_before)

    @property
    def streams(self) -> tuple[Stream, ...]:
        """The open streams, in the order in which they were opened."""
        return tuple(self._thread_of)

    @property
    def workers(self) -> int:
        """The number of threads that compute IRs."""
        return self._workers.threads

    @property
    def has_first_work_waiting(self) -> bool:
        """Whether first IRs or plans wait for a worker."""
        return self._workers.has_urgent

    def streams_by_thread(self) -> dict["AudioThread", list[Stream]]:
        """Return the open streams of each thread."""
        streams: dict[AudioThread, list[Stream]] = {thread: [] for thread in self.threads}
        for stream, thread in self._thread_of.items():
            streams.setdefault(thread, []).append(stream)
        return streams

    @property
    def steps(self) -> Counter[LevelReason]:
        """How often the quality of a stream was changed, by reason."""
        return sum((thread.steps for thread in self.threads), Counter())

    def open(self, stream: Stream) -> None:
        """Start a stream now, on the least busy thread. If all of them are dead or stuck, on the least busy of all."""
        loads = self._loads()
        able = [thread for thread in self.threads if thread.busy_share is not None] or self.threads
        thread = min(able, key=lambda thread: sum(loads[thread].values()))
        self._thread_of[stream] = thread
        self._share_workers()
        thread.open(stream)

    def close(self, stream: Stream) -> None:
        """Stop rendering a stream; blocks made before may still be delivered. Closing twice does no harm."""
        thread = self._thread_of.pop(stream, None)
        if thread is not None:
            self._balance_state = self._balance_state.without(stream)
            self._share_workers()
            thread.close(stream)

    def replace(self, dead: Watched) -> None:
        """Start a thread to replace one that died. Its streams continue on the new one, unless it died while it worked
        on them: then their state is unknown, and they have failed."""
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
        """Tell the streams of a stuck thread that they have failed."""
        for stream in self._streams_of(stuck):
            stream.deliver([StreamFailed()])

    @property
    def demand(self) -> float:
        """How many cores the blocks of all streams take. It belongs to the event loop."""
        return sum(sum(streams.values()) for streams in self._loads().values())

    def loads(self) -> dict[str, tuple[int, float]]:
        """Number of streams of each thread, by name, and the share of the last period in which it rendered. Any thread
        may call this."""
        counts = Counter(tuple(self._thread_of.values()))
        return {thread.name: (counts[thread], thread.busy_share or 0.0) for thread in tuple(self.threads)}

    def _loads(self) -> dict["AudioThread", dict[Stream, float]]:
        """Return the share of a core of each stream, by thread. A stream that has just opened has shown little of what
        it will need, so it is taken to need what is expected of it, and no less than the others do on average."""
        heard = [stream.load for stream in self._thread_of if stream.is_measured]
        presumed = max(self._thresholds.presumed_load, sum(heard) / len(heard) if heard else 0.0)
        loads: dict[AudioThread, dict[Stream, float]] = {thread: {} for thread in self.threads}
        for stream, thread in self._thread_of.items():
            loads[thread][stream] = (
                stream.load if stream.is_measured else max(presumed, stream.load, stream.expected_load)
            )
        return loads

    def _balance(self) -> None:
        """Move a stream if the threads call for it. Audio threads post this whenever they have measured their load."""
        now_s = self._time_s()
        if now_s - self._balanced_s < self._thresholds.period_s:
            return
        self._balanced_s = now_s
        loads = self._loads()
        measured = [
            None if thread.busy_share is None else ThreadLoad(thread.busy_share, loads[thread])
            for thread in self.threads
        ]
        self._balance_state, move = balance(self._thresholds, self._balance_state, now_s, measured)
        if move is not None:
            source = self.threads[move.source]
            source.hand_over(move.key, partial(self._take_over, move.key, source, move.target))

    def _take_over(self, stream: Stream, source: "AudioThread", number: int) -> None:
        """Let a stream continue on the thread with this number, now that its old thread has let go of it."""
        if self._thread_of.get(stream) is not source:
            return  # it was closed, or continues on the successor of a thread that died
        thread = self._thread_of[stream] = self.threads[number]
        self.moves += 1
        self._share_workers()
        thread.take_over(stream)

    def _streams_of(self, thread: Watched) -> list[Stream]:
        return [stream for stream, its_thread in self._thread_of.items() if its_thread is thread]

    def _share_workers(self) -> None:
        """Give all threads with streams equal shares of the workers."""
        sharing = set(self._thread_of.values())
        for thread in sharing:
            thread.turns.requests = requests_at_once(
                self._thresholds, workers=self._workers.threads, threads=len(sharing)
            )


class AudioThread:
    """A thread that renders its streams by calling `tick` over and over."""

    def __init__(
        self,
        post: Post,
        workers: Workers,
        *,
        number: int,
        is_real_time: bool,
        thresholds: Thresholds,
        time_s: Callable[[], float],
        after_look: Callable[[], None] | None,
    ) -> None:
        self._post = post
        self._workers = workers
        self.turns = RequestQueue(1)
        """The turns of its streams to request IRs."""
        self._number = number
        self._is_real_time = is_real_time
        self._thresholds = thresholds
        self._time_s = time_s
        self._after_look = after_look
        """Posted to the event loop after each measurement."""
        # It has all reasons from the start: a reader on another thread must not see it grow.
        self.steps: Counter[LevelReason] = Counter(dict.fromkeys(get_args(LevelReason), 0))
        """How often the quality of a stream was changed, by reason."""
        self._load = ThreadState()
        self._busy_s = 0.0
        self._busy = 0.0
        self.mean_busy = 0.0
        """Share of the last second or so in which it rendered. Any thread may read it."""
        self.has_room_on_top = True
        """Whether a stream may step up to the top of its ladder. Any thread may set it."""
        self.others_wait = False
        """Whether others wait to be let in. Any thread may set it."""
        self.others_begin = False
        """Whether newcomers begin. Any thread may set it."""
        self.worker_pace = 1.0
        """Share of a core that a worker got lately while it computed IRs for its streams. Any thread may read it."""
        self.spare_cores = math.inf
        """Cores that are left to the IRs of its streams. Any thread may set it."""
        self.longest_wait = 0.0
        """The longest wait for IRs of the last period, as a share of the patience of the stream that waited. Any thread
        may read it."""
        self.least_blocks = 1
        """Least number of blocks at once, for newcomers whose work is still to come. Any thread may set it."""
        self._looked_s = time_s()
        self._streams: dict[Stream, int] = {}
        """The streams, each with its place: its phase, and the block at which its groups of blocks begin."""
        self._calls: deque[Callable[[float], None]] = deque()
        """What the next tick does first, with the time."""
        self._leaving: dict[Stream, Callable[[], None]] = {}
        """Streams to let go of, each with what is then called on the event loop."""
        self._origin_s: float | None = None
        self._wake = threading.Event()
        self._has_arrived = threading.Event()
        """Set once the event loop has handled everything it was given."""
        self._has_arrived.set()
        self._is_stopping = False
        self._ticks = 0
        self._is_ticking = False
        self._thread = threading.Thread(target=self._run, name=f"nafir-audio-{number}", daemon=True)

    @property
    def blocks_at_once(self) -> int:
        """How many blocks of a stream are rendered together."""
        return self._load.ahead.blocks

    @property
    def busy_share(self) -> float | None:
        """The share of the last period in which it rendered; None if it is dead or stuck. Any thread may call this."""
        if self.is_dead:
            return None
        if self._time_s() - self._looked_s <= _STALE_S:
            return self._busy
        return None if self._is_ticking else 0.0

    @property
    def name(self) -> str:
        return self._thread.name

    @property
    def is_dead(self) -> bool:
        """Whether the thread has ended without being stopped."""
        return self._thread.ident is not None and not (self._thread.is_alive() or self._is_stopping)

    @property
    def work_number(self) -> int | None:
        """The number of the tick in progress, None between two; for a dead thread, the tick in which it died."""
        return self._ticks if self._is_ticking else None

    def start(self) -> None:
        self._thread.start()

    def successor(self) -> "AudioThread":
        """Return a new thread without streams that continues the counts of this one."""
        thread = AudioThread(
            self._post,
            self._workers,
            number=self._number,
            is_real_time=self._is_real_time,
            thresholds=self._thresholds,
            time_s=self._time_s,
            after_look=self._after_look,
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
        """Start a stream."""
        self._attach(stream)
        self._call(partial(self._start, stream))

    def take_over(self, stream: Stream) -> None:
        """Continue a stream that another thread has let go of."""
        self._attach(stream)
        self._call(partial(self._continue, stream))

    def close(self, stream: Stream) -> None:
        self._call(partial(self._end, stream))

    def hand_over(self, stream: Stream, then: Callable[[], None]) -> None:
        """Let go of a stream after its next block, or at once if it is paused, and post `then` to the event loop, where
        it comes after the stream's output. If the stream is closed or fails before, nothing is called."""
        self._call(partial(self._leave, stream, then))

    def _attach(self, stream: Stream) -> None:
        stream.attach(wake=self._wake.set, time_s=self._time_s, turns=self.turns)

    def _call(self, call: Callable[[float], None]) -> None:
        self._calls.append(call)
        self._wake.set()

    def tick(self) -> float | None:
        """Process waiting messages and results, render the blocks that are due, and pass on the output.

        Return the seconds until the next block is due; None if there is no stream to render.
        """
        now_s = self._time_s()
        while self._calls:
            self._calls.popleft()(now_s)
        made: dict[Stream, list[Outgoing]] = {}
        due: list[_Due] = []
        blocks_of = self._due(now_s)
        self.turns.deal([member for stream in self._streams for member in stream.audience.members])
        for stream in tuple(self._streams):
            blocks = blocks_of.get(stream)
            is_next = any(self.turns.is_next(member) for member in stream.audience.members)
            if blocks is None and not stream.has_news and not is_next:
                continue
            try:
                made[stream] = stream.drain_inbox(self._workers)
                if blocks is not None:
                    began_s = self._time_s()
                    stream.audience.begin_block()
                    # After the messages just processed, the stream may have to be rendered block by block.
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
        if self._leaving:
            self._let_go({each.stream for each in due})
        next_s = min((stream.due_s for stream in self._streams), default=math.inf)
        return None if next_s == math.inf else next_s - self._time_s()

    def _due(self, now_s: float) -> dict[Stream, int]:
        """Return the streams to render now, with the number of blocks of each: of all that are due, those with the
        earliest deadlines, as many as a tick has time for. If the thread fell behind, the first of them are sent before
        it goes on."""
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
        """Return whether a stream of the next instant is rendered together with those of this one, at the highest
        number of blocks at once: this halves the ticks, and such blocks are early anyway."""
        early_s = stream.block_s / PHASES + _EARLY_S
        return stream.due_s <= now_s + early_s and stream.audience.runs_by_itself

    def _blocks_of(self, stream: Stream) -> int:
        """Return how many blocks of a stream that is due to render now."""
        count = self.blocks_at_once
        if count == 1 or not stream.audience.runs_by_itself:
            return 1
        assert self._origin_s is not None
        since_origin = math.floor((stream.due_s - self._origin_s) / stream.block_s + 0.5 / PHASES)
        return count - (since_origin - self._streams[stream] // PHASES) % count

    def _render(self, due: list["_Due"], made: dict[Stream, list[Outgoing]]) -> None:
        began_s = self._time_s()
        clocks = [each.stream.session.sample_clock for each in due]
        renderers_of = [each.stream.audience.renderers(each.blocks) for each in due]
        renderers = [renderer for some in renderers_of for renderer in some]
        try:
            blocks = iter(render_all(renderers))
        except Exception:  # rendering each alone shows which one fails
            _logger.exception("%d blocks rendered together failed", len(renderers))
            for each in due:
                if len(due) == 1 and each.blocks == 1:
                    self._fail(each.stream, made)
                else:
                    self._render([each._replace(blocks=1)], made)
            return
        now_s = self._time_s()
        each_s = (now_s - began_s) / len(renderers)
        for (stream, _, cost_s), clock, own in zip(due, clocks, renderers_of, strict=True):
            rendered = list(islice(blocks, len(own)))
            try:
                made[stream] += stream.finish_blocks(clock, rendered, cost_s=cost_s + len(own) * each_s, now_s=now_s)
            except Exception:
                _logger.exception(_FAILED)
                self._fail(stream, made)

    def _look(self, now_s: float, made: dict[Stream, list[Outgoing]]) -> None:
        """Measure the load of the thread and its streams, and carry out the decision of the load policy."""
        period_s = now_s - self._looked_s
        self._busy = busy = self._busy_s / period_s
        self._busy_s = 0.0
        self._looked_s = now_s
        self.mean_busy += self._thresholds.newest_weight * (busy - self.mean_busy)
        saved, kept = saving(LIMITS, self.blocks_at_once), math.exp(-period_s / LIMITS.memory_s)
        requested = [stream.note_cost(period_s=period_s, saving=saved, memory=kept) for stream in self._streams]
        if duration_s := sum(each.duration_s for each in requested):
            pace = min(1.0, sum(each.cpu_s for each in requested) / duration_s)
            self.worker_pace += self._thresholds.newest_weight * (pace - self.worker_pace)
        state = LoadState(self._load, {stream: stream.ladder for stream in self._streams})
        samples = {stream: stream.sample_load(now_s) for stream in self._streams}
        measurement = Measurement(
            now_s,
            busy,
            samples,
            self.least_blocks,
            self.has_room_on_top,
            others_wait=self.others_wait,
            others_begin=self.others_begin,
            spare_cores=self.spare_cores,
        )
        self.longest_wait = longest_wait(self._thresholds, state, measurement)
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
        if self._after_look is not None:
            self._post(self._after_look)

    def _fail(self, stream: Stream, made: dict[Stream, list[Outgoing]]) -> None:
        """Drop a stream that failed; the others keep playing."""
        del self._streams[stream]
        made.setdefault(stream, []).append(StreamFailed())

    def _start(self, stream: Stream, now_s: float) -> None:
        if not self._streams:
            self._load = replace(self._load, ahead=RenderAhead())
            self.mean_busy = 0.0
        place = self._freest_place(stream.block_s)
        stream.start(self._origin_of(place % PHASES, stream.block_s, now_s))
        self._streams[stream] = place

    def _continue(self, stream: Stream, now_s: float) -> None:
        if not self._streams:
            self._load = replace(self._load, ahead=RenderAhead())
        if self._origin_s is None:
            self._origin_s = now_s
        block_s, due_s = stream.block_s, stream.clock.origin_s

        def early_s(place: int) -> float:
            assert self._origin_s is not None
            after_s = (due_s - self._origin_s - place % PHASES / PHASES * block_s) % block_s
            return 0.0 if block_s - after_s < _EARLY_S else after_s

        place = self._freest_place(block_s, early_s)
        stream.change_thread(early_s(place), now_s)
        self._streams[stream] = place
        self._load = self._load.restarted

    def _leave(self, stream: Stream, then: Callable[[], None], _: float) -> None:
        if stream in self._streams:
            self._leaving[stream] = then

    def _end(self, stream: Stream, _: float) -> None:
        self._streams.pop(stream, None)
        stream.leave()

    def _let_go(self, rendered: Set[Stream]) -> None:
        """Let go of streams that are to leave: of those just `rendered`, whose next block has the most time, and of
        those that are paused."""
        for stream, then in tuple(self._leaving.items()):
            if stream not in self._streams:  # it was closed or has failed
                del self._leaving[stream]
            elif stream in rendered or stream.due_s == math.inf:
                del self._leaving[stream], self._streams[stream]
                self._load = self._load.restarted
                self._post(then)

    def _freest_place(self, block_s: float, early_s: Callable[[int], float] = lambda _: 0.0) -> int:
        """Return the place with the fewest streams of the same block duration: in its phase, and among those that would
        be rendered with it, two blocks at once or more. Of equal phases, take that with the least `early_s`. Among
        equal places, take one apart from those taken before: an instant with more work should be followed by one with
        less, or the event loop and IRs get no time for long."""
        taken = [place for stream, place in self._streams.items() if stream.block_s == block_s]
        *periods, cycle = [PHASES * count for count in self._thresholds.blocks_at_once]

        def company(place: int) -> list[float]:
            phase = sum((other - place) % PHASES == 0 for other in taken)
            alike = [sum((other - place) % period == 0 for other in taken) for period in periods]
            # With the most blocks at once, all phases of a block are rendered together.
            return [
                phase,
                early_s(place),
                *alike,
                sum(other // PHASES == place // PHASES for other in taken),
                taken.count(place),
            ]

        return min((number * _APART % cycle for number in range(cycle)), key=company)

    def _origin_of(self, phase: int, block_s: float, now_s: float) -> float:
        """Return the next instant of `phase` that is at least one block ahead, so that there is time to render the
        first block."""
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
        """Sleep until the next stream is due. If there is no time to sleep, let the event loop have the core for as
        long as it takes to send the blocks: until then they are of no use."""
        if wait_s is not None and wait_s < _GIVE_WAY_S and not (self._is_stopping or self._has_arrived.is_set()):
            began_s = self._time_s()
            # With several blocks at once, all but the first are early.
            self._has_arrived.wait(_GIVE_WAY_S if wait_s <= 0 or self.blocks_at_once > 1 else wait_s)
            if wait_s < 0:
                self._busy_s += self._time_s() - began_s
            return
        if wait_s is None or wait_s > 0:
            self._wake.wait(wait_s)
        self._wake.clear()

    def _deliver(self, made: dict[Stream, list[Outgoing]]) -> None:
        """Deliver the output of a tick; runs on the event loop."""
        try:
            for stream, outgoing in made.items():
                stream.deliver(outgoing)
        finally:
            self._has_arrived.set()


class _Due(NamedTuple):
    """A stream with the number of its `blocks` to render, which have cost `cost_s` so far."""

    stream: Stream
    blocks: int
    cost_s: float
