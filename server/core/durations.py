"""A histogram of durations that is cheap enough to measure every audio block."""

import math
from bisect import bisect_left
from itertools import accumulate

_SHORTEST_S = 1e-6
_PER_OCTAVE = 16
_OCTAVES = 26
"""Octaves of a microsecond that the histogram covers: up to about a minute."""
_BINS = _OCTAVES * _PER_OCTAVE


class DurationHistogram:
    """Counts durations in logarithmic bins from a microsecond to a minute, accurate to 2.2 %. A duration outside that
    range counts in the nearest bin. The sum is in whole nanoseconds, so it does not depend on the order in which
    histograms are merged. One thread adds; any thread may read."""

    def __init__(self) -> None:
        self.count = 0
        self._total_ns = 0
        self._bins = [0] * _BINS

    @property
    def total_s(self) -> float:
        """Sum of all durations added."""
        return self._total_ns / 1e9

    def add(self, duration_s: float, times: int = 1) -> None:
        place = int(math.log2(duration_s / _SHORTEST_S) * _PER_OCTAVE) if duration_s > _SHORTEST_S else 0
        self._bins[place if place < _BINS else _BINS - 1] += times
        self.count += times
        self._total_ns += times * round(max(0.0, duration_s) * 1e9)

    def merge(self, other: "DurationHistogram") -> None:
        """Add the counts of another histogram."""
        self.count += other.count
        self._total_ns += other._total_ns
        self._bins = [own + added for own, added in zip(self._bins, other._bins, strict=True)]

    def cumulative(self) -> list[tuple[float, int]]:
        """Pairs of a duration, each twice the one before, and the number of durations below it. The last pair counts
        all durations, since longer ones are in the last bin."""
        sums = list(accumulate(self._bins))
        return [(_SHORTEST_S * 2**octave, sums[octave * _PER_OCTAVE - 1]) for octave in range(1, _OCTAVES + 1)]

    def quantiles_s(self, *shares: float) -> list[float | None]:
        """Quantiles, one for each of `shares` (0 to 1); None if nothing was added yet."""
        if not self.count:
            return [None] * len(shares)
        sums = list(accumulate(self._bins))
        # Another thread may have added to a bin and not yet to the count.
        wanted = [min(max(1, math.ceil(share * self.count)), sums[-1]) for share in shares]
        return [_SHORTEST_S * 2 ** ((bisect_left(sums, count) + 0.5) / _PER_OCTAVE) for count in wanted]
