"""Whenever a stream ends while somebody reads, what it has counted is in the totals once."""

import threading

import pytest

from server.api.stream_counts import StreamLedger
from server.streaming.audience import Audience
from server.streaming.plan_audit import Regret, RegretRecord
from server.streaming.stream_times import StreamTimes


class Counting:
    """A stream, as far as it counts; `when_read` is called in the midst of a reader's look at it."""

    def __init__(self, blocks, when_read=lambda: None):
        self.session = self.window = self.renderer = self
        self.sent = self.blocks_late = self.blocks_dropped = self.blocks_limited = self.ir_exchanges = blocks
        self.samples_silenced = 0
        self.times = StreamTimes()
        self._regrets, self._when_read = RegretRecord(), when_read
        self.count(blocks)

    def count(self, blocks):
        self.times.render.add(0.0001, blocks)

    @property
    def audience(self):
        return Audience(self, self.times)

    @property
    def regrets(self):
        self._when_read()
        return self._regrets


def read(ledger):
    totals = ledger.totals()
    return totals.counts["sent"], totals.counts["late"], totals.durations["render"].count


@pytest.mark.parametrize("ends", ["before it is read", "after it is read"])
def test_a_stream_that_ends_amid_a_look_at_another_is_counted_once(ends):
    ledger = StreamLedger()
    ending = Counting(5)
    reading = Counting(7, when_read=lambda: ledger.close(ending))
    for stream in (reading, ending) if ends == "before it is read" else (ending, reading):
        ledger.open(stream)
    assert read(ledger) == (12, 12, 12)
    assert read(ledger) == (12, 12, 12)


def test_what_a_stream_counts_while_it_ends_is_not_taken_back():
    """A block that its audio thread renders after the end: no reader has seen it, or every later one does."""
    ledger, looks = StreamLedger(), []
    ending = Counting(5)

    def end():
        ledger.close(ending)
        ending.sent += 1
        ending.count(1)

    reading = Counting(7, when_read=end)
    ledger.open(reading)
    ledger.open(ending)
    looks += [read(ledger), read(ledger)]
    assert looks[0] == looks[1] == (12, 12, 12)


def test_an_end_waits_for_the_look_at_that_very_stream():
    """So a reader that has seen the newest count cannot be followed by one to whom an older one is final."""
    ledger, is_read, is_counted = StreamLedger(), threading.Event(), threading.Event()

    def wait():
        is_read.set()
        assert is_counted.wait(5)

    stream = Counting(5, when_read=wait)
    ledger.open(stream)
    looks = []
    looking = threading.Thread(target=lambda: looks.append(read(ledger)))
    looking.start()
    assert is_read.wait(5)
    ending = threading.Thread(target=ledger.close, args=[stream])
    ending.start()
    stream.count(3)  # after the reader has looked at other counts, before it looks at this one
    ending.join(0.1)
    assert ending.is_alive()
    is_counted.set()
    looking.join(5)
    ending.join(5)
    assert looks == [(5, 5, 8)]
    assert read(ledger) == (5, 5, 8)


def test_a_stream_that_has_ended_is_kept_by_nobody():
    ledger, stream = StreamLedger(), Counting(5)
    ledger.open(stream)
    ledger.close(stream)
    ledger.close(stream)
    assert read(ledger) == (5, 5, 5)
    assert stream not in vars(ledger)["_books"].accounts


def test_sums_of_durations_are_the_same_whoever_has_ended():
    """In floating point they would depend on the order, and fall by a rounding error where a stream ends."""
    times_s = [0.1 / 3, 0.7 / 3, 1e-5 / 3, 0.9 / 7]
    ledger, streams = StreamLedger(), [Counting(0) for _ in times_s]
    for stream, time_s in zip(streams, times_s, strict=True):
        stream.times.render.add(time_s, 3)
        ledger.open(stream)
    sums = {ledger.totals().durations["render"].total_s}
    for stream in reversed(streams):
        ledger.close(stream)
        sums.add(ledger.totals().durations["render"].total_s)
    (total_s,) = sums
    assert total_s == pytest.approx(3 * sum(times_s), abs=1e-8)


def test_checks_are_counted_while_others_are_added():
    """The first of a parameter makes the record longer, which nobody may be going through meanwhile."""
    ledger, stream = StreamLedger(), Counting(1)

    class Growing(dict):
        def items(self):
            for name, jnd in super().items():
                self[f"{name}+"] = 1.0
                yield name, jnd

    stream._regrets.add(Regret({"spectrum": 2.0}, {}, 0.0))
    stream._regrets.worst_jnd = Growing(stream._regrets.worst_jnd)
    ledger.open(stream)
    regrets = ledger.totals().regrets
    assert (regrets.checks, regrets.failures, regrets.worst_jnd["spectrum"]) == (1, 1, 2.0)
