import dataclasses
import hashlib
import io
import json
import re
import threading
import time
import zipfile
from contextlib import contextmanager
from itertools import count

import netCDF4
import numpy as np
import pytest
import soundfile
from PIL import Image
from starlette.testclient import TestClient

from server.api import app
from server.api.app import create_app
from server.api.openapi_examples import answer_examples
from server.api.settings import Settings
from server.assets.hrtfs import HrtfLibrary
from server.core.errors import FieldError
from server.field.ambisonic_noise import even_noises
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.rendering.head_decoder import HeadDecoder
from server.rendering.hrtf import KEMAR, HeadFilters, Hrtf, kemar
from server.responses.impulse_response import MEDIA_TYPES, ImpulseResponse, IrQuery
from server.responses.response_batch import BATCH_FORMATS, BATCH_MEDIA_TYPES
from server.scene.bundle import Bundle
from server.scene.manifest_schema import manifest_schema
from tests.directional_flat import write_directional
from tests.killing import kill, threads_may_die

IR = "/v1/scenes/flat/impulse-response"
BATCH = "/v1/scenes/flat/impulse-responses"
POSE = {"listener": [1, 2, 1.5], "emitter": [6, 3, 1.5]}
DECODER = "/v1/hrtfs/kemar/decoder"
NOISES = "/v1/scenes/flat/ambisonic-noises"
PLACES = {"listener": "1,2,1.5", "emitter": "6,3,1.5"}
HEADINGS_DEG = count(1)


def wait_until_ready(client):
    for _ in range(3_600):  # the first time ever, everything is compiled
        if client.get("/readyz").status_code == 200:
            return
        time.sleep(0.05)
    raise AssertionError("never ready")


@contextmanager
def serving(levels, hrtfs):
    settings = Settings(ir_workers=1, max_waiting_requests=1)
    with TestClient(
        create_app(settings, scenes={"flat": levels}, hrtfs=hrtfs), raise_server_exceptions=False
    ) as client:
        wait_until_ready(client)
        yield client


@pytest.fixture
def client(field, hrtfs):
    with serving(FieldsByLevel([field]), hrtfs) as client:
        yield client


@pytest.fixture(scope="module")
def shared_client(bundle, hrtfs):
    """Of a server for tests that leave it as it was."""
    with serving(FieldsByLevel.load(bundle), hrtfs) as client:
        yield client


def check_problem(response, status, code, field=None):
    assert response.status_code == status
    assert response.headers["content-type"] == "application/problem+json"
    body = response.json()
    assert {name: body[name] for name in ("status", "code", "field")} == {
        "status": status,
        "code": code,
        "field": field,
    }
    assert body["title"]
    assert body["detail"]


def test_health(shared_client):
    assert shared_client.get("/livez").json() == {"status": "live"}
    assert shared_client.get("/readyz").json() == {"status": "ready"}


def test_ready_only_after_the_field_has_been_used(field, hrtfs):
    compute, may_go_on = field.impulse_responses, threading.Event()

    def held_up(*arguments, **options):
        may_go_on.wait(5)
        return compute(*arguments, **options)

    field.impulse_responses = held_up
    with TestClient(create_app(Settings(), scenes={"flat": FieldsByLevel([field])}, hrtfs=hrtfs)) as client:
        assert client.get("/livez").status_code == 200
        check_problem(client.get("/readyz"), 503, "not_ready")
        may_go_on.set()
        wait_until_ready(client)


def test_a_failing_warm_up_leaves_the_server_live_and_not_ready(field, hrtfs, caplog):
    def broken(*_, **__):
        raise RuntimeError("the field broke")

    field.impulse_responses = broken
    with TestClient(create_app(Settings(), scenes={"flat": FieldsByLevel([field])}, hrtfs=hrtfs)) as client:
        for _ in range(3_600):
            if "warm-up failed" in caplog.text:
                break
            time.sleep(0.05)
        assert client.get("/livez").status_code == 200
        check_problem(client.get("/readyz"), 503, "not_ready")


def test_scenes(shared_client):
    listed = shared_client.get("/v1/scenes").json()
    (scene,) = listed["scenes"]
    assert listed["max_emitters"] == Settings().max_emitters
    assert scene == shared_client.get("/v1/scenes/flat").json()
    assert (scene["id"], scene["sample_rate"], scene["height_m"]) == ("flat", 24_000, 2.8)
    assert scene["bounds"] == {"minimum": [0.3, 0.3, 0.5], "maximum": [7.7, 4.7, 2.3]}
    assert scene["listener"] == {"position": [2.0, 2.5, 1.5], "yaw": pytest.approx(np.pi / 2)}


def test_clips(shared_client):
    clips = shared_client.get("/v1/clips").json()["clips"]
    assert "woman-reading" in {clip["name"] for clip in clips}
    assert all(clip["duration_s"] > 0 and clip["title"] for clip in clips)


def test_heads_are_named_and_kemar_is_the_default(shared_client):
    assert shared_client.get("/v1/hrtfs").json() == {"default": "kemar", "hrtfs": ["kemar"]}


