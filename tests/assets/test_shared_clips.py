"""Clips that several machines share: each machine here is a `SharedClips` with a folder of its own."""

import asyncio
import errno
import logging
import threading
import time

import fsspec
import numpy as np
import pytest
import soundfile

from server.assets import shared_clips
from server.assets.clip_store import ClipStore
from server.assets.clips import UnknownClipError
from server.assets.shared_clips import LOOK_S, STALE_S, SharedClips, clips_among, superfluous
from server.core.errors import RequestError
from server.core.stores import Store

EXPIRES_S = 3_600.0
METHODS = ("list", "size_bytes", "read", "get", "put", "write", "remove")


class Clock:
    def __init__(self):
        self.now_s = 1_000_000_000.0

    def __call__(self):
        return self.now_s


class FaultyStore(Store):
    """Counts the calls of its methods. Those in `errors` raise, and those in `stalled` never return before `release`
    is set."""

    def __init__(self, url):
        super().__init__(url, "clips_url")
        self.errors, self.stalled, self.release, self.asked = {}, set(), threading.Event(), []


def _faulty(method):
    def call(self, *args):
        self.asked.append(method)
        if method in self.stalled:
            self.release.wait(30)
        if (error := self.errors.get(method)) is not None:
            raise error
        return getattr(Store, method)(self, *args)

    return call


for each in METHODS:
    setattr(FaultyStore, each, _faulty(each))


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture(params=["memory", "file"])
def url(request, tmp_path):
    system = fsspec.filesystem("memory")
    system.store.clear()
    system.pseudo_dirs[:] = [""]
    yield "memory://games/clips" if request.param == "memory" else f"file://{tmp_path}/store"
    system.store.clear()
    system.pseudo_dirs[:] = [""]


@pytest.fixture
def machine(url, clock, tmp_path):
    """Makes machines, each by the name of its folder. Nothing of their stores waits any longer at the end."""
    stores = []

    def make(name="one", *, quota_bytes=1_000_000, call_s=10.0, expires_s=EXPIRES_S):
        copies = ClipStore(tmp_path / name, quota_bytes=quota_bytes, expires_s=expires_s, time_s=clock)
        stores.append(FaultyStore(url))
        how = {"quota_bytes": quota_bytes, "expires_s": expires_s, "time_s": clock, "call_s": call_s}
        return SharedClips(copies, stores[-1], **how)

    yield make
    for store in stores:
        store.release.set()


def arrive(shared, content=b"content", seconds=0.5):
    incoming = shared.copies.receive()
    incoming.write(content)
    incoming.close()
    samples = np.full(round(24_000 * seconds), 0.25, np.float32)
    soundfile.write(incoming.target, samples, 24_000, format="WAV", subtype="FLOAT")
    return incoming


async def put(shared, content=b"content", title="A clip", seconds=0.5):
    incoming = arrive(shared, content, seconds)
    try:
        return await shared.keep(incoming, title, seconds)
    finally:
        incoming.discard()


def stored(url):
    """The store's files by name, with their sizes."""
    system, root = fsspec.url_to_fs(url)
    try:
        return {each["name"].rpartition("/")[2]: each["size"] for each in system.ls(root, detail=True)}
    except FileNotFoundError:
        return {}


def samples(shared, name):
    return shared.copies.load(name, 24_000).size


def test_what_one_machine_stores_the_others_have(machine, url):
    async def scenario():
        one, two = machine("one"), machine("two")
        assert await two.clips() == []
        clip, is_new = await put(one)
        assert is_new
        assert (clip.title, clip.duration_s, clip.credit) == ("A clip", 0.5, "")
        assert clip.expires_at == "2001-09-09T02:46:40+00:00"
        assert await one.clips() == [clip]
        await two.bring(clip.name)  # at once, though its list is older
        assert samples(two, clip.name) == 12_000
        assert await two.clips() == [clip]
        assert await two.describe(clip.name) == clip
        assert sorted(file.rpartition(".")[2] for file in stored(url)) == ["json", "wav"]

    asyncio.run(scenario())


def test_a_machine_that_is_lost_loses_no_clip_and_one_that_restarts_copies_none_again(machine):
    async def first():
        return (await put(machine("one")))[0]

    async def again(name):
        shared = machine(name)
        await shared.bring(clip.name)
        assert samples(shared, clip.name) == 12_000
        return shared._store.asked.count("get")

    clip = asyncio.run(first())
    assert asyncio.run(again("one")) == 0
    assert asyncio.run(again("new")) == 1
    assert asyncio.run(again("new")) == 0


