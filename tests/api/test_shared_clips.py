"""Two servers whose uploaded clips are in one store."""

import re
import sys
import time

import fsspec
import numpy as np
import pytest
from fsspec.implementations.memory import MemoryFileSystem
from starlette.testclient import TestClient

from server.api.app import create_app
from server.api.connection_limits import ConnectionLimits
from server.api.settings import Settings
from server.core.errors import NafirError
from server.field.fields_by_level import FieldsByLevel
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import PROTOCOL, AddEmitter, Hello, Ping, Resume
from server.protocol.server_messages import EmitterAdded, Error, Pong, SnapshotTaken, Welcome, parse_server_message
from tests.api.test_routes import wait_until_ready
from tests.assets.uploads import encoded

URL = "memory://games/clips"
WAV = encoded("wav")
ADD = {"id": "a", "position": (6.0, 3.0, 1.5)}


def _empty():
    system = fsspec.filesystem("memory")
    system.store.clear()
    system.pseudo_dirs[:] = [""]


@pytest.fixture(scope="module")
def servers(bundle, hrtfs, tmp_path_factory):
    _empty()
    levels = FieldsByLevel.load(bundle)
    settings = {"clips_url": URL, "max_clip_bytes": 400_000, "resume_secret": "a secret of two servers"}
    apps = [
        create_app(Settings(**settings, **more), scenes={"flat": levels}, hrtfs=hrtfs)
        for more in ({"clips_folder": tmp_path_factory.mktemp("clips")}, {})
    ]
    one, two = (TestClient(app, raise_server_exceptions=False) for app in apps)
    with one, two:
        for each in (one, two):
            wait_until_ready(each)
        yield one, two
    _empty()


@pytest.fixture(autouse=True)
def _nothing_is_left(servers):
    yield
    for clip in servers[0].get("/v1/clips").json()["clips"]:
        if clip["expires_at"]:
            servers[0].delete(f"/v1/clips/{clip['name']}")
    assert fsspec.filesystem("memory").find("/") == []


def upload(client, content=WAV):
    answer = client.post("/v1/clips", content=content)
    assert answer.status_code == 201, answer.text
    return answer.json()


def refusal(answer):
    assert answer.headers["content-type"] == "application/problem+json"
    return answer.status_code, answer.json()["code"]


class Listening:
    """A stream whose blocks are acknowledged as they come."""

    def __init__(self, socket):
        self.socket, self.blocks, self.loudest = socket, 0, 0.0

    def until(self, kind, most=4_000):
        """The next event of a kind. An `Error` ends the wait, too."""
        for _ in range(most):
            message = self.socket.receive()
            if message.get("text") is not None:
                event = parse_server_message(message["text"])
                if isinstance(event, kind | Error):
                    return event
                continue
            block = AudioBlock.parse(message["bytes"], "f32")
            self.blocks += 1
            self.loudest = max(self.loudest, float(np.abs(block.samples).max()))
            self.socket.send_text(f'{{"type":"acknowledge","sequence":{block.sequence}}}')
        raise AssertionError(f"no {kind.__name__} came")

    def play(self, seconds=0.5):
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            self.socket.send_text(Ping(id=1).serialize())
            self.until(Pong)


def test_a_clip_that_one_server_has_taken_is_at_the_other(servers):
    one, two = servers
    clip = upload(one)
    assert two.get(f"/v1/clips/{clip['name']}").json() == clip
    assert clip in two.get("/v1/clips").json()["clips"]
    sound = two.get(f"/v1/clips/{clip['name']}/audio")
    assert sound.content == one.get(f"/v1/clips/{clip['name']}/audio").content
    part = two.get(f"/v1/clips/{clip['name']}/audio", headers={"Range": "bytes=4-7"})
    assert (part.status_code, part.content) == (206, sound.content[4:8])
    again = two.post("/v1/clips", content=WAV)
    assert (again.status_code, again.json()["name"]) == (200, clip["name"])
    assert two.delete(f"/v1/clips/{clip['name']}").status_code == 204
    assert refusal(two.get(f"/v1/clips/{clip['name']}")) == (404, "unknown_clip")
    end_s = time.monotonic() + 30
    while one.get(f"/v1/clips/{clip['name']}").status_code != 404:  # with its next listing
        assert time.monotonic() < end_s
        time.sleep(0.1)


