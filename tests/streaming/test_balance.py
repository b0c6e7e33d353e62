"""Which streams move between audio threads, on cores that are arithmetic."""

from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
import pytest

from server.streaming.balance import BalanceState, Move, ThreadLoad, balance
from server.streaming.load_thresholds import THRESHOLDS, Thresholds


def after(threads, *, periods=THRESHOLDS.uneven_periods + 30, thresholds=THRESHOLDS):
    """The first move for threads of a steady load, and in which period it came."""
    state = BalanceState()
    for number in range(periods):
        state, move = balance(thresholds, state, number * thresholds.period_s, threads)
        if move is not None:
            return number, move
    return None, None


def loaded(*streams, busy=None):
    """A thread with streams of these loads, named by them."""
    return ThreadLoad(sum(load for load in streams) if busy is None else busy, {load: load for load in streams})


def test_the_stream_moves_that_evens_out_the_most():
    _, move = after([loaded(0.3, 0.25, 0.1), loaded(0.2)])
    assert move == Move(0.25, 0, 1)


def test_nothing_moves_that_would_only_change_which_thread_is_busier():
    assert after([loaded(0.6), loaded(0.1)]) == (None, None)
    assert after([loaded(0.31, 0.3), loaded(0.3, 0.2)]) == (None, None)


def test_nothing_moves_from_a_single_thread_or_from_none():
    assert after([loaded(0.5, 0.4)]) == (None, None)
    assert after([None]) == (None, None)


def test_a_stream_that_has_just_come_stays_until_its_load_is_known():
    number, _ = after([loaded(0.3, 0.31), loaded(0.0)])
    known = THRESHOLDS.load_known_s / THRESHOLDS.period_s
    assert number == pytest.approx(known + THRESHOLDS.uneven_periods, abs=1.5)


def test_a_thread_without_spare_time_does_not_wait_as_long():
    calm, _ = after([loaded(0.3, 0.3, 0.2), loaded(0.0)])
    full, _ = after([loaded(0.3, 0.3, 0.3), loaded(0.0)])
    assert calm - full == THRESHOLDS.uneven_periods - THRESHOLDS.full_periods


def test_a_thread_that_is_dead_or_stuck_neither_gives_nor_takes():
    _, move = after([loaded(0.4, 0.41), None, loaded(0.1)])
    assert move == Move(0.4, 0, 2)
    assert after([loaded(0.4, 0.41), None]) == (None, None)


def test_where_the_busiest_has_nothing_to_give_the_next_one_gives():
    _, move = after([loaded(0.8), loaded(0.3, 0.2), loaded(0.1)])
    assert move == Move(0.2, 1, 2)


def test_a_load_of_a_second_moves_nothing():
    state, threads = BalanceState(), [loaded(0.3, 0.2), loaded(0.3, 0.2, busy=0.5)]
    for number in range(200):
        peak = replace(threads[0], busy=0.95) if 100 <= number < 104 else threads[0]
        state, move = balance(THRESHOLDS, state, number * THRESHOLDS.period_s, [peak, threads[1]])
        assert move is None


@dataclass
class Cores:
    """Threads on cores of these speeds, with streams that need shares of a core of speed 1."""

    speeds: tuple[float, ...]
    spread: float = 0.05
    work: dict[str, float] = field(default_factory=dict)
    thread_of: dict[str, int] = field(default_factory=dict)
    moves: list[tuple[float, str]] = field(default_factory=list)
    worst: list[float] = field(default_factory=list)
    state: BalanceState = field(default_factory=BalanceState)
    thresholds: Thresholds = THRESHOLDS
    now_s: float = 0.0

    def __post_init__(self):
        self._rng = np.random.default_rng(5)
        self._loads = {}

    def open(self, name, work, *, on=None):
        self.work[name] = work
        self.thread_of[name] = int(np.argmin(self.busy)) if on is None else on

    def close(self, name):
        del self.work[name], self.thread_of[name]

    @property
    def busy(self):
        busy = np.zeros(len(self.speeds))
        for name, thread in self.thread_of.items():
            busy[thread] += self.work[name] / self.speeds[thread]
        return busy

    def run(self, duration_s):
        for _ in range(round(duration_s / THRESHOLDS.period_s)):
            self.now_s += THRESHOLDS.period_s
            threads = [ThreadLoad(min(1.0, busy * self._luck()), {}) for busy in self.busy]
            for name, thread in self.thread_of.items():
                load = self.work[name] / self.speeds[thread] * self._luck()
                before = self._loads.get(name, 0.0)
                # Half of the way in a period, as a stream's load is smoothed.
                self._loads[name] = threads[thread].streams[name] = before + 0.5 * (load - before)
            self.state, move = balance(self.thresholds, self.state, self.now_s, threads)
            if move is not None:
                assert self.thread_of[move.key] == move.source
                self.thread_of[move.key] = move.target
                self.moves.append((self.now_s, move.key))
            self.worst.append(max(self.busy))
        return self

    def optimum(self):
        """The busy share of the worst thread, at the best of all ways to spread the streams."""
        reached = {(0.0,) * len(self.speeds)}
        for work in self.work.values():
            reached = {
                (*busy[:place], round(busy[place] + work / speed, 9), *busy[place + 1 :])
                for busy, (place, speed) in product(reached, enumerate(self.speeds))
            }
        return min(max(busy) for busy in reached)

    def _luck(self):
        return float(np.exp(self.spread * self._rng.standard_normal()))


