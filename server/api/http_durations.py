"""How long answers to HTTP requests took, in a histogram for each route, method and class of status."""

from bisect import bisect_left
from collections.abc import Iterator
from itertools import accumulate
from typing import Final

BOUNDS_S: Final = (0.005, 0.025, 0.1, 0.5, 2.5, 10.0)
"""Upper bounds of the buckets. What is kept in memory takes milliseconds, one response tens of them, and a map or a
batch seconds."""
_METHODS: Final = frozenset({"GET", "HEAD", "OPTIONS", "POST", "PUT", "DELETE"})
_OTHER: Final = "other"


class HttpDurations:
    """Durations by method, route and class of status. Clients cannot make new ones: a method or path that no route has
    is `other`. One thread notes; any thread may read."""

    def __init__(self) -> None:
        self._counts: dict[tuple[str, str, str], list[int]] = {}
        """By method, route and status, the durations in each bucket and beyond the last."""
        self._totals_s: dict[tuple[str, str, str], float] = {}

    def note(self, method: str, route: str | None, status: int, duration_s: float) -> None:
        """Count an answer. `route` is the path of a route with names of parameters; None if there is no such route."""
        labels = (method if method in _METHODS else _OTHER, route or _OTHER, f"{status // 100}xx")
        counts = self._counts.setdefault(labels, [0] * (len(BOUNDS_S) + 1))
        self._totals_s[labels] = self._totals_s.get(labels, 0.0) + duration_s
        counts[bisect_left(BOUNDS_S, duration_s)] += 1

    def told(self) -> Iterator[tuple[tuple[str, str, str], list[tuple[str, float]], float]]:
        """For each method, route and status, the buckets as Prometheus has them, and the sum of durations in
        seconds."""
        bounds = (*(f"{bound_s:g}" for bound_s in BOUNDS_S), "+Inf")
        for labels, counts in tuple(self._counts.items()):
            buckets = zip(bounds, map(float, accumulate(tuple(counts))), strict=True)
            yield labels, list(buckets), self._totals_s.get(labels, 0.0)
