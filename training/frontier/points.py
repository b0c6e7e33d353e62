"""Points of the frontier: errors and cost of a quality level, and which levels are Pareto-optimal."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from server.scene.manifest import Accuracy, Cost, QualityLevel

_Floats = npt.NDArray[np.float64]
_MISSING_ALLOWANCE = 0.01
LEAST_COST_RATIO = 3.0
SIMILAR_ERROR = 1.03
"""Errors, mostly below one JND, whose ratio is less than this count as equal."""
SIMILAR_TIME = 1.1
"""Times whose ratio is less than this count as equal, because the host's speed varies."""


@dataclass(frozen=True)
class Point:
    """A level with its measured `accuracy` and `cost`. `audible` are its mean errors in JND by metric, `by_pair`
    (pair,) their mean for each held-out pair.

    `predicts` says what the level's field predicts. A `bound`, such as the true phase, is a level that no server can
    offer; it is drawn for comparison only. `missing` is the share of errors that cannot be measured: a level must not
    win because its hardest responses cannot be measured.
    """

    level: QualityLevel
    audible: Mapping[str, float]
    by_pair: _Floats
    missing: float = 0.0
    bound: bool = False
    predicts: Literal["ears", "directions"] = "ears"

    @property
    def accuracy(self) -> Accuracy:
        assert self.level.accuracy is not None
        return self.level.accuracy

    @property
    def cost(self) -> Cost:
        assert self.level.cost is not None
        return self.level.cost

    @property
    def audible_error(self) -> float:
        """Mean over metrics, JND."""
        return math.fsum(self.audible.values()) / len(self.audible)


def pareto(points: Sequence[Point], *, missing: float = 0.0) -> list[Point]:
    """The Pareto-optimal points by mean cost, cheapest first, among those with hardly more missing than `missing`."""
    return _optimal(eligible(points, missing=missing))


def _optimal(points: Sequence[Point]) -> list[Point]:
    """The Pareto-optimal ones of points that are all eligible.

    Each is more accurate than the one before by more than one standard error of their difference over the held-out
    pairs, so that chance does not decide.
    """
    best: list[Point] = []
    for point in sorted(points, key=lambda point: point.cost.ms_mean):
        if not best or _is_better(point.by_pair, best[-1].by_pair):
            best.append(point)
    return best


def eligible(points: Sequence[Point], *, missing: float) -> list[Point]:
    """The points that a server can offer and that have hardly more missing than `missing`."""
    return [point for point in points if not point.bound and point.missing <= missing + _MISSING_ALLOWANCE]


def _is_better(ours: _Floats, theirs: _Floats) -> bool:
    gain = theirs - ours
    gain = gain[np.isfinite(gain)]
    if len(gain) < 2:
        return bool(np.mean(gain) > 0)
    return bool(np.mean(gain) > np.std(gain, ddof=1) / math.sqrt(len(gain)))


def default_point(best: Sequence[Point], *, ms: float) -> Point:
    """The default level: of the Pareto-optimal points whose response takes at most `ms` without the cache, and whose
    error is similar to the least one, it takes those that are about as quick as the quickest, and of them the most
    accurate. Quick is what takes little time for a pose that moved and one whose head only turned,
    together. If no response takes at most `ms`, it is the quickest."""
    quick = [point for point in best if point.cost.ms_miss <= ms]
    if not quick:
        return min(best, key=lambda point: point.cost.ms_miss)
    least = min(point.audible_error for point in quick)
    alike = [point for point in quick if point.audible_error <= SIMILAR_ERROR * least]
    soonest_ms = min(map(_moved_and_turned_ms, alike))
    return min(
        (point for point in alike if _moved_and_turned_ms(point) <= SIMILAR_TIME * soonest_ms),
        key=lambda point: point.audible_error,
    )


def _moved_and_turned_ms(point: Point) -> float:
    cost = point.cost
    return cost.ms_miss + (cost.ms_miss if cost.ms_turn is None else cost.ms_turn)


def default_among(points: Sequence[Point], *, ms: float) -> Point:
    """The default level of a bundle with all these eligible points. Where a field predicts directions it is one of
    these, because they are heard through any head that is turned in any way."""
    directional = [point for point in points if point.predicts == "directions"]
    return default_point(_optimal(directional or points), ms=ms)


def offered_points(points: Sequence[Point], best: Sequence[Point], default: Point, *, ms: float) -> list[Point]:
    """A few of the Pareto-optimal points, the default first. From it on down and up, each is the most accurate of those
    that cost a third of the one before or less, or three times as much or more. The cheapest of all is offered too: a
    crowd gets it before anybody is refused.

    If no such point is of a field of ears, or of directions, and there are eligible `points` of one, what would be the
    default among these with this `ms` follows: both ways to predict a response can be heard side by side.
    """
    offered = [default]
    for point in reversed(best):
        if point.cost.ms_mean * LEAST_COST_RATIO <= offered[-1].cost.ms_mean:
            offered.append(point)
    if best[0].cost.ms_mean * SIMILAR_TIME < offered[-1].cost.ms_mean:
        offered.append(best[0])
    dearest = default
    for point in best:
        if point.cost.ms_mean >= LEAST_COST_RATIO * dearest.cost.ms_mean:
            dearest = point
            offered.append(point)
    others = sorted({point.predicts for point in points} - {point.predicts for point in offered})
    of_others = [_optimal([point for point in points if point.predicts == kind]) for kind in others]
    return [*offered, *(default_point(of_kind, ms=ms) for of_kind in of_others)]
