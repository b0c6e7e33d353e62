"""Answers are compressed where it helps, and are what they were."""

import gzip

import pytest
from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.testclient import TestClient

from server.api.compression import Compression, accepts_gzip

LONG = {"samples": [f"{number / 7:.12f}" for number in range(4_000)]}
TAG = '"abc"'
TAGGED = {"ETag": TAG}


async def parts():
    for number in range(40):
        yield f"line {number} of many\n".encode() * (1 + 1000 * (number % 2))


def answer(name, tmp_path):
    match name:
        case "long":
            return JSONResponse(LONG, headers=TAGGED)
        case "short":
            return JSONResponse({"status": "live"}, headers=TAGGED)
        case "streamed":
            return StreamingResponse(parts(), media_type="text/plain")
        case "sound":
            return Response(b"0" * 10_000, media_type="audio/wav", headers=TAGGED)
        case "coded":
            return Response(
                gzip.compress(b"0" * 10_000, mtime=0), headers={"Content-Encoding": "gzip"}, media_type="text/css"
            )
        case "file":
            (tmp_path / "a.js").write_text("// a comment\n" * 10_000)
            return FileResponse(tmp_path / "a.js")


@pytest.fixture
def ask(tmp_path):
    """Asks for an answer by its name: status, headers, and the body as sent."""

    async def endpoint(request):
        return answer(request.path_params["name"], tmp_path)

    app = Compression(Starlette(routes=[Route("/{name}", endpoint)]))

    def run(name, method="GET", **headers):
        headers = {key.replace("_", "-"): value for key, value in headers.items()}
        with TestClient(app) as client, client.stream(method, f"/{name}", headers=headers) as got:
            return got.status_code, got.headers, b"".join(got.iter_raw())

    return run


@pytest.mark.parametrize("name", ["long", "streamed", "file"])
def test_text_is_compressed_for_those_who_read_gzip_and_is_the_same(ask, name):
    _, plain, whole = ask(name, accept_encoding="identity")
    status, headers, body = ask(name, accept_encoding="br, gzip")
    assert (status, headers["content-encoding"]) == (200, "gzip")
    assert gzip.decompress(body) == whole
    assert len(body) < len(whole) / 2
    assert "content-encoding" not in plain
    for each in (plain, headers):
        assert each["vary"] == "Accept-Encoding"
    assert headers.get("content-length", str(len(body))) == str(len(body))


@pytest.mark.parametrize("name", ["short", "sound", "coded"])
def test_what_is_short_or_coded_is_sent_as_it_is(ask, name):
    plain, asked = (ask(name, accept_encoding=each) for each in ("identity", "gzip"))
    assert asked[1:] == plain[1:]


def test_the_tag_of_compressed_bytes_is_weak(ask):
    assert ask("long", accept_encoding="gzip")[1]["etag"] == f"W/{TAG}"
    assert ask("long", accept_encoding="identity")[1]["etag"] == TAG
    assert ask("short", accept_encoding="gzip")[1]["etag"] == TAG


def test_a_part_of_a_file_is_sent_as_it_is(ask):
    status, headers, body = ask("file", accept_encoding="gzip", range="bytes=3-9")
    assert (status, body) == (206, b"a comme")
    assert "content-encoding" not in headers


@pytest.mark.parametrize("name", ["long", "short", "sound"])
def test_head_tells_the_same(ask, name):
    got, head = (ask(name, method, accept_encoding="gzip") for method in ("GET", "HEAD"))
    assert head[2] == b""
    for each in ("etag", "content-encoding", "vary", "content-type"):
        assert head[1].get(each) == got[1].get(each)


@pytest.mark.parametrize(
    ("accepted", "has"),
    [
        ("gzip", True),
        ("GZIP;q=0.5, br", True),
        ("*", True),
        ("gzip;q=0", False),
        ("gzip; q=0.000, *", False),
        ("br, *;q=0", False),
        ("gzipped", False),
        ("gzip;q=much", False),
        ("", False),
    ],
)
def test_gzip_is_read_from_the_header(accepted, has):
    assert accepts_gzip(Headers({"accept-encoding": accepted})) is has
