"""How long things took, kept so cheaply that every block can be measured."""

import math
from bisect import bisect_left
from itertools import accumulate

_SHORTEST_S = 1e-6
_PER_OCTAVE = 16
_OCTAVES = 26
"""Up to a minute."""
_BINS = _OCTAVES * _PER_OCTAVE


class DurationHistogram:
    """Counts of durations on a logarithmic scale from a microsecond to a minute, to within 2.2 %; what lies outside
    counts as the nearest end. Their sum is kept in whole nanoseconds, so that it is the same in whatever order
    histograms are merged. One thread adds; any may read."""

    def __init__(self) -> None:
        self.count = 0
        self._total_ns = 0
        self._bins = [0] * _BINS

    @property
    def total_s(self) -> float:
        """Of all that were added."""
        return self._total_ns / 1e9

    def add(self, duration_s: float, times: int = 1) -> None:
        place = int(math.log2(duration_s / _SHORTEST_S) * _PER_OCTAVE) if duration_s > _SHORTEST_S else 0
        self._bins[place if place < _BINS else _BINS - 1] += times
        self.count += times
        self._total_ns += times * round(max(0.0, duration_s) * 1e9)

    def merge(self, other: "DurationHistogram") -> None:
        """Add what another counted."""
        self.count += other.count
        self._total_ns += other._total_ns
        self._bins = [mine + others for mine, others in zip(self._bins, other._bins, strict=True)]

    def cumulative(self) -> list[tuple[float, int]]:
        """Durations, each twice the one before, and how many were below each. Of the last, how many there were: what is
        longer counts there too."""
        sums = list(accumulate(self._bins))
        return [(_SHORTEST_S * 2**octave, sums[octave * _PER_OCTAVE - 1]) for octave in range(1, _OCTAVES + 1)]

    def quantiles_s(self, *shares: float) -> list[float | None]:
        """For each, the shortest duration that such a share of all do not exceed; None before the first."""
        if not self.count:
            return [None] * len(shares)
        sums = list(accumulate(self._bins))
        # Another thread may be about to count in what it has added to a bin.
        wanted = [min(max(1, math.ceil(share * self.count)), sums[-1]) for share in shares]
        return [_SHORTEST_S * 2 ** ((bisect_left(sums, count) + 0.5) / _PER_OCTAVE) for count in wanted]
