"""The clock of the wall is set, forward and back, while the server runs. What lasts for a time goes by a clock that
nobody sets; what ends at a date ends when that is told to have come, and no later than the next look."""

import asyncio
import json
import time
from datetime import UTC, datetime

import pytest

from server.api import access as access_module
from server.api.access import Access, AccessError
from server.api.api_keys import ApiKeys, create_key
from server.api.kept_streams import KeptStream, KeptStreams
from server.api.rate_limits import Rate, RateLimits
from server.assets.clip_store import ClipStore

YEAR_S = 365 * 86_400.0


class Wall:
    """A clock of the wall that can be set."""

    def __init__(self):
        self.ahead_s = 0.0
        self._real = time.time

    def __call__(self):
        return self._real() + self.ahead_s


@pytest.fixture
def wall(monkeypatch):
    """Sets the clock that `time.time` tells."""
    clock = Wall()
    monkeypatch.setattr(time, "time", clock)
    return clock


@pytest.mark.parametrize("jump_s", [-YEAR_S, YEAR_S])
def test_who_has_spent_a_rate_waits_as_long_as_before(wall, jump_s):
    limits = RateLimits({"request": Rate(2, 60.0)})
    assert [limits.refusal("request", "a") for _ in range(2)] == [None, None]
    wall.ahead_s = jump_s
    refused = limits.refusal("request", "a")
    assert dict(refused.headers)["Retry-After"] == "30"


@pytest.mark.parametrize("jump_s", [-YEAR_S, YEAR_S])
def test_a_lost_stream_is_kept_for_as_long_as_was_told(wall, jump_s):
    async def scenario():
        streams = KeptStreams(keep_s=0.1, most=4, give_up=lambda _: None)
        first, second = streams.open(lambda: None), streams.open(lambda: None)
        for token in (first, second):
            streams.close(token, KeptStream(b"state", 1.0))
        wall.ahead_s = jump_s
        found = await streams.take(first)
        await asyncio.sleep(0.2)
        return found, await streams.take(second)

    found, late = asyncio.run(scenario())
    assert found is not None
    assert late is None


def test_a_key_ends_when_its_date_is_told_to_have_come_and_not_before(wall, tmp_path, monkeypatch):
    monkeypatch.setattr(access_module, "LOOK_S", 0.01)
    expires = datetime.fromtimestamp(time.time() + 3_600, UTC)
    key, _ = create_key(tmp_path / "keys.json", "", ["listen"], expires)
    access = Access(read_keys=lambda: ApiKeys.read(tmp_path / "keys.json"), time_s=wall)
    caller = access.admit(key)

    async def scenario():
        ended = asyncio.create_task(access.ended(caller))
        wall.ahead_s = -YEAR_S  # a wait that was reckoned now would last for a year
        await asyncio.sleep(0.05)
        was_open = not ended.done()
        wall.ahead_s = 3_601.0
        return was_open, await asyncio.wait_for(ended, 5.0)

    assert asyncio.run(scenario()) == (True, "key_expired")
    with pytest.raises(AccessError, match="expired"):
        access.admit(key)
    wall.ahead_s = 0.0
    assert access.admit(key).name == caller.name


def test_clips_from_the_future_are_kept_and_played(wall, tmp_path):
    """They were uploaded before the clock was set back. None that is arriving is lost when it is set forward."""
    store = ClipStore(tmp_path, quota_bytes=2**20, expires_s=3_600.0, time_s=wall)
    wall.ahead_s = YEAR_S
    incoming = store.receive()
    incoming.write(b"any")
    incoming.close()
    incoming.target.write_bytes(b"sound")
    clip, _ = store.keep(incoming, "a title", 1.0)
    incoming.discard()
    wall.ahead_s = 0.0
    again = ClipStore(tmp_path, quota_bytes=2**20, expires_s=3_600.0, time_s=wall)
    assert [each.name for each in again.clips()] == [clip.name]
    assert json.loads((tmp_path / f"{clip.name}.json").read_bytes())["title"] == again.describe(clip.name).title
    again.remove(clip.name)
    assert again.clips() == []
