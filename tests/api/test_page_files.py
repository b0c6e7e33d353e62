import gzip
import hashlib
import os

import pytest
from starlette.applications import Starlette
from starlette.testclient import TestClient

from server.api.app import WEB
from server.api.page_files import PageFiles


@pytest.fixture
def page(tmp_path):
    app = Starlette()
    app.mount("/", PageFiles(directory=tmp_path, html=True))
    (tmp_path / "a.js").write_text("one")
    os.utime(tmp_path / "a.js", ns=(1, 1))
    return tmp_path / "a.js", TestClient(app)


def test_files_of_one_size_and_time_have_tags_of_their_own(page, tmp_path):
    _, client = page
    (tmp_path / "b.js").write_text("two")
    (tmp_path / "c.js").write_text("one")
    os.utime(tmp_path / "b.js", ns=(1, 1))
    os.utime(tmp_path / "c.js", ns=(2, 2))
    tags = [client.get(f"/{name}.js").headers["etag"] for name in "abc"]
    assert tags[0] != tags[1]
    assert tags[0] == tags[2]


def test_what_a_client_has_is_not_sent_again_until_it_changes(page):
    path, client = page
    tag = client.get("/a.js").headers["etag"]
    assert client.get("/a.js", headers={"If-None-Match": f'"x", W/{tag}'}).status_code == 304
    path.write_text("three")
    changed = client.get("/a.js", headers={"If-None-Match": tag})
    assert (changed.status_code, changed.text) == (200, "three")


def test_a_time_alone_proves_nothing(page):
    _, client = page
    assert client.get("/a.js", headers={"If-Modified-Since": "Wed, 25 Nov 2099 10:00:00 GMT"}).status_code == 200


def test_a_file_stored_compressed_is_sent_so_or_whole(page, tmp_path):
    _, client = page
    (tmp_path / "d.js.gz").write_bytes(gzip.compress(b"four", mtime=0))
    tags = set()
    for accepted, stored in (("gzip", True), ("identity", False)):
        with client.stream("GET", "/d.js", headers={"Accept-Encoding": accepted}) as got:
            body = b"".join(got.iter_raw())
        assert body == (gzip.compress(b"four", mtime=0) if stored else b"four")
        assert got.headers.get("content-encoding") == ("gzip" if stored else None)
        assert got.headers["content-type"].startswith("text/javascript")
        assert got.headers["vary"] == "Accept-Encoding"
        tags.add(got.headers["etag"])
        again = client.get("/d.js", headers={"Accept-Encoding": accepted, "If-None-Match": got.headers["etag"]})
        assert again.status_code == 304
    assert len(tags) == 2
    assert client.get("/e.js").status_code == 404


def test_a_page_is_found_without_its_suffix(page, tmp_path):
    _, client = page
    (tmp_path / "read.html").write_text("<p>read")
    got = client.get("/read")
    assert (got.text, got.headers["content-type"].partition(";")[0]) == ("<p>read", "text/html")


def test_what_comes_from_elsewhere_is_what_its_digests_say():
    folder = WEB / "vendor"
    lines = [line.split() for line in (folder / "SHA256SUMS").read_text().splitlines()]
    assert {f"{name}.gz" for _, name in lines} == {path.name for path in folder.glob("*.gz")}
    for digest, name in lines:
        assert hashlib.sha256(gzip.decompress((folder / f"{name}.gz").read_bytes())).hexdigest() == digest
    assert {path.name for path in folder.glob("LICENSE.*")} == {"LICENSE.redoc.txt", "LICENSE.swagger-ui.txt"}