def test_a_clip_that_cannot_be_decoded_is_left_out_and_the_log_says_why(field, hrtfs, tmp_path, caplog):
    (tmp_path / "noise.flac").write_bytes(b"not audio")
    settings = Settings(clips=(tmp_path / "noise.flac",))
    with TestClient(create_app(settings, scenes={"flat": FieldsByLevel([field])}, hrtfs=hrtfs)) as client:
        names = {clip["name"] for clip in client.get("/v1/clips").json()["clips"]}
    assert "noise" not in names
    assert "noise.flac" in caplog.text


def test_an_impulse_response_is_what_the_command_line_would_write(shared_client, field):
    query = IrQuery((1.0, 2.0, 1.5), (6.0, 3.0, 1.5), 90.0)
    expected = ImpulseResponse.compute(field, query)
    for name, media_type in [("wav", "audio/wav"), ("npy", "application/octet-stream"), ("json", "application/json")]:
        response = shared_client.get(IR, params={**PLACES, "yaw_deg": 90, "format": name})
        assert response.headers["content-type"] == media_type
        assert response.content == expected.encode(name)
    samples, rate = soundfile.read(
        io.BytesIO(shared_client.get(IR, params={**PLACES, "yaw_deg": 90}).content), dtype="float32"
    )
    assert rate == 24_000
    np.testing.assert_array_equal(samples.T, expected.samples)


@pytest.fixture(scope="module")
def directional_client(tmp_path_factory):
    field = AcousticField.load(write_directional(tmp_path_factory.mktemp("directional") / "flat"))
    heads = HrtfLibrary((), [24_000])
    heads._filters[("small", 24_000)] = small_head()
    heads.names = ("kemar", "small")
    with TestClient(create_app(Settings(), scenes={"flat": FieldsByLevel([field])}, hrtfs=heads)) as client:
        wait_until_ready(client)
        client.field = field
        yield client


def small_head():
    head = Hrtf.read(KEMAR, 24_000)
    return HeadFilters.from_hrtf(dataclasses.replace(head, impulse_responses=0.5 * head.impulse_responses))


@pytest.mark.parametrize("name", ["wav", "npy", "json", "sofa"])
@pytest.mark.parametrize(
    "asked",
    [
        {"yaw_deg": 30.0, "pitch_deg": -20.0, "roll_deg": 10.0},
        {"orientation": "0.1,0.2,0.3,0.4"},
        {"output": "ambisonics"},
        {"output": "ambisonics", "order": 3, "pitch_deg": 90.0},
        {"output": "mono"},
        {"output": "binaural", "hrtf": "kemar"},
    ],
)
def test_every_output_is_what_the_query_computes(directional_client, asked, name):
    field = directional_client.field
    expected = ImpulseResponse.compute(field, IrQuery.of(field, *PLACES.values(), **asked))
    response = directional_client.get(IR, params={**PLACES, **asked, "format": name})
    assert response.status_code == 200
    assert response.content == expected.encode(name)
    assert response.headers["content-type"] == MEDIA_TYPES[name]
    again = directional_client.get(
        IR, params={**PLACES, **asked, "format": name}, headers={"If-None-Match": response.headers["etag"]}
    )
    assert again.status_code == 304


@pytest.mark.parametrize("name", BATCH_FORMATS)
def test_many_responses_are_the_single_ones(directional_client, name):
    poses = [
        {"listener": [1, 2, 1.5], "emitter": [6, 3, 1.5], "yaw_deg": 90},
        {"listener": [2, 2, 1.25], "emitter": [6, 3, 1.5], "orientation": [0, 0.1, 0, 1]},
    ]
    answer = directional_client.post(BATCH, json={"poses": poses, "output": "ambisonics", "format": name})
    assert answer.status_code == 200
    assert answer.headers["content-type"] == BATCH_MEDIA_TYPES[name]
    assert answer.headers["cache-control"] == "no-store"
    for number, pose in enumerate(poses):
        params = {key: ",".join(map(str, value)) if isinstance(value, list) else value for key, value in pose.items()}
        single = directional_client.get(IR, params={**params, "output": "ambisonics", "format": "npy"})
        samples = np.load(io.BytesIO(single.content))
        match name:
            case "npz":
                mine = np.load(io.BytesIO(answer.content))["responses"][number]
            case "zip":
                with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
                    file = io.BytesIO(archive.read(f"{number}.wav"))
                mine = soundfile.read(file, dtype="float32")[0].T
            case "sofa":
                with netCDF4.Dataset("batch", memory=answer.content) as file:
                    mine = np.asarray(file["Data.IR"][number])
        np.testing.assert_array_equal(mine, samples)


@pytest.mark.parametrize(
    ("options", "status", "code", "at_fault"),
    [
        (
            {"json": {"poses": [POSE, {**POSE, "listener": [99, 2, 1.5]}]}},
            404,
            "position_out_of_bounds",
            "poses[1].listener",
        ),
        ({"json": {"poses": [POSE], "level": "best"}}, 404, "unknown_level", "level"),
        ({"json": {"poses": [POSE], "hrtf": "mine"}}, 404, "unknown_hrtf", "hrtf"),
        ({"json": {"poses": [POSE] * 257}}, 422, "too_many_poses", "poses"),
        ({"json": {}}, 422, "malformed_request", "poses"),
        ({"content": b"{"}, 422, "malformed_request", None),
        ({"data": {"poses": "1"}}, 415, "unsupported_media_type", None),
    ],
)
def test_bad_batches_are_answered_with_a_problem(shared_client, options, status, code, at_fault):
    check_problem(shared_client.post(BATCH, **options), status, code, at_fault)


