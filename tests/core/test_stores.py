"""Folders of stores that fsspec reads."""

import errno
import sys

import fsspec
import pytest

from server.core.errors import NafirError
from server.core.stores import Store


@pytest.fixture(params=["memory", "file"])
def store(request, tmp_path):
    system = fsspec.filesystem("memory")
    system.store.clear()
    system.pseudo_dirs[:] = [""]
    yield Store("memory://games/clips" if request.param == "memory" else f"file://{tmp_path}/clips", "clips_url")
    system.store.clear()
    system.pseudo_dirs[:] = [""]


def test_files_come_and_go(store, tmp_path):
    (tmp_path / "here").write_bytes(b"sound")
    with pytest.raises(FileNotFoundError):
        store.list()
    store.put(str(tmp_path / "here"), store.path("a.wav"))
    store.write(store.path("a.json"), b"label")
    found = {entry.name: entry for entry in store.list()}
    assert found.keys() == {"a.wav", "a.json"}
    assert all(entry.is_file and not entry.is_folder and entry.size_bytes == 5 for entry in found.values())
    assert store.size_bytes(store.path("a.wav")) == 5
    label, missing = store.read([store.path("a.json"), store.path("none")], 3)
    assert label == b"lab"
    assert isinstance(missing, FileNotFoundError)
    store.get(store.path("a.wav"), str(tmp_path / "there"))
    assert (tmp_path / "there").read_bytes() == b"sound"
    for _ in range(2):
        store.remove(store.path("a.wav"))
    assert [entry.name for entry in store.list()] == ["a.json"]


def counted(store):
    return {operation: durations.count for operation, durations in store.calls.durations.items()}


def test_each_call_is_counted_by_what_was_asked(store, tmp_path):
    (tmp_path / "here").write_bytes(b"sound")
    store.put(str(tmp_path / "here"), store.path("a.wav"))
    store.write(store.path("a.json"), b"label")
    store.list()
    store.key(store.path("a.wav"))
    store.size_bytes(store.path("a.wav"))
    store.read([store.path("a.json")], 3)
    store.get(store.path("a.wav"), str(tmp_path / "there"))
    for _ in range(2):
        store.remove(store.path("a.wav"))
    assert counted(store) == {"list": 1, "read": 4, "write": 2, "remove": 2}
    assert not any(store.calls.failures.values())
    assert store.calls.answered_s > 0


def test_that_there_is_nothing_is_an_answer_and_an_error_is_none(store, monkeypatch):
    with pytest.raises(FileNotFoundError):
        store.size_bytes(store.path("none"))
    assert not any(store.calls.failures.values())
    answered_s = store.calls.answered_s
    assert answered_s > 0

    def fail(*_, **__):
        raise PermissionError("refused")

    for method in ("ls", "pipe_file", "rm_file", "info"):
        monkeypatch.setattr(type(store._system), method, fail)
    for call in (store.list, lambda: store.write("x", b""), lambda: store.remove("x"), lambda: store.size_bytes("x")):
        with pytest.raises(PermissionError):
            call()
    monkeypatch.setattr(type(store._system), "cat_ranges", lambda *_, **__: [b"label", PermissionError("refused")])
    store.read(["x", "y"], 3)
    failures = {key: count for key, count in store.calls.failures.items() if count}
    assert failures == {("list", "error"): 1, ("write", "error"): 1, ("remove", "error"): 1, ("read", "error"): 2}


def test_where_files_can_be_renamed_none_is_seen_before_it_is_whole(tmp_path, monkeypatch):
    (tmp_path / "clips").mkdir()
    store = Store(f"file://{tmp_path}/clips", "clips_url")

    def fail(*_):
        raise OSError(errno.EIO, "lost")

    monkeypatch.setattr(type(store._system), "mv", fail)
    with pytest.raises(OSError, match="lost"):
        store.write(store.path("a.json"), b"label")
    assert [entry.name for entry in store.list()] == ["a.json.part"]


@pytest.mark.parametrize(
    "url",
    [
        "web://anne:s3cret@store.example/clips?sig=t0ken",
        "web://anne:s3cret@store.example/clips",
        "simplecache::web://anne:s3cret@store.example/clips?sig=t0ken",
        "web://anne:s3cret%2Fx@store.example/clips?sig=t0ken",
    ],
)
def test_no_password_is_told(url):
    class Web(fsspec.AbstractFileSystem):
        protocol = "web"

        @classmethod
        def _strip_protocol(cls, path):
            return path

        def unstrip_protocol(self, name):
            return name

    fsspec.register_implementation("web", Web, clobber=True)
    store = Store(url, "clips_url")
    for text in (store.name, store.told(OSError(f"no answer of {url}")), store.told(f"s3cret/x of {url}")):
        assert "store.example/clips" in text
        for secret in ("anne", "s3cret", "t0ken"):
            assert secret not in text


def test_a_url_of_no_use_is_refused(monkeypatch):
    with pytest.raises(NafirError, match=r"clips_url: .*nosuch") as caught:
        Store("nosuch://anne:s3cret@place", "clips_url")
    assert "s3cret" not in str(caught.value)
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(NafirError, match=r"clips_url: .*pip install 'nafir\[store\]'"):
        Store("memory://place", "clips_url")
