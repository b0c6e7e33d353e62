"""Uploaded clips: stored whole or not at all, within a quota, until they expire."""

import errno
import json
from pathlib import Path

import numpy as np
import pytest
import soundfile

from server.assets import clip_store
from server.assets.clip_store import ClipStore, is_upload
from server.assets.clips import UnknownClipError
from server.core.errors import RequestError


class Clock:
    def __init__(self):
        self.now_s = 1_000_000.0

    def __call__(self):
        return self.now_s


@pytest.fixture
def clock():
    return Clock()


def open_store(folder, clock, *, quota_bytes=1_000_000, expires_s=3_600.0):
    return ClipStore(folder / "clips", quota_bytes=quota_bytes, expires_s=expires_s, time_s=clock)


@pytest.fixture
def store(tmp_path, clock):
    return open_store(tmp_path, clock)


def arrive(store, content=b"content", seconds=0.5):
    """A file that has arrived and was decoded, but is not stored yet."""
    incoming = store.receive()
    incoming.write(content)
    incoming.close()
    samples = np.full(round(24_000 * seconds), 0.25, np.float32)
    soundfile.write(incoming.target, samples, 24_000, format="WAV", subtype="FLOAT")
    return incoming


def put(store, content=b"content", title="A clip", seconds=0.5):
    incoming = arrive(store, content, seconds)
    try:
        return store.keep(incoming, title, seconds)
    finally:
        incoming.discard()


def files(store):
    return sorted(path.name for path in store._folder.iterdir() if path.name != ".lock")


def test_a_clip_is_found_by_its_content(store):
    clip, is_new = put(store)
    assert is_new
    assert is_upload(clip.name)
    assert (clip.title, clip.duration_s, clip.credit) == ("A clip", 0.5, "")
    assert clip.expires_at == "1970-01-12T14:46:40+00:00"
    assert store.clips() == [clip]
    assert store.describe(clip.name) == clip
    again, is_new = put(store, title="Another title")
    assert (again, is_new) == (clip, False)
    other, is_new = put(store, b"other")
    assert is_new
    assert other.name != clip.name
    assert files(store) == sorted(f"{each}.{suffix}" for each in (clip.name, other.name) for suffix in ("json", "wav"))


def test_it_is_played_at_any_rate_and_kept_in_memory(store):
    clip, _ = put(store)
    assert store.loaded(clip.name, 24_000) is None
    loaded = store.load(clip.name, 24_000)
    assert loaded.size == 12_000
    assert store.loaded(clip.name, 24_000) is loaded
    assert store.load(clip.name, 48_000).size == 24_000


def test_another_process_finds_the_same_clips(store, tmp_path, clock):
    other = open_store(tmp_path, clock)
    clip, _ = put(store)
    assert other.clips() == [clip]
    other.remove(clip.name)
    assert store.clips() == []
    with pytest.raises(UnknownClipError):
        store.load(clip.name, 24_000)


def test_a_clip_expires_unless_it_is_uploaded_again(store, clock):
    clip, _ = put(store)
    clock.now_s += 3_000
    put(store)
    clock.now_s += 3_000
    assert [each.name for each in store.clips()] == [clip.name]
    clock.now_s += 600
    assert store.clips() == []
    for use in (store.describe, store.remove, lambda name: store.load(name, 24_000)):
        with pytest.raises(UnknownClipError):
            use(clip.name)
    put(store, b"other")
    assert not any(clip.name in name for name in files(store)), "the next upload removes what has expired"


def test_what_does_not_fit_is_refused_and_leaves_nothing(store, clock):
    seconds = 4.0  # 384 kB each
    first, _ = put(store, b"1", seconds=seconds)
    put(store, b"2", seconds=seconds)
    before = files(store)
    with pytest.raises(RequestError, match="are free: delete others first") as caught:
        put(store, b"3", seconds=seconds)
    assert (caught.value.code, caught.value.status) == ("clips_full", 507)
    assert files(store) == before
    store.remove(first.name)
    put(store, b"3", seconds=seconds)
    clock.now_s += 3_600
    put(store, b"4", seconds=seconds)
    assert len(store.clips()) == 1, "expired clips make room"


@pytest.mark.parametrize("step", ["sound", "label"])
def test_a_full_disk_is_told_and_leaves_nothing(store, monkeypatch, step):
    put(store)
    before = files(store)
    incoming = arrive(store, b"other")
    replace = Path.replace

    def fail(self, target):
        if Path(target).suffix == {"sound": ".wav", "label": ".json"}[step]:
            raise OSError(errno.ENOSPC, "No space left on device")
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(RequestError, match="the disk is full") as caught:
        store.keep(incoming, "Other", 0.5)
    incoming.discard()
    assert (caught.value.code, caught.value.status) == ("storage_failed", 507)
    assert files(store) == before


def test_a_disk_that_is_full_while_a_file_arrives_is_told(store, monkeypatch):
    incoming = store.receive()
    incoming.close()

    class Full:
        def write(self, _):
            raise OSError(errno.ENOSPC, "No space left on device")

        def close(self):
            pass

    monkeypatch.setattr(incoming, "_file", Full())
    with pytest.raises(RequestError, match="the disk is full"):
        incoming.write(b"content")
    incoming.discard()
    assert files(store) == []


def test_a_server_that_was_killed_leaves_only_what_the_next_removes(store, tmp_path, clock):
    clip, _ = put(store)
    unfinished = arrive(store, b"unfinished")
    unfinished.close()
    half = "upload-" + "0" * 32
    (store._folder / f"{half}.wav").write_bytes(b"sound without a label")
    (store._folder / "of somebody else.txt").write_text("stays")
    clock.now_s = clip_store.time.time()
    open_store(tmp_path, clock, expires_s=4e9)
    assert f"{half}.wav" not in files(store)
    clock.now_s += 2 * clip_store._ABANDONED_S
    open_store(tmp_path, clock, expires_s=4e9)
    assert unfinished.path.exists(), "another process is writing it, whatever the time is"
    assert unfinished.target.exists()
    unfinished._held.close()  # as the system does when that is killed
    after = open_store(tmp_path, clock, expires_s=4e9)
    assert files(after) == sorted([f"{clip.name}.json", f"{clip.name}.wav", "of somebody else.txt"])


@pytest.mark.parametrize("name", ["../../etc/passwd", "upload-../x", "upload-" + "A" * 32, "", "upload-" + "0" * 33])
def test_no_other_name_becomes_a_path(store, name):
    assert not is_upload(name)
    for use in (store.describe, store.remove, lambda name: store.load(name, 24_000)):
        with pytest.raises(UnknownClipError):
            use(name)


def test_a_damaged_label_is_no_clip(store):
    clip, _ = put(store)
    for damage in ("", "[]", '{"title": 5}', json.dumps({"title": "x", "duration_s": "long"})):
        (store._folder / f"{clip.name}.json").write_text(damage)
        with pytest.raises(UnknownClipError):
            store.describe(clip.name)
        assert store.clips() == []
