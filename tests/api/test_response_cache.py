"""Bodies are computed once for all who wait, for nobody else, and in fair turns."""

import asyncio
import threading
from concurrent.futures import CancelledError

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
        return [*bodies, await ask(cache, work, "x")]

    assert scenario(run) == [b"x"] * 11
    assert work.begun == ["x"]


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