def test_the_same_file_at_once_is_one_clip(machine, url):
    async def scenario():
        one, two = machine("one"), machine("two")
        (first, _), (second, _) = await asyncio.gather(put(one), put(two))
        assert first == second
        for shared in (one, two):
            await shared.look()
            await shared._clean_up()
            assert await shared.clips() == [first]
            await shared.bring(first.name)
            assert samples(shared, first.name) == 12_000
        assert len(stored(url)) == 2

    asyncio.run(scenario())


def test_the_same_file_at_once_at_one_machine_is_stored_once(machine):
    async def scenario():
        one = machine()
        kept = await asyncio.gather(*(put(one) for _ in range(4)))
        assert [is_new for _, is_new in kept].count(True) == 1
        assert one._store.asked.count("put") == 1

    asyncio.run(scenario())


def test_uploading_again_keeps_the_title_and_the_sound_and_expires_later(machine, url, clock):
    async def scenario():
        one, two = machine("one"), machine("two")
        clip, _ = await put(one)
        await two.bring(clip.name)
        clock.now_s += 3_000
        again, is_new = await put(one, title="Another title")
        assert (again.title, is_new) == ("A clip", False)
        assert again.expires_at > clip.expires_at
        assert one._store.asked.count("put") == 1
        assert len(stored(url)) == 2
        clock.now_s += 3_000
        await two.look()
        await two.bring(clip.name)
        assert samples(two, clip.name) == 12_000
        assert two._store.asked.count("get") == 1

    asyncio.run(scenario())


def test_a_clip_that_is_about_to_expire_is_stored_anew(machine, url, clock):
    async def scenario():
        one = machine()
        await put(one)
        clock.now_s += EXPIRES_S - 60
        clip, is_new = await put(one, title="Another title")
        assert (clip.title, is_new) == ("A clip", False)
        assert one._store.asked.count("put") == 2
        clock.now_s += 60
        await one._clean_up()
        assert len(stored(url)) == 2
        assert await one.clips() == [clip]

    asyncio.run(scenario())


def test_whoever_finds_an_expired_clip_removes_it(machine, url, clock):
    async def scenario():
        one, two = machine("one"), machine("two")
        clip, _ = await put(one)
        await two.bring(clip.name)
        clock.now_s += EXPIRES_S
        assert await one.clips() == []
        for use in (one.describe, two.bring, one.remove):
            with pytest.raises(UnknownClipError):
                await use(clip.name)
        running = asyncio.create_task(two.run())
        async with asyncio.timeout(30):
            while stored(url):  # noqa: ASYNC110
                await asyncio.sleep(0.01)
        running.cancel()
        assert not two._has_copy(clip.name)

    asyncio.run(scenario())


def test_what_is_deleted_is_gone_from_the_store_and_from_others(machine, url):
    async def scenario():
        one, two = machine("one"), machine("two")
        clip, _ = await put(one)
        await two.bring(clip.name)
        await two.remove(clip.name)
        assert stored(url) == {}
        with pytest.raises(UnknownClipError):
            await two.remove(clip.name)
        await one.look()
        assert await one.clips() == []
        with pytest.raises(UnknownClipError):
            await one.bring(clip.name)
        assert not one._has_copy(clip.name)

    asyncio.run(scenario())


@pytest.mark.parametrize("has_asked", [False, True])
def test_what_was_deleted_elsewhere_is_new_when_it_is_uploaded_again(machine, clock, has_asked):
    async def scenario():
        one, two = machine("one"), machine("two")
        clip, _ = await put(one)
        await two.look()
        await two.remove(clip.name)
        if not has_asked:
            one._labels.clear()  # as one that has not read the label yet
        clock.now_s += 1
        _, is_new = await put(one)
        assert is_new

    asyncio.run(scenario())


def test_a_quota_counts_what_all_machines_have_stored(machine, url, clock):
    async def scenario():
        one, two = machine("one"), machine("two")
        first, _ = await put(one, b"1", seconds=4.0)  # 384 kB each
        await put(two, b"2", seconds=4.0)
        await one.look()
        before = stored(url)
        with pytest.raises(RequestError, match="are free: delete others first") as caught:
            await put(one, b"3", seconds=4.0)
        assert (caught.value.code, caught.value.status) == ("clips_full", 507)
        assert stored(url) == before
        await two.remove(first.name)
        await one.look()
        await put(one, b"3", seconds=4.0)
        clock.now_s += EXPIRES_S
        await put(one, b"4", seconds=4.0)
        assert len(await one.clips()) == 1, "expired clips make room"

    asyncio.run(scenario())


