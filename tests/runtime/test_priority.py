import os
import sys
import threading
import time
from concurrent.futures import CancelledError, ThreadPoolExecutor

import pytest

from server.runtime.priority import DutyCycle, become_background, become_prompt, become_real_time

pytestmark = pytest.mark.timed

on_linux = pytest.mark.skipif(sys.platform != "linux", reason="priorities of single threads are Linux's")


def in_a_thread(function):
    """What `function` returns in a thread of its own, whose priority ends with it."""
    returned = []
    thread = threading.Thread(target=lambda: returned.append(function()))
    thread.start()
    thread.join()
    return returned[0]


@on_linux
def test_who_is_prompt_goes_before_ordinary_threads_and_threads_it_starts_are_ordinary():
    def look():
        return os.getpriority(os.PRIO_PROCESS, 0), os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK

    def work():
        return become_prompt(), look(), in_a_thread(look)

    is_allowed, of_itself, of_its_threads = in_a_thread(work)
    ordinary = in_a_thread(look)
    assert of_itself == ((-10, os.SCHED_OTHER) if is_allowed else ordinary)
    assert of_its_threads == ordinary


@on_linux
def test_real_time_is_reached_or_the_reason_is_told_and_other_threads_stay_ordinary():
    def try_it():
        reason = become_real_time()
        return reason, os.sched_getscheduler(0), in_a_thread(lambda: os.sched_getscheduler(0))

    reason, policy, policy_of_child = in_a_thread(try_it)
    if reason is None:
        assert policy == os.SCHED_RR | os.SCHED_RESET_ON_FORK
    else:
        assert policy == os.SCHED_OTHER
    assert policy_of_child == os.SCHED_OTHER
    assert os.sched_getscheduler(0) == os.SCHED_OTHER


@on_linux
def test_where_real_time_is_forbidden_the_reason_is_told(monkeypatch):
    def forbid(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", forbid)
    assert become_real_time() == "Operation not permitted"


@on_linux
def test_a_thread_in_the_background_yields_and_the_others_do_not():
    def try_it():
        become_background()
        return os.getpriority(os.PRIO_PROCESS, 0)

    before = os.getpriority(os.PRIO_PROCESS, 0)
    assert in_a_thread(try_it) == 5
    assert os.getpriority(os.PRIO_PROCESS, 0) == before


def test_work_with_breaks_rests_in_proportion_once_it_has_worked_long_enough():
    worked_s = 0.0
    breaks = DutyCycle(0.25, stretch_s=0.1, thread_time_s=lambda: worked_s)

    def rested_s():
        began_s = time.perf_counter()
        breaks.rest()
        return time.perf_counter() - began_s

    breaks.rest()
    worked_s = 0.09
    assert min(rested_s() for _ in range(10)) < 0.09
    worked_s = 0.11
    assert rested_s() >= 3 * 0.11
    assert min(rested_s() for _ in range(10)) < 0.09
    worked_s = 0.22
    assert rested_s() >= 3 * 0.1


def test_work_that_disturbs_nobody_does_not_rest():
    worked_s, is_idle = 0.0, True
    breaks = DutyCycle(1e-6, is_idle=lambda: is_idle, thread_time_s=lambda: worked_s)
    breaks.rest()
    for _ in range(10):  # each would rest for more than a day
        worked_s += 0.1
        breaks.rest()
    is_idle = False
    worked_s += 1e-6
    breaks.rest()  # what was worked while nobody was disturbed is not made up for
    worked_s += 0.1
    with ThreadPoolExecutor(1) as thread:
        resting = thread.submit(breaks.rest)
        with pytest.raises(TimeoutError):
            resting.result(timeout=0.05)
        breaks.call_off()
        with pytest.raises(CancelledError):
            resting.result(timeout=5)


def test_work_called_off_ends_with_the_break_it_has():
    breaks = DutyCycle(1e-6, stretch_s=0.001)

    def work():
        while True:
            breaks.rest()

    with ThreadPoolExecutor(1) as thread:
        working = thread.submit(work)
        time.sleep(0.05)
        breaks.call_off()
        with pytest.raises(CancelledError):
            working.result(timeout=5)
