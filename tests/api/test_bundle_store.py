"""Bundles in a store that fsspec reads."""

import logging
import shutil
import sys
import time

import fsspec
import pytest
from fsspec.implementations.ftp import FTPFileSystem
from starlette.testclient import TestClient

from server.api import bundle_store
from server.api.app import create_app
from server.api.bundle_store import BundleStore
from server.api.settings import Settings
from server.core.errors import NafirError
from server.field.fields_by_level import FieldsByLevel
from server.scene.bundle import MANIFEST_FILE, Bundle


@pytest.fixture
def url():
    """A store in memory, empty before and after."""
    system = fsspec.filesystem("memory")
    system.store.clear()
    system.pseudo_dirs[:] = [""]
    system.makedirs("/games/scenes")
    yield "memory://games/scenes"
    system.store.clear()
    system.pseudo_dirs[:] = [""]


def put(bundle, url, name) -> None:
    system, root = fsspec.url_to_fs(url)
    for file, data in bundle.contents.items():
        system.pipe_file(f"{root}/{name}/{file}", data)


def copied(store) -> dict[str, set[str]]:
    return {folder.name: {file.name for file in folder.iterdir()} for folder in store.copies.iterdir()}


def test_bundles_come_change_and_go(bundle, url):
    system, root = fsspec.url_to_fs(url)
    put(bundle, url, "hall")
    system.pipe_file(f"{root}/notes/read.me", b"no bundle")
    with BundleStore(url) as store:
        store.fetch()
        assert copied(store) == {"hall": set(bundle.contents)}
        assert Bundle.load(store.copies / "hall").digest == bundle.digest
        put(bundle, url, "office")
        store.fetch()
        assert copied(store).keys() == {"hall", "office"}
        system.rm(f"{root}/hall", recursive=True)
        system.rm_file(f"{root}/office/{MANIFEST_FILE}")
        store.fetch()
        assert copied(store) == {}
        folder = store.copies
    assert not folder.parent.exists()


def test_only_what_has_changed_is_copied_again(bundle, url, monkeypatch):
    system, root = fsspec.url_to_fs(url)
    put(bundle, url, "hall")
    with BundleStore(url) as store:
        store.fetch()
        asked = []
        get_file = type(system).get_file
        monkeypatch.setattr(type(system), "get_file", lambda *args: (asked.append(args[1]), get_file(*args))[1])
        before = (store.copies / "hall").stat().st_ino
        store.fetch()
        assert asked == []
        assert (store.copies / "hall").stat().st_ino == before
        system.pipe_file(f"{root}/hall/{MANIFEST_FILE}", bundle.contents[MANIFEST_FILE] + b"\n")
        store.fetch()
        assert asked == [f"{root}/hall/{MANIFEST_FILE}"]
        assert (store.copies / "hall" / MANIFEST_FILE).read_bytes() == bundle.contents[MANIFEST_FILE] + b"\n"
        assert copied(store) == {"hall": set(bundle.contents)}


def test_what_changes_while_it_is_copied_is_taken_at_the_next_look(bundle, url, monkeypatch, caplog):
    system, root = fsspec.url_to_fs(url)
    put(bundle, url, "hall")
    get_file = type(system).get_file

    def change(*args) -> None:
        get_file(*args)
        system.pipe_file(f"{root}/hall/{MANIFEST_FILE}", b"another")

    with BundleStore(url) as store, monkeypatch.context() as patch:
        patch.setattr(type(system), "get_file", change)
        store.fetch()
        assert copied(store) == {}
        assert "hall: changed while it was copied" in caplog.text
        patch.undo()
        store.fetch()
        assert (store.copies / "hall" / MANIFEST_FILE).read_bytes() == b"another"


@pytest.mark.parametrize(
    ("limit", "value", "problem"),
    [("MOST_FILES", 2, "more than 2 files"), ("MOST_FILE_BYTES", -bundle_store.MOST_MANIFEST_BYTES + 9, "bytes")],
)
def test_what_is_larger_than_a_bundle_is_left_out_and_others_come(
    bundle, url, monkeypatch, caplog, limit, value, problem
):
    system, root = fsspec.url_to_fs(url)
    put(bundle, url, "hall")
    system.pipe_file(f"{root}/small/{MANIFEST_FILE}", b"{}")
    monkeypatch.setattr(bundle_store, limit, value)
    with BundleStore(url) as store:
        for _ in range(3):
            store.fetch()
        assert copied(store) == {"small": {MANIFEST_FILE}}
        said = [record.getMessage() for record in caplog.records if record.levelno == logging.ERROR]
        assert len(said) == 1, said
        assert "hall" in said[0]
        assert problem in said[0]


def test_a_store_that_cannot_be_read_leaves_all_as_it_was(bundle, url, monkeypatch, caplog):
    system, _ = fsspec.url_to_fs(url)
    put(bundle, url, "hall")

    def fail(*_, **__) -> None:
        raise PermissionError("no longer")

    with BundleStore(url) as store:
        store.fetch()
        with monkeypatch.context() as patch:
            patch.setattr(type(system), "ls", fail)
            store.fetch()
            store.fetch()
        assert copied(store) == {"hall": set(bundle.contents)}
        assert caplog.text.count("no longer") == 1
        assert store.calls.failures["list", "error"] == 2
        store.fetch()
        assert copied(store) == {"hall": set(bundle.contents)}


@pytest.mark.parametrize("name", ["..", ".hidden", "a b", "x" * 200])
def test_no_name_leads_out_of_the_folder(bundle, tmp_path, monkeypatch, name):
    (tmp_path / "store").mkdir()
    url = f"file://{tmp_path}/store"
    system, root = fsspec.url_to_fs(url)
    entry = {"name": f"{root}/{name}", "type": "directory", "size": 0}
    ls = type(system).ls
    monkeypatch.setattr(type(system), "ls", lambda own, path, **how: [entry] if path == root else ls(own, path, **how))
    shutil.copytree(bundle.folder, tmp_path, dirs_exist_ok=True)
    with BundleStore(url) as store:
        store.fetch()
        assert copied(store) == {}


def test_a_url_of_no_use_is_refused(monkeypatch):
    with pytest.raises(NafirError, match=r"bundle_url: .*nosuch"):
        BundleStore("nosuch://place")
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(NafirError, match=r"bundle_url: .*nafir\[store\]"):
        BundleStore("memory://place")


def test_no_password_is_told(monkeypatch):
    monkeypatch.setattr(FTPFileSystem, "_connect", lambda _: None)
    monkeypatch.setattr(FTPFileSystem, "__del__", lambda _: None)  # it would close what was never opened
    store = BundleStore("ftp://anne:secret@store.example/scenes")
    assert "secret" not in store.name
    assert store.name.endswith("/scenes")


def test_bundles_are_in_one_place():
    with pytest.raises(ValueError, match="bundle_url is given, and bundle_folder too"):
        Settings(bundle_url="memory://a", bundle_folder="b")


def test_a_server_offers_what_the_store_has(bundle, url):
    put(bundle, url, "hall")
    settings = Settings(bundle_url=url, bundle_folder_s=0.1)
    system, root = fsspec.url_to_fs(url)
    with TestClient(create_app(settings, scenes={"other": FieldsByLevel.load(bundle)})) as client:
        assert client.get(f"/v1/scenes/{bundle.id}").status_code == 200
        system.rm(f"{root}/hall", recursive=True)
        end = time.monotonic() + 180  # the folder is followed once all is measured
        while client.get(f"/v1/scenes/{bundle.id}").status_code != 404:
            assert time.monotonic() < end
            time.sleep(0.1)
