"""Doors over HTTP and in a real stream."""

import io
import json
import time

import numpy as np
import pytest
from starlette.testclient import TestClient
from typer.testing import CliRunner

from server.api.app import create_app
from server.api.settings import Settings
from server.cli.main import app
from server.field.fields_by_level import FieldsByLevel
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import PROTOCOL, AddEmitter, Hello, ListenerPose, SetDoor
from server.protocol.server_messages import EmitterAdded, Error, parse_server_message
from tests.api.test_listeners_of_a_stream import lose
from tests.api.test_stream import Ears
from tests.two_rooms import BEFORE, BEHIND, EAST, WEST, write_two_rooms

PLACES = {"listener": ",".join(map(str, WEST)), "emitter": ",".join(map(str, EAST))}


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    return write_two_rooms(tmp_path_factory.mktemp("two-rooms") / "scene")


@pytest.fixture(scope="module")
def client(bundle, hrtfs):
    scenes = {bundle.id: FieldsByLevel.load(bundle)}
    with TestClient(create_app(Settings(), scenes=scenes, hrtfs=hrtfs)) as client:
        for _ in range(3_600):
            if client.get("/readyz").status_code == 200:
                break
            time.sleep(0.05)
        yield client


def response(client, **query):
    return client.get("/v1/scenes/two-rooms/impulse-response", params={**PLACES, "format": "npy", **query})


def energy(answer) -> float:
    assert answer.status_code == 200, answer.text
    return float(np.sum(np.load(io.BytesIO(answer.content)).astype(float) ** 2))


def test_a_response_is_that_of_the_doors_in_its_query(client):
    open_, shut = response(client), response(client, door="between=0")
    assert energy(shut) < 1e-3 * energy(open_)
    assert response(client, door="between=1").content == open_.content
    assert response(client, door="between=1").headers["etag"] == open_.headers["etag"]
    assert shut.headers["etag"] != open_.headers["etag"]
    assert response(client, door="between=-0.0").headers["etag"] == shut.headers["etag"]


@pytest.mark.parametrize(
    ("door", "status", "code"),
    [
        ("attic=0", 404, "unknown_door"),
        ("between", 422, "malformed_door"),
        ("between=nan", 422, "malformed_door"),
        ("between=1.5", 422, "malformed_door"),
        (["between=0", "between=1"], 409, "doubled_door"),
    ],
)
@pytest.mark.parametrize("path", ["impulse-response", "loudness", "plan"])
def test_a_door_that_there_is_not_is_refused(client, path, door, status, code):
    places = {"emitter": PLACES["emitter"]} if path == "loudness" else PLACES
    answer = client.get(f"/v1/scenes/two-rooms/{path}", params={**places, "door": door})
    assert (answer.status_code, answer.json()["code"]) == (status, code)


def test_a_batch_has_its_doors(client):
    poses = [{"listener": WEST, "emitter": EAST}]

    def of(**given):
        answer = client.post("/v1/scenes/two-rooms/impulse-responses", json={"poses": poses, **given})
        assert answer.status_code == 200, answer.text
        return np.load(io.BytesIO(answer.content))["responses"]

    single = np.load(io.BytesIO(response(client, door="between=0").content))
    assert np.array_equal(of(doors={"between": 0.0})[0], single)
    assert np.array_equal(of(), of(doors={"between": 1}))
    for doors, code in (({"attic": 0}, "unknown_door"), ({"between": 2}, "malformed_request")):
        answer = client.post("/v1/scenes/two-rooms/impulse-responses", json={"poses": poses, "doors": doors})
        assert answer.json()["code"] == code


def test_maps_and_plans_are_of_the_doors_in_their_query(client):
    def west(door):
        query = {"emitter": PLACES["emitter"], "door": door, "format": "json", "spacing_m": 0.5}
        found = client.get("/v1/scenes/two-rooms/loudness", params=query).json()
        levels = np.array([[np.nan if each is None else each for each in row] for row in found["levels_db"]])
        return np.nanmean(levels[:, :7])

    assert west("between=0") < west("between=1") - 15
    shut, open_ = (
        client.get("/v1/scenes/two-rooms/plan", params={"listener": PLACES["listener"], "door": door}).json()
        for door in ("between=0", "between=1")
    )
    assert shut["decisions"] != open_["decisions"]


def test_a_description_has_its_doors(client):
    (door,) = client.get("/v1/scenes/two-rooms").json()["doors"]
    assert (door["name"], door["openness"]) == ("between", 1.0)


