"""Whatever many requests want, the loop comes round to everything else between any two of them."""

import asyncio
import time
from functools import partial
from itertools import pairwise

import pytest

from server.api.turn_taking import OneAtATime, TurnTaking


def test_everything_begins_in_the_order_it_came():
    async def run():
        turns, begun, loop = TurnTaking(), [], asyncio.get_running_loop()
        for number in range(20):
            turns.begin(loop, lambda number=number: begun.append(number))
        assert begun == [0]
        assert len(turns) == 19
        while turns:  # noqa: ASYNC110  it has no event for it
            await asyncio.sleep(0.001)
        turns.begin(loop, lambda: begun.append(20))
        await asyncio.sleep(0.01)
        return begun

    assert asyncio.run(run()) == list(range(21))


def test_others_have_half_of_the_loops_time():
    """Sixty tasks of 5 ms of work, all at once, beside one who comes back to the loop again and again."""

    async def work():
        until_s = time.monotonic() + 0.005
        while time.monotonic() < until_s:
            pass

    async def run():
        turns, loop, tasks = TurnTaking(), asyncio.get_running_loop(), []
        for _ in range(60):
            turns.begin(loop, lambda: tasks.append(loop.create_task(work())))
        begin_s, rounds = time.monotonic(), 0
        while len(tasks) < 60:
            await asyncio.sleep(0)
            rounds += 1
        return time.monotonic() - begin_s, rounds

    took_s, rounds = asyncio.run(run())
    assert took_s > 0.5
    assert rounds > 60


def test_one_piece_of_work_at_a_time_and_rests_between_them():
    spans = []

    def work(number):
        begin_s = time.monotonic()
        time.sleep(0.01)
        spans.append((begin_s, time.monotonic()))
        return number

    async def run():
        one = OneAtATime()
        return await asyncio.gather(*(one.run(partial(work, number), is_wanted=lambda: True) for number in range(10)))

    assert asyncio.run(run()) == list(range(10))
    # Timers of a loop may be a millisecond early.
    rests_s = [later - ended for (_, ended), (later, _) in pairwise(spans)]
    assert min(rests_s) >= 0.008


def test_what_nobody_wants_by_then_is_not_done_and_keeps_nobody_waiting():
    done, wanted = [], {number: number % 2 == 0 for number in range(6)}

    async def run():
        one = OneAtATime()

        def work(number):
            done.append(number)
            return number

        return await asyncio.gather(
            *(one.run(partial(work, number), is_wanted=partial(wanted.get, number)) for number in wanted)
        )

    assert asyncio.run(run()) == [0, None, 2, None, 4, None]
    assert done == [0, 2, 4]


def test_work_that_fails_lets_others_have_their_turn():
    async def run():
        one = OneAtATime()
        with pytest.raises(ZeroDivisionError):
            await one.run(lambda: 1 // 0, is_wanted=lambda: True)
        return await one.run(lambda: 1, is_wanted=lambda: True)

    assert asyncio.run(asyncio.wait_for(run(), 10)) == 1


def test_who_waits_no_longer_keeps_nobody_waiting():
    async def run():
        one = OneAtATime()
        first = asyncio.create_task(one.run(lambda: time.sleep(0.05), is_wanted=lambda: True))
        second = asyncio.create_task(one.run(lambda: 2, is_wanted=lambda: True))
        await asyncio.sleep(0.01)
        second.cancel()
        await first
        return await one.run(lambda: 3, is_wanted=lambda: True)

    assert asyncio.run(asyncio.wait_for(run(), 10)) == 3
