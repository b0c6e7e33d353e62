"""What an audio thread and its streams give up when there is more work than time: `decide`, a pure function of one
measurement. Nothing here waits, reads a clock or stores anything.

A thread measures its load and that of its streams four times a second. A `LoadState` carries what matters of earlier
decisions; `decide` takes one and returns the next. These things are given up, in this order:

1. *Blocks at once*: a thread renders more blocks of a stream at once, which takes less of a core for each; poses
   take effect up to that many blocks later.
2. *Responses*: below the top of its ladder, a stream's impulse responses (IRs) get an equal part of a share of a
   core, which shrinks as the thread gets busier.
3. *Quality*: a stream steps down its ladder (`server.streaming.quality_steps`).

Late blocks, or a thread without spare time, concern all its streams alike: those on the highest steps step down first,
and those on the lowest are the first to step back up, one at a time. Slow IRs concern the stream that waits for them.
After a step down, a stream waits until the step shows before it steps again. A stream that steps up, and has to step
down soon after, waits twice as long the next time: near a limit, a stream stays below it.

Times are seconds of one monotonic clock. The thresholds, with their reasons, are in `server.streaming.load_thresholds`.
"""

import itertools
import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Generic, TypeVar

from server.protocol.server_messages import LevelReason
from server.streaming.load_thresholds import Thresholds
from server.streaming.quality_steps import QualityStep

Key = TypeVar("Key", bound=Hashable)
"""A key that identifies a stream of a thread."""


@dataclass(frozen=True)
class LoadSample:
    """The load of a stream in the last period.

    `lateness` is the longest time from a block's due time until it was ready, as a share of what the client has in
    hand: 1 is late. `ir_wait_s` is the longest time from requesting IRs to having them, so far if the stream still
    waits; None if it requested none. `ir_interval_s` is the least time between its requests. `request_s` and `plan_s`
    are smoothed CPU times of a request for IRs and of a plan of effects.
    """

    lateness: float = 0.0
    ir_wait_s: float | None = None
    request_s: float = 0.0
    plan_s: float = 0.0
    rendering: float = 0.0
    is_in_effect: bool = True
    ir_interval_s: float = 0.0


@dataclass(frozen=True)
class Measurement(Generic[Key]):
    """The load of an audio thread in the period that ended at `now_s`; it rendered for the share `busy` of it.
    `least_blocks` is the least number of blocks at once, for newcomers whose work is still to come. Unless it
    `has_room_on_top`, no stream steps up to the top of its ladder, from where it asks for IRs as often as it likes, but
    those that were let in there. While `others_wait` to be let in, none steps up above the step on which it was let in
    itself. While `others_begin`, whose first IRs go before all others, waits for IRs say nothing of the streams that
    are there. `spare_cores` are left to the IRs of its streams by everything else."""

    now_s: float
    busy: float
    streams: Mapping[Key, LoadSample]
    least_blocks: int = 1
    has_room_on_top: bool = True
    others_wait: bool = False
    others_begin: bool = False
    spare_cores: float = math.inf

    @property
    def lateness(self) -> float:
        """The worst lateness of all streams."""
        return max((sample.lateness for sample in self.streams.values()), default=0.0)

    @property
    def demand(self) -> float:
        """Share of a core that the blocks of all streams have to get to be in time: it may exceed 1, and lies below
        `busy` while a thread works off what has piled up."""
        return sum(sample.rendering for sample in self.streams.values()) or self.busy


@dataclass(frozen=True)
class Ladder:
    """A stream's quality steps, best first, with its present step and how it came there.

    `caution` multiplies the time for which load must be low before the stream steps up. `rose_s` is the time of its
    last step up, while that may still prove to have been too early. `let_in_at` is the number of the step on which it
    was let in.
    """

    steps: tuple[QualityStep, ...]
    at: int = 0
    let_in_at: int = 0
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
        """The next better step, or the present one at the top."""
        return self.steps[max(0, self.at - 1)]

    @property
    def is_eased(self) -> bool:
        """Whether the stream is below its top step."""
        return self.at > 0

    @property
    def is_lowest(self) -> bool:
        return self.at + 1 >= len(self.steps)


