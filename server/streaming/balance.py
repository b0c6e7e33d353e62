"""Which stream moves from one audio thread to another, if any: `balance`, a pure function of one measurement. Nothing
here waits, reads a clock or stores anything.

A move is called for if it makes the busier of two threads less busy by a threshold, even though the other one then has
the stream. Cores may differ in speed, and a stream takes another share of each: what it takes on the other core shows
only there. But a move that was called for never calls for the same move back, however much the cores differ: the
difference between the threads was larger than the stream by the threshold, so that after it the stream's return would
leave them as they were.

To be carried out, a move has to be called for in a number of periods in a row. Fewer do for a thread without spare
time: its streams had better move than step down. A stream that was moved then stays where it is for some time, and one
that has just come stays until its load is known.
"""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Generic, TypeVar

from server.streaming.load_thresholds import Thresholds

Key = TypeVar("Key", bound=Hashable)
"""A key that identifies a stream."""


@dataclass(frozen=True)
class ThreadLoad(Generic[Key]):
    """The load of a thread: the share `busy` of the last period in which it rendered, and the smoothed share of a core
    that each of its streams takes."""

    busy: float
    streams: Mapping[Key, float]

    @property
    def demand(self) -> float:
        """The share of a core that the thread needs: more than it was busy if it falls behind."""
        return max(self.busy, sum(self.streams.values()))


@dataclass(frozen=True)
class Move(Generic[Key]):
    """A move of a stream from the thread number `source` to `target`."""

    key: Key
    source: int
    target: int


@dataclass(frozen=True)
class BalanceState(Generic[Key]):
    """What matters of earlier measurements: the mean demand of each thread, None if it is dead or stuck; how many
    periods in a row have called for a move; and until when each stream stays where it is."""

    means: tuple[float | None, ...] = ()
    periods: int = 0
    stays_until_s: Mapping[Key, float] = field(default_factory=dict)

    def without(self, key: Key) -> "BalanceState[Key]":
        """The same without a stream that has ended."""
        stays = {each: until_s for each, until_s in self.stays_until_s.items() if each != key}
        return replace(self, stays_until_s=stays)


def balance(
    thresholds: Thresholds, state: BalanceState[Key], now_s: float, threads: Sequence[ThreadLoad[Key] | None]
) -> tuple[BalanceState[Key], Move[Key] | None]:
    """Return the next state, and the move to carry out. A thread that is dead or stuck is None."""
    before_s = state.stays_until_s
    known_s = now_s + thresholds.load_known_s
    stays_until_s = {key: before_s.get(key, known_s) for thread in threads if thread for key in thread.streams}
    means = _means(thresholds, state.means, threads)
    move = _called_for(thresholds, means, threads, {key for key, until_s in stays_until_s.items() if until_s > now_s})
    if move is None:
        return BalanceState(means, 0, stays_until_s), None
    state = BalanceState(means, state.periods + 1, stays_until_s)
    is_full = (means[move.source] or 0.0) > thresholds.full_busy
    if state.periods < (thresholds.full_periods if is_full else thresholds.uneven_periods):
        return state, None
    return _carried_out(thresholds, state, move, now_s, threads), move


def _means(
    thresholds: Thresholds, means: Sequence[float | None], threads: Sequence[ThreadLoad[Key] | None]
) -> tuple[float | None, ...]:
    """Return the mean demands with one more period."""
    before = means or (None,) * len(threads)
    return tuple(
        None
        if thread is None
        else thread.demand
        if mean is None
        else mean + thresholds.newest_weight * (thread.demand - mean)
        for mean, thread in zip(before, threads, strict=True)
    )


def _called_for(
    thresholds: Thresholds,
    means: Sequence[float | None],
    threads: Sequence[ThreadLoad[Key] | None],
    staying: set[Key],
) -> Move[Key] | None:
    """Return the best move from the busiest thread that has one, to the least busy thread."""
    busy = {number: mean for number, mean in enumerate(means) if mean is not None}
    if not busy:
        return None
    target = min(busy, key=busy.__getitem__)
    for source in sorted(busy, key=busy.__getitem__, reverse=True):
        thread = threads[source]
        assert thread is not None
        gains = {
            key: min(load, busy[source] - busy[target] - load)
            for key, load in thread.streams.items()
            if key not in staying
        }
        best = max(gains, key=gains.__getitem__, default=None)
        if best is not None and gains[best] >= thresholds.least_gain:
            return Move(best, source, target)
    return None


def _carried_out(
    thresholds: Thresholds,
    state: BalanceState[Key],
    move: Move[Key],
    now_s: float,
    threads: Sequence[ThreadLoad[Key] | None],
) -> BalanceState[Key]:
    """Return the state after a move, with means as they will be if the stream takes as much as before."""
    source = threads[move.source]
    assert source is not None
    change = {move.source: -source.streams[move.key], move.target: source.streams[move.key]}
    means = tuple(
        None if mean is None else max(0.0, mean + change.get(number, 0.0)) for number, mean in enumerate(state.means)
    )
    stays = {**state.stays_until_s, move.key: now_s + thresholds.stay_s}
    return replace(state, means=means, periods=0, stays_until_s=stays)
