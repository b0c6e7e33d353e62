"""Clips over HTTP: what is taken, what is refused and why, and that streams play it at once."""

import asyncio
import errno
import io
import os
from pathlib import Path

import numpy as np
import pytest
import soundfile
from starlette.requests import ClientDisconnect
from starlette.testclient import TestClient

from server.api import uploads
from server.api.app import create_app
from server.api.settings import Settings
from server.api.uploads import MOST_AT_ONCE, Uploads
from server.assets.clip_store import ClipStore
from server.assets.upload_decoder import DecodingLimits
from server.core.errors import RequestError
from server.field.fields_by_level import FieldsByLevel
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import PROTOCOL, AddEmitter, Hello
from server.protocol.server_messages import EmitterAdded, Error, Status, parse_server_message
from tests.api.test_routes import wait_until_ready
from tests.assets.uploads import KINDS, encoded, mutated

WAV = encoded("wav")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("uploads")


@pytest.fixture(scope="module")
def client(bundle, hrtfs, folder):
    settings = Settings(clips_folder=folder, max_clip_bytes=400_000, max_clip_s=3.0, clips_quota_bytes=2**20)
    app = create_app(settings, scenes={"flat": FieldsByLevel.load(bundle)}, hrtfs=hrtfs)
    with TestClient(app, raise_server_exceptions=False) as client:
        wait_until_ready(client)
        yield client


@pytest.fixture(autouse=True)
def _nothing_is_left(client, folder):
    yield
    for clip in client.get("/v1/clips").json()["clips"]:
        client.delete(f"/v1/clips/{clip['name']}")
    assert [path.name for path in folder.iterdir()] == [".lock"]


def upload(client, content=WAV, **options):
    return client.post("/v1/clips", content=content, **options)


def refusal(answer):
    document = answer.json()
    assert answer.headers["content-type"] == "application/problem+json"
    assert document["status"] == answer.status_code
    return answer.status_code, document["code"]


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_becomes_a_clip(client, kind):
    answer = upload(client, encoded(kind), params={"title": "A tone"}, headers={"Content-Type": "audio/x-any"})
    assert answer.status_code == 201
    clip = answer.json()
    assert (clip["title"], clip["credit"]) == ("A tone", "")
    assert clip["duration_s"] == pytest.approx(0.5, abs=0.1)
    assert clip["expires_at"].endswith("+00:00")
    assert answer.headers["location"] == f"/v1/clips/{clip['name']}"
    assert clip in client.get("/v1/clips").json()["clips"]
    assert client.get(answer.headers["location"]).json() == clip
    sound = client.get(f"{answer.headers['location']}/audio").content
    assert soundfile.info(io.BytesIO(sound)).duration == pytest.approx(clip["duration_s"], abs=0.001)
    head = client.head(answer.headers["location"])
    assert (head.status_code, head.content) == (200, b"")


def test_the_same_file_is_the_same_clip(client):
    first, again = upload(client, params={"title": "One"}), upload(client, params={"title": "Two"})
    assert (first.status_code, again.status_code) == (201, 200)
    assert again.json() == {**first.json(), "expires_at": again.json()["expires_at"]}


def test_whoever_polls_the_list_learns_of_a_new_clip_and_of_nothing_else(client):
    before = {"If-None-Match": client.get("/v1/clips").headers["etag"]}
    assert client.get("/v1/clips", headers=before).status_code == 304
    name = upload(client).json()["name"]
    found = client.get("/v1/clips", headers=before)
    assert found.status_code == 200
    assert name in {clip["name"] for clip in found.json()["clips"]}
    client.delete(f"/v1/clips/{name}")
    assert client.get("/v1/clips", headers=before).status_code == 304