def test_copies_make_room_for_others(machine, clock):
    async def scenario():
        one, two = machine("one", quota_bytes=10_000_000), machine("two", quota_bytes=500_000)
        names = []
        for number in range(3):
            clip, _ = await put(one, b"%d" % number, seconds=2.0)  # 192 kB each
            names.append(clip.name)
            clock.now_s += 1
        for name in names:
            await two.bring(name)
        assert [two._has_copy(name) for name in names] == [False, True, True]

    asyncio.run(scenario())


@pytest.mark.parametrize("how", ["fails", "stalls"])
@pytest.mark.parametrize("method", ["list", "put", "size_bytes", "write"])
def test_an_upload_is_acknowledged_only_once_it_is_stored(machine, method, how):
    async def scenario():
        one, two = machine("one", call_s=0.2), machine("two")
        store = one._store
        if how == "fails":
            store.errors[method] = PermissionError("not today")
        else:
            store.stalled.add(method)
        begun_s = time.monotonic()
        with pytest.raises(RequestError, match="ask again in 5 s") as caught:
            await put(one)
        refused = caught.value
        assert (refused.code, refused.status, refused.retry_after_s) == ("store_unreachable", 503, 5)
        assert time.monotonic() - begun_s < 5
        assert await two.clips() == []
        store.errors.clear()
        store.stalled.clear()
        store.release.set()
        await one.look()
        clip, is_new = await put(one)
        assert is_new or method == "write"  # the label may have come late
        await two.look()
        assert [each.name for each in await two.clips()] == [clip.name]
        await two.bring(clip.name)
        assert samples(two, clip.name) == 12_000

    asyncio.run(scenario())


@pytest.mark.parametrize("how", ["fails", "stalls"])
@pytest.mark.parametrize(
    ("use", "method"),
    [
        ("bring", "list"),
        ("bring", "read"),
        ("bring", "get"),
        ("describe", "read"),
        ("clips", "list"),
        ("clips", "read"),
        ("remove", "list"),
        ("remove", "remove"),
    ],
)
def test_a_store_that_does_not_answer_is_told_in_time(machine, caplog, use, method, how):
    async def scenario():
        one, two = machine("one"), machine("two", call_s=0.2)
        clip, _ = await put(one)
        if how == "fails":
            two._store.errors[method] = OSError(errno.EIO, "unplugged")
        else:
            two._store.stalled.add(method)
        begun_s = time.monotonic()
        with pytest.raises(RequestError) as caught:
            await (two.clips() if use == "clips" else getattr(two, use)(clip.name))
        assert (caught.value.code, caught.value.status) == ("store_unreachable", 503)
        assert time.monotonic() - begun_s < 5
        operation = {"get": "read"}.get(method, method)
        assert two._store.calls.failures[operation, "timeout"] == (how == "stalls")
        assert not two._has_copy(clip.name)
        two._store.errors.clear()
        two._store.stalled.clear()
        two._store.release.set()
        await two.look()
        if (use, how) != ("remove", "stalls"):  # which comes late
            await two.bring(clip.name)
        assert "unplugged" in caplog.text or how == "stalls"
        assert "games/clips" in caplog.text or "store" in caplog.text

    asyncio.run(scenario())


def test_while_the_store_is_lost_copies_play_and_all_else_is_refused_at_once(machine, caplog, monkeypatch):
    async def scenario():
        one, two = machine("one"), machine("two")
        clip, _ = await put(one)
        other, _ = await put(one, b"other")
        await two.bring(clip.name)
        both = await two.clips()
        two._store.errors = dict.fromkeys(METHODS, ConnectionError("unplugged"))
        for _ in range(3):
            with pytest.raises(RequestError):
                await two.look()
        assert caplog.text.count("unplugged") == 1
        calls = len(two._store.asked)
        await two.bring(clip.name)
        assert samples(two, clip.name) == 12_000
        assert await two.clips() == both
        monkeypatch.setattr(shared_clips, "STALE_S", -1.0)
        for use in (two.clips, lambda: two.bring(other.name), lambda: two.remove(clip.name), lambda: put(two, b"new")):
            with pytest.raises(RequestError) as caught:
                await use()
            assert caught.value.code == "store_unreachable"
        assert len(two._store.asked) == calls
        two._store.errors.clear()
        with caplog.at_level(logging.INFO):
            await two.look()
        assert "listed again" in caplog.text
        await two.bring(other.name)

    asyncio.run(scenario())


