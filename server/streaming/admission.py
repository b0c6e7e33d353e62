"""Lets streams and emitters in as long as nobody's sound breaks, and tells others when to come back.

An `Admission` measures the load of a server and asks the pure functions of `server.streaming.headroom` whether a
newcomer fits. Every stream that is let in has a `Place`. Until the stream has shown what it costs, it counts with what
it is expected to cost, so that many who come at once cannot all slip through. What streams really cost corrects what
newcomers are expected to.

An `Admission` belongs to the event loop, whose CPU time it measures; `headroom` may be read by any thread.
"""

import asyncio
import math
import random
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, Literal, get_args

from server.core.errors import RequestError
from server.streaming.audio_engine import AudioEngine, AudioThread
from server.streaming.beginnings import Beginnings
from server.streaming.headroom import (
    LIMITS,
    Correction,
    Limits,
    Scarce,
    ServerLoad,
    StreamCost,
    StreamKind,
    ThreadLoad,
    blocks_for_waits,
    blocks_needed,
    expected_cost,
    fits_on_top,
    freest_thread,
    headroom,
    obstacle,
    obstacle_to_change,
    retry_after_s,
    saving,
    seconds_to_next_ending,
    spare_cores,
    spare_for_irs,
    taken_elsewhere,
)
from server.streaming.load_policy import patience_s
from server.streaming.load_thresholds import THRESHOLDS, Thresholds
from server.streaming.quality_steps import QualityStep
from server.streaming.stream import Stream

Asked = Literal["upgrade", "hello", "add_emitter", "add_listener", "set_level", "set_effects"]
"""What was refused: a connection before it became a WebSocket, or a message."""

_WHY: Final[dict[Scarce, str]] = {
    "streams": "the server has no free stream",
    "rendering": "the server has no time left to render more",
    "event_loop": "the server has no time left to send more",
    "cores": "the server has no time left to render more",
    "responses": "the server has no time left for more impulse responses",
    "opening": "too many streams begin just now",
}
_KindOnStep = tuple[tuple[str, int, int, int | None], str, bool]
"""A kind of stream, its quality level, and whether it keeps later parts of responses, which makes requests cheaper."""
_REQUEST: Final = "request", "computations"
"""How HTTP requests are counted for whose computation there is no room."""
_HELD_SHARE: Final = 8
"""For so many open streams one place may be held for a stream that has lost its client. So losing connections on
purpose keeps nobody out."""
_COMES_BACK_S = 2.0
"""How much later than it was told a client may come back."""
_SHOWN_EMITTERS = 16
"""Streams that came last, by which it is judged how many emitters the next will have."""


@dataclass(frozen=True)
class Refusal:
    """Why something does not fit, and after how many seconds to ask again. `level` is a quality level at which a stream
    that insists on another would fit."""

    scarce: Scarce
    retry_after_s: int
    level: str | None = None

    @property
    def error(self) -> RequestError:
        hint = "" if self.level is None else f"; it would fit at level {self.level}"
        message = f"{_WHY[self.scarce]}{hint}: ask again in {self.retry_after_s} s"
        return RequestError("server_busy", message, status=503, retry_after_s=self.retry_after_s, level=self.level)


@dataclass(eq=False)
class Place:
    """A stream's place on a server. `emitters` have been asked for, and room is kept for `reserved` until `until_s`;
    until then it counts with its expected cost. The same goes for `listeners` and `seats`. `step` is the quality
    step on which it begins, on top of its ladder or not."""

    kind: StreamKind | None
    step: QualityStep
    is_top: bool
    thread: int
    emitters: int
    reserved: int
    until_s: float
    listeners: int = 1
    seats: int = 1
    is_live: bool = False
    stream: Stream | None = None
    is_kept: bool = False
    """Whether its stream has lost its client, who may come back."""
    is_asked: bool = False
    """Whether `step` is one that its stream asks for, and not the one on which it is."""

    @property
    def now_on(self) -> QualityStep:
        return self.step if self.stream is None or self.is_asked else self.stream.ladder.step

    @property
    def is_on_top(self) -> bool:
        return self.is_top if self.stream is None or self.is_asked else not self.stream.ladder.is_eased


