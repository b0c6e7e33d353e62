"""What is urgent is done first, and nothing is lost."""

import threading

import pytest

from server.workers import Workers


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


def test_kinds_take_turns_however_many_wait_of_either(workers, hold):
    done = []
    plans = [workers.submit(done.append, number, kind="plan") for number in range(5)]
    responses = [workers.submit(done.append, name, kind="response") for name in "abc"]
    hold()
    for future in (*plans, *responses):
        future.result(timeout=10)
    assert done == ["a", 0, "b", 1, "c", 2, 3, 4]


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


def test_several_workers_do_everything_once():
    done = []
    with Workers(3) as workers:
        for number in range(300):
            workers.submit(done.append, number, kind=("plan", "response")[number % 2], is_urgent=number % 3 > 0)
    assert sorted(done) == list(range(300))