@dataclass(frozen=True)
class RenderAhead:
    """How many blocks of a stream a thread renders at once, and its mean busy share over the last of the `periods`
    since that number changed.

    `caution` multiplies the length of the `long_mean` that calls for fewer blocks. `periods_since_fewer` counts from
    the last decrease, while that may still prove to have been too early. `calm_periods` counts from when blocks were
    last nearly late, while they are expected to be so again. After they were, with a `late_caution` above 1, the number
    does not decrease meanwhile.
    """

    blocks: int = 1
    mean_busy: float = 0.0
    periods: int = 0
    long_mean: float = 0.0
    caution: int = 1
    periods_since_fewer: int | None = None
    calm_periods: int | None = None
    late_caution: int = 1

    @property
    def restarted(self) -> "RenderAhead":
        """The same number of blocks, with means that begin anew."""
        return replace(self, mean_busy=0.0, periods=0, long_mean=0.0)


@dataclass(frozen=True)
class ThreadState:
    """The part of a decision's input that belongs to a thread, besides the newest measurement."""

    ahead: RenderAhead = RenderAhead()
    overloaded_periods: int = 0
    well_since_s: float | None = None
    lateness: float = 0.0
    """The worst of the last period."""
    catches_up: bool = False
    """Whether blocks have time enough, and those of the last period were less late than those before."""
    moved_s: float = -math.inf
    """When the thread last made streams step down because it had too much to do."""
    changed_s: float = -math.inf
    """When the number of blocks at once last changed or streams last stepped down: waits for IRs change with both."""
    begun_s: float = -math.inf
    """When newcomers were last seen to begin."""

    @property
    def waits_since_s(self) -> float:
        """Since when waits for IRs show whether there is time for those of all streams."""
        return max(self.changed_s, self.begun_s)

    @property
    def restarted(self) -> "ThreadState":
        """The state after a stream has come from another thread or left for one: earlier measurements say nothing of
        the load from now on, so neither steps down nor steps up may follow from them."""
        return replace(self, ahead=self.ahead.restarted, overloaded_periods=0, well_since_s=None)


@dataclass(frozen=True)
class LoadState(Generic[Key]):
    """The state of a thread and the ladders of its streams."""

    thread: ThreadState
    ladders: Mapping[Key, Ladder]


@dataclass(frozen=True)
class Decision(Generic[Key]):
    """The decision: how many blocks of a stream to render at once, which streams move by one step and why, and for each
    stream the least seconds between requests for IRs and between plans of effects. `ir_share` is the share of a core
    that IRs may take."""

    blocks_at_once: int
    ir_share: float
    moved: Mapping[Key, LevelReason] = field(default_factory=dict)
    ir_intervals_s: Mapping[Key, float] = field(default_factory=dict)
    plan_intervals_s: Mapping[Key, float] = field(default_factory=dict)


