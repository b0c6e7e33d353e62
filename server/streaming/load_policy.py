"""What an audio thread and its streams do without when there is more to do than there is time: `decide`, a pure
function of one measurement. Nothing here waits, looks at a clock or keeps anything.

A thread measures four times a second what it and its streams went through. What was decided before, as far as it
matters, is a `LoadState`, which `decide` takes and gives back anew. In this order something is given up:

1. *Blocks at once*: a thread renders more blocks of a stream at once, which takes less of a core for each; poses are
   heard up to so many blocks later.
2. *Responses*: below the top of its ladder a stream gets impulse responses (IRs) from an equal part of a share of a
   core, the smaller the busier the thread is.
3. *Quality*: a stream steps down its ladder (`server.streaming.quality_steps`).

Late blocks, or a thread with no time left, concern all its streams alike: those that stand best step down first, and
those that stand worst are the first to step back up, one at a time. IRs that are long in coming concern the stream that
waits for them. A stream that stepped down waits until the step shows before it steps again. One that steps up, and has
to step down soon after, waits twice as long the next time: near a limit, a stream stays below it.

Seconds are of one monotonic clock. The thresholds, with their reasons, are in `server.streaming.load_thresholds`.
"""

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Generic, TypeVar

from server.protocol.server_messages import LevelReason
from server.streaming.load_thresholds import Thresholds
from server.streaming.quality_steps import QualityStep

Key = TypeVar("Key", bound=Hashable)
"""Tells the streams of a thread apart."""


@dataclass(frozen=True)
class LoadSample:
    """What a stream went through in the period just over.

    `lateness` is how long after it was due a block was ready, at worst, as a share of what the client has in hand: 1 is
    late. `ir_wait_s` is the longest time from asking for IRs to having them, so far where it still waits; None where it
    asked for none. `request_s` and `plan_s` are seconds of CPU time that a request for IRs and a plan of effects have
    taken of late.
    """

    lateness: float = 0.0
    ir_wait_s: float | None = None
    request_s: float = 0.0
    plan_s: float = 0.0


@dataclass(frozen=True)
class Measurement(Generic[Key]):
    """What an audio thread went through in the period that ended `now_s`: for the share `busy` of it, it rendered."""

    now_s: float
    busy: float
    streams: Mapping[Key, LoadSample]

    @property
    def lateness(self) -> float:
        """The worst of all streams."""
        return max((sample.lateness for sample in self.streams.values()), default=0.0)


@dataclass(frozen=True)
class Ladder:
    """A stream's steps, best first, on which of them it stands, and how it has come there.

    `caution` multiplies how long all has to be well before it steps up. `rose_s` is when it stepped up last, as long as
    that may turn out to have been too early.
    """

    steps: tuple[QualityStep, ...]
    at: int = 0
    caution: int = 1
    moved_s: float = -math.inf
    rose_s: float | None = None
    well_since_s: float | None = None
    overloaded_periods: int = 0

    @property
    def step(self) -> QualityStep:
        return self.steps[self.at]

    @property
    def above(self) -> QualityStep:
        """The next better step, or this one at the top."""
        return self.steps[max(0, self.at - 1)]

    @property
    def is_eased(self) -> bool:
        """Whether it stands below its top."""
        return self.at > 0

    @property
    def is_lowest(self) -> bool:
        return self.at + 1 >= len(self.steps)


@dataclass(frozen=True)
class RenderAhead:
    """How many blocks of a stream a thread renders at once, and its mean busy share over so many `periods` since that
    changed."""

    blocks: int = 1
    mean_busy: float = 0.0
    periods: int = 0


@dataclass(frozen=True)
class ThreadState:
    """What a decision depends on beside the newest measurement, of a thread."""

    ahead: RenderAhead = RenderAhead()
    overloaded_periods: int = 0
    well_since_s: float | None = None
    moved_s: float = -math.inf
    """When it had its streams step down last."""


@dataclass(frozen=True)
class LoadState(Generic[Key]):
    """The same, of a thread and its streams."""

    thread: ThreadState
    ladders: Mapping[Key, Ladder]