def test_a_machine_that_starts_without_the_store_plays_its_copies(machine):
    async def stored_before():
        return (await put(machine("one")))[0]

    async def scenario():
        one = machine("one")
        one._store.errors["list"] = ConnectionError("unplugged")
        await one.bring(clip.name)
        with pytest.raises(RequestError) as caught:
            await one.bring("upload-" + "0" * 32)
        assert caught.value.code == "store_unreachable"

    clip = asyncio.run(stored_before())
    asyncio.run(scenario())


def test_a_full_disk_of_the_store_is_told(machine):
    async def scenario():
        one = machine()
        one._store.errors["put"] = OSError(errno.ENOSPC, "No space left on device")
        with pytest.raises(RequestError, match="the disk is full") as caught:
            await put(one)
        assert (caught.value.code, caught.value.status) == ("storage_failed", 507)

    asyncio.run(scenario())


def test_a_machine_that_is_killed_between_sound_and_label_leaves_nothing_that_is_seen(machine, url, clock):
    async def killed():
        one = machine("one")
        one._store.stalled.add("write")
        putting = asyncio.create_task(put(one))
        async with asyncio.timeout(30):
            while "write" not in one._store.asked:  # noqa: ASYNC110
                await asyncio.sleep(0.01)
        putting.cancel()

    async def scenario():
        two = machine("two")
        assert await two.clips() == []
        await two._clean_up()
        assert len(stored(url)) == 1, "it may still be arriving"
        clip, is_new = await put(two)
        assert is_new
        clock.now_s += shared_clips._ABANDONED_S / 2
        await put(two)  # so that it does not expire
        clock.now_s += shared_clips._ABANDONED_S / 2 + 1
        await two.look()
        await two._clean_up()
        assert len(stored(url)) == 2
        assert [each.name for each in await two.clips()] == [clip.name]

    asyncio.run(killed())
    asyncio.run(scenario())


def test_half_a_sound_is_neither_acknowledged_nor_played(machine, url, monkeypatch):
    def cut(method, place):
        def copy(self, source, target):
            getattr(Store, method)(self, source, target)
            system, path = fsspec.url_to_fs(url if place == "store" else f"file://{target}")
            path = target if place == "store" else path
            system.pipe_file(path, system.cat_file(path)[:-10])

        return copy

    async def scenario():
        one, two = machine("one"), machine("two")
        with monkeypatch.context() as patch:
            patch.setattr(FaultyStore, "put", cut("put", "store"))
            with pytest.raises(RequestError) as caught:
                await put(one)
            assert caught.value.code == "store_unreachable"
        assert one._store.calls.failures["write", "incomplete"] == 1
        assert await two.clips() == []
        clip, _ = await put(one)
        with monkeypatch.context() as patch:
            patch.setattr(FaultyStore, "get", cut("get", "machine"))
            with pytest.raises(RequestError) as caught:
                await two.bring(clip.name)
            assert caught.value.code == "store_unreachable"
            assert not two._has_copy(clip.name)
        assert two._store.calls.failures["read", "incomplete"] == 1
        await two.bring(clip.name)

    asyncio.run(scenario())


def test_a_sound_that_is_removed_while_it_gets_a_new_label_is_stored_again(machine, clock, monkeypatch):
    async def scenario():
        one, two = machine("one"), machine("two")
        clip, _ = await put(one)
        clock.now_s += 10
        write = FaultyStore.write

        def remove_first(self, path, data):
            write(self, path, data)
            monkeypatch.setattr(FaultyStore, "write", write)
            two_store = two._store
            for entry in Store.list(two_store):
                if entry.path != path:
                    Store.remove(two_store, entry.path)

        monkeypatch.setattr(FaultyStore, "write", remove_first)
        again, _ = await put(one)
        assert again.name == clip.name
        await two.bring(clip.name)
        assert samples(two, clip.name) == 12_000

    asyncio.run(scenario())


def test_a_clip_that_was_stored_anew_while_it_is_copied_is_copied(machine):
    async def scenario():
        one, two = machine("one"), machine("two")
        clip, _ = await put(one)
        await two.look()
        await one.remove(clip.name)
        await put(one)
        await two.bring(clip.name)
        assert samples(two, clip.name) == 12_000

    asyncio.run(scenario())