def test_a_stream_plays_it_at_once_and_goes_on_when_it_is_deleted(client):
    name = upload(client).json()["name"]
    with client.websocket_connect("/v1/stream") as socket:
        socket.send_text(Hello(protocol=PROTOCOL, scene="flat", buffer_blocks=32).serialize())
        socket.send_text(AddEmitter(id="a", clip=name, position=(6.0, 3.0, 1.5)).serialize())
        blocks_after = None
        for _ in range(2_000):
            message = socket.receive()
            if message.get("text") is not None:
                event = parse_server_message(message["text"])
                assert not isinstance(event, Error), event
                if isinstance(event, EmitterAdded):
                    assert client.delete(f"/v1/clips/{name}").status_code == 204
                    blocks_after = 0
                continue
            block = AudioBlock.parse(message["bytes"], "f32")
            socket.send_text(f'{{"type":"acknowledge","sequence":{block.sequence}}}')
            if blocks_after is not None and np.abs(block.samples).max() > 0.001:
                blocks_after += 1
                if blocks_after > 150:  # the clip lasts 47 blocks
                    break
        assert blocks_after is not None
        assert blocks_after > 150
        socket.send_text(AddEmitter(id="b", clip=name, position=(6.0, 3.0, 1.5)).serialize())
        events = (message["text"] for message in iter(socket.receive, None) if message.get("text") is not None)
        error = next(event for event in map(parse_server_message, events) if not isinstance(event, Status))
        assert isinstance(error, Error)
        assert (error.code, error.field, error.emitter) == ("unknown_clip", "clip", "b")


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", (422, "undecodable_clip")),
        (b"RIFF but not really", (422, "undecodable_clip")),
        (os.urandom(5_000), (422, "undecodable_clip")),
        (encoded("mp3", 3.5), (422, "clip_too_long")),
        (encoded("wav", 0.1, channels=9), (422, "clip_too_long")),
        (encoded("wav", 5.0), (413, "body_too_large")),
        (iter([WAV, bytes(400_000)]), (413, "body_too_large")),
    ],
    ids=["empty", "no wav", "random", "long", "channels", "large", "large in pieces"],
)
def test_what_is_not_taken_is_refused_with_its_reason(client, content, expected):
    assert refusal(upload(client, content)) == expected


def test_a_quota_refuses_until_something_is_deleted(client):
    names = []
    for number in range(20):
        answer = upload(client, encoded("wav", 1.0 + number / 100))
        if answer.status_code != 201:
            break
        names.append(answer.json()["name"])
    assert len(names) == 5
    assert refusal(answer) == (507, "clips_full")
    assert client.delete(f"/v1/clips/{names[0]}").status_code == 204
    assert upload(client, encoded("wav", 1.0 + number / 100)).status_code == 201


def test_a_full_disk_is_told(client, monkeypatch):
    def fail(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "replace", fail)
    assert refusal(upload(client)) == (507, "storage_failed")


def test_only_uploaded_clips_are_deleted(client):
    assert refusal(client.delete("/v1/clips/trumpet")) == (409, "fixed_clip")
    for name in ("nothing", "upload-" + "0" * 32, "..%2F..%2Fx"):
        for method in ("DELETE", "GET"):
            assert client.request(method, f"/v1/clips/{name}").status_code == 404
    assert refusal(client.get("/v1/clips/nothing")) == (404, "unknown_clip")
    assert client.get("/v1/clips/trumpet").json()["name"] == "trumpet"


@pytest.mark.parametrize("kind", ["application/json", "multipart/form-data; boundary=x", "text/plain"])
def test_a_form_is_told_what_to_send(client, kind):
    answer = upload(client, headers={"Content-Type": kind})
    assert refusal(answer) == (415, "unsupported_media_type")
    assert "send the audio file itself" in answer.json()["detail"]


def test_a_title_has_an_end(client):
    answer = upload(client, params={"title": "x" * 121})
    assert refusal(answer) == (422, "malformed_request")
    assert answer.json()["field"] == "title"


