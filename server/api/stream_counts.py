"""What streams have counted, those that are open and those that have ended, such that no sum ever falls.

A stream that ends moves from one side to the other while another thread reads both. So both sides are one immutable
value that is replaced at once, and what a stream has counted is final before it moves: a reader counts every stream
exactly once, whichever value it holds.
"""

import threading
from collections import Counter, defaultdict
from typing import NamedTuple, Self

from server.core.durations import DurationHistogram
from server.streaming.plan_audit import RegretRecord
from server.streaming.stream import Stream


class StreamTotals:
    """What several streams counted and timed, together."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.regrets = RegretRecord()
        self.durations: defaultdict[str, DurationHistogram] = defaultdict(DurationHistogram)

    @classmethod
    def of(cls, stream: Stream) -> Self:
        totals = cls()
        session = stream.session
        totals.counts["sent"] = session.window.sent
        totals.counts["late"] = stream.blocks_late
        totals.counts["dropped"] = session.blocks_dropped
        totals.counts["exchanges"] = session.ir_exchanges
        totals.counts["limited"] = session.blocks_limited
        totals.counts["silenced"] = session.renderer.samples_silenced
        totals.regrets.merge(stream.regrets)
        totals.durations["render"].merge(stream.times.render)
        totals.durations["lateness"].merge(stream.times.lateness)
        totals.durations["ir"].merge(stream.times.response)
        totals.durations["pose"].merge(stream.times.pose.durations)
        return totals

    def merge(self, other: "StreamTotals") -> None:
        self.counts += other.counts
        self.regrets.merge(other.regrets)
        for name, durations in other.durations.items():
            self.durations[name].merge(durations)


class _Account:
    """What one stream has counted: up to now, or, once it is closed, up to then."""

    def __init__(self, stream: Stream) -> None:
        self._stream: Stream | None = stream
        self._final = StreamTotals()
        self._lock = threading.Lock()

    def close(self) -> StreamTotals:
        """Heed nothing that the stream counts from now on, and let go of it."""
        with self._lock:
            if self._stream is not None:
                self._final, self._stream = StreamTotals.of(self._stream), None
            return self._final

    def read(self) -> StreamTotals:
        with self._lock:
            return self._final if self._stream is None else StreamTotals.of(self._stream)


class _Books(NamedTuple):
    """`past` is never changed: a reader may hold it for as long as it likes."""

    accounts: dict[Stream, _Account]
    past: StreamTotals


class StreamLedger:
    """Of a server. The event loop opens and closes; any thread may ask for the totals."""

    def __init__(self) -> None:
        self._books = _Books({}, StreamTotals())

    def open(self, stream: Stream) -> None:
        """Count a stream from now on."""
        accounts, past = self._books
        self._books = _Books({**accounts, stream: _Account(stream)}, past)

    def close(self, stream: Stream) -> None:
        """Keep what a stream has counted, and let go of it. Closing twice does no harm."""
        accounts, past = self._books
        if stream not in accounts:
            return
        # Until both sides are replaced, readers find the same figures in its account.
        final = accounts[stream].close()
        left = {other: account for other, account in accounts.items() if other is not stream}
        self._books = _Books(left, _sum(past, final))

    def totals(self) -> StreamTotals:
        """Of all streams there have ever been; nothing in it is less than in the totals of before."""
        accounts, past = self._books
        return _sum(past, *(account.read() for account in accounts.values()))


def _sum(*several: StreamTotals) -> StreamTotals:
    total = StreamTotals()
    for each in several:
        total.merge(each)
    return total
