"""How long things took, kept so cheaply that every block can be measured."""

import math
from itertools import accumulate

_SHORTEST_S = 1e-6
_PER_OCTAVE = 16
_OCTAVES = 26
"""Up to a minute."""
_BINS = _OCTAVES * _PER_OCTAVE


class DurationHistogram:
    """Counts of durations on a logarithmic scale from a microsecond to a minute, to within 2.2 %; what lies outside
    counts as the nearest end. One thread adds; any may read."""

    def __init__(self) -> None:
        self.count = 0
        self.total_s = 0.0
        self._bins = [0] * _BINS

    def add(self, duration_s: float, times: int = 1) -> None:
        place = int(math.log2(duration_s / _SHORTEST_S) * _PER_OCTAVE) if duration_s > _SHORTEST_S else 0
        self._bins[place if place < _BINS else _BINS - 1] += times
        self.count += times
        self.total_s += times * duration_s

    def merge(self, other: "DurationHistogram") -> None:
        """Add what another counted."""
        self.count += other.count
        self.total_s += other.total_s
        self._bins = [mine + others for mine, others in zip(self._bins, other._bins, strict=True)]

    def cumulative(self) -> list[tuple[float, int]]:
        """Durations, each twice the one before, and how many were below each. Of the last, how many there were: what is
        longer counts there too."""
        sums = list(accumulate(self._bins))
        return [(_SHORTEST_S * 2**octave, sums[octave * _PER_OCTAVE - 1]) for octave in range(1, _OCTAVES + 1)]

    def quantile_s(self, share: float) -> float | None:
        """The shortest duration that `share` of all do not exceed; None before the first."""
        wanted = max(1, math.ceil(share * self.count))
        seen = 0
        for place, count in enumerate(self._bins):
            seen += count
            if seen >= wanted:
                return float(_SHORTEST_S * 2 ** ((place + 0.5) / _PER_OCTAVE))
        return None