def test_a_batch_whose_first_response_fails_is_a_problem_and_later_ones_cut_the_answer(client, field):
    compute, calls = field.impulse_responses, count(1)

    def failing(*arguments, **options):
        if next(calls) in {1, 3}:
            raise FieldError("the field broke")
        return compute(*arguments, **options)

    field.impulse_responses = failing
    request = {"poses": [POSE, {**POSE, "yaw_deg": 10}]}
    check_problem(client.post(BATCH, json=request), 500, "no_response")
    answer = client.post(BATCH, json=request)
    with pytest.raises(zipfile.BadZipFile):
        np.load(io.BytesIO(answer.content))
    field.impulse_responses = compute
    assert np.load(io.BytesIO(client.post(BATCH, json=request).content))["responses"].shape[0] == 2


def test_a_bundle_can_be_read_back_file_by_file(shared_client, bundle, tmp_path):
    listed = shared_client.get("/v1/scenes/flat/bundle").json()
    assert (listed["scene"], listed["files"][0]["name"]) == ("flat", "scene.json")
    for each in listed["files"]:
        answer = shared_client.get(f"/v1/scenes/flat/bundle/{each['name']}", headers={"Accept-Encoding": "identity"})
        assert len(answer.content) == each["bytes"]
        assert hashlib.sha256(answer.content).hexdigest() == each["sha256"]
        (tmp_path / each["name"]).write_bytes(answer.content)
    assert Bundle.load(tmp_path).digest == bundle.digest


def test_what_is_sent_of_a_bundle_is_what_was_checked(bundle_copy, hrtfs):
    """Whoever changes a file later, or puts a link in its place, changes nothing of it."""
    loaded = Bundle.load(bundle_copy)
    secret = bundle_copy.parent / "secret"
    secret.write_text("a secret")
    with serving(FieldsByLevel.load(loaded), hrtfs) as client:
        for name in (*loaded.manifest.files, "scene.json"):
            (bundle_copy / name).unlink()
        (bundle_copy / "arrays.npz").write_bytes(b"others")
        (bundle_copy / "scene.json").symlink_to(secret)
        for each in client.get("/v1/scenes/flat/bundle").json()["files"]:
            answer = client.get(f"/v1/scenes/flat/bundle/{each['name']}")
            assert hashlib.sha256(answer.content).hexdigest() == each["sha256"]
            assert answer.headers["etag"].strip('"W/') in each["sha256"]


def test_a_file_of_a_bundle_is_sent_once_and_in_parts(shared_client, bundle):
    path = "/v1/scenes/flat/bundle/arithmetic.onnx"
    answer = shared_client.get(path)
    assert shared_client.get(path, headers={"If-None-Match": answer.headers["etag"]}).status_code == 304
    part = shared_client.get(path, headers={"Range": "bytes=5-9", "If-Range": answer.headers["etag"]})
    assert (part.status_code, part.content) == (206, bundle.models["arithmetic.onnx"][5:10])
    check_problem(shared_client.get(path, headers={"Range": "bytes=99999999-"}), 416, "range_not_satisfiable", "Range")
    for name in ("scene.jso", "..%2Fscene.json", "%2Fetc%2Fpasswd"):
        assert shared_client.get(f"/v1/scenes/flat/bundle/{name}").status_code == 404
    check_problem(shared_client.get("/v1/scenes/flat/bundle/a.onnx"), 404, "unknown_file", "file")


def test_the_sound_of_a_clip_is_sent_as_it_is_stored(shared_client):
    path = "/v1/clips/trumpet/audio"
    answer = shared_client.get(path)
    samples, rate = soundfile.read(io.BytesIO(answer.content))
    assert len(samples) / rate == pytest.approx(shared_client.get("/v1/clips/trumpet").json()["duration_s"], abs=0.01)
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert shared_client.get(path, headers={"If-None-Match": answer.headers["etag"]}).status_code == 304
    part = shared_client.get(path, headers={"Range": "bytes=5-9"})
    assert (part.status_code, part.content) == (206, answer.content[5:10])
    for name in ("kazoo", "upload-0f1e2d3c4b5a69788796a5b4c3d2e1f0", "..%2Fclips"):
        assert shared_client.get(f"/v1/clips/{name}/audio").status_code == 404


def test_bundles_are_kept_where_an_operator_says_so(field, hrtfs):
    settings = Settings(offer_bundles=False)
    with TestClient(create_app(settings, scenes={"flat": FieldsByLevel([field])}, hrtfs=hrtfs)) as client:
        for path in ("bundle", "bundle/scene.json"):
            check_problem(client.get(f"/v1/scenes/flat/{path}"), 403, "bundle_not_offered")
        check_problem(client.get("/v1/clips/trumpet/audio"), 403, "bundle_not_offered")


def test_the_schema_of_bundles_is_published(shared_client):
    answer = shared_client.get("/v1/schemas/bundle")
    assert answer.headers["content-type"] == "application/schema+json"
    assert answer.json() == manifest_schema()


