"""Bundles that come, change and go while the server runs."""

import asyncio
import json
import shutil
import time
from contextlib import contextmanager

import pytest
from starlette.testclient import TestClient

from server.api import app
from server.api.app import create_app
from server.api.bundle_folder import BundleFolder
from server.api.settings import Settings
from server.core.errors import FieldError
from server.field.fields_by_level import FieldsByLevel
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import PROTOCOL, Acknowledge, AddEmitter, Hello
from server.protocol.server_messages import EmitterAdded, Error, Welcome, parse_server_message
from server.scene.bundle import MANIFEST_FILE


def put(bundle, folder, **changes) -> None:
    """A copy of the bundle with other values in its manifest, moved in at once as an operator should."""
    prepared = folder.parent / f"{folder.parent.name}-{folder.name}"
    shutil.copytree(bundle.folder, prepared)
    document = json.loads((prepared / MANIFEST_FILE).read_text()) | changes
    (prepared / MANIFEST_FILE).write_text(json.dumps(document))
    if folder.exists():
        shutil.rmtree(folder)
    prepared.rename(folder)


def looked(folder: BundleFolder) -> tuple[dict[str, str], set[str]]:
    """What two looks find: names of scenes by id, and what has gone."""
    first, second = folder.look(), folder.look()
    loaded = {**first.loaded, **second.loaded}
    return {scene: levels.bundle.manifest.name for scene, levels in loaded.items()}, {*first.gone, *second.gone}


@pytest.fixture
def watched(tmp_path):
    path = tmp_path / "scenes"
    path.mkdir()
    return path


def test_bundles_come_change_and_go(bundle, watched):
    put(bundle, watched / "hall", id="hall", name="A hall")
    (watched / "notes").mkdir()
    folder = BundleFolder(watched, {})
    assert folder.look(is_first=True).loaded.keys() == {"hall"}
    assert looked(folder) == ({}, set())
    put(bundle, watched / "office", id="office", name="An office")
    put(bundle, watched / "hall", id="hall", name="A larger hall")
    assert looked(folder) == ({"hall": "A larger hall", "office": "An office"}, set())
    shutil.rmtree(watched / "hall")
    assert looked(folder) == ({}, {"hall"})
    put(bundle, watched / "office", id="studio", name="A studio")
    assert looked(folder) == ({"studio": "A studio"}, {"office"})


def test_what_is_still_being_copied_is_left_alone(bundle, watched):
    folder = BundleFolder(watched, {})
    (watched / "hall").mkdir()
    files = sorted(bundle.folder.iterdir(), key=lambda file: file.name != MANIFEST_FILE)
    for file in files:
        shutil.copy(file, watched / "hall")
        assert not folder.look()
        assert folder.refused == 0
    assert folder.look().loaded.keys() == {"flat"}


def test_a_damaged_bundle_changes_nothing_and_is_told_once(bundle, watched, caplog):
    put(bundle, watched / "hall", id="hall")
    folder = BundleFolder(watched, {})
    folder.look(is_first=True)
    graph = next((watched / "hall").glob("*.onnx"))
    whole = graph.read_bytes()
    graph.write_bytes(whole[:-1])
    assert looked(folder) == looked(folder) == ({}, set())
    assert folder.refused == 1
    told = [record.getMessage() for record in caplog.records if "left out" in record.getMessage()]
    assert len(told) == 1
    assert graph.name in told[0]
    graph.write_bytes(whole)
    assert looked(folder)[0].keys() == {"hall"}
    assert folder.refused == 0


def test_of_two_bundles_with_one_id_the_first_is_served(bundle, watched, caplog):
    put(bundle, watched / "a", id="hall", name="A")
    put(bundle, watched / "b", id="hall", name="B")
    folder = BundleFolder(watched, {})
    assert folder.look(is_first=True).loaded["hall"].bundle.manifest.name == "A"
    assert folder.refused == 1
    assert "so is that of" in caplog.text
    shutil.rmtree(watched / "a")
    (watched / "b" / "touched").touch()
    assert looked(folder)[0] == {"hall": "B"}


