"""Whatever many requests want, the loop comes round to everything else between any two of them."""

import asyncio
import time

from server.api.turn_taking import TurnTaking


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