def test_a_stream_goes_on_while_its_clip_comes_from_elsewhere(servers, monkeypatch):
    one, two = servers
    name = upload(one)["name"]
    get_file = MemoryFileSystem.get_file

    def slow(self, *args, **options):
        time.sleep(2.0)
        return get_file(self, *args, **options)

    monkeypatch.setattr(MemoryFileSystem, "get_file", slow)
    with two.websocket_connect("/v1/stream") as socket:
        socket.send_text(Hello(protocol=PROTOCOL, scene="flat", buffer_blocks=8).serialize())
        stream = Listening(socket)
        assert isinstance(stream.until(Welcome), Welcome)
        socket.send_text(AddEmitter(clip=name, **ADD).serialize())
        socket.send_text(Ping(id=7).serialize())
        pong = stream.until(Pong)
        before = stream.blocks
        added = stream.until(EmitterAdded)
        assert isinstance(pong, Pong), pong
        assert isinstance(added, EmitterAdded), added
        assert stream.blocks - before > 2 * 40, "a window is 32 blocks and the buffer's 8"
        stream.play()
        assert stream.loudest > 0.001
        socket.send_text(AddEmitter(clip="upload-" + "0" * 32, **{**ADD, "id": "b"}).serialize())
        refused = stream.until(EmitterAdded)
        assert (refused.code, refused.emitter) == ("unknown_clip", "b")


def test_a_lost_stream_goes_on_at_another_server_with_its_uploaded_clip(servers):
    one, two = servers
    name = upload(one, encoded("wav", 0.7))["name"]  # which no test before has played
    with one.websocket_connect("/v1/stream") as socket:
        socket.send_text(Hello(protocol=PROTOCOL, scene="flat", buffer_blocks=8, snapshots=True).serialize())
        stream = Listening(socket)
        stream.until(Welcome)
        socket.send_text(AddEmitter(clip=name, **ADD).serialize())
        assert isinstance(stream.until(EmitterAdded), EmitterAdded)
        snapshot = stream.until(SnapshotTaken)
        while snapshot.handled < 1:
            snapshot = stream.until(SnapshotTaken)
    with two.websocket_connect("/v1/stream") as socket:
        socket.send_text(Resume(protocol=PROTOCOL, snapshot=snapshot.snapshot).serialize())
        stream = Listening(socket)
        assert isinstance(stream.until(Welcome), Welcome)
        stream.play(1.0)
        assert stream.loudest > 0.001


def test_a_store_that_is_lost_is_told_with_a_time_to_come_back(servers, monkeypatch, caplog):
    one, two = servers
    name = upload(one)["name"]

    def fail(*_, **__):
        raise ConnectionError("unplugged")

    with monkeypatch.context() as patch:
        for method in ("ls", "info", "get_file", "put_file", "pipe_file", "cat_file", "rm_file"):
            patch.setattr(MemoryFileSystem, method, fail)
        unknown = "upload-" + "0" * 32
        requests = [
            two.get(f"/v1/clips/{unknown}"),
            two.get(f"/v1/clips/{unknown}/audio"),
            two.post("/v1/clips", content=encoded("flac")),
            two.delete(f"/v1/clips/{name}"),
        ]
        for answer in requests:
            assert refusal(answer) == (503, "store_unreachable")
            assert answer.headers["retry-after"] == "5"
        assert "games/clips" in caplog.text
        assert "unplugged" in caplog.text
        failed = re.search(
            r'nafir_store_failures_total{operation="list",reason="error",store="clips"} ([0-9.]+)',
            two.get("/metrics").text,
        )
        assert float(failed[1]) > 0
        assert two.get("/v1/clips/trumpet").status_code == 200
        assert two.get("/readyz").status_code == 200
        end_s = time.monotonic() + 30
        while refusal(one.post("/v1/clips", content=encoded("flac")))[1] != "store_unreachable":
            assert time.monotonic() < end_s
        assert one.get(f"/v1/clips/{name}/audio").status_code == 200, "its copy is here"
        with two.websocket_connect("/v1/stream") as socket:
            socket.send_text(Hello(protocol=PROTOCOL, scene="flat", buffer_blocks=8).serialize())
            stream = Listening(socket)
            stream.until(Welcome)
            socket.send_text(AddEmitter(clip=unknown, **ADD).serialize())
            refused = stream.until(EmitterAdded)
            assert (refused.code, refused.retry_after_s, refused.emitter) == ("store_unreachable", 5, "a")
            socket.send_text(Ping(id=3).serialize())
            assert isinstance(stream.until(Pong), Pong)
    end_s = time.monotonic() + 30
    for each in servers:  # they notice by themselves
        while (answer := each.post("/v1/clips", content=encoded("flac"))).status_code not in {200, 201}:
            assert refusal(answer) == (503, "store_unreachable")
            assert time.monotonic() < end_s
            time.sleep(0.1)


def test_uploads_have_their_limits_with_a_store_alone():
    limits = ConnectionLimits.of(Settings(clips_url=URL, max_clip_bytes=400_000))
    assert limits.max_upload_bytes == 400_000


def test_a_server_without_fsspec_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(NafirError, match=r"clips_url: .*pip install 'nafir\[store\]'"):
        create_app(Settings(clips_url=URL))


def test_clips_of_a_folder_stay_when_there_is_a_store(tmp_path):
    (tmp_path / "mine.wav").write_bytes(WAV)
    app = create_app(Settings(clips_url=URL, clips_folder=tmp_path))
    with TestClient(app):
        folders = {path.name.partition("-")[0] for path in tmp_path.iterdir()}
    assert folders == {"mine.wav", "copies"}
