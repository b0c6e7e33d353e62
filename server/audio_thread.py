"""The one thread that renders every stream.

A hop through an executor costs a millisecond per block; a thread that stays awake for all streams costs none. Each tick
renders at most one block per stream and hands everything it made to the event loop in one call. Impulse responses (IRs)
are computed by a pool of workers and picked up at the next block: the audio thread never waits for one.

Who may touch what: a `Session` belongs to the audio thread; `Stream.offer` and the public methods of `AudioThread` may
be called from any thread.
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from functools import partial

import numpy as np

from server.field.field import AcousticField
from server.pacing import StreamClock
from server.protocol import AudioBlock, ClientMessage, Durations, ServerMessage, Status
from server.session import IrRequest, IrResponse, Session, compute_irs

MAX_WAITING_MESSAGES = 256
_MAX_BEHIND_S = 0.5
_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class TimedBlock:
    """A block on its way out; after `deadline_s` of the audio thread's clock it is late."""

    block: AudioBlock
    deadline_s: float


@dataclass(frozen=True)
class StreamFailed:
    """Rendering raised: nothing more will come from this stream."""


Outgoing = ServerMessage | TimedBlock | StreamFailed


class Stream:
    """A session in time: its clock, what waits to go in, and how long things take.

    `deliver` is called on the event loop with what the stream made, in order.
    """

    def __init__(
        self,
        session: Session,
        field: AcousticField,
        *,
        block_s: float,
        lead: int,
        deliver: Callable[[list[Outgoing]], None],
    ) -> None:
        self.session = session
        self.deliver = deliver
        self.blocks_late = 0
        """Counted by whoever sends the blocks, since only it knows when they left."""
        self._field = field
        self._block_s = block_s
        self._lead = lead
        self._clock: StreamClock | None = None
        self._next_block = 0
        self._messages: deque[ClientMessage] = deque()
        self._answers: deque[tuple[IrRequest, Future[tuple[IrResponse, float]]]] = deque()
        self._render_times_s: list[float] = []
        self._ir_times_s: list[float] = []
        self._next_status_s = 1.0

    def offer(self, message: ClientMessage) -> bool:
        """Leave a message for the next block; False, and the message refused, where too many wait already."""
        if len(self._messages) >= MAX_WAITING_MESSAGES:
            return False
        self._messages.append(message)
        return True

    def start(self, now_s: float) -> None:
        """The origin lies one block ahead, so that the first block has time to be rendered."""
        self._clock = StreamClock(origin_s=now_s + self._block_s, block_s=self._block_s, lead=self._lead)

    def due_s(self) -> float:
        assert self._clock is not None
        return self._clock.due_s(self._next_block)

    def step(self, workers: Executor, time_s: Callable[[], float]) -> list[Outgoing]:
        """Take in what waits, ask for IRs, render one block."""
        assert self._clock is not None
        outgoing: list[Outgoing] = []
        for _ in range(len(self._messages)):
            outgoing += self.session.receive(self._messages.popleft())
        while self._answers:
            outgoing += self._take_answer(*self._answers.popleft())
        if (request := self.session.take_request()) is not None:
            answer = workers.submit(_compute_timed, self._field, request, self.session)
            answer.add_done_callback(partial(self._keep_answer, request))

        started_s = time_s()
        block = self.session.render_block()
        finished_s = time_s()
        self._render_times_s.append(finished_s - started_s)
        if block is not None:
            outgoing.append(TimedBlock(block, self._clock.deadline_s(self._next_block)))
        if self._clock.ahead_s(self._next_block, finished_s) < -_MAX_BEHIND_S:
            self._clock.slip(self._next_block, finished_s)
        self._next_block += 1
        if self._next_block * self._block_s >= self._next_status_s:
            self._next_status_s += 1.0
            outgoing.append(self._status(finished_s))
        return outgoing

    def _keep_answer(self, request: IrRequest, answer: Future[tuple[IrResponse, float]]) -> None:
        self._answers.append((request, answer))  # on the worker's thread

    def _take_answer(self, request: IrRequest, answer: Future[tuple[IrResponse, float]]) -> list[ServerMessage]:
        if (failure := answer.exception()) is not None:
            _logger.error("no impulse response for pose %d", request.pose_id, exc_info=failure)
            return self.session.give_up(request)
        response, duration_s = answer.result()
        self._ir_times_s.append(duration_s)
        return self.session.accept(response)

    def _status(self, now_s: float) -> Status:
        assert self._clock is not None
        session = self.session
        status = Status(
            sample_clock=session.sample_clock,
            blocks_sent=session.window.sent,
            blocks_late=self.blocks_late,
            blocks_dropped=session.blocks_dropped,
            unacknowledged=session.window.unacknowledged,
            buffer_ms=round(self._clock.ahead_s(self._next_block, now_s) * 1000, 3),
            render_ms=_durations(self._render_times_s),
            ir_ms=_durations(self._ir_times_s),
            ir_exchanges=session.ir_exchanges,
        )
        self._render_times_s.clear()
        self._ir_times_s.clear()
        return status


