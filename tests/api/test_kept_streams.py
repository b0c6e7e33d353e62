"""Who may go on with which stream, and for how long. What keeps it all is an event loop."""

import asyncio

import pytest

from server.api import kept_streams
from server.api.kept_streams import KeptStream, KeptStreams


def running(scenario):
    return asyncio.run(scenario())


def keeping(*, keep_s=0.05, most=4):
    given_up = []
    return KeptStreams(keep_s=keep_s, most=most, give_up=given_up.append), given_up


def test_a_lost_stream_is_found_once_by_its_token():
    async def scenario():
        streams, _ = keeping(keep_s=5.0)
        token = streams.open(lambda: None)
        streams.close(token, KeptStream(b"state", 1.0))
        return await streams.take(token), await streams.take(token), await streams.take("other")

    found, again, other = running(scenario)
    assert (found.data, found.plays_s) == (b"state", 1.0)
    assert again is None
    assert other is None


def test_a_stream_that_ended_with_a_goodbye_is_not_found():
    async def scenario():
        streams, _ = keeping()
        token = streams.open(lambda: None)
        streams.close(token)
        streams.close(token, KeptStream(b"late", 1.0))
        return await streams.take(token), len(streams)

    assert running(scenario) == (None, 0)


def test_a_stream_is_found_by_its_owner_alone():
    async def scenario():
        streams, _ = keeping(keep_s=5.0)
        taken_over = []
        token = streams.open(lambda: taken_over.append(1), owner="a")
        assert await streams.take(token, owner="b") is None
        assert await streams.take(token) is None
        assert taken_over == []
        streams.close(token, KeptStream(b"state", 1.0))
        assert await streams.take(token, owner="b") is None
        assert await streams.take(token) is None
        of_nobody = streams.open(lambda: None)
        streams.close(of_nobody, KeptStream(b"of nobody", 1.0))
        return (await streams.take(token, owner="a")).data, (await streams.take(of_nobody)).data

    assert running(scenario) == (b"state", b"of nobody")


def test_nobody_guesses_a_token():
    streams, _ = keeping()
    tokens = {streams.open(lambda: None) for _ in range(100)}
    assert len(tokens) == 100
    assert all(len(token) >= 32 for token in tokens)


def test_after_its_time_a_stream_is_gone_and_its_place_free():
    async def scenario():
        streams, given_up = keeping(keep_s=0.05)
        token, place = streams.open(lambda: None), object()
        streams.close(token, KeptStream(b"state", 1.0, place))
        held = streams.has_places
        await asyncio.sleep(0.1)
        return held, streams.has_places, given_up == [place], await streams.take(token), streams.outcomes["expired"]

    assert running(scenario) == (True, False, True, None, 1)


def test_what_is_put_back_is_kept_no_longer_than_before():
    async def scenario():
        streams, given_up = keeping(keep_s=0.1)
        token = streams.open(lambda: None)
        streams.close(token, KeptStream(b"state", 1.0, place := object()))
        await asyncio.sleep(0.06)
        streams.put_back(await streams.take(token))
        found = await streams.take(token)
        streams.put_back(found)
        await asyncio.sleep(0.06)
        return found is not None, given_up == [place], len(streams)

    assert running(scenario) == (True, True, 0)


def test_the_oldest_make_room_for_the_newest():
    async def scenario():
        streams, given_up = keeping(keep_s=5.0, most=3)
        tokens = [streams.open(lambda: None) for _ in range(5)]
        for number, token in enumerate(tokens):
            streams.close(token, KeptStream(b"state", 1.0, number))
        return given_up, [await streams.take(token) is not None for token in tokens]

    assert running(scenario) == ([0, 1], [False, False, True, True, True])


def test_all_kept_streams_together_have_so_many_bytes():
    async def scenario():
        streams, _ = keeping(keep_s=5.0, most=1_000)
        for _ in range(40):
            streams.close(streams.open(lambda: None), KeptStream(bytes(2**20), 1.0))
        return len(streams)

    assert running(scenario) == 16


def test_a_stream_with_a_connection_is_taken_over():
    async def scenario():
        streams, _ = keeping(keep_s=5.0)
        ends = []
        token = streams.open(lambda: ends.append("old"))
        taking = asyncio.create_task(streams.take(token))
        await asyncio.sleep(0.01)
        assert ends == ["old"]
        assert not taking.done()
        streams.close(token, KeptStream(b"state", 1.0))
        return (await taking).data

    assert running(scenario) == b"state"


@pytest.mark.parametrize("is_confirmed", [True, False])
def test_the_former_token_is_good_until_the_client_has_shown_that_it_has_the_new_one(is_confirmed):
    async def scenario():
        streams, _ = keeping(keep_s=5.0)
        first = streams.open(lambda: None)
        streams.close(first, KeptStream(b"state", 1.0))
        await streams.take(first)
        second = streams.open(lambda: None, former=first)
        if is_confirmed:
            streams.confirm(second)
        streams.close(second, KeptStream(b"later", 2.0))
        found = await streams.take(first)
        return None if found is None else (found.data, await streams.take(second))

    assert running(scenario) == (None if is_confirmed else (b"later", None))


def test_a_place_is_held_until_the_stream_goes_on_elsewhere():
    async def scenario():
        streams, given_up = keeping(keep_s=5.0)
        token = streams.open(lambda: None)
        streams.close(token, KeptStream(b"state", 1.0, place := object()))
        assert await streams.lend(token, owner="another") is None
        assert (await streams.lend(token, owner=None)).data == b"state"
        assert given_up == []
        assert await streams.take(token) is None  # one at a time
        streams.settle(token, by=2, is_resumed=False)
        assert (await streams.lend(token, owner=None)).place is place
        assert streams.moved_to(token) is None
        streams.settle(token, by=2, is_resumed=True)
        streams.settle(token, by=2, is_resumed=True)  # a second call changes nothing
        assert streams.moved_to(token) == 2
        return given_up == [place], await streams.take(token), len(streams)

    assert running(scenario) == (True, None, 0)


@pytest.mark.parametrize("is_told_late", [True, False])
def test_a_stream_of_which_nothing_more_is_heard_is_kept_again(monkeypatch, is_told_late):
    monkeypatch.setattr(kept_streams, "_LENT_S", 0.02)

    async def scenario():
        streams, given_up = keeping(keep_s=5.0)
        token = streams.open(lambda: None)
        streams.close(token, KeptStream(b"state", 1.0, place := object()))
        await streams.lend(token, owner=None)
        await asyncio.sleep(0.1)
        assert (len(streams), given_up) == (1, [])
        if is_told_late:
            streams.settle(token, by=1, is_resumed=True)
        return await streams.take(token) is None, given_up == [place]

    assert running(scenario) == (is_told_late, is_told_late)


def test_a_stream_that_comes_back_is_where_it_is():
    async def scenario():
        streams, _ = keeping(keep_s=5.0)
        token = streams.open(lambda: None)
        streams.close(token, KeptStream(b"state", 1.0))
        await streams.lend(token, owner=None)
        streams.settle(token, by=1, is_resumed=True)
        streams.open(lambda: None, former=token)
        return streams.moved_to(token)

    assert running(scenario) is None
