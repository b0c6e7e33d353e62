"""A server that ends: at once where nothing is in flight, else as soon as that is done, and in a stated time for
certain."""

import asyncio
import time

import pytest

from server.runtime.drain import Drain


def test_with_nothing_in_flight_there_is_nothing_to_wait_for():
    async def scenario():
        drain = Drain(60.0)
        assert not drain.has_begun
        await asyncio.wait_for(drain.settle(), 1)
        return drain.has_begun

    assert asyncio.run(scenario())


def test_it_waits_for_what_is_in_flight_and_no_longer():
    async def scenario():
        drain = Drain(60.0)

        async def request():
            with drain.in_flight():
                await asyncio.sleep(0.2)

        requests = [asyncio.create_task(request()) for _ in range(3)]
        await asyncio.sleep(0.05)
        began_s = time.monotonic()
        await drain.settle()
        return time.monotonic() - began_s, [each.done() for each in requests]

    waited_s, done = asyncio.run(scenario())
    assert all(done)
    assert 0.1 < waited_s < 5


def test_what_never_ends_is_told_that_its_time_is_over_and_is_not_waited_for_for_ever():
    async def scenario():
        drain, told_s = Drain(1.0), []

        async def request():
            with drain.in_flight():
                await drain.out_of_time()
                told_s.append(time.monotonic())
                await asyncio.Event().wait()

        endless = asyncio.create_task(request())
        await asyncio.sleep(0)
        began_s = time.monotonic()
        await drain.settle()
        settled_s = time.monotonic() - began_s
        endless.cancel()
        return told_s[0] - began_s, settled_s

    told_s, settled_s = asyncio.run(scenario())
    assert 0.65 < told_s < 0.85
    assert 0.8 < settled_s < 1.0


def test_who_asks_again_is_told_when_the_server_will_be_gone():
    now_s = [100.0]
    drain = Drain(8.0, time_s=lambda: now_s[0])
    assert drain.retry_after_s == 8
    drain.begin()
    now_s[0] += 5.5
    drain.begin()  # a second time changes nothing
    assert drain.retry_after_s == 3
    now_s[0] += 60
    assert drain.retry_after_s == 1


async def ends_s(drain, streams):
    """Seconds from the beginning of a shutdown after which each of so many streams has its turn."""
    turns_s = []

    async def stream():
        await drain.turn()
        turns_s.append(time.monotonic() - began_s)

    tasks = [asyncio.create_task(stream()) for _ in range(streams)]
    await asyncio.sleep(0.01)
    assert not turns_s
    began_s = time.monotonic()
    drain.begin()
    await asyncio.gather(*tasks)
    return turns_s


def test_streams_end_as_it_begins():
    assert max(asyncio.run(ends_s(Drain(60.0), 20))) < 5


def test_where_others_take_them_streams_end_one_after_the_other_in_half_of_the_time():
    turns_s = asyncio.run(ends_s(Drain(2.0, in_turn=True), 4))
    assert [turn_s >= 0.249 * number for number, turn_s in enumerate(turns_s)] == [True] * 4
    assert turns_s == sorted(turns_s)


def test_streams_are_told_to_come_back_soon_and_where_others_take_them_at_once():
    assert Drain(8.0).streams_retry_after_s == 1
    assert Drain(8.0, in_turn=True).streams_retry_after_s is None
    assert Drain(8.0, in_turn=True).retry_after_s == 8


@pytest.mark.parametrize("failure", [KeyError, asyncio.CancelledError])
def test_what_fails_is_no_longer_in_flight(failure):
    async def scenario():
        drain = Drain(60.0)
        with pytest.raises(failure), drain.in_flight():
            raise failure
        await asyncio.wait_for(drain.settle(), 1)

    asyncio.run(scenario())