def decide(
    thresholds: Thresholds, state: LoadState[Key], measurement: Measurement[Key]
) -> tuple[LoadState[Key], Decision[Key]]:
    """Return the next state and the decision. `state` has a ladder for each stream in the measurement."""
    # A thread that could save time by more blocks at once before this measurement does that first.
    can_make_time = state.thread.ahead.blocks < thresholds.blocks_at_once[-1]
    thread = _judge_thread(thresholds, state.thread, measurement, can_make_time=can_make_time)
    ladders = {
        key: _judge_stream(thresholds, state.ladders[key], sample, measurement.now_s, since_s=thread.waits_since_s)
        for key, sample in measurement.streams.items()
    }
    thread, ladders, moved = _move(thresholds, thread, ladders, measurement)
    share = ir_share(thresholds, busy=measurement.busy, spare_cores=measurement.spare_cores)
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
    """Return the blocks at once after a period in which a thread rendered for the share `busy`, with the worst lateness
    `lateness`."""
    ahead = _note_lateness(thresholds, _average(thresholds, ahead, busy), lateness)
    numbers = thresholds.blocks_at_once
    at = numbers.index(ahead.blocks)
    has_mean = ahead.periods >= thresholds.mean_periods
    has_long_mean = ahead.periods >= thresholds.mean_periods * ahead.caution
    falls_behind = busy > thresholds.behind_busy and lateness > thresholds.behind_lateness
    is_full = at + 1 < len(numbers) and has_mean and ahead.mean_busy > thresholds.more_blocks_above[at]
    if is_full or (at + 1 < len(numbers) and falls_behind):
        # A short peak of load does not show that fewer blocks were too few.
        has_relapsed = is_full and ahead.periods_since_fewer is not None
        caution = min(thresholds.most_caution, 2 * ahead.caution) if has_relapsed else ahead.caution
        return replace(ahead.restarted, blocks=numbers[at + 1], caution=caution, periods_since_fewer=None)
    if at == 0 or (ahead.late_caution > 1 and ahead.calm_periods is not None):
        return ahead
    left = 1 - thresholds.saved_by_doubling
    would_do = has_long_mean and ahead.long_mean / left < thresholds.more_blocks_above[at - 1]
    # Where even a quarter of the blocks would suffice, half of them certainly do.
    if would_do or (has_mean and ahead.mean_busy / left**2 < thresholds.more_blocks_above[at - 1]):
        return replace(ahead.restarted, blocks=numbers[at - 1], periods_since_fewer=0)
    return ahead


def _note_lateness(thresholds: Thresholds, ahead: RenderAhead, lateness: float) -> RenderAhead:
    """Note whether blocks were nearly late. A load that makes them so again within `relapse_s` is expected to come once
    more, and each time that it does, for twice as long."""
    calm = ahead.calm_periods
    if lateness > thresholds.tight:
        comes_again = calm is not None and calm * thresholds.period_s > thresholds.clear_s
        caution = min(thresholds.most_caution, 2 * ahead.late_caution) if comes_again else ahead.late_caution
        return replace(ahead, calm_periods=0, late_caution=caution)
    if calm is None:
        return ahead
    if (calm + 1) * thresholds.period_s > thresholds.relapse_s * ahead.late_caution:
        return replace(ahead, calm_periods=None, late_caution=1)
    return replace(ahead, calm_periods=calm + 1)


