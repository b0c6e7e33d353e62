"""Work that is raced against something that ends it: whichever comes first, neither goes on."""

import asyncio

import pytest

from server.runtime.racing import StoppedError, run_until


async def forever(log):
    try:
        await asyncio.Event().wait()
    finally:
        log.append("cleaned up")


async def value(result):
    await asyncio.sleep(0)
    return result


def test_the_result_comes_back_and_what_would_have_stopped_it_is_cancelled():
    log = []

    async def scenario():
        result = await run_until(value(7), forever(log))
        return result, len(asyncio.all_tasks())

    assert asyncio.run(scenario()) == (7, 1)
    assert log == ["cleaned up"]


def test_what_is_stopped_has_cleaned_up_before_it_is_told():
    log = []

    async def scenario():
        with pytest.raises(StoppedError):
            await run_until(forever(log), value(None))
        return list(log), len(asyncio.all_tasks())

    assert asyncio.run(scenario()) == (["cleaned up"], 1)


def test_an_exception_of_the_work_comes_back():
    async def scenario():
        async def failing():
            raise KeyError("x")

        await run_until(failing(), forever([]))

    with pytest.raises(KeyError):
        asyncio.run(scenario())


def test_cancelled_from_outside_both_are_cancelled():
    log = []

    async def scenario():
        task = asyncio.create_task(run_until(forever(log), forever(log)))
        await asyncio.sleep(0.01)
        task.cancel()
        await asyncio.wait([task])
        return task.cancelled(), len(asyncio.all_tasks())

    assert asyncio.run(scenario()) == (True, 1)
    assert log == ["cleaned up"] * 2
