"""What is urgent is done first, and nothing is lost."""

import gc
import itertools
import threading
import time
import weakref

import pytest

from server.runtime.workers import Workers
from server.streaming.pending_work import PendingWork


@pytest.fixture
def workers():
    with Workers(1) as workers:
        yield workers


@pytest.fixture
def hold(workers):
    """Keeps the only worker until it is called."""
    is_released = threading.Event()
    begun = workers.submit(is_released.wait, kind="plan")
    while not begun.running():
        pass
    yield is_released.set
    is_released.set()


def test_urgent_work_is_done_before_what_waits_longer_and_all_else_in_order(workers, hold):
    done = []
    futures = [workers.submit(done.append, number, kind="plan") for number in range(3)]
    futures += [workers.submit(done.append, name, kind="plan", is_urgent=True) for name in "ab"]
    hold()
    for future in futures:
        future.result(timeout=10)
    assert done == ["a", "b", 0, 1, 2]


def test_each_kind_has_its_share_of_the_time_however_many_wait_of_either(workers, hold, monkeypatch):
    """Three quarters for responses, of equal pieces of work; what has not waited saves nothing up."""
    clock_s = itertools.count()
    monkeypatch.setattr("server.runtime.workers.time.thread_time", lambda: next(clock_s))
    done = []
    hold()
    for future in [workers.submit(done.append, "early", kind="response") for _ in range(20)]:
        future.result(timeout=10)
    is_released = threading.Event()
    workers.submit(is_released.wait, kind="response", is_urgent=True)
    works = [workers.submit(done.append, kind, kind=kind) for kind in ("plan", "response") for _ in range(12)]
    is_released.set()
    for future in works:
        future.result(timeout=10)
    both = done[20:32]
    assert both.count("response") == pytest.approx(9, abs=1)
    assert both.index("plan") <= 3


def test_results_and_exceptions_come_back(workers):
    assert workers.submit(divmod, 7, 2, kind="response").result(timeout=10) == (3, 1)
    with pytest.raises(ZeroDivisionError):
        workers.submit(divmod, 7, 0, kind="plan", is_urgent=True).result(timeout=10)


def test_what_was_cancelled_is_left_out(workers, hold):
    done = []
    cancelled, kept = (workers.submit(done.append, number, kind="plan") for number in (1, 2))
    assert cancelled.cancel()
    hold()
    kept.result(timeout=10)
    assert done == [2]


def test_what_was_cancelled_is_let_go_of_while_it_waits(workers, hold):
    class Asker:
        def keep(self, outcome):
            raise AssertionError(outcome)

    asker, pending = Asker(), PendingWork()
    reference = weakref.ref(asker)
    pending.keep_outcome(workers.submit(print, asker, kind="response", is_urgent=True), asker.keep)
    pending.cancel()
    assert len(pending) == 0
    del asker
    assert reference() is None
    hold()


def test_several_workers_do_everything_once():
    done = []
    with Workers(3) as workers:
        for number in range(300):
            workers.submit(done.append, number, kind=("plan", "response")[number % 2], is_urgent=number % 3 > 0)
    assert sorted(done) == list(range(300))


def test_work_that_fails_is_let_go_of_at_once(workers):
    """A traceback holds the frames that it passed through, and with them whatever they hold."""

    class Asker:
        pass

    def fail(asker):
        raise ValueError(asker)

    asker = Asker()
    reference = weakref.ref(asker)
    gc.collect()
    gc.disable()
    try:
        future = workers.submit(fail, asker, kind="plan")
        assert isinstance(future.exception(5), ValueError)
        del future, asker
        until_s = time.monotonic() + 5
        while reference() is not None and time.monotonic() < until_s:
            time.sleep(0.01)  # the worker may still be about to leave
        assert reference() is None
    finally:
        gc.enable()