@pytest.mark.parametrize("path", [path for path in answer_examples() if path.startswith("/")])
def test_examples_of_answers_have_what_answers_have(shared_client, path):
    """Of the same keys, at every depth: items of lists are compared by their first."""

    def keys(value):
        if isinstance(value, dict):
            return {name: keys(inside) for name, inside in value.items()}
        return [keys(value[0])] if isinstance(value, list | tuple) and value else None

    params = {"listener": PLACES["listener"], "emitter": PLACES["emitter"], "format": "json", "sample_rate": 24_000}
    operation = shared_client.get("/openapi.json").json()["paths"][path]["get"]
    wanted = {each["name"] for each in operation.get("parameters", ()) if each.get("in") == "query"}
    asked = path.replace("{scene}", "flat").replace("{hrtf}", "kemar").replace("{clip}", "trumpet")
    answer = shared_client.get(asked, params={name: text for name, text in params.items() if name in wanted}).json()
    example = operation["responses"]["200"]["content"]["application/json"]["example"]
    assert example == json.loads(json.dumps(answer_examples()[path]))
    assert set(example) == set(answer)
    if path not in {"/v1/scenes", "/v1/scenes/{scene}", "/v1/scenes/{scene}/frontier"}:  # a level has what it has
        assert keys(example) == keys(answer)


def test_every_number_of_a_query_is_taken_within_the_bounds_of_its_schema_and_nowhere_else(shared_client):
    tried = 0
    for path, operations in shared_client.get("/openapi.json").json()["paths"].items():
        for each in operations.get("get", {}).get("parameters", ()):
            schema = each["schema"]
            if schema.get("type") not in {"number", "integer"}:
                continue
            tried += 1
            for value, is_taken in (
                (schema["minimum"], True),
                (schema["maximum"], True),
                (schema["minimum"] - 1, False),
                (schema["maximum"] + 1, False),
                ("1e162", False),
            ):
                asked = path.replace("{scene}", "flat").replace("{hrtf}", "kemar")
                others = {**PLACES, "sample_rate": 24_000, "output": "ambisonics"}
                own = {other["name"] for other in operations["get"]["parameters"] if other["in"] == "query"}
                given = {name: text for name, text in others.items() if name in own and name != each["name"]}
                answer = shared_client.get(asked, params={**given, each["name"]: value})
                # A number that is taken may still ask for what there is not.
                assert (answer.status_code != 422) == is_taken, (path, each["name"], value, answer.text)
    assert tried >= 8


def test_every_number_of_a_body_has_bounds_in_its_schema(shared_client):
    def numbers(schema):
        if isinstance(schema, list):
            for inside in schema:
                yield from numbers(inside)
        if isinstance(schema, dict):
            if schema.get("type") in {"number", "integer"}:
                yield schema
            yield from numbers(list(schema.values()))

    schemas = shared_client.get("/openapi.json").json()["components"]["schemas"]
    found = [*numbers(schemas["ResponseBatch"]), *numbers(schemas["PosePair"])]
    assert len(found) >= 8
    assert all({"minimum", "maximum"} <= set(each) for each in found)
    assert schemas["ResponseBatch"]["properties"]["poses"]["maxItems"] == Settings().max_poses


def test_every_parameter_and_json_answer_has_an_example(shared_client):
    for path, operations in shared_client.get("/openapi.json").json()["paths"].items():
        for operation in operations.values():
            for each in operation.get("parameters", ()):
                assert "example" in each or "examples" in each["schema"], (path, each["name"])
            content = operation["responses"].get("200", {}).get("content", {})
            if path != "/v1/scenes/{scene}/bundle/{file}":
                assert "example" in content.get("application/json", {"example": ""}), path


def test_another_head_has_another_response_and_tag(directional_client):
    usual, small = (
        directional_client.get(IR, params={**PLACES, "hrtf": hrtf, "format": "npy"}) for hrtf in ("kemar", "small")
    )
    assert usual.headers["etag"] != small.headers["etag"]
    one, other = (np.load(io.BytesIO(answer.content)) for answer in (usual, small))
    np.testing.assert_allclose(np.sum(other**2), np.sum(one**2) / 4, rtol=0.01)


def test_every_parameter_has_its_tag(directional_client):
    asked = [
        {},
        {"pitch_deg": 1},
        {"roll_deg": 1},
        {"orientation": "0,0,1,1"},
        {"hrtf": "small"},
        {"output": "mono"},
        {"output": "ambisonics"},
        {"output": "ambisonics", "order": 2},
        {"format": "sofa"},
    ]
    tags = {directional_client.head(IR, params={**PLACES, **each}).headers["etag"] for each in asked}
    assert len(tags) == len(asked)


def test_what_a_client_has_is_not_sent_again(client, field):
    first = client.get(IR, params=PLACES)
    assert first.headers["cache-control"].startswith("public, max-age=")
    tag = first.headers["etag"]
    # A 304 costs no computation.
    field.impulse_responses = None
    for header in (tag, f"W/{tag}", f'"other", {tag}', "*"):
        again = client.get(IR, params=PLACES, headers={"If-None-Match": header})
        expected = header if header.startswith("W/") else tag
        assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", expected)
        assert again.headers["cache-control"] == first.headers["cache-control"]
    assert client.get(IR, params=PLACES, headers={"If-None-Match": '"other"'}).content == first.content


