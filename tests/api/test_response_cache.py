"""Bodies are computed once for all who wait, for nobody else, and in fair turns."""

import asyncio
import threading
from concurrent.futures import CancelledError
from functools import partial

import pytest

from server.api.response_cache import ResponseCache
from server.core.errors import RequestError


class Work:
    """Computations that wait for a test: `begun` lists them in order, each ends when it is released."""

    def __init__(self):
        self.begun, self.called_off = [], []
        self._released = {}

    def of(self, name):
        self._released.setdefault(name, threading.Event())

        def compute(checkpoint):
            self.begun.append(name)
            try:
                while not self._released[name].wait(0.002):
                    checkpoint()
            except CancelledError:
                self.called_off.append(name)
                raise
            return name.encode()

        return compute

    def release(self, *names):
        for name in names or tuple(self._released):
            self._released[name].set()


@pytest.fixture
def work():
    work = Work()
    yield work
    work.release()


def scenario(run, *, workers=1, waiting=8):
    async def within():
        with ResponseCache(workers=workers, waiting=waiting) as cache:
            return await asyncio.wait_for(run(cache), 20)

    return asyncio.run(within())


async def until(condition):
    async with asyncio.timeout(5):
        while not condition():  # noqa: ASYNC110  it changes on another thread
            await asyncio.sleep(0.002)


def ask(cache, work, name, *, kind="single", client="a"):
    return asyncio.create_task(cache.get(name, work.of(name), kind=kind, client=client))


def test_equal_requests_are_one_computation_and_the_body_is_kept(work):
    async def run(cache):
        asked = [ask(cache, work, "x") for _ in range(10)]
        await until(lambda: work.begun)
        work.release()
        bodies = await asyncio.gather(*asked)
        again = await ask(cache, work, "x")
        return [*bodies, again], cache.lookups, cache.kept_bytes

    bodies, lookups, kept_bytes = scenario(run)
    assert bodies == [b"x"] * 11
    assert work.begun == ["x"]
    assert lookups == {"miss": 1, "shared": 9, "hit": 1}
    assert kept_bytes == 1


def test_what_nobody_waits_for_is_called_off_with_the_last_who_leaves(work):
    async def run(cache):
        first, second, queued = ask(cache, work, "x"), ask(cache, work, "x"), ask(cache, work, "queued")
        await until(lambda: work.begun)
        first.cancel()
        queued.cancel()
        await asyncio.sleep(0.05)
        assert not work.called_off
        assert cache.waiting == 0
        second.cancel()
        await until(lambda: work.called_off)
        again = ask(cache, work, "x")  # computed anew, not taken from what was called off
        await until(lambda: work.begun == ["x", "x"])
        work.release()
        return await again

    assert scenario(run) == b"x"
    assert work.called_off == ["x"]


def test_a_dozen_maps_leave_a_thread_to_what_is_cheap(work):
    async def run(cache):
        maps = [ask(cache, work, f"map {number}", kind="map") for number in range(12)]
        await until(lambda: work.begun)
        work.of("cheap")
        work.release("cheap")
        assert await asyncio.wait_for(ask(cache, work, "cheap"), 2) == b"cheap"
        assert [name for name in work.begun if name != "cheap"] == ["map 0"]
        work.release()
        await asyncio.gather(*maps)

    scenario(run, workers=2, waiting=32)


def test_clients_take_turns_however_much_one_asks_for(work):
    async def run(cache):
        held = ask(cache, work, "held", client="greedy")
        await until(lambda: work.begun)
        asked = [ask(cache, work, f"greedy {number}", client="greedy") for number in range(4)]
        asked += [ask(cache, work, f"modest {number}", client="modest") for number in range(2)]
        await asyncio.sleep(0.02)
        work.release()
        await asyncio.gather(held, *asked)

    scenario(run)
    assert work.begun == ["held", "modest 0", "greedy 0", "modest 1", "greedy 1", "greedy 2", "greedy 3"]


def test_where_there_is_no_room_who_has_most_waiting_gives_way_and_is_told_when_to_come_back(work):
    async def run(cache):
        held = ask(cache, work, "held", client="greedy")
        await until(lambda: work.begun)
        greedy = [ask(cache, work, f"greedy {number}", client="greedy") for number in range(3)]
        await asyncio.sleep(0.02)
        with pytest.raises(RequestError) as refused:
            await ask(cache, work, "one more", client="greedy")
        assert (refused.value.code, refused.value.status) == ("server_busy", 503)
        assert refused.value.retry_after_s >= 1
        modest = ask(cache, work, "modest", client="modest")
        with pytest.raises(RequestError):
            await greedy[-1]
        work.release()
        return await asyncio.gather(held, *greedy[:-1], modest)

    assert scenario(run, waiting=3) == [b"held", b"greedy 0", b"greedy 1", b"modest"]