CASES = {
    "all on the first of two": ((1.0, 1.0), [0.1] * 8),
    "all on the first of four": ((1.0, 1.0, 1.0, 1.0), [0.12] * 7),
    "one large one": ((1.0, 1.0), [0.5, 0.1, 0.1, 0.1, 0.1]),
    "of every size": ((1.0, 1.0, 1.0), [0.4, 0.3, 0.25, 0.2, 0.15, 0.12, 0.1, 0.05]),
    "a fast and a slow core": ((1.0, 0.5), [0.12] * 8),
    "one slow among three": ((1.0, 0.5, 1.0), [0.12] * 12),
    "more than there is": ((1.0, 1.0), [0.3] * 8),
    "hardly anything": ((1.0, 1.0, 1.0), [0.02] * 8),
}


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("name", CASES)
def test_threads_become_even_and_then_nothing_moves(name, first):
    speeds, works = CASES[name]
    cores = Cores(speeds)
    for number, work in enumerate(works):
        cores.open(str(number), work, on=first)
    cores.run(90.0)
    assert max(cores.busy) <= cores.optimum() + 2 * THRESHOLDS.least_gain
    settled = len(cores.moves)
    cores.run(600.0)
    assert len(cores.moves) == settled
    assert settled <= len(works)


@pytest.mark.parametrize("name", ["all on the first of two", "of every size", "a fast and a slow core"])
def test_a_policy_that_moves_whatever_the_gain_has_streams_go_to_and_fro_for_ever(name):
    speeds, works = CASES[name]
    rash = replace(THRESHOLDS, least_gain=-0.1, uneven_periods=1, full_periods=1, load_known_s=0.0, stay_s=0.0)
    cores = Cores(speeds, thresholds=rash)
    for number, work in enumerate(works):
        cores.open(str(number), work, on=0)
    cores.run(90.0)
    settled = len(cores.moves)
    cores.run(600.0)
    assert len(cores.moves) > settled + 20


def test_streams_that_come_go_and_grow_stay_even_and_move_seldom():
    """For half an hour somebody comes, goes, or has more or fewer emitters every five seconds."""
    rng = np.random.default_rng(1)
    cores = Cores((1.0, 0.6, 1.0, 1.4))
    uneven = []
    for number in range(360):
        happens = rng.choice(["comes", "goes", "changes"])
        names = list(cores.work)
        if (happens == "comes" and len(names) < 24) or len(names) < 12:
            cores.open(f"stream {number}", rng.uniform(0.03, 0.2))
        elif happens == "goes":
            cores.close(rng.choice(names))
        else:
            cores.work[rng.choice(names)] = rng.uniform(0.03, 0.2)
        cores.run(5.0)
        uneven.append(max(cores.busy) - sum(cores.work.values()) / sum(cores.speeds))
    assert np.mean(uneven) < 1.5 * THRESHOLDS.least_gain
    assert np.quantile(uneven, 0.95) < 3 * THRESHOLDS.least_gain
    assert len(cores.moves) < 360 / 3
    for (before_s, before), (now_s, now) in zip(cores.moves, cores.moves[1:], strict=False):
        assert now_s - before_s >= THRESHOLDS.full_periods * THRESHOLDS.period_s
        assert now != before or now_s - before_s >= THRESHOLDS.stay_s