def test_other_spellings_of_the_same_query_have_the_same_tag_and_other_queries_another(shared_client):
    def tag(**changes):
        return shared_client.get(IR, params={**PLACES, **changes}).headers["etag"]

    assert tag() == tag(listener="1.0, 2.0,1.50", yaw_deg="0.0", format="wav")
    assert len({tag(), tag(yaw_deg=1), tag(format="npy"), tag(listener="1,2,1.6")}) == 4


@pytest.mark.parametrize("order", [1, 2, 3])
def test_the_decoder_of_a_head_is_that_of_the_server_in_every_format(shared_client, filters, order):
    decoder = HeadDecoder.of(filters, order)
    asked = {"order": order, "sample_rate": 24_000}
    as_json, as_npy, as_wav = (
        shared_client.get(DECODER, params={**asked, "format": name}) for name in ("json", "npy", "wav")
    )
    assert [each.headers["content-type"] for each in (as_json, as_npy, as_wav)] == [
        "application/json",
        "application/octet-stream",
        "audio/wav",
    ]
    told = as_json.json()
    np.testing.assert_array_equal(np.float32(told.pop("filters")), decoder.filters)
    assert told == {"hrtf": "kemar", "order": order, "sample_rate": 24_000, "delay_samples": decoder.delay}
    np.testing.assert_array_equal(np.load(io.BytesIO(as_npy.content)), decoder.filters)
    samples, rate = soundfile.read(io.BytesIO(as_wav.content), dtype="float32")
    assert rate == 24_000
    np.testing.assert_array_equal(samples.T.reshape(decoder.filters.shape), decoder.filters)


@pytest.mark.parametrize("rate", [44_100, 48_000, 96_000])
def test_decoders_have_every_rate_of_streams(shared_client, rate):
    told = shared_client.get(DECODER, params={"sample_rate": rate}).json()
    decoder = HeadDecoder.of(kemar(rate), 1)
    assert (told["sample_rate"], told["delay_samples"]) == (rate, decoder.delay)
    np.testing.assert_array_equal(np.float32(told["filters"]), decoder.filters)
    assert rate in shared_client.get("/v1/scenes/flat").json()["sample_rates"]


def test_the_decoder_is_of_first_order_and_json_unless_asked_otherwise(shared_client):
    usual = shared_client.get(DECODER, params={"sample_rate": 24_000})
    asked = shared_client.get(DECODER, params={"sample_rate": 24_000, "order": 1, "format": "json"})
    assert usual.content == asked.content
    assert np.shape(usual.json()["filters"])[:2] == (2, 4)


def test_each_decoder_has_its_tag_and_is_sent_once(directional_client):
    asked = [
        ("kemar", {}),
        ("kemar", {"order": 2}),
        ("kemar", {"format": "npy"}),
        ("small", {}),
    ]
    answers = [
        directional_client.get(f"/v1/hrtfs/{head}/decoder", params={"sample_rate": 24_000, **each})
        for head, each in asked
    ]
    tags = [answer.headers["etag"] for answer in answers]
    assert len(set(tags)) == len(tags)
    assert answers[0].headers["cache-control"].startswith("public, max-age=")
    again = directional_client.get(DECODER, params={"sample_rate": 24_000}, headers={"If-None-Match": tags[0]})
    assert (again.status_code, again.content) == (304, b"")
    kemar, small = (np.array(answers[number].json()["filters"]) for number in (0, 3))
    np.testing.assert_allclose(np.sum(small**2), np.sum(kemar**2) / 4, rtol=0.01)


def test_the_noises_are_those_of_ambisonic_responses(directional_client):
    codec = directional_client.field.bundle.manifest.codec
    answers = {order: directional_client.get(NOISES, params={"order": order}) for order in (1, 3)}
    for order, answer in answers.items():
        noises = np.load(io.BytesIO(answer.content))
        assert noises.dtype == np.dtype("<f4")
        wanted = even_noises(codec.sample_rate, codec.samples, (order + 1) ** 2)
        np.testing.assert_array_equal(noises, wanted.astype(np.float32))
    assert directional_client.get(NOISES).content == answers[1].content
    tag = {"If-None-Match": answers[1].headers["etag"]}
    again = directional_client.get(NOISES, headers=tag)
    assert (again.status_code, again.content) == (304, b"")
    assert directional_client.get(NOISES, params={"order": 3}, headers=tag).status_code == 200


