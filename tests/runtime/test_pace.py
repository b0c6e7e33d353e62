"""Work stands back for what is urgent, comes to its end all the same, and ends when nobody wants its result."""

from concurrent.futures import CancelledError

import pytest

from server.runtime.pace import Pace


class Thread:
    """Whose work and sleep take time that a test counts."""

    def __init__(self, *, urgent_for_s=0.0):
        self.worked_s = self.slept_s = 0.0
        self.is_wanted = True
        self.pace = Pace(
            is_urgent=lambda: self.slept_s < urgent_for_s,
            is_wanted=lambda: self.is_wanted,
            least_share=0.1,
            thread_time_s=lambda: self.worked_s,
            sleep=self._sleep,
        )

    def _sleep(self, duration_s):
        self.slept_s += duration_s

    def work(self, duration_s, stretch_s=0.01):
        for _ in range(round(duration_s / stretch_s)):
            self.worked_s += stretch_s
            self.pace()


def test_with_nothing_urgent_it_never_sleeps():
    thread = Thread()
    thread.work(10.0)
    assert thread.slept_s == 0


def test_it_sleeps_as_long_as_something_is_urgent_and_no_longer():
    thread = Thread(urgent_for_s=0.05)
    thread.work(1.0)
    assert 0.05 <= thread.slept_s < 0.06


def test_however_long_something_is_urgent_it_has_its_least_share():
    thread = Thread(urgent_for_s=1e9)
    thread.work(1.0)
    assert thread.worked_s / (thread.worked_s + thread.slept_s) == pytest.approx(0.1, abs=0.02)


def test_what_nobody_wants_ends_at_its_next_checkpoint():
    thread = Thread()
    thread.work(0.1)
    thread.is_wanted = False
    with pytest.raises(CancelledError):
        thread.work(0.01)
