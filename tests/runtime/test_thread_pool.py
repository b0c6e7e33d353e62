"""Threads that do what they are given, whatever becomes of one of them."""

import threading
import time

import pytest

from server.runtime.thread_pool import ThreadPool
from server.runtime.thread_watch import ThreadWatch
from tests.killing import kill, threads_may_die


@pytest.fixture
def pool():
    pool = ThreadPool(2, "pool", patience_s=1.0)
    yield pool
    assert pool.stop(5)


def done_of(pool, number):
    """What so many jobs did, once all have."""
    done, all_done = [], threading.Event()

    def job(each):
        done.append(each)
        if len(done) == number:
            all_done.set()

    for each in range(number):
        pool.submit(lambda each=each: job(each))
    assert all_done.wait(5)
    return done


def wait_until(condition):
    until_s = time.monotonic() + 5
    while not condition():
        assert time.monotonic() < until_s
        time.sleep(0.005)


def test_everything_is_done_once(pool):
    assert sorted(done_of(pool, 200)) == list(range(200))


@threads_may_die
def test_nothing_is_lost_with_threads_that_die_and_new_ones_take_their_place(pool):
    watch = ThreadWatch((pool,))
    for thread in pool.threads:
        kill(thread._thread)
    done, is_done = [], threading.Event()
    # A waiting thread dies with the next job that it is handed.
    pool.submit(lambda: done.append("a"))
    pool.submit(lambda: (done.append("b"), is_done.set()))
    wait_until(lambda: all(thread.is_dead for thread in pool.threads))
    watch.look()
    assert is_done.wait(5)
    wait_until(lambda: len(done) == 2)
    assert sorted(done) == ["a", "b"]
    assert watch.restarts == {"pool-0": 1, "pool-1": 1}
    assert sorted(done_of(pool, 50)) == list(range(50))


def test_an_initializer_that_raises_is_told_of_and_keeps_nobody_from_working(caplog):
    def initialize():
        raise OSError("no such priority")

    pool = ThreadPool(1, "pool", initializer=initialize, patience_s=1.0)
    try:
        assert done_of(pool, 3) == [0, 1, 2]
    finally:
        pool.stop(5)
    assert "no such priority" in caplog.text


def test_a_thread_says_what_it_is_at(pool):
    release, begun = threading.Event(), threading.Event()
    pool.submit(lambda: (begun.set(), release.wait(5)))
    assert begun.wait(5)
    assert sorted(thread.work_number is None for thread in pool.threads) == [False, True]
    release.set()
    wait_until(lambda: all(thread.work_number is None for thread in pool.threads))


def test_stopping_does_not_wait_for_what_never_ends():
    pool, release = ThreadPool(1, "pool", patience_s=1.0), threading.Event()
    pool.submit(release.wait)
    began_s = time.monotonic()
    assert not pool.stop(0.2)
    assert time.monotonic() - began_s < 2
    release.set()


def test_a_pool_that_was_stopped_is_not_taken_for_dead():
    pool = ThreadPool(2, "pool", patience_s=1.0)
    assert pool.stop(5)
    assert not any(thread.is_dead for thread in pool.threads)
