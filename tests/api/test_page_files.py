import os

import pytest
from starlette.applications import Starlette
from starlette.testclient import TestClient

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