@pytest.mark.parametrize(
    ("path", "params", "status", "code", "at_fault"),
    [
        ("/v1/scenes/moon", {}, 404, "unknown_scene", "scene"),
        ("/v1/scenes/moon/impulse-response", PLACES, 404, "unknown_scene", "scene"),
        ("/v1/scenes/moon/loudness", {"emitter": "6,3,1.5"}, 404, "unknown_scene", "scene"),
        (IR, {"listener": "1,2,1.5"}, 422, "malformed_pose", "emitter"),
        (IR, {**PLACES, "listener": "1,2"}, 422, "malformed_pose", "listener"),
        (IR, {**PLACES, "listener": "1,2,three"}, 422, "malformed_pose", "listener"),
        (IR, {**PLACES, "emitter": "nan,2,1"}, 422, "malformed_pose", "emitter"),
        (IR, {**PLACES, "emitter": "1,2,inf"}, 422, "malformed_pose", "emitter"),
        (IR, {**PLACES, "yaw_deg": "nan"}, 422, "malformed_pose", "yaw_deg"),
        (IR, {**PLACES, "listener": "0_1,2,1.5"}, 422, "malformed_pose", "listener"),
        (IR, {**PLACES, "listener": "١,2,1.5"}, 422, "malformed_pose", "listener"),
        (IR, {**PLACES, "yaw_deg": "1_0"}, 422, "malformed_pose", "yaw_deg"),
        (IR, {**PLACES, "yaw_deg": "٩"}, 422, "malformed_pose", "yaw_deg"),
        (IR, {**PLACES, "pitch_deg": "up"}, 422, "malformed_pose", "pitch_deg"),
        (IR, {**PLACES, "roll_deg": "1e9"}, 422, "malformed_pose", "roll_deg"),
        (IR, {**PLACES, "orientation": "0,0,0,0"}, 422, "malformed_pose", "orientation"),
        (IR, {**PLACES, "orientation": "1e260,0,0,0"}, 422, "malformed_pose", "orientation"),
        (IR, {**PLACES, "orientation": "0,0,1"}, 422, "malformed_pose", "orientation"),
        (IR, {**PLACES, "orientation": "0,0,inf,1"}, 422, "malformed_pose", "orientation"),
        (IR, {**PLACES, "orientation": "0,0,1,1", "yaw_deg": 0}, 409, "contradicting_parameters", "orientation"),
        (IR, {**PLACES, "hrtf": "moomin"}, 404, "unknown_hrtf", "hrtf"),
        (IR, {**PLACES, "hrtf": "kemar", "output": "mono"}, 409, "contradicting_parameters", "hrtf"),
        (IR, {**PLACES, "output": "stereo"}, 422, "unknown_output", "output"),
        (IR, {**PLACES, "output": "ambisonics"}, 409, "no_directions", "output"),
        (IR, {**PLACES, "order": 1}, 409, "contradicting_parameters", "order"),
        (IR, {**PLACES, "output": "ambisonics", "order": 4}, 422, "malformed_request", "order"),
        (IR, {**PLACES, "output": "ambisonics", "order": "first"}, 422, "malformed_request", "order"),
        (IR, {**PLACES, "output": "ambisonics", "order": "1.5"}, 422, "malformed_request", "order"),
        (IR, {**PLACES, "level": "finest"}, 404, "unknown_level", "level"),
        ("/v1/scenes/flat/plan", {"effect": ["hrtf=on", "hrtf=off"]}, 409, "doubled_effect", "effect"),
        (IR, {**PLACES, "yaw_deg": "north"}, 422, "malformed_pose", "yaw_deg"),
        (IR, {**PLACES, "listener": "1,2,99"}, 404, "position_out_of_bounds", "listener"),
        (IR, {**PLACES, "emitter": "-1,2,1"}, 404, "position_out_of_bounds", "emitter"),
        (IR, {**PLACES, "format": "mp3"}, 422, "unknown_format", "format"),
        ("/v1/scenes/flat/loudness", {"emitter": "6,3"}, 422, "malformed_pose", "emitter"),
        ("/v1/scenes/flat/loudness", {"emitter": "6,3,9"}, 404, "position_out_of_bounds", "emitter"),
        ("/v1/scenes/flat/loudness", {"emitter": "6,3,1.5", "height_m": 9}, 404, "position_out_of_bounds", "height_m"),
        ("/v1/scenes/flat/loudness", {"emitter": "6,3,1.5", "spacing_m": 0.01}, 422, "malformed_request", "spacing_m"),
        ("/v1/scenes/flat/loudness", {"emitter": "6,3,1.5", "spacing_m": 0.1}, 409, "map_too_fine", "spacing_m"),
        ("/v1/scenes/flat/loudness", {"emitter": "6,3,1.5", "format": "gif"}, 422, "unknown_format", "format"),
        ("/v1/hrtfs/moomin/decoder", {"sample_rate": 24_000}, 404, "unknown_hrtf", "hrtf"),
        (DECODER, {"sample_rate": 32_000}, 404, "unsupported_sample_rate", "sample_rate"),
        (DECODER, {}, 422, "malformed_request", "sample_rate"),
        (DECODER, {"sample_rate": "fast"}, 422, "malformed_request", "sample_rate"),
        (DECODER, {"sample_rate": 24_000, "order": 0}, 422, "malformed_request", "order"),
        (DECODER, {"sample_rate": 24_000, "order": 4}, 422, "malformed_request", "order"),
        (DECODER, {"sample_rate": 24_000, "order": "first"}, 422, "malformed_request", "order"),
        (DECODER, {"sample_rate": 24_000, "format": "sofa"}, 422, "unknown_format", "format"),
        (DECODER, {"sample_rate": 24_000, "taps": 8}, 422, "unknown_parameter", "taps"),
        (NOISES, {}, 409, "no_directions", "output"),
        (NOISES, {"order": 4}, 422, "malformed_request", "order"),
        (NOISES, {"level": "finest"}, 404, "unknown_level", "level"),
        ("/v1/nothing", {}, 404, "not_found", None),
        ("/nothing", {}, 404, "not_found", None),
    ],
)
def test_bad_requests_are_answered_with_a_problem(shared_client, path, params, status, code, at_fault):
    check_problem(shared_client.get(path, params=params), status, code, at_fault)
    # And the server goes on, with a response that it has not kept.
    assert shared_client.get(IR, params={**PLACES, "yaw_deg": next(HEADINGS_DEG)}).status_code == 200


