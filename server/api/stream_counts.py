"""Total counts of all streams, open and ended. No total ever falls.

A stream that ends moves from the open streams to the past totals while another thread may read both. So both are one
immutable value that is replaced at once, and a stream's counts are final before it moves. A reader therefore counts
every stream exactly once, whichever value it has.
"""

import threading
from collections import Counter, defaultdict
from typing import NamedTuple, Self

from server.core.durations import DurationHistogram
from server.streaming.plan_audit import RegretRecord
from server.streaming.stream import Stream


class StreamTotals:
    """Sum of the counts and durations of several streams."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.regrets = RegretRecord()
        self.durations: defaultdict[str, DurationHistogram] = defaultdict(DurationHistogram)

    @classmethod
    def of(cls, stream: Stream) -> Self:
        totals = cls()
        counts, times = stream.audience.totals()
        totals.counts.update(counts)
        totals.counts["late"] = stream.blocks_late
        totals.regrets.merge(stream.regrets)
        totals.durations["render"].merge(stream.times.render)
        totals.durations["lateness"].merge(stream.times.lateness)
        for each in times:
            totals.durations["ir"].merge(each.response)
            totals.durations["pose"].merge(each.pose.durations)
        return totals

    def merge(self, other: "StreamTotals") -> None:
        self.counts += other.counts
        self.regrets.merge(other.regrets)
        for name, durations in other.durations.items():
            self.durations[name].merge(durations)


class _Account:
    """Counts of one stream, up to now or up to when it was closed."""

    def __init__(self, stream: Stream) -> None:
        self._stream: Stream | None = stream
        self._final = StreamTotals()
        self._lock = threading.Lock()

    def close(self) -> StreamTotals:
        """Keep the present counts as final, and drop the stream."""
        with self._lock:
            if self._stream is not None:
                self._final, self._stream = StreamTotals.of(self._stream), None
            return self._final

    def read(self) -> StreamTotals:
        with self._lock:
            return self._final if self._stream is None else StreamTotals.of(self._stream)


class _Books(NamedTuple):
    """Accounts of open streams, and the sum of the ended ones. `past` is never modified, so a reader may keep it."""

    accounts: dict[Stream, _Account]
    past: StreamTotals


class StreamLedger:
    """Counts of all streams of a server. The event loop opens and closes streams; any thread may read the totals."""

    def __init__(self) -> None:
        self._books = _Books({}, StreamTotals())

    def open(self, stream: Stream) -> None:
        """Count a stream from now on."""
        accounts, past = self._books
        self._books = _Books({**accounts, stream: _Account(stream)}, past)

    def close(self, stream: Stream) -> None:
        """Keep the counts of a stream, and drop the stream. A second call changes nothing."""
        accounts, past = self._books
        if stream not in accounts:
            return
        # Until `_books` is replaced, readers find the same counts in the account.
        final = accounts[stream].close()
        left = {other: account for other, account in accounts.items() if other is not stream}
        self._books = _Books(left, _sum(past, final))

    def totals(self) -> StreamTotals:
        """Sum over all streams since the start. No count is less than in earlier totals."""
        accounts, past = self._books
        return _sum(past, *(account.read() for account in accounts.values()))


def _sum(*several: StreamTotals) -> StreamTotals:
    total = StreamTotals()
    for each in several:
        total.merge(each)
    return total
