"""Points of the frontier: what a quality level gets wrong, what it costs, and which levels are worth their time."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.scene.manifest import Accuracy, Cost, QualityLevel

_Floats = npt.NDArray[np.float64]
_MISSING_ALLOWANCE = 0.01
OFFERED_APART = 3.0
ALIKE = 1.03
"""Errors, below one JND most of them, whose difference nobody would wait for."""
AS_SOON = 1.1
"""Times whose difference may be the host's mood."""


@dataclass(frozen=True)
class Point:
    """A level with its measured `accuracy` and `cost`; `audible` are its mean errors in JND by metric, `by_pair`
    (pair,) the mean of them for each held-out pair.

    A level that no server can offer, such as the true phase, is a `bound`: drawn for orientation only. So is one whose
    responses cannot be measured as often as the references can (`missing`, a share): it must not win by leaving the
    hard ones out.
    """

    level: QualityLevel
    audible: Mapping[str, float]
    by_pair: _Floats
    missing: float = 0.0
    bound: bool = False

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
    """Those that no cheaper one equals, cheapest first, of all that miss hardly more than `missing`. Their cost is the
    mean.

    Each is more accurate than the one before it by more than one standard error of their difference over the held-out
    pairs, so that what is called better is not the luck of the draw.
    """
    best: list[Point] = []
    eligible = [point for point in points if not point.bound and point.missing <= missing + _MISSING_ALLOWANCE]
    for point in sorted(eligible, key=lambda point: point.cost.ms_mean):
        if not best or _is_better(point.by_pair, best[-1].by_pair):
            best.append(point)
    return best


def _is_better(ours: _Floats, theirs: _Floats) -> bool:
    gain = theirs - ours
    gain = gain[np.isfinite(gain)]
    if len(gain) < 2:
        return bool(np.mean(gain) > 0)
    return bool(np.mean(gain) > np.std(gain, ddof=1) / math.sqrt(len(gain)))


def default_point(best: Sequence[Point], *, ms: float) -> Point:
    """The most accurate of Pareto-optimal points whose response takes at most `ms` where nothing was kept; or rather,
    of those hardly less accurate (`ALIKE`), the most accurate that takes hardly longer (`AS_SOON`) than the quickest.
    Where none is in time, the one whose response takes least."""
    quick = [point for point in best if point.cost.ms_miss <= ms]
    if not quick:
        return min(best, key=lambda point: point.cost.ms_miss)
    least = min(point.audible_error for point in quick)
    alike = [point for point in quick if point.audible_error <= ALIKE * least]
    soonest_ms = min(point.cost.ms_miss for point in alike)
    return min(
        (point for point in alike if point.cost.ms_miss <= AS_SOON * soonest_ms), key=lambda point: point.audible_error
    )


def offered_points(best: Sequence[Point], default: Point) -> list[Point]:
    """A few of the Pareto-optimal points, the default first: from it on down and up, each the most accurate of those
    that cost a third or less of the one before it, or three times as much or more."""
    offered = [default]
    for point in reversed(best):
        if point.cost.ms_mean * OFFERED_APART <= offered[-1].cost.ms_mean:
            offered.append(point)
    dearest = default
    for point in best:
        if point.cost.ms_mean >= OFFERED_APART * dearest.cost.ms_mean:
            dearest = point
            offered.append(point)
    return offered