class AudioThread:
    """Ticks streams until stopped.

    `post` runs a call on the event loop (`loop.call_soon_threadsafe`). `workers` computes IRs; each stream has at most
    one request with it, so its queue is never longer than there are streams.
    """

    def __init__(
        self,
        post: Callable[[Callable[[], None]], object],
        workers: Executor,
        *,
        time_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._post = post
        self._workers = workers
        self._time_s = time_s
        self._streams: list[Stream] = []
        self._arrivals: deque[tuple[Stream, bool]] = deque()
        self._wake = threading.Event()
        self._is_stopping = False
        self._thread = threading.Thread(target=self._run, name="nafir-audio", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """Return once the thread has ended, which takes one tick."""
        self._is_stopping = True
        self._wake.set()
        self._thread.join()

    def open(self, stream: Stream) -> None:
        """Start a stream now."""
        self._arrivals.append((stream, True))
        self._wake.set()

    def close(self, stream: Stream) -> None:
        """Stop rendering a stream; what it made before may still be delivered. Closing twice does no harm."""
        self._arrivals.append((stream, False))
        self._wake.set()

    def tick(self) -> float | None:
        """Render one block of every stream that is due one. Seconds until the next is due, None without streams."""
        now_s = self._time_s()
        self._admit(now_s)
        made: list[tuple[Stream, list[Outgoing]]] = []
        for stream in tuple(self._streams):
            if stream.due_s() > now_s:
                continue
            try:
                made.append((stream, stream.step(self._workers, self._time_s)))
            except Exception:  # the boundary between streams: one that breaks leaves the others sounding
                _logger.exception("a stream failed and is closed")
                self._streams.remove(stream)
                made.append((stream, [StreamFailed()]))
        if made:
            self._post(lambda: _deliver(made))
        if not self._streams:
            return None
        return min(stream.due_s() for stream in self._streams) - self._time_s()

    def _admit(self, now_s: float) -> None:
        while self._arrivals:
            stream, is_opening = self._arrivals.popleft()
            if is_opening:
                stream.start(now_s)
                self._streams.append(stream)
            elif stream in self._streams:
                self._streams.remove(stream)

    def _run(self) -> None:
        while not self._is_stopping:
            wait_s = self.tick()
            if wait_s is None or wait_s > 0:
                self._wake.wait(wait_s)
            self._wake.clear()


def _deliver(made: list[tuple[Stream, list[Outgoing]]]) -> None:
    for stream, outgoing in made:
        stream.deliver(outgoing)


def _compute_timed(field: AcousticField, request: IrRequest, session: Session) -> tuple[IrResponse, float]:
    started_s = time.perf_counter()
    response = compute_irs(field, request, session.prepare)
    return response, time.perf_counter() - started_s


def _durations(times_s: list[float]) -> Durations:
    if not times_s:
        return Durations(p50=None, p99=None)
    p50, p99 = np.percentile(times_s, (50, 99)) * 1000
    return Durations(p50=round(float(p50), 3), p99=round(float(p99), 3))
