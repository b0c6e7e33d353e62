"""Shares and medians with their intervals.

Answers of one person are alike, which binomial intervals do not know. So beside them there are intervals over people:
listeners are drawn with replacement, and the interval holds the middle 95 % of what those draws give.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
import numpy.typing as npt
import scipy.stats

from server.scene.geometry import Strict

CONFIDENCE: Final = 0.95
_DRAWS: Final = 4_000
_SEED: Final = 0
_MOST_PERMUTED: Final = 7

Interval = tuple[float, float]


class Share(Strict):
    """`count` of `trials`. `wilson` and `clopper_pearson` are binomial intervals; `over_listeners` is None for fewer
    than two people. `p` is that of the exact two-sided test against one half."""

    count: int
    trials: int
    listeners: int
    share: float
    wilson: Interval
    clopper_pearson: Interval
    over_listeners: Interval | None
    p: float

    @classmethod
    def of(cls, by_listener: Sequence[tuple[int, int]]) -> "Share":
        """From (count, trials) of each listener, with one trial at least in all."""
        counts = np.array(by_listener)
        count, trials = (int(total) for total in counts.sum(axis=0))
        test = scipy.stats.binomtest(count, trials)
        wilson, exact = (test.proportion_ci(CONFIDENCE, method=method) for method in ("wilson", "exact"))
        return cls(
            count=count,
            trials=trials,
            listeners=len(counts),
            share=count / trials,
            wilson=(float(wilson.low), float(wilson.high)),
            clopper_pearson=(float(exact.low), float(exact.high)),
            over_listeners=_over(len(counts), lambda drawn: float(np.divide(*counts[drawn].sum(axis=0)))),
            p=float(test.pvalue),
        )


class Spread(Strict):
    """The median of ratings, its interval over listeners (None for fewer than two), and the quartiles."""

    ratings: int
    median: float
    interval: Interval | None
    quartiles: Interval

    @classmethod
    def of(cls, by_listener: Sequence[Sequence[float]]) -> "Spread":
        """From the ratings of each listener, each one at least."""
        ratings = [np.asarray(given, np.float64) for given in by_listener]
        together = np.concatenate(ratings)
        low, median, high = (float(each) for each in np.quantile(together, (0.25, 0.5, 0.75)))

        def median_of(drawn: npt.NDArray[np.integer]) -> float:
            return float(np.median(np.concatenate([ratings[index] for index in drawn])))

        return cls(ratings=len(together), median=median, interval=_over(len(ratings), median_of), quartiles=(low, high))


def holm(p: Sequence[float]) -> list[float]:
    """p values corrected for their number (Holm, 1979)."""
    corrected = np.empty(len(p))
    highest = 0.0
    for rank, index in enumerate(np.argsort(p, kind="stable")):
        highest = max(highest, min(1.0, (len(p) - rank) * p[index]))
        corrected[index] = highest
    return [float(each) for each in corrected]


class RankAgreement(Strict):
    """Spearman's rank correlation over `count` methods, and its two-sided p: exact for a few methods."""

    count: int
    rho: float
    p: float

    @classmethod
    def of(cls, first: Sequence[float], second: Sequence[float]) -> "RankAgreement | None":
        """None for fewer than three, or if one side is all equal."""
        if len(first) < 3 or len(set(first)) == 1 or len(set(second)) == 1:
            return None
        found = scipy.stats.spearmanr(first, second)
        rho, p = float(found.statistic), float(found.pvalue)
        if len(first) <= _MOST_PERMUTED:
            # The usual p is that of many methods: it is 0 for three in the same order.
            ranks, others = (scipy.stats.zscore(scipy.stats.rankdata(side)) for side in (first, second))
            possible = np.array(list(itertools.permutations(ranks))) @ others / len(first)
            p = float(np.mean(np.abs(possible) >= abs(rho) - 1e-9))
        return cls(count=len(first), rho=rho, p=p)


def _over(listeners: int, statistic: Callable[[npt.NDArray[np.integer]], float]) -> Interval | None:
    if listeners < 2:
        return None
    rng = np.random.default_rng(_SEED)
    draws = [statistic(rng.integers(listeners, size=listeners)) for _ in range(_DRAWS)]
    low, high = np.quantile(draws, (0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2))
    return float(low), float(high)