@dataclass(frozen=True)
class Decision(Generic[Key]):
    """What follows: how many blocks of a stream are rendered at once, which streams have moved by one step and why, and
    the least seconds from one request for IRs, and from one plan of effects, to the next. `ir_share` is what IRs may
    take of a core."""

    blocks_at_once: int
    ir_share: float
    moved: Mapping[Key, LevelReason] = field(default_factory=dict)
    ir_intervals_s: Mapping[Key, float] = field(default_factory=dict)
    plan_intervals_s: Mapping[Key, float] = field(default_factory=dict)


def decide(
    thresholds: Thresholds, state: LoadState[Key], measurement: Measurement[Key]
) -> tuple[LoadState[Key], Decision[Key]]:
    """The state that follows, and what the thread and its streams are to do. `state` has a ladder for each stream that
    was measured."""
    # A thread that could make time before this measurement gets the chance to first.
    can_make_time = state.thread.ahead.blocks < thresholds.blocks_at_once[-1]
    thread = _judge_thread(thresholds, state.thread, measurement, can_make_time=can_make_time)
    ladders = {
        key: _judge_stream(thresholds, state.ladders[key], sample, measurement.now_s)
        for key, sample in measurement.streams.items()
    }
    thread, ladders, moved = _move(thresholds, thread, ladders, measurement)
    share = ir_share(thresholds, busy=measurement.busy)
    streams = len(measurement.streams)
    decision = Decision(
        thread.ahead.blocks,
        share,
        moved,
        {
            key: ir_interval_s(ladders[key], request_s=sample.request_s, streams=streams, share=share)
            for key, sample in measurement.streams.items()
        },
        {key: sample.plan_s * streams / thresholds.plan_share for key, sample in measurement.streams.items()},
    )
    return LoadState(thread, ladders), decision


def render_ahead(thresholds: Thresholds, ahead: RenderAhead, *, busy: float, lateness: float) -> RenderAhead:
    """After a period in which a thread rendered for the share `busy`, and a block was late by `lateness` at worst."""
    periods = ahead.periods + 1
    mean = ahead.mean_busy + max(1 / periods, thresholds.newest_weight) * (busy - ahead.mean_busy)
    numbers = thresholds.blocks_at_once
    at = numbers.index(ahead.blocks)
    has_mean = periods >= thresholds.mean_periods
    falls_behind = busy > thresholds.behind_busy and lateness > thresholds.behind_lateness
    if at + 1 < len(numbers) and (falls_behind or (has_mean and mean > thresholds.more_blocks_above[at])):
        return RenderAhead(numbers[at + 1], mean)
    if at > 0 and has_mean and mean / (1 - thresholds.saved_by_doubling) < thresholds.more_blocks_above[at - 1]:
        return RenderAhead(numbers[at - 1], mean)
    return RenderAhead(ahead.blocks, mean, periods)


def ir_share(thresholds: Thresholds, *, busy: float) -> float:
    """Of a core, for IRs of the streams of an audio thread that renders for a share `busy` of the time."""
    most = thresholds.ir_share
    return min(most, max(thresholds.shared_core - busy, thresholds.least_ir_share * most))


def ir_interval_s(ladder: Ladder, *, request_s: float, streams: int, share: float) -> float:
    """Least time from one request for IRs to the next. `request_s` of CPU time is what one takes; below the top of its
    ladder, a stream may take an equal part of a `share` of a core, with `streams` that do."""
    rate_hz = ladder.step.ir_rate_hz
    paced_s = 0.0 if rate_hz is None else 1 / rate_hz
    return max(paced_s, request_s * streams / share) if ladder.is_eased else paced_s


def requests_at_once(thresholds: Thresholds, *, workers: int, threads: int) -> int:
    """How many requests for IRs a thread may have unanswered, of so many threads with streams that share workers."""
    return thresholds.requests_ahead + math.ceil(workers / threads)


def patience_s(thresholds: Thresholds, step: QualityStep) -> float:
    """How long IRs may take from being asked for to being there."""
    if step.ir_rate_hz is None:
        return thresholds.patience_s
    return max(thresholds.patience_s, thresholds.patience_intervals / step.ir_rate_hz)


def _judge_thread(
    thresholds: Thresholds, thread: ThreadState, measurement: Measurement[Key], *, can_make_time: bool
) -> ThreadState:
    """With what the measurement says of the thread. One that `can_make_time` otherwise is not overloaded as long as no
    block is nearly late."""
    busy, lateness = measurement.busy, measurement.lateness
    is_overloaded = (busy > thresholds.full_busy and not can_make_time) or lateness > thresholds.tight
    is_well = busy <= thresholds.free_busy and lateness <= thresholds.easy
    return replace(
        thread,
        ahead=render_ahead(thresholds, thread.ahead, busy=busy, lateness=lateness),
        overloaded_periods=thread.overloaded_periods + 1 if is_overloaded else 0,
        well_since_s=_since(thread.well_since_s, measurement.now_s, is_so=is_well),
    )