@pytest.mark.parametrize("has_failed", [False, True], ids=["is deleted", "cannot be served"])
def test_where_the_first_of_two_with_one_id_goes_the_other_comes(bundle, watched, has_failed):
    put(bundle, watched / "a", id="hall", name="First")
    put(bundle, watched / "b", id="hall", name="Second")
    folder = BundleFolder(watched, {})
    assert folder.look(is_first=True).loaded.keys() == {"hall"}
    if has_failed:
        folder.refuse(watched / "a")
    else:
        shutil.rmtree(watched / "a")
    loaded, _ = looked(folder)
    assert loaded == {"hall": "Second"}
    assert folder.refused == has_failed


def test_a_newer_bundle_that_cannot_be_served_leaves_its_id_to_the_older(bundle, watched):
    put(bundle, watched / "a", id="hall", name="Older")
    folder = BundleFolder(watched, {})
    folder.look(is_first=True)
    put(bundle, watched / "a", id="hall", name="Newer")
    assert looked(folder) == ({"hall": "Newer"}, set())
    folder.refuse(watched / "a")
    put(bundle, watched / "b", id="hall", name="Another")
    assert looked(folder) == ({}, set())
    shutil.rmtree(watched / "a")
    assert looked(folder)[0] == {"hall": "Another"}


def test_a_scene_that_was_replaced_comes_back(bundle, watched):
    usual = FieldsByLevel.load(bundle)
    folder = BundleFolder(watched, {"flat": usual})
    put(bundle, watched / "mine", name="Mine")
    assert looked(folder) == ({"flat": "Mine"}, set())
    shutil.rmtree(watched / "mine")
    changes = folder.look()
    assert changes.loaded["flat"] is usual
    assert not changes.gone


def test_a_folder_that_cannot_be_read_changes_nothing(bundle, watched, caplog):
    put(bundle, watched / "hall", id="hall")
    folder = BundleFolder(watched, {})
    folder.look(is_first=True)
    watched.rename(watched.with_name("elsewhere"))
    assert looked(folder) == ({}, set())
    assert "cannot be read" in caplog.text


@contextmanager
def serving(watched, bundle, hrtfs):
    settings = Settings(bundle_folder=watched, bundle_folder_s=0.1, stall_timeout_s=120)
    with TestClient(create_app(settings, scenes={"flat": FieldsByLevel.load(bundle)}, hrtfs=hrtfs)) as client:
        until(lambda: client.get("/readyz").status_code == 200)
        yield client


def until(is_so) -> None:
    for _ in range(3_600):  # the first time ever, everything is compiled
        if is_so():
            return
        time.sleep(0.05)
    raise AssertionError("it did not come to be")


def names(client) -> dict[str, str]:
    return {scene["id"]: scene["name"] for scene in client.get("/v1/scenes").json()["scenes"]}


def received(socket, kind):
    while True:
        message = socket.receive()
        if message.get("text") is None:
            block = AudioBlock.parse(message["bytes"], "f32")
            socket.send_text(Acknowledge(sequence=block.sequence).serialize())
            parsed = block
        else:
            parsed = parse_server_message(message["text"])
        if isinstance(parsed, kind):
            return parsed


def test_a_bundle_whose_field_fails_keeps_no_other_from_coming(bundle, hrtfs, watched, monkeypatch):
    usual = app._prepared

    def prepared(host, levels):
        if levels.bundle.id == "bad":
            raise FieldError("no sound")
        return usual(host, levels)

    monkeypatch.setattr(app, "_prepared", prepared)
    with serving(watched, bundle, hrtfs) as client:
        put(bundle, watched / "a", id="bad")
        put(bundle, watched / "b", id="good")
        until(lambda: "good" in names(client))
        assert "bad" not in names(client)
        until(lambda: "nafir_bundles_refused 1" in client.get("/metrics").text)
        put(bundle, watched / "c", id="later")
        until(lambda: "later" in names(client))