def test_a_wrong_method_is_a_problem_too(shared_client):
    response = shared_client.post("/v1/scenes")
    check_problem(response, 405, "method_not_allowed")
    assert "GET" in response.headers["allow"]


def test_a_crash_is_a_problem_that_tells_nothing_of_the_inside(client, field):
    def broken(*_, **__):
        raise RuntimeError("secret")

    field.impulse_responses = broken
    response = client.get(IR, params=PLACES)
    check_problem(response, 500, "internal_error")
    assert "secret" not in response.text


def test_the_loudness_map_is_a_picture_or_numbers_and_loudest_at_the_emitter(shared_client):
    params = {"emitter": "6,3,1.5", "spacing_m": 0.5}
    picture = shared_client.get("/v1/scenes/flat/loudness", params=params)
    assert picture.headers["content-type"] == "image/png"
    assert Image.open(io.BytesIO(picture.content)).format == "PNG"
    numbers = shared_client.get("/v1/scenes/flat/loudness", params={**params, "format": "json"})
    assert numbers.headers["etag"] != picture.headers["etag"]
    levels = np.array(json.loads(numbers.content)["levels_db"], float)
    row, column = np.unravel_index(np.nanargmax(levels), levels.shape)
    x, y = json.loads(numbers.content)["origin"]
    assert abs(x + column * 0.5 - 6) <= 0.5
    assert abs(y + row * 0.5 - 3) <= 0.5


def test_too_many_waiting_requests_are_turned_away_and_health_is_answered_meanwhile(client, field):
    compute, may_go_on = field.impulse_responses, threading.Event()

    def held_up(*arguments, **options):
        may_go_on.wait(10)
        return compute(*arguments, **options)

    field.impulse_responses = held_up
    statuses = []

    def ask(height):
        statuses.append(client.get(IR, params={**PLACES, "listener": f"1,2,{height}"}).status_code)

    # Two are computed at once and one may wait; the rest is turned away.
    askers = [threading.Thread(target=ask, args=(1 + number / 10,)) for number in range(6)]
    for asker in askers:
        asker.start()
    try:
        for _ in range(500):
            if len(statuses) == 3:
                break
            time.sleep(0.02)
        assert statuses == [503] * 3
        assert client.get("/livez").status_code == 200
    finally:
        may_go_on.set()
        for asker in askers:
            asker.join()
    assert sorted(statuses) == [200] * 3 + [503] * 3


def test_the_interface_describes_itself(shared_client):
    document = shared_client.get("/openapi.json").json()
    assert document == json.loads(json.dumps(shared_client.app.openapi()))
    assert IR.replace("flat", "{scene}") in document["paths"]


def test_behind_a_proxy_that_serves_it_below_a_path_the_interface_says_so(shared_client, monkeypatch):
    at_the_root = shared_client.get("/openapi.json").json()
    monkeypatch.setattr(shared_client._transport, "root_path", "/sound")
    assert shared_client.get("/sound/openapi.json").json() == at_the_root | {"servers": [{"url": "/sound"}]}


def test_the_interface_is_written_once(shared_client, monkeypatch):
    first = shared_client.get("/openapi.json").content
    monkeypatch.setattr("server.api.openapi.json.dumps", lambda *_, **__: pytest.fail("written again"))
    assert shared_client.get("/openapi.json").content == first


@pytest.mark.parametrize("path", ["/livez", "/readyz"])
def test_load_balancers_may_probe_with_head(shared_client, path):
    assert shared_client.head(path).status_code == 200


def wait_for_status(client, path, status):
    """The answer, and how many seconds it took until the status was that."""
    began_s = time.monotonic()
    while (answer := client.get(path)).status_code != status:
        assert time.monotonic() - began_s < 10
        time.sleep(0.02)
    return answer, time.monotonic() - began_s


def metric(client, name):
    return float(re.search(rf"^{re.escape(name)} (.*)$", client.get("/metrics").text, re.MULTILINE)[1])


@threads_may_die
@pytest.mark.parametrize("group", ["audio", "ir"])
def test_a_thread_that_dies_is_replaced_within_two_seconds_and_counted(client, group):
    host = client.app_state["host"]
    threads = (lambda: host.audio.threads) if group == "audio" else (lambda: host.readiness.watch._groups[1].threads)
    dead = threads()[0]
    restarts = f'nafir_thread_restarts_total{{thread="{dead.name}"}}'
    assert metric(client, restarts) == 0
    kill(dead._thread)
    if group == "audio":
        dead._wake.set()
    began_s = time.monotonic()
    while metric(client, restarts) == 0:
        if group == "ir":  # a waiting worker dies with the next work, which is not lost
            host.audio._workers.submit(int, kind="plan").result(timeout=5)
        assert time.monotonic() - began_s < 2
    assert dead not in threads()
    assert metric(client, f'nafir_thread_healthy{{thread="{dead.name}"}}') == 1
    assert client.get("/readyz").status_code == 200


