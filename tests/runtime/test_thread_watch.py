"""A dead thread is replaced and a stuck one told of, by a watch whose looks a test makes."""

import asyncio
import contextlib
import math
import time

import pytest

from server.runtime.thread_watch import PERIOD_S, ThreadWatch


class Thread:
    def __init__(self, name):
        self.name, self.is_dead, self.work_number = name, False, None


class Group:
    patience_s = 1.0

    def __init__(self, *names):
        self.threads = [Thread(name) for name in names]
        self.given_up = []

    def replace(self, dead):
        self.threads = [Thread(each.name) if each is dead else each for each in self.threads]

    def give_up(self, stuck):
        self.given_up.append(stuck.name)


@pytest.fixture
def group():
    return Group("a", "b")


@pytest.fixture
def watch(group):
    return ThreadWatch((group,))


def look_for(watch, duration_s):
    for _ in range(math.ceil(duration_s / PERIOD_S)):
        watch.look()


def test_threads_that_wait_or_go_from_work_to_work_are_no_problem(watch, group):
    for number in range(600):
        group.threads[0].work_number = number // 5  # half a second each
        watch.look()
    assert watch.problem is None
    assert watch.states == {"a": "working", "b": "working"}


def test_a_thread_at_one_piece_of_work_for_longer_than_its_patience_is_stuck_until_it_goes_on(watch, group):
    group.threads[1].work_number = 7
    look_for(watch, 0.8)
    assert watch.problem is None
    look_for(watch, 0.3)
    assert watch.stuck == ("b",)
    assert "b" in watch.problem
    assert watch.states == {"a": "working", "b": "stuck"}
    group.threads[1].work_number = 8
    watch.look()
    assert watch.problem is None


def test_what_is_stuck_for_long_is_given_up_once(watch, group):
    group.threads[0].work_number = 1
    look_for(watch, 2.5)
    assert group.given_up == []
    look_for(watch, 60)
    assert group.given_up == ["a"]


def test_a_dead_thread_is_replaced_at_the_next_look_and_counted(watch, group, caplog):
    dead = group.threads[0]
    dead.is_dead = True
    watch.look()
    assert dead not in group.threads
    assert [thread.name for thread in group.threads] == ["a", "b"]
    assert watch.restarts == {"a": 1}
    assert watch.problem is None  # it was replaced: the work goes on
    assert "thread a has died" in caplog.text


def test_threads_that_die_again_and_again_are_a_problem_until_they_live_for_a_minute(watch, group):
    for _ in range(3):
        group.threads[0].is_dead = True
        look_for(watch, 1)
    assert "again and again" in watch.problem
    look_for(watch, 61)
    assert watch.problem is None


def test_a_watch_that_fails_is_a_problem_itself(monkeypatch, group, caplog):
    from server.runtime import thread_watch

    monkeypatch.setattr(thread_watch, "PERIOD_S", 0.0)
    group.replace = None
    group.threads[0].is_dead = True
    watch = ThreadWatch((group,))
    asyncio.run(watch.run())
    assert "watch" in watch.problem
    assert "has failed" in caplog.text


def test_what_holds_up_the_event_loop_is_lag(watch):
    held_s = 3 * PERIOD_S

    async def hold_up():
        watching = asyncio.create_task(watch.run())
        await asyncio.sleep(0)  # the watch begins to wait
        time.sleep(held_s)  # noqa: ASYNC251  what must not be done
        while not watch.lag.count:  # noqa: ASYNC110
            await asyncio.sleep(0)
        watching.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await watching

    asyncio.run(hold_up())
    assert watch.lag.total_s >= held_s - PERIOD_S - 0.001
