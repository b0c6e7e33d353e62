import os
import sys
import threading

import pytest

from server.priority import become_background, become_real_time

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="priorities of single threads are Linux's")


def in_a_thread(function):
    """What `function` returns in a thread of its own, whose priority ends with it."""
    returned = []
    thread = threading.Thread(target=lambda: returned.append(function()))
    thread.start()
    thread.join()
    return returned[0]


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


def test_where_real_time_is_forbidden_the_reason_is_told(monkeypatch):
    def forbid(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", forbid)
    assert become_real_time() == "Operation not permitted"


def test_a_thread_in_the_background_yields_and_the_others_do_not():
    def try_it():
        become_background()
        return os.getpriority(os.PRIO_PROCESS, 0)

    before = os.getpriority(os.PRIO_PROCESS, 0)
    assert in_a_thread(try_it) == 5
    assert os.getpriority(os.PRIO_PROCESS, 0) == before
