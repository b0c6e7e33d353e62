"""Calls that may never return."""

import asyncio
import threading

import pytest

from server.runtime.bounded_calls import BoundedCalls


def test_results_and_errors_come_back():
    async def scenario():
        calls = BoundedCalls(2, "calls")
        assert await calls.run(lambda: 7, 5) == 7
        with pytest.raises(ZeroDivisionError):
            await calls.run(lambda: 1 / 0, 5)

    asyncio.run(scenario())


def test_a_call_that_is_given_up_keeps_its_thread_until_it_returns():
    release = threading.Event()

    async def scenario():
        calls = BoundedCalls(2, "calls")
        for _ in range(2):
            with pytest.raises(TimeoutError):
                await calls.run(release.wait, 0.05)
        with pytest.raises(TimeoutError):
            await calls.run(lambda: 7, 0.05)
        assert sum(thread.name == "calls" for thread in threading.enumerate()) == 2
        waiting = asyncio.create_task(calls.run(lambda: 7, 5))
        await asyncio.sleep(0)
        release.set()
        assert await waiting == 7

    asyncio.run(scenario())


def test_an_error_after_the_call_was_given_up_is_not_reported(caplog):
    release = threading.Event()

    def fail():
        release.wait()
        raise OSError("late")

    async def scenario():
        calls = BoundedCalls(1, "calls")
        with pytest.raises(TimeoutError):
            await calls.run(fail, 0.05)
        release.set()
        assert await calls.run(lambda: 7, 5) == 7

    asyncio.run(scenario())
    assert caplog.records == []