def test_when_to_come_back_grows_with_what_waits(work):
    async def run(cache):
        asked, retry = [], [cache.retry_after_s]
        for number in range(3):
            asked.append(ask(cache, work, f"map {number}", kind="map"))
            await asyncio.sleep(0.02)
            retry.append(cache.retry_after_s)
        work.release()
        await asyncio.gather(*asked)
        return retry

    assert scenario(run) == [1, 5, 10, 15]


def test_what_a_computation_raises_comes_back_to_all_and_is_not_kept():
    async def run(cache):
        def failing(_):
            raise ValueError("no field")

        asked = [asyncio.create_task(cache.get("x", failing, kind="single", client="a")) for _ in range(2)]
        results = await asyncio.gather(*asked, return_exceptions=True)
        return results, await cache.get("x", lambda _: b"now", kind="single", client="a")

    (first, second), then = scenario(run)
    assert isinstance(first, ValueError)
    assert isinstance(second, ValueError)
    assert then == b"now"


def test_leaving_calls_off_what_runs(work):
    async def run(cache):
        asked = ask(cache, work, "x")
        await until(lambda: work.begun)
        return asked

    scenario(run)
    assert work.called_off == ["x"]


async def taken(parts):
    return [each async for each in parts]


def test_a_batch_is_computed_part_by_part_as_it_is_taken(work):
    async def run(cache):
        parts = cache.batch([work.of("a"), work.of("b")], client="x")
        work.release()
        first = await anext(parts)
        await asyncio.sleep(0.05)
        begun = list(work.begun)
        return first, begun, await taken(parts)

    assert scenario(run) == (b"a", ["a"], [b"b"])


def test_a_batch_that_is_no_longer_taken_stops(work):
    async def run(cache):
        taking = asyncio.create_task(taken(cache.batch([work.of("a"), work.of("b")], client="x")))
        await until(lambda: work.begun)
        taking.cancel()
        await until(lambda: work.called_off)
        await asyncio.wait({taking})
        # Its place is free again.
        again = cache.batch([work.of("c")], client="x")
        work.release()
        assert await taken(again) == [b"c"]

    scenario(run, waiting=1)
    assert work.begun == ["a", "c"]


def test_other_requests_take_turns_with_a_batch(work):
    def as_many(cache, begun, waiting):
        return (len(work.begun), cache.waiting) == (begun, waiting)

    async def run(cache):
        batch = asyncio.create_task(taken(cache.batch([work.of(name) for name in "abc"], client="x")))
        await until(lambda: work.begun)
        singles = [
            asyncio.create_task(cache.get(name, work.of(name), kind="single", client="y")) for name in ("1", "2")
        ]
        for number, waiting in enumerate((2, 2, 1, 1), start=1):
            await until(partial(as_many, cache, number, waiting))
            work.release(work.begun[-1])
        work.release()
        await asyncio.gather(batch, *singles)

    scenario(run)
    assert work.begun == ["a", "1", "b", "2", "c"]


def test_a_batch_under_way_keeps_its_place_and_takes_nobody_elses(work):
    async def run(cache):
        blocker = asyncio.create_task(cache.get("0", work.of("0"), kind="single", client="z"))
        batch = asyncio.create_task(taken(cache.batch([work.of("a"), work.of("b")], client="x")))
        await until(lambda: work.begun and cache.waiting == 1)
        work.release("0")
        await until(lambda: "a" in work.begun)
        held = asyncio.create_task(cache.get("1", work.of("1"), kind="single", client="z"))
        await until(lambda: cache.waiting == 1)
        work.release("a")
        await until(lambda: "1" in work.begun and cache.waiting == 1)  # "b" waits
        waiting = asyncio.create_task(cache.get("2", work.of("2"), kind="single", client="y"))
        await until(lambda: cache.waiting == 2)  # there was room, although "b" waits
        with pytest.raises(RequestError, match="ask again"):
            await cache.get("3", work.of("3"), kind="single", client="y")
        work.release()
        await asyncio.gather(blocker, held, waiting)
        return await batch

    assert scenario(run, waiting=1) == [b"a", b"b"]


def test_one_client_has_at_most_half_of_the_batches(work):
    async def run(cache):
        parts = {name: work.of(name) for name in "abcde"}
        work.release()
        under_way = [cache.batch([parts[name], parts["c"]], client="x") for name in "ab"]
        for each in under_way:
            await anext(each)
        with pytest.raises(RequestError) as refused:
            await taken(cache.batch([parts["c"]], client="x"))
        assert refused.value.code == "server_busy"
        assert await taken(cache.batch([parts["d"]], client="y")) == [b"d"]
        await under_way[0].aclose()
        assert await taken(cache.batch([parts["e"]], client="x")) == [b"e"]
        await under_way[1].aclose()

    scenario(run, waiting=4)