def _judge_stream(thresholds: Thresholds, ladder: Ladder, sample: LoadSample, now_s: float) -> Ladder:
    """With what the measurement says of how one stream waits for IRs."""
    wait_s = sample.ir_wait_s or 0.0
    is_overloaded = wait_s > patience_s(thresholds, ladder.step)
    expected_s = wait_s * ladder.above.cost_ms / ladder.step.cost_ms
    would_be_well = expected_s <= thresholds.patience_above * patience_s(thresholds, ladder.above)
    judged = replace(
        ladder,
        overloaded_periods=ladder.overloaded_periods + 1 if is_overloaded else 0,
        well_since_s=_since(ladder.well_since_s, now_s, is_so=would_be_well and not is_overloaded),
    )
    if ladder.rose_s is not None and now_s - ladder.rose_s > thresholds.relapse_s:
        return replace(judged, rose_s=None, caution=max(1, ladder.caution // 2))
    return judged


def _since(since_s: float | None, now_s: float, *, is_so: bool) -> float | None:
    if not is_so:
        return None
    return now_s if since_s is None else since_s


def _move(
    thresholds: Thresholds, thread: ThreadState, ladders: dict[Key, Ladder], measurement: Measurement[Key]
) -> tuple[ThreadState, dict[Key, Ladder], dict[Key, LevelReason]]:
    """One step at a time: down those that wait too long for IRs, and, where the thread has too much to do, those that
    stand best; or else up one."""
    now_s = measurement.now_s
    moved: dict[Key, LevelReason] = {}

    def lower(key: Key) -> None:
        if key not in moved and not ladders[key].is_lowest:
            ladders[key] = _lowered(thresholds, ladders[key], now_s)
            moved[key] = "load"

    for key, ladder in ladders.items():
        has_waited = ladder.overloaded_periods >= thresholds.overloaded_periods
        if has_waited and now_s - ladder.moved_s >= thresholds.settle_s:
            lower(key)
    is_overloaded = thread.overloaded_periods >= thresholds.overloaded_periods or measurement.lateness > thresholds.late
    if is_overloaded and now_s - thread.moved_s >= thresholds.settle_s:
        for key in _best_off(ladders):
            lower(key)
        return replace(thread, moved_s=now_s), ladders, moved
    rising = [key for key in ladders if _may_rise(thresholds, thread, ladders[key], now_s)]
    if rising and not moved:
        key = max(rising, key=lambda key: ladders[key].at)
        ladders[key] = _raised(ladders[key], now_s)
        moved[key] = "recovered"
    return thread, ladders, moved


def _best_off(ladders: Mapping[Key, Ladder]) -> Sequence[Key]:
    """Those that stand highest of all that can still step down."""
    able = [key for key, ladder in ladders.items() if not ladder.is_lowest]
    highest = min((ladders[key].at for key in able), default=0)
    return [key for key in able if ladders[key].at == highest]


def _may_rise(thresholds: Thresholds, thread: ThreadState, ladder: Ladder, now_s: float) -> bool:
    if not ladder.is_eased or ladder.well_since_s is None or thread.well_since_s is None:
        return False
    since_s = max(ladder.well_since_s, thread.well_since_s, ladder.moved_s)
    return now_s - since_s >= ladder.caution * thresholds.clear_s


def _lowered(thresholds: Thresholds, ladder: Ladder, now_s: float) -> Ladder:
    has_relapsed = ladder.rose_s is not None
    caution = min(thresholds.most_caution, 2 * ladder.caution) if has_relapsed else ladder.caution
    return _moved(replace(ladder, caution=caution, rose_s=None), 1, now_s)


def _raised(ladder: Ladder, now_s: float) -> Ladder:
    return _moved(replace(ladder, rose_s=now_s), -1, now_s)


def _moved(ladder: Ladder, steps: int, now_s: float) -> Ladder:
    return replace(ladder, at=ladder.at + steps, moved_s=now_s, well_since_s=None, overloaded_periods=0)