def _average(thresholds: Thresholds, ahead: RenderAhead, busy: float) -> RenderAhead:
    """Return the means with one more period, and with less caution if fewer blocks have sufficed for long enough."""
    periods, since, caution = ahead.periods + 1, ahead.periods_since_fewer, ahead.caution
    if since is not None:
        since += 1
        if since * thresholds.period_s > thresholds.relapse_s * caution:
            since, caution = None, max(1, caution // 2)
    newest, newest_of_long = (max(1 / periods, thresholds.newest_weight / times) for times in (1, ahead.caution))
    return replace(
        ahead,
        mean_busy=ahead.mean_busy + newest * (busy - ahead.mean_busy),
        periods=periods,
        long_mean=ahead.long_mean + newest_of_long * (busy - ahead.long_mean),
        caution=caution,
        periods_since_fewer=since,
    )


def ir_share(thresholds: Thresholds, *, busy: float, spare_cores: float = math.inf) -> float:
    """Return the share of a core for IRs of the streams of an audio thread that renders for a share `busy` of the time,
    where all else leaves `spare_cores`."""
    most = thresholds.ir_share
    left = min(thresholds.shared_core - busy, thresholds.used_of_spare * spare_cores)
    return min(most, max(left, thresholds.least_ir_share * most))


def ir_interval_s(ladder: Ladder, *, request_s: float, streams: int, share: float) -> float:
    """Return the least time between requests for IRs. `request_s` is the CPU time of one. Below the top of its ladder,
    a stream may take an equal part of a `share` of a core, which `streams` such streams divide."""
    rate_hz = ladder.step.ir_rate_hz
    paced_s = 0.0 if rate_hz is None else 1 / rate_hz
    return max(paced_s, request_s * streams / share) if ladder.is_eased else paced_s


def requests_at_once(thresholds: Thresholds, *, workers: int, threads: int) -> int:
    """Return how many unanswered requests for IRs a thread may have, if `threads` with streams share the workers."""
    return thresholds.requests_ahead + math.ceil(workers / threads)


def patience_s(thresholds: Thresholds, step: QualityStep, interval_s: float = 0.0) -> float:
    """Return how long IRs may take from their request to their arrival, where requests are at least `interval_s` apart:
    the longer for that, but no longer than with the fewest requests there may be, as reverberation lags meanwhile."""
    if step.ir_rate_hz is None:
        return thresholds.patience_s
    paced_s = min(max(1 / step.ir_rate_hz, interval_s), 1 / thresholds.least_ir_rate_hz)
    return max(thresholds.patience_s, thresholds.patience_intervals * paced_s)


def _patience_s(thresholds: Thresholds, ladder: Ladder, sample: LoadSample) -> float:
    """Return the patience of a stream. On the step on which it was let in, where it shares a budget with all who have
    come since, it goes by how often it may ask now: others that come do not lower it."""
    return patience_s(thresholds, ladder.step, sample.ir_interval_s if ladder.at == ladder.let_in_at else 0.0)


def longest_wait(thresholds: Thresholds, state: LoadState[Key], measurement: Measurement[Key]) -> float:
    """Return the longest wait for IRs as a share of the patience on the step of the stream that waits. Streams whose
    step is not in effect yet do not count."""
    return max(
        (
            (sample.ir_wait_s or 0.0) / patience_s(thresholds, state.ladders[key].step)
            for key, sample in measurement.streams.items()
            if sample.is_in_effect
        ),
        default=0.0,
    )


def _judge_thread(
    thresholds: Thresholds, thread: ThreadState, measurement: Measurement[Key], *, can_make_time: bool
) -> ThreadState:
    """Return the thread's state after the measurement. A thread that `can_make_time` by other means is not overloaded
    as long as no block is nearly late."""
    busy, lateness = measurement.busy, measurement.lateness
    # What has piled up before the last change is worked off.
    has_changed = measurement.now_s - thread.changed_s < 1.5 * thresholds.period_s
    catches_up = measurement.demand <= thresholds.full_busy and (has_changed or lateness < thread.lateness)
    is_full = busy > thresholds.full_busy and not can_make_time
    is_overloaded = (is_full or lateness > thresholds.tight) and not catches_up
    is_well = (
        _with_most_blocks(thresholds, busy, thread.ahead.blocks) <= thresholds.free_busy and lateness <= thresholds.easy
    )
    ahead = render_ahead(thresholds, thread.ahead, busy=busy, lateness=lateness)
    if ahead.blocks < measurement.least_blocks:
        ahead = replace(thread.ahead.restarted, blocks=measurement.least_blocks, periods_since_fewer=None)
    return replace(
        thread,
        ahead=ahead,
        lateness=lateness,
        catches_up=catches_up,
        changed_s=thread.changed_s if ahead.blocks == thread.ahead.blocks else measurement.now_s,
        begun_s=measurement.now_s if measurement.others_begin else thread.begun_s,
        overloaded_periods=thread.overloaded_periods + 1 if is_overloaded else 0,
        well_since_s=_since(thread.well_since_s, measurement.now_s, is_so=is_well),
    )


def _new_wait_s(thresholds: Thresholds, wait_s: float, since_s: float) -> float:
    """Return for how long a stream has waited for IRs since what its thread gives up last changed, or newcomers last
    began, which was `since_s` seconds ago. A wait from before says nothing of it, unless it goes on for long."""
    return min(wait_s, since_s) if wait_s <= since_s or since_s > thresholds.stale_wait_s else 0.0


def _with_most_blocks(thresholds: Thresholds, busy: float, blocks: int) -> float:
    """Return the busy share of a thread if it rendered the most blocks at once: poses are heard later before quality
    stays low."""
    numbers = thresholds.blocks_at_once
    doublings = len(numbers) - 1 - numbers.index(blocks)
    return busy * (1 - thresholds.surely_saved) ** doublings


def _judge_stream(
    thresholds: Thresholds, ladder: Ladder, sample: LoadSample, now_s: float, *, since_s: float
) -> Ladder:
    """Return a stream's ladder after the measurement of how long it waits for IRs, on a thread where waits show
    something `since_s`."""
    wait_s = _new_wait_s(thresholds, sample.ir_wait_s or 0.0, now_s - since_s)
    # IRs of another level are all computed anew: how long that takes says nothing of the waits that follow.
    is_overloaded = sample.is_in_effect and wait_s > _patience_s(thresholds, ladder, sample)
    expected_s = wait_s * ladder.above.cost_ms / ladder.step.cost_ms
    would_be_well = expected_s <= thresholds.patience_above * patience_s(thresholds, ladder.above)
    judged = replace(
        ladder,
        overloaded_periods=ladder.overloaded_periods + 1 if is_overloaded else 0,
        well_since_s=_since(ladder.well_since_s, now_s, is_so=would_be_well and not is_overloaded),
    )
    if ladder.rose_s is not None and now_s - ladder.rose_s > thresholds.relapse_s * ladder.caution:
        return replace(judged, rose_s=None, caution=max(1, ladder.caution // 2))
    return judged


def _since(since_s: float | None, now_s: float, *, is_so: bool) -> float | None:
    if not is_so:
        return None
    return now_s if since_s is None else since_s


def _move(
    thresholds: Thresholds, thread: ThreadState, ladders: dict[Key, Ladder], measurement: Measurement[Key]
) -> tuple[ThreadState, dict[Key, Ladder], dict[Key, LevelReason]]:
    """Move streams by one step: down those that wait too long for IRs and, if the thread has too much work, those on
    the highest steps; or else one of them up."""
    now_s = measurement.now_s
    moved: dict[Key, LevelReason] = {}

    def lower(key: Key) -> None:
        if key not in moved and not ladders[key].is_lowest:
            ladders[key] = _lowered(thresholds, ladders[key], now_s)
            moved[key] = "load"

    has_settled = now_s - thread.waits_since_s >= thresholds.settle_s
    if has_settled and (slow := _slowest(thresholds, thread, ladders, measurement)):
        for key in slow:
            lower(key)
        # The others wait in the same queue: whether that was enough, only new waits can tell.
        ladders.update({key: replace(ladder, overloaded_periods=0) for key, ladder in ladders.items()})
        thread = replace(thread, changed_s=now_s)
    is_late = measurement.lateness > thresholds.late and not thread.catches_up
    is_overloaded = thread.overloaded_periods >= thresholds.overloaded_periods or is_late
    if is_overloaded and (moved or thread.changed_s < now_s) and now_s - thread.moved_s >= thresholds.settle_s:
        best_off, is_enough = _best_off(thresholds, ladders, measurement)
        for key in best_off:
            lower(key)
        # While blocks are late, steps that save too little are not waited for.
        moved_s = now_s if is_enough or not is_late else thread.moved_s
        return replace(thread, moved_s=moved_s, changed_s=now_s), ladders, moved
    rising = [
        key
        for key, ladder in ladders.items()
        if _may_rise(thresholds, thread, ladder, now_s)
        and (measurement.has_room_on_top or ladder.at > 1 or not ladder.let_in_at)
        and (ladder.at > ladder.let_in_at or not measurement.others_wait)
        and _has_time_above(thresholds, thread, ladder, measurement.streams[key].rendering, measurement.demand)
    ]
    if rising and not moved:
        key = max(rising, key=lambda key: ladders[key].at)
        ladders[key] = _raised(ladders[key], now_s)
        moved[key] = "recovered"
    return thread, ladders, moved


def _slowest(
    thresholds: Thresholds, thread: ThreadState, ladders: Mapping[Key, Ladder], measurement: Measurement[Key]
) -> Sequence[Key]:
    """Return which of the streams that have waited too long for IRs step down: as large a part of them as the longest
    wait is too long, those on the highest steps first. They wait in one queue, so each gains by the steps of others."""
    since_s = measurement.now_s - thread.waits_since_s
    waits_s = {
        key: _new_wait_s(thresholds, measurement.streams[key].ir_wait_s or 0.0, since_s)
        for key, ladder in ladders.items()
        if ladder.overloaded_periods >= thresholds.overloaded_periods
        and measurement.streams[key].is_in_effect
        and not ladder.is_lowest
    }
    excess = max(
        (
            _excess(wait_s, _patience_s(thresholds, ladders[key], measurement.streams[key]))
            for key, wait_s in waits_s.items()
        ),
        default=0,
    )
    ranked = sorted(waits_s, key=lambda key: (ladders[key].at, -waits_s[key]))
    return ranked[: math.ceil(excess * len(ranked))]


def _excess(wait_s: float, patience_s: float) -> float:
    """Return the share of a wait for IRs that is beyond a stream's patience."""
    return max(0.0, 1 - patience_s / wait_s) if wait_s else 0.0


def _best_off(
    thresholds: Thresholds, ladders: Mapping[Key, Ladder], measurement: Measurement[Key]
) -> tuple[Sequence[Key], bool]:
    """Return which streams step down in a thread with too much to do, and whether that is expected to be enough: those
    on the highest steps, and as many as it takes, by what their blocks take now. If that is little, and all of them
    would save less, only some do: most steps save no rendering."""
    ranked = sorted((key for key, ladder in ladders.items() if not ladder.is_lowest), key=lambda key: ladders[key].at)
    highest = [key for key in ranked if ladders[key].at == ladders[ranked[0]].at]
    rendering = {key: sample.rendering for key, sample in measurement.streams.items()}
    excess = measurement.demand - thresholds.relieved_busy
    saved = [*itertools.accumulate(_saving(thresholds, ladders[key]) * rendering[key] for key in highest)]
    least = math.ceil(thresholds.least_lowered * len(ladders))
    needed = max(1 + sum(so_far < excess for so_far in saved), least)
    is_enough = needed <= len(highest)
    is_little = measurement.demand <= thresholds.full_busy
    return highest[: least if is_little and not is_enough else needed], is_enough


def _saving(thresholds: Thresholds, ladder: Ladder) -> float:
    """Return the share of what a stream's blocks take that its next step down is expected to save."""
    now, then = (thresholds.rendering_by_sharing[step.sharing] for step in (ladder.step, ladder.steps[ladder.at + 1]))
    return 1 - then / now


def _may_rise(thresholds: Thresholds, thread: ThreadState, ladder: Ladder, now_s: float) -> bool:
    if not ladder.is_eased or ladder.well_since_s is None or thread.well_since_s is None:
        return False
    since_s = max(ladder.well_since_s, thread.well_since_s, ladder.moved_s)
    return now_s - since_s >= ladder.caution * thresholds.clear_s


def _has_time_above(
    thresholds: Thresholds, thread: ThreadState, ladder: Ladder, rendering: float, demand: float
) -> bool:
    """Return whether a thread has time for the blocks of a stream, which take the share `rendering` of a core, on its
    next better step."""
    above = replace(ladder, at=ladder.at - 1)
    risen = demand + rendering * (1 / (1 - _saving(thresholds, above)) - 1)
    return _with_most_blocks(thresholds, risen, thread.ahead.blocks) <= thresholds.free_busy


def _lowered(thresholds: Thresholds, ladder: Ladder, now_s: float) -> Ladder:
    has_relapsed = ladder.rose_s is not None
    caution = min(thresholds.most_caution, 2 * ladder.caution) if has_relapsed else ladder.caution
    return _moved(replace(ladder, caution=caution, rose_s=None), 1, now_s)


def _raised(ladder: Ladder, now_s: float) -> Ladder:
    return _moved(replace(ladder, rose_s=now_s), -1, now_s)


def _moved(ladder: Ladder, steps: int, now_s: float) -> Ladder:
    return replace(ladder, at=ladder.at + steps, moved_s=now_s, well_since_s=None, overloaded_periods=0)