@pytest.mark.parametrize("method", ["POST", "DELETE"])
@pytest.mark.parametrize(
    "headers", [{"Origin": "https://evil.example"}, {"Origin": "null"}, {"Sec-Fetch-Site": "cross-site"}]
)
def test_pages_of_other_sites_neither_upload_nor_delete(client, method, headers):
    name = upload(client).json()["name"]
    path = "/v1/clips" if method == "POST" else f"/v1/clips/{name}"
    answer = client.request(method, path, content=encoded("flac"), headers=headers)
    assert refusal(answer) == (403, "origin_not_allowed")
    assert [clip["name"] for clip in client.get("/v1/clips").json()["clips"] if clip["expires_at"]] == [name]


def test_without_a_folder_there_are_no_uploads(bundle, hrtfs):
    app = create_app(Settings(), scenes={"flat": FieldsByLevel.load(bundle)}, hrtfs=hrtfs)
    with TestClient(app) as client:
        assert refusal(upload(client)) == (403, "uploads_off")
        assert client.get("/v1/clips/trumpet").status_code == 200
        assert refusal(client.delete("/v1/clips/trumpet")) == (409, "fixed_clip")
        assert refusal(client.delete("/v1/clips/upload-" + "0" * 32)) == (404, "unknown_clip")


def opened(folder):
    store = ClipStore(folder, quota_bytes=2**30, expires_s=3_600)
    return Uploads(store, max_bytes=2**20, limits=DecodingLimits(seconds=10))


def test_so_many_uploads_arrive_at_once_and_others_are_told_to_come_back(tmp_path):
    async def slowly(release):
        yield WAV
        await release.wait()

    async def scenario():
        taking, release = opened(tmp_path), asyncio.Event()
        running = [asyncio.create_task(taking.receive(slowly(release), "")) for _ in range(MOST_AT_ONCE)]
        await asyncio.sleep(0.2)
        with pytest.raises(RequestError, match="try again later") as caught:
            await taking.receive(slowly(release), "")
        release.set()
        stored = await asyncio.gather(*running)
        return caught.value, stored

    refused, stored = asyncio.run(scenario())
    assert (refused.code, refused.status, refused.retry_after_s) == ("server_busy", 503, 5)
    assert len({clip.name for clip, _ in stored}) == 1
    assert [is_new for _, is_new in stored].count(True) == 1


@pytest.mark.parametrize("how", ["client leaves", "cancelled", "cancelled while decoding"])
def test_an_upload_that_ends_early_leaves_nothing(tmp_path, monkeypatch, how):
    async def body():
        yield WAV
        if how == "client leaves":
            raise ClientDisconnect
        if how == "cancelled":
            await asyncio.sleep(60)

    async def stay(*_):
        await asyncio.sleep(60)

    if how == "cancelled while decoding":
        monkeypatch.setattr(uploads, "decode_apart", stay)

    async def scenario():
        taking = opened(tmp_path)
        running = asyncio.create_task(taking.receive(body(), ""))
        await asyncio.sleep(0.2)
        running.cancel()
        with pytest.raises((asyncio.CancelledError, ClientDisconnect)):
            await running
        return taking._arriving

    assert asyncio.run(scenario()) == 0
    assert [path.name for path in tmp_path.iterdir()] == [".lock"]


@pytest.mark.long
def test_broken_files_never_break_the_server(client):
    """A thousand of them: no answer but a clip or a refusal, and the server's memory stays as it is."""
    rng = np.random.default_rng(5)
    originals = [encoded(kind, 0.3) for kind in KINDS]
    statuses, resident = [], []
    for number in range(1_000):
        content = rng.bytes(3_000) if number % 10 == 9 else mutated(originals[number % len(originals)], rng)
        answer = upload(client, content)
        statuses.append(answer.status_code)
        if answer.status_code in {200, 201}:
            client.delete(f"/v1/clips/{answer.json()['name']}")
        resident.append(int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE"))
    assert set(statuses) == {201, 422}
    assert min(statuses.count(201), statuses.count(422)) > 100
    assert max(resident[200:]) - resident[200] < 20_000_000
