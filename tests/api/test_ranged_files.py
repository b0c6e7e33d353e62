"""Parts of files, as RFC 9110 has them."""

import pytest
from starlette.applications import Starlette
from starlette.routing import Route
from starlette.testclient import TestClient

from server.api.ranged_files import RangedBytes, RangedFile
from tests.api.test_routes import check_problem

CONTENT = bytes(range(100))
TAG = '"abc"'


@pytest.fixture(params=["on disk", "in memory"])
def ask(tmp_path, request):
    path = tmp_path / "a.bin"
    path.write_bytes(CONTENT)

    async def endpoint(_):
        if request.param == "in memory":
            return RangedBytes(CONTENT, headers={"ETag": TAG}, media_type="application/octet-stream")
        return RangedFile(path, headers={"ETag": TAG}, stat_result=path.stat())

    client = TestClient(Starlette(routes=[Route("/", endpoint, methods=["GET"])]))
    return lambda method="GET", **headers: client.request(
        method, "/", headers={name.replace("_", "-"): text for name, text in headers.items()}
    )


@pytest.mark.parametrize(
    ("asked", "part"),
    [
        ("bytes=0-9", slice(0, 10)),
        ("bytes=90-", slice(90, 100)),
        ("bytes=-5", slice(95, 100)),
        ("bytes=90-1000", slice(90, 100)),
        ("bytes=-1000", slice(0, 100)),
        ("bytes= 3-3", slice(3, 4)),
    ],
)
def test_a_part_is_sent_with_its_place(ask, asked, part):
    answer = ask(range=asked)
    assert (answer.status_code, answer.content) == (206, CONTENT[part])
    assert answer.headers["content-range"] == f"bytes {part.start}-{part.stop - 1}/100"
    assert answer.headers["etag"] == TAG


@pytest.mark.parametrize(
    "asked", ["", "bytes", "bytes=", "bytes=-", "bytes=9-3", "lines=1-2", "bytes=0-1,5-6", "bytes=x-"]
)
def test_what_is_no_single_range_is_ignored(ask, asked):
    answer = ask(range=asked)
    assert (answer.status_code, answer.content) == (200, CONTENT)
    assert answer.headers["accept-ranges"] == "bytes"


@pytest.mark.parametrize("asked", ["bytes=100-", "bytes=100-101", "bytes=-0"])
def test_what_lies_behind_the_end_is_a_problem(ask, asked):
    answer = ask(range=asked)
    check_problem(answer, 416, "range_not_satisfiable", "Range")
    assert answer.headers["content-range"] == "bytes */100"


def test_a_part_of_another_version_is_not_sent(ask):
    assert ask(range="bytes=0-9", if_range=TAG).status_code == 206
    for other in ('"abd"', f"W/{TAG}", "Wed, 25 Nov 2099 10:00:00 GMT"):
        assert ask(range="bytes=0-9", if_range=other).content == CONTENT
        assert ask(range="bytes=500-", if_range=other).content == CONTENT