def test_a_bundle_whose_field_fails_at_the_start_keeps_no_other_from_being_served(bundle, hrtfs, watched, monkeypatch):
    usual = app._measured

    def measured(host, levels):
        if levels.bundle.manifest.name == "Bad":
            raise FieldError("no sound")
        return usual(host, levels)

    monkeypatch.setattr(app, "_measured", measured)
    for folder, scene, name in (("a", "bad", "Bad"), ("b", "good", "Good"), ("c", "flat", "Bad")):
        put(bundle, watched / folder, id=scene, name=name)
    with serving(watched, bundle, hrtfs) as client:
        assert names(client) == {"flat": bundle.manifest.name, "good": "Good"}
        assert "nafir_bundles_refused 2" in client.get("/metrics").text
        query = {"listener": "2,2,1.5", "emitter": "6,3,1.5"}
        assert client.get("/v1/scenes/flat/impulse-response", params=query).status_code == 200
        assert client.get("/v1/scenes/bad/impulse-response", params=query).status_code == 404
        put(bundle, watched / "a", id="bad", name="Mended")
        until(lambda: names(client).get("bad") == "Mended")
        assert "nafir_bundles_refused 1" in client.get("/metrics").text


def test_what_nothing_waits_for_is_prepared_once_at_a_time(monkeypatch):
    at_once, most, begun = 0, 0, 0

    async def scenario():
        has_changed, may_end = asyncio.Event(), asyncio.Event()

        async def prepare(_):
            nonlocal at_once, most, begun
            at_once, begun = at_once + 1, begun + 1
            most = max(most, at_once)
            await may_end.wait()
            at_once -= 1

        async def others():
            for _ in range(20):
                await asyncio.sleep(0)

        monkeypatch.setattr(app, "_prepare_the_rest", prepare)
        has_changed.set()
        task = asyncio.create_task(app._keep_prepared(None, has_changed))
        await others()
        for _ in range(5):  # while the first is under way: one more time is enough
            has_changed.set()
            await others()
        may_end.set()
        await others()
        task.cancel()

    asyncio.run(scenario())
    assert (most, begun) == (1, 2)


def test_a_stream_finishes_with_the_scene_that_it_began_in(bundle, hrtfs, watched):
    put(bundle, watched / "hall", id="hall", name="A hall")
    with serving(watched, bundle, hrtfs) as client:
        assert names(client)["hall"] == "A hall"
        with client.websocket_connect("/v1/stream") as socket:
            socket.send_text(Hello(protocol=PROTOCOL, scene="hall").serialize())
            assert received(socket, Welcome).scene.name == "A hall"
            put(bundle, watched / "hall", id="hall", name="Another hall")
            until(lambda: names(client).get("hall") == "Another hall")
            with client.websocket_connect("/v1/stream") as another:
                another.send_text(Hello(protocol=PROTOCOL, scene="hall").serialize())
                assert received(another, Welcome).scene.name == "Another hall"
            shutil.rmtree(watched / "hall")
            until(lambda: "hall" not in names(client))
            socket.send_text(AddEmitter(id="a", live=True, position=(6.0, 3.0, 1.5)).serialize())
            received(socket, EmitterAdded)
            received(socket, AudioBlock)
        with client.websocket_connect("/v1/stream") as late:
            late.send_text(Hello(protocol=PROTOCOL, scene="hall").serialize())
            assert received(late, Error).code == "unknown_scene"
        assert client.get("/v1/scenes/hall").status_code == 404
        assert client.get("/v1/scenes/flat/frontier").status_code == 200
        put(bundle, watched / "office", id="office", name="An office")
        until(lambda: "office" in names(client))
        listener, emitter = "2,2,1.5", "6,3,1.5"
        query = {"listener": listener, "emitter": emitter}
        assert client.get("/v1/scenes/office/impulse-response", params=query).status_code == 200
        assert "nafir_bundles_refused 0" in client.get("/metrics").text