def _call_later(seconds: float, call: Callable[[], None]) -> None:
    asyncio.get_running_loop().call_later(seconds, call)


class Admission:
    """The places of a server whose streams `engine` renders on `cores`. If it is not `is_on`, only the number of
    streams is limited, to `most_streams`.

    `time_s` is a clock, `loop_cpu_s` the CPU time of the calling thread, `luck` a random number from 0 to 1, and
    `call_later` runs a call on the event loop after some seconds.
    """

    def __init__(
        self,
        engine: AudioEngine,
        *,
        most_streams: int,
        cores: int,
        is_on: bool = True,
        limits: Limits = LIMITS,
        thresholds: Thresholds = THRESHOLDS,
        time_s: Callable[[], float] = time.monotonic,
        loop_cpu_s: Callable[[], float] = time.thread_time,
        luck: Callable[[], float] = random.random,
        call_later: Callable[[float, Callable[[], None]], object] = _call_later,
    ) -> None:
        self.refusals: Counter[tuple[str, str]] = Counter(
            {(asked, scarce): 0 for asked in get_args(Asked) for scarce in get_args(Scarce)} | {_REQUEST: 0}
        )
        """How often what was refused, and for lack of what."""
        self.headroom = 1.0
        """The share of the server that is free, from 0 to 1, at the last measurement."""
        self.spare_cores = float(cores)
        """Cores that streams left free at the last measurement."""
        self.background_share = math.inf
        """Share of a core that HTTP computations may take: half of what streams leave, and all of it without any."""
        self._engine = engine
        self._most_streams, self._cores, self._is_on = most_streams, cores, is_on
        self._limits, self._thresholds = limits, thresholds
        self._time_s, self._loop_cpu_s, self._luck = time_s, loop_cpu_s, luck
        self._places: dict[Place, None] = {}
        self._by_stream: dict[Stream, Place] = {}
        self._corrections: dict[_KindOnStep, Correction] = {}
        """By kind and quality level."""
        self._cheapest: dict[tuple[str, int, int, int | None], tuple[StreamKind, QualityStep]] = {}
        self._endings_s: deque[float] = deque(maxlen=limits.endings)
        self._refused_until_s: deque[float] = deque(maxlen=4 * most_streams)
        self._emitters: deque[int] = deque(maxlen=_SHOWN_EMITTERS)
        self._block_sent_s = limits.block_sent_s
        self._beginnings = Beginnings(
            spare_cores=float(cores),
            most_ahead_s=limits.most_opening_s,
            patience_s=limits.turn_patience_s,
            is_behind=lambda: engine.has_first_work_waiting or self._longest_wait > limits.full_waits,
            call_later=call_later,
            time_s=time_s,
        )
        self._measured_s, self._measured_cpu_s = time_s(), 0.0
        self._longest_wait, self._waited_s = 0.0, -math.inf
        """The longest wait for responses of the last second, as a share of patience, and when it was seen."""
        self._elsewhere = 0.0
        """Cores that workers do not get, of those that streams leave."""

    @property
    def streams(self) -> int:
        """The number of places that are taken."""
        return len(self._places)

    @property
    def held(self) -> int:
        """The number of places that are held for streams that have lost their clients."""
        return sum(place.is_kept for place in self._places)

    async def run(self) -> None:
        """Measure four times a second until cancelled."""
        self._measured_cpu_s = self._loop_cpu_s()
        while True:
            await asyncio.sleep(self._thresholds.period_s)
            self.measure()

    def measure(self) -> None:
        """Measure what the event loop takes and what streams have shown, and tell the audio threads what is coming."""
        now_s, cpu_s = self._time_s(), self._loop_cpu_s()
        passed_s, cpu_passed_s = now_s - self._measured_s, cpu_s - self._measured_cpu_s
        if passed_s <= 0:
            return
        self._measured_s, self._measured_cpu_s = now_s, cpu_s
        blocks_hz = sum(len(stream.audience.members) / stream.block_s for stream in self._engine.streams)
        if blocks_hz:
            # The event loop does other work too, so blocks take no more than what it took when it took least.
            seen_s = cpu_passed_s / passed_s / blocks_hz
            self._block_sent_s = min(seen_s, 1.01 * self._block_sent_s)
        self._note_waits(now_s)
        self._note_pace()
        self._learn(now_s)
        load = self.load()
        self.headroom = headroom(self._limits, self._thresholds, load)
        self.spare_cores = spare_cores(self._limits, self._thresholds, load)
        self._beginnings.spare_cores = spare_cores(self._limits, self._thresholds, self._load_now())
        left = self.spare_cores - load.demand - load.eased_demand
        self.background_share = max(self._limits.least_background, left / 2) if load.streams else math.inf
        for_waits = self._announce(load)
        has_room = not self._is_on or load.streams <= 1 or self._may_rise(load, now_s)
        begins = self._is_on and (self._beginnings.done_in_s > 0 or self._beginnings.turn_in_s > 0)
        for thread in self._engine.threads:
            thread.has_room_on_top, thread.others_wait = has_room, self._is_on and self._others_wait(now_s)
            thread.others_begin = begins
            thread.spare_cores = spare_for_irs(self._limits, self._thresholds, load, least=for_waits)

    def _note_waits(self, now_s: float) -> None:
        """Note how long streams have waited for responses lately, as a share of their patience."""
        longest = max((thread.longest_wait for thread in self._engine.threads if thread.busy_share), default=0.0)
        if longest >= self._longest_wait or now_s - self._waited_s > self._limits.full_waits_s:
            self._longest_wait, self._waited_s = longest, now_s

    def _note_pace(self) -> None:
        """Note what workers get of a core while they compute responses, and what others have of it."""
        paces = [thread.worker_pace for thread in self._engine.threads if thread.busy_share]
        alone = replace(self._load_now(), elsewhere=0.0)
        pace = sum(paces) / len(paces) if paces else 1.0
        self._elsewhere = taken_elsewhere(self._limits, self._thresholds, alone, pace)

    def _others_wait(self, now_s: float) -> bool:
        """Return whether clients that were refused are still to come back."""
        return any(until_s + _COMES_BACK_S > now_s for until_s in self._refused_until_s)

    def load(self) -> ServerLoad:
        """Return what all streams take, those with a place but not opened yet included."""
        return self._load_now().plus_all(
            (place.thread, self._expected_by_then(place)) for place in self._places if place.stream is None
        )

    def _load_now(self) -> ServerLoad:
        """Return what open streams take."""
        now_s = self._time_s()
        by_thread = self._engine.streams_by_thread()
        numbers = {thread: number for number, thread in enumerate(self._engine.threads)}
        alone = ServerLoad(
            threads=tuple(self._own_load(thread, by_thread[thread]) for thread in self._engine.threads),
            cores=self._cores,
            workers=self._engine.workers,
            opening_s=self._beginnings.done_in_s,
            turn_in_s=self._beginnings.turn_in_s,
            longest_wait=self._longest_wait,
            elsewhere=self._elsewhere,
            most_streams=self._most_streams,
        )
        return alone.plus_all(
            (numbers.get(thread, 0), self._cost_of(stream, now_s))
            for thread, streams in by_thread.items()
            for stream in streams
        )

    def offer(self, kind: StreamKind, step: QualityStep) -> None:
        """Note the cheapest step of a kind of streams, by which clients are turned away."""
        self._cheapest[kind.key] = kind, step

    def count_request(self) -> None:
        """Count an HTTP request that was refused because too many computations wait."""
        self.refusals[_REQUEST] += 1

    def turn_away(self) -> Refusal | None:
        """Return a refusal if not even the cheapest stream fits."""
        load = self.load()
        if self.streams >= self._most_streams:
            return self._refuse("upgrade", "streams")
        if not (self._is_on and self._cheapest):
            return None
        thread = freest_thread(self._limits, load)
        found: Scarce | None = None
        for kind, step in self._cheapest.values():
            found = self._obstacle(load, thread, self._cost_on(kind, step, 1, is_top=False))
            if found is None:
                return None
        return None if found is None else self._refuse("upgrade", found)

    def admit(
        self,
        kind: StreamKind | None,
        steps: Sequence[QualityStep],
        emitters: int | None = None,
        *,
        listeners: int = 1,
        others: Sequence[QualityStep] = (),
    ) -> Place | Refusal:
        """Return a place on the first of the `steps` on which a stream fits, which will have so many `listeners` and
        `emitters`, or as many emitters as streams had lately. If none fits, the refusal names a level of the `others`
        that does."""
        load = self.load()
        if self.streams >= self._most_streams:
            return self._refuse("hello", "streams")
        thread = freest_thread(self._limits, load)
        reserved = max(1, self._usual_emitters if emitters is None else emitters)
        if kind is None or not self._is_on:
            return self._take(kind, steps[0], thread, reserved, listeners, is_top=True)
        found: Scarce | None = None
        for number, step in enumerate(steps):
            cost = self._cost_on(kind, step, reserved, listeners, is_top=not number)
            found = self._obstacle(load, thread, cost)
            if found is None:
                return self._take(kind, step, thread, reserved, listeners, is_top=not number)
        assert found is not None
        fitting = (
            step.level
            for step in others
            if self._obstacle(load, thread, self._cost_on(kind, step, reserved, listeners, is_top=False)) is None
        )
        return self._refuse("hello", found, level=next(fitting, None))

    async def take_turn(self, place: Place, *, is_there: Callable[[], bool]) -> Refusal | None:
        """Wait until it is the turn of a place that was just taken to begin. If it does not come soon, or the client
        `is_there` no longer, give the place back and return a refusal."""
        turn: asyncio.Future[Refusal | None] = asyncio.get_running_loop().create_future()
        self.await_turn(place, lambda refusal: None if turn.done() else turn.set_result(refusal), is_there=is_there)
        return await turn

    def await_turn(
        self, place: Place, settle: Callable[[Refusal | None], None], *, is_there: Callable[[], bool] = lambda: True
    ) -> None:
        """Call `settle` as soon as it is the turn of a place: at once if nobody begins. If the turn does not come soon,
        the place is given back, and it gets a refusal."""

        def refuse() -> None:
            self.leave(place)
            settle(self._refuse("hello", "opening"))

        if place.kind is None or not self._is_on:
            settle(None)
            return
        self._beginnings.enter(
            self._expected_by_then(place).opening_s,
            partial(settle, None),
            refuse,
            is_wanted=lambda: place in self._places and is_there(),
        )

    def open(self, place: Place, stream: Stream) -> None:
        """Note that the stream of a place begins, before the engine opens it."""
        place.stream, place.is_kept, place.until_s = stream, False, self._time_s() + self._limits.reserved_s
        self._by_stream[stream] = place
        stream.expected_load = self._expected_by_then(place).rendering if place.kind else 0.0

    def keep(self, place: Place) -> bool:
        """Hold the place of a stream that has lost its client, with what the stream is expected to cost. Return False,
        and give the place back, if too many are held."""
        stream = place.stream
        if stream is None or self.held >= len(self._by_stream) // _HELD_SHARE:
            self.leave(place)
            return False
        place.emitters = stream.session.emitter_count
        place.reserved, place.until_s = max(1, place.emitters), math.inf
        place.seats = place.listeners
        place.step, place.is_top, place.is_asked = place.now_on, place.is_on_top, False
        place.thread = self._thread_of(stream)
        place.stream, place.is_kept = None, True
        del self._by_stream[stream]
        return True

    def leave(self, place: Place) -> None:
        """Give a place back. A second call changes nothing."""
        if place not in self._places:
            return
        del self._places[place]
        if place.stream is not None:
            del self._by_stream[place.stream]
        if place.stream is not None or place.is_kept:
            self._endings_s.append(self._time_s())
            self._emitters.append(max(1, place.emitters))

    def add_emitter(self, place: Place, *, is_live: bool) -> Refusal | None:
        """Make room for another emitter of a stream, or return a refusal."""
        self._count_emitters(place)
        now_s = self._time_s()
        after = replace(place, emitters=place.emitters + 1, is_live=place.is_live or is_live)
        is_reserved = after.emitters <= place.reserved and now_s < place.until_s and after.is_live == place.is_live
        if not is_reserved and (found := self._found(place, after)) is not None:
            return self._refuse("add_emitter", found)
        place.emitters, place.is_live = after.emitters, after.is_live
        place.reserved = max(place.reserved, place.emitters)
        self._keep(place, now_s)
        return None

    def remove_emitter(self, place: Place) -> None:
        """Note that an emitter of a stream goes."""
        place.emitters = max(0, place.emitters - 1)

    def add_listener(self, place: Place) -> Refusal | None:
        """Make room for another listener of a stream, with all its emitters; or return a refusal."""
        self._count_emitters(place)
        now_s = self._time_s()
        after = replace(place, listeners=place.listeners + 1)
        is_reserved = after.listeners <= place.seats and now_s < place.until_s
        if not is_reserved and (found := self._found(place, after)) is not None:
            return self._refuse("add_listener", found)
        place.listeners = after.listeners
        place.seats = max(place.seats, place.listeners)
        self._keep(place, now_s)
        return None

    def remove_listener(self, place: Place) -> None:
        """Note that a listener of a stream goes."""
        place.listeners = max(1, place.listeners - 1)

    def choose(self, place: Place, steps: Sequence[QualityStep]) -> int | Refusal:
        """Return the number of the first of the `steps` to which a stream may change, or a refusal if there is none."""
        self._count_emitters(place)
        found: Scarce | None = None
        for number, step in enumerate(steps):
            found = self._found(place, replace(place, step=step, is_top=not number, is_asked=True))
            if found is None:
                self._keep(place, self._time_s())
                return number
        assert found is not None
        return self._refuse("set_level", found)

    def add_effects(self, place: Place) -> Refusal | None:
        """Make room for a stream to have all effects, which it is expected to cost at first; or return a refusal."""
        self._count_emitters(place)
        found = self._found(place, place, is_whole=True)
        if found is not None:
            return self._refuse("set_effects", found)
        self._keep(place, self._time_s())
        return None

    def _count_emitters(self, place: Place) -> None:
        """Once a stream has shown what it takes, it has the emitters that it has."""
        if place.stream is not None and self._time_s() >= place.until_s:
            place.emitters = place.reserved = place.stream.session.emitter_count
            place.seats = place.listeners

    def _found(self, before: Place, after: Place, *, is_whole: bool = False) -> Scarce | None:
        """Return what there is too little of for a stream to change: by the difference of what is expected of it or, if
        `is_whole`, to all that is expected."""
        stream, kind = before.stream, before.kind
        if not self._is_on or kind is None or stream is None:
            return None
        load = self.load()
        thread = self._thread_of(stream)
        present = self._cost_of(stream, self._time_s())
        old, new = (self._expected(each, max(1, each.emitters)) for each in (before, after))
        base = StreamCost(0.0) if is_whole else present
        less = StreamCost(0.0) if is_whole else old
        added = max(0, after.emitters - before.emitters) / max(1, after.emitters)
        joining = after.listeners - before.listeners
        cost = StreamCost(
            rendering=max(0.0, base.rendering + new.rendering - less.rendering),
            loop=present.loop + new.loop - old.loop,
            encoding=present.encoding + new.encoding - old.encoding,
            request_s=max(0.0, base.request_s + new.request_s - less.request_s),
            rate_hz=new.rate_hz,
            patience_s=new.patience_s,
            opening_s=new.request_s * (joining / after.listeners if joining else added),
            is_top=after.is_on_top,
            is_live=present.is_live or after.is_live,
        )
        return obstacle_to_change(self._limits, self._thresholds, load, thread, present, cost)

    def _thread_of(self, stream: Stream) -> int:
        by_thread = self._engine.streams_by_thread()
        return next((number for number, each in enumerate(self._engine.threads) if stream in by_thread[each]), 0)

    def _keep(self, place: Place, now_s: float) -> None:
        """Count a stream with its expected cost for some time more."""
        place.until_s = max(place.until_s, now_s + self._limits.shown_after_s)
        if place.stream is not None and place.kind is not None:
            place.stream.expected_load = self._expected_by_then(place).rendering

    def _take(
        self, kind: StreamKind | None, step: QualityStep, thread: int, reserved: int, seats: int, *, is_top: bool
    ) -> Place:
        # Until its stream begins, a place is kept without end.
        place = Place(kind, step, is_top, thread, emitters=0, reserved=reserved, until_s=math.inf, seats=seats)
        self._places[place] = None
        if kind is not None and self._is_on:
            self._announce(self.load())
        return place

    def _refuse(self, asked: Asked, scarce: Scarce, *, level: str | None = None) -> Refusal:
        self.refusals[asked, scarce] += 1
        now_s, limits = self._time_s(), self._limits
        while self._refused_until_s and self._refused_until_s[0] <= now_s:
            self._refused_until_s.popleft()
        next_s = seconds_to_next_ending(limits, self._endings_s, now_s, streams=len(self._places))
        if scarce == "opening":
            next_s = self._limits.most_opening_s
        seconds = retry_after_s(limits, next_ending_s=next_s, waiting=len(self._refused_until_s), luck=self._luck())
        if asked in {"upgrade", "hello"}:
            self._refused_until_s.append(now_s + seconds)
        return Refusal(scarce, seconds, level)

    def _obstacle(self, load: ServerLoad, thread: int, cost: StreamCost) -> Scarce | None:
        return obstacle(self._limits, self._thresholds, load, thread, cost)

    def _cost_on(
        self, kind: StreamKind, step: QualityStep, emitters: int, listeners: int = 1, *, is_top: bool
    ) -> StreamCost:
        place = Place(kind, step, is_top, 0, emitters=emitters, reserved=emitters, until_s=0.0, listeners=listeners)
        return self._expected(place, emitters)

    def _expected_by_then(self, place: Place) -> StreamCost:
        """What a stream is expected to take once it has all the emitters and listeners for which room is kept."""
        there = replace(place, listeners=max(place.listeners, place.seats))
        return self._expected(there, max(place.emitters, place.reserved))

    def _expected(self, place: Place, emitters: int) -> StreamCost:
        if place.kind is None:
            return StreamCost(self._thresholds.presumed_load)
        return expected_cost(
            self._limits,
            self._thresholds,
            place.kind,
            place.now_on,
            emitters=emitters,
            listeners=place.listeners,
            correction=self._corrections.get(_on_step(place.kind, place.now_on), Correction()),
            block_sent_s=self._block_sent_s,
            is_top=place.is_on_top,
            is_live=place.is_live,
        )

    def _cost_of(self, stream: Stream, now_s: float) -> StreamCost:
        """Return what an open stream counts with: what it has shown or, until it has shown it, what is expected."""
        shown = stream.shown
        cost = StreamCost(
            rendering=shown.rendering,
            loop=self._block_sent_s / stream.block_s * len(stream.audience.members),
            encoding=stream.encoding_load,
            request_s=stream.request_s if shown.responses > 0 else 0.0,
            rate_hz=shown.responses / stream.request_s if stream.request_s else 0.0,
            patience_s=patience_s(self._thresholds, stream.ladder.step) if shown.responses > 0 else math.inf,
            is_top=not stream.ladder.is_eased,
            is_live=shown.is_live,
        )
        place = self._by_stream.get(stream)
        if place is None or place.kind is None or now_s >= place.until_s:
            stream.expected_load = 0.0
            return cost
        expected = self._expected_by_then(place)
        return replace(
            cost,
            loop=max(cost.loop, expected.loop),
            rendering=max(cost.rendering, expected.rendering),
            encoding=max(cost.encoding, expected.encoding),
            request_s=max(cost.request_s, expected.request_s),
            rate_hz=max(cost.rate_hz, expected.rate_hz),
            patience_s=expected.patience_s,
            is_live=cost.is_live or expected.is_live,
        )

    def _may_rise(self, load: ServerLoad, now_s: float) -> bool:
        """Return whether whichever stream is the next to reach the top of its ladder fits there."""
        return all(
            fits_on_top(
                self._limits,
                self._thresholds,
                load,
                self._request_on_top_s(stream),
                eased=self._cost_of(stream, now_s),
            )
            for stream in self._engine.streams
            if stream.ladder.is_eased
        )

    def _request_on_top_s(self, stream: Stream) -> float:
        """Return the CPU time of a request for IRs if the stream stood on top of its ladder, where all are computed
        whole."""
        place = self._by_stream.get(stream)
        if place is None or place.kind is None or not stream.ladder.is_eased:
            return stream.request_s
        top = stream.ladder.steps[0]
        expected = expected_cost(
            self._limits,
            self._thresholds,
            place.kind,
            top,
            emitters=stream.session.emitter_count,
            listeners=len(stream.audience.members),
            correction=self._corrections.get(_on_step(place.kind, top), Correction()),
        )
        return max(stream.request_s, expected.request_s)

    def _own_load(self, thread: AudioThread, streams: list[Stream]) -> ThreadLoad:
        """Return what a thread takes besides the blocks of its streams."""
        if not streams:
            return ThreadLoad()
        saved = saving(self._limits, thread.blocks_at_once)
        return ThreadLoad(ahead=max(0.0, thread.mean_busy - sum(stream.load for stream in streams)) / saved)

    def _announce(self, load: ServerLoad) -> int:
        """Have each thread render as many blocks at once as it will need for those who come, and for IRs to be in time;
        return as many as the latter takes."""
        now_s = self._time_s()
        others_come = self._others_wait(now_s) or any(place.until_s > now_s for place in self._places)
        for_waits = blocks_for_waits(self._limits, self._thresholds, load, others_come=others_come)
        for number, thread in enumerate(self._engine.threads):
            is_expecting = any(
                place.until_s > self._time_s() and place.thread == number and place.kind is not None
                for place in self._places
            )
            needed = blocks_needed(self._limits, self._thresholds, load.threads[number]) if is_expecting else 1
            thread.least_blocks = max(needed, for_waits) if self._is_on else 1
        return for_waits if self._is_on else 1

    def _learn(self, now_s: float) -> None:
        """Correct what streams of each kind are expected to cost by what they do cost."""
        weight, low, high = (
            self._limits.correction_weight,
            self._limits.least_correction,
            self._limits.most_correction,
        )
        for stream, place in self._by_stream.items():
            if place.kind is None or now_s < place.until_s:
                continue
            emitters = stream.session.emitter_count
            key = _on_step(place.kind, stream.ladder.step)
            correction = self._corrections.get(key, Correction())
            plain = expected_cost(
                self._limits,
                self._thresholds,
                place.kind,
                stream.ladder.step,
                emitters=max(1, emitters),
                listeners=len(stream.audience.members),
            )
            rendering = min(high, max(low, stream.shown.rendering / plain.rendering))
            requests = correction.requests
            if stream.request_s and plain.request_s:
                requests = min(high, max(low, stream.request_s / plain.request_s))
            self._corrections[key] = Correction(
                correction.rendering + weight * (rendering - correction.rendering),
                correction.requests + weight * (requests - correction.requests),
            )

    @property
    def _usual_emitters(self) -> int:
        """The number of emitters of the streams that came last."""
        counts = [*self._emitters, *(max(1, place.emitters) for place in self._places if place.stream is not None)]
        return round(sum(counts[-_SHOWN_EMITTERS:]) / len(counts[-_SHOWN_EMITTERS:])) if counts else 1


def _on_step(kind: StreamKind, step: QualityStep) -> _KindOnStep:
    return kind.key, step.level, step.late_reach_m > 0