class Visitor(Ears):
    def __init__(self, socket, **hello):
        super().__init__(socket, Hello(protocol=PROTOCOL, scene="two-rooms", **hello))

    def level_db(self, blocks=20):
        heard = np.concatenate([self.until(AudioBlock).samples for _ in range(blocks)], axis=1)
        return 10 * np.log10(np.mean(heard.astype(float) ** 2) + 1e-30)

    def level_comes_to(self, condition):
        return any(condition(self.level_db(10)) for _ in range(60))


def test_a_stream_follows_its_door_and_goes_on_after_a_wrong_one(client):
    with client.websocket_connect("/v1/stream") as socket:
        visitor = Visitor(socket, listener={"position": BEFORE, "yaw": 0.0})
        assert visitor.welcome.doors == {"between": 1.0}
        visitor.send(AddEmitter(id="a", clip="trumpet", position=BEHIND, loop=True, offset_s=1.0))
        visitor.until(EmitterAdded)
        visitor.level_db(20)
        before = max(visitor.level_db(20) for _ in range(5))
        visitor.send(SetDoor(door="between", openness=0.0))
        assert visitor.level_comes_to(lambda level: level < before - 25)
        visitor.send(SetDoor(door="attic", openness=0.0))
        assert visitor.until(Error).code == "unknown_door"
        for openness, code in (("2", "malformed_message"), ("null", "malformed_message")):
            visitor.send(f'{{"type": "set_door", "door": "between", "openness": {openness}}}')
            error = visitor.until(Error)
            assert (error.code, error.field) == (code, "openness")
        visitor.send(SetDoor(door="between", openness=1 + 1e-7))
        assert visitor.level_comes_to(lambda level: level > before - 10)
        visitor.send(ListenerPose(pose_id=1, position=WEST, yaw=0.0))
        assert np.isfinite(visitor.level_db())


def test_a_stream_begins_and_is_resumed_with_doors_as_they_were(client):
    with client.websocket_connect("/v1/stream") as socket:
        visitor = Visitor(socket, doors={"between": 0.5})
        assert visitor.welcome.doors == {"between": 0.5}
        visitor.send(SetDoor(door="between", openness=0.25))
        visitor.until(AudioBlock)
        token = visitor.welcome.resume_token
        lose(socket, client)
    with client.websocket_connect("/v1/stream") as socket:
        socket.send_text(json.dumps({"type": "resume", "protocol": PROTOCOL, "token": token}))
        message = parse_server_message(socket.receive_text())
        assert message.resumed is not None
        assert message.doors == {"between": 0.25}


def test_a_hello_that_opens_a_door_that_there_is_not_is_refused(client):
    with client.websocket_connect("/v1/stream") as socket:
        socket.send_text(Hello(protocol=PROTOCOL, scene="two-rooms", doors={"attic": 1.0}).serialize())
        assert parse_server_message(socket.receive()["text"]).code == "unknown_door"


def test_commands_take_doors(bundle, tmp_path):
    def run(*words):
        return CliRunner().invoke(app, [words[0], str(bundle.folder), *map(str, words[1:])])

    written = {}
    for share in ("0", "1"):
        path = tmp_path / f"{share}.npy"
        places = ("--listener", PLACES["listener"], "--emitter", PLACES["emitter"])
        done = run("ir", *places, "--door", f"between={share}", "--output", path)
        assert done.exit_code == 0, done.output
        written[share] = np.sum(np.load(path).astype(float) ** 2)
    assert written["0"] < 1e-3 * written["1"]
    refused = run("plan", "--door", "attic=1")
    assert refused.exit_code != 0
    assert "no door 'attic'" in str(refused.exception)


def test_a_section_has_the_lines_at_a_height_without_doors(client):
    lines = np.array(client.get("/v1/scenes/two-rooms/section", params={"height_m": 1.0}).json()["lines"])
    assert lines.shape[1] == 4
    assert lines.min() == 0.0
    assert lines[:, [0, 2]].max() == 8.0
    assert not np.any((lines[:, 0] == 4.05) | (lines[:, 2] == 4.05))
    assert client.get("/v1/scenes/two-rooms/section", params={"height_m": 9.0}).json()["lines"] == []
    assert client.get("/v1/scenes/two-rooms/section", params={"height_m": "nan"}).status_code == 422


def test_a_description_has_its_storeys(client):
    assert client.get("/v1/scenes/two-rooms").json()["storeys"] == [{"floor_m": 0.0, "top_m": 2.8}]