def test_damaged_labels_are_no_clips_and_the_next_upload_mends_them(machine, url):
    async def scenario():
        clip, _ = await put(machine("one"))
        system, root = fsspec.url_to_fs(url)
        (label,) = (file for file in stored(url) if file.endswith(".json"))
        for number, damage in enumerate(
            (b"", b"[]", b'{"title": 5}', b"\xff", b" " * 5_000, b'{"title":"","duration_s":NaN}')
        ):
            system.pipe_file(f"{root}/{label}", damage)
            shared = machine(f"reader {number}")
            assert await shared.clips() == []
            with pytest.raises(UnknownClipError):
                await shared.bring(clip.name)
        await put(shared, title="New")
        assert [each.title for each in await shared.clips()] == ["New"]
        await shared._clean_up()
        assert len(stored(url)) == 2

    asyncio.run(scenario())


def test_other_files_of_the_store_stay(machine, url, clock):
    async def scenario():
        one = machine()
        clip, _ = await put(one)
        system, root = fsspec.url_to_fs(url)
        for other in ("read.me", f"{clip.name}.wav", f"{clip.name}.json", "upload-x.1-2.wav"):
            system.pipe_file(f"{root}/{other}", b"stays")
        clock.now_s += EXPIRES_S + shared_clips._ABANDONED_S
        await one.look()
        await one._clean_up()
        assert set(stored(url)) == {"read.me", f"{clip.name}.wav", f"{clip.name}.json", "upload-x.1-2.wav"}

    asyncio.run(scenario())


@pytest.mark.parametrize("name", ["../../etc/passwd", "upload-../x", "upload-" + "A" * 32, "", "upload-" + "0" * 33])
def test_no_other_name_becomes_a_path(machine, name):
    async def scenario():
        one = machine()
        for use in (one.describe, one.bring, one.remove):
            with pytest.raises(UnknownClipError):
                await use(name)
        assert one._store.asked == []

    asyncio.run(scenario())


def test_many_who_ask_for_what_there_is_not_share_a_listing(machine):
    async def scenario():
        one = machine()
        names = [f"upload-{number:032x}" for number in range(50)]
        found = await asyncio.gather(*map(one.bring, names), return_exceptions=True)
        assert all(isinstance(each, UnknownClipError) for each in found)
        assert len(one._store.asked) <= 2

    asyncio.run(scenario())


def test_many_who_ask_for_a_clip_share_a_copy(machine):
    async def scenario():
        one, two = machine("one"), machine("two")
        clip, _ = await put(one)
        await asyncio.gather(*(two.bring(clip.name) for _ in range(10)))
        assert two._store.asked.count("get") == 1

    asyncio.run(scenario())


def test_what_changes_while_the_store_is_listed_is_not_forgotten(machine, monkeypatch):
    listed, release = threading.Event(), threading.Event()

    def slow(self):
        found = Store.list(self)
        listed.set()
        release.wait(30)
        return found

    async def scenario():
        one = machine()
        gone, _ = await put(one, b"gone")
        with monkeypatch.context() as patch:
            patch.setattr(FaultyStore, "list", slow)
            looking = asyncio.create_task(one.look())
            await asyncio.to_thread(listed.wait)
            clip, _ = await put(one)
            for file in [file for file in one._files if file.startswith(gone.name)]:
                await one._discard(file)
            release.set()
            await looking
        assert await one.clips() == [clip]

    asyncio.run(scenario())


def test_the_event_loop_goes_on_while_the_store_stalls(machine):
    async def scenario():
        one = machine(call_s=0.5)
        one._store.stalled = set(METHODS)
        asking = asyncio.create_task(one.clips())
        longest_s, last_s = 0.0, time.monotonic()
        while not asking.done():
            await asyncio.sleep(0.001)
            longest_s, last_s = max(longest_s, time.monotonic() - last_s), time.monotonic()
        with pytest.raises(RequestError):
            asking.result()
        assert longest_s < 0.4

    asyncio.run(scenario())


def test_of_several_labels_the_newest_counts_whose_sound_is_there():
    name, old, new = "upload-" + "0" * 32, "1000000000000-00000000", "1000000001000-11111111"
    files = {
        f"{name}.{old}.wav": 4,
        f"{name}.{old}.1000000000000.json": 1,
        f"{name}.{old}.1000000002000.json": 1,
        f"{name}.{new}.1000000003000.json": 1,
        f"{name}.{old}.1000000004000.json.part": 1,
    }
    assert clips_among(files)[name].uploaded_ms == 1_000_000_002_000
    assert superfluous(files, now_s=1e9 + 10, expires_s=60) == [f"{name}.{old}.1000000000000.json"]
    late = superfluous(files, now_s=1e9 + 4_000, expires_s=60)
    assert late[-1] == f"{name}.{old}.wav"
    assert set(late) == set(files)
    assert LOOK_S < STALE_S