def test_a_thread_that_is_stuck_leaves_readiness_within_two_seconds_until_it_goes_on(client):
    stuck, release = client.app_state["host"].audio.threads[0], threading.Event()
    tick = stuck.tick
    stuck.tick = lambda: release.wait(20) and tick()
    stuck._wake.set()
    answer, waited_s = wait_for_status(client, "/readyz", 503)
    assert waited_s < 2
    check_problem(answer, 503, "not_ready")
    assert stuck.name in answer.json()["detail"]
    assert int(answer.headers["retry-after"]) >= 1
    assert metric(client, "nafir_ready") == 0
    assert metric(client, f'nafir_thread_healthy{{thread="{stuck.name}"}}') == 0
    with client.websocket_connect("/v1/stream") as stream:
        assert json.loads(stream.receive_text())["code"] == "not_ready"
    release.set()
    wait_for_status(client, "/readyz", 200)


def test_a_failed_warm_up_is_told_apart_from_one_under_way(field, hrtfs, caplog):
    def broken(*_, **__):
        raise RuntimeError("the field broke")

    field.impulse_responses = broken
    with TestClient(create_app(Settings(), scenes={"flat": FieldsByLevel([field])}, hrtfs=hrtfs)) as client:
        began_s = time.monotonic()
        while "has failed" not in (detail := client.get("/readyz").json()["detail"]):
            assert "still warming up" in detail
            assert time.monotonic() - began_s < 180
            time.sleep(0.05)
    assert "the field broke" in caplog.text


def test_effects_whose_cost_cannot_be_measured_leave_the_server_ready_and_the_log_says_why(
    field, hrtfs, caplog, monkeypatch
):
    def broken(*_, **__):
        raise RuntimeError("no clock")

    monkeypatch.setattr(app, "measure_costs", broken)
    monkeypatch.setattr(app, "_COSTS_AFTER_S", 0.0)
    with TestClient(create_app(Settings(), scenes={"flat": FieldsByLevel([field])}, hrtfs=hrtfs)) as client:
        wait_until_ready(client)
        began_s = time.monotonic()
        while "no clock" not in caplog.text:
            assert time.monotonic() - began_s < 10
            time.sleep(0.02)
        assert client.get("/readyz").status_code == 200


def test_answers_are_timed_by_route_and_lookups_of_the_cache_are_counted(shared_client):
    labels = '{method="GET",route="/v1/scenes/{scene}/impulse-response",status="2xx"}'
    timed = f"nafir_http_request_duration_seconds_count{labels}"
    looked_up = 'nafir_response_cache_lookups_total{result="%s"}'
    query = {"listener": "2.03,2.01,1.5", "emitter": "6.07,3.02,1.5"}
    assert shared_client.get("/v1/scenes/flat/impulse-response", params=query).status_code == 200
    before = [metric(shared_client, name) for name in (timed, looked_up % "miss", looked_up % "hit")]
    for _ in range(2):
        assert shared_client.get("/v1/scenes/flat/impulse-response", params=query | {"yaw_deg": "7.25"}).is_success
    after = [metric(shared_client, name) for name in (timed, looked_up % "miss", looked_up % "hit")]
    assert [now - then for now, then in zip(after, before, strict=True)] == [2, 1, 1]


LISTS = (
    "/v1/scenes",
    "/v1/scenes/flat",
    "/v1/scenes/flat/frontier",
    "/v1/scenes/flat/section",
    "/v1/scenes/flat/bundle",
    "/v1/clips",
    "/v1/clips/woman-reading",
    "/v1/hrtfs",
    "/v1/encodings",
    "/v1/schemas/bundle",
    "/asyncapi.json",
)


@pytest.mark.parametrize("path", LISTS)
def test_a_list_that_a_client_has_is_not_sent_again(shared_client, path):
    first = shared_client.get(path)
    tag, cache = first.headers["etag"], first.headers["cache-control"]
    assert first.status_code == 200
    assert shared_client.head(path).headers["etag"] == tag
    for known in (tag, f"W/{tag.removeprefix('W/')}", f'"other", {tag}', "*"):
        again = shared_client.get(path, headers={"If-None-Match": known})
        assert (again.status_code, again.content) == (304, b"")
        assert again.headers["etag"].removeprefix("W/") == tag.removeprefix("W/")
        assert again.headers["cache-control"] == cache
    other = shared_client.get(path, headers={"If-None-Match": '"other"'})
    assert (other.status_code, other.content) == (200, first.content)


def test_tags_of_lists_are_those_of_their_content(shared_client):
    plain = {"Accept-Encoding": "identity"}
    answers = [shared_client.get(path, headers=plain) for path in LISTS]
    assert len({answer.headers["etag"] for answer in answers}) == len(LISTS)
    low, high = (
        shared_client.get("/v1/scenes/flat/section", params={"height_m": height_m}, headers=plain)
        for height_m in (0.5, 90.0)
    )
    assert (low.headers["etag"] == high.headers["etag"]) == (low.content == high.content)
    assert low.content != high.content
    assert "etag" not in shared_client.get("/v1/scenes/moon", headers=plain).headers
    assert "etag" not in shared_client.get("/livez").headers


def test_every_answer_to_get_may_be_told_by_its_tag(shared_client):
    for path, operations in shared_client.get("/openapi.json").json()["paths"].items():
        for method, operation in operations.items():
            is_tagged = method == "get" and path not in {"/livez", "/readyz"}
            assert ("304" in operation["responses"]) == is_tagged, path
            assert ("ETag" in operation["responses"].get("200", {}).get("headers", {})) == is_tagged, path
