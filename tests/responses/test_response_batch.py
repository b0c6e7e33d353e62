"""Many responses in one file are the single ones, and what is wrong with a request is told with its place."""

import io
import json
import tracemalloc
import zipfile

import numpy as np
import pytest
import sofar
import soundfile
from numpy.testing import assert_allclose, assert_array_equal

from server.core.errors import RequestError
from server.field.field import AcousticField
from server.responses.impulse_response import ImpulseResponse, IrQuery
from server.responses.response_batch import BATCH_EXAMPLE, BATCH_FORMATS, MOST_BYTES, ResponseBatch
from tests.directional_flat import write_directional

POSES = (
    {"listener": [1, 2, 1.5], "emitter": [6, 3, 1.5]},
    {"listener": [2, 2.5, 1.25], "emitter": [6, 3, 1.5], "yaw_deg": 90, "roll_deg": -5},
    {"listener": [1, 2, 1.5], "emitter": [5, 3, 1.75], "orientation": [0, 0.1, 0, 1]},
)
OUTPUTS = ({}, {"output": "mono"}, {"output": "ambisonics", "order": 2})


def parsed(**request):
    return ResponseBatch.parse(json.dumps(request).encode())


def texts(pose):
    """The same pose as a single query has it."""
    return {
        name: ",".join(map(str, value)) if isinstance(value, list) else float(value) for name, value in pose.items()
    }


def single(field, pose, **common):
    return ImpulseResponse.compute(field, IrQuery.of(field, **texts(pose), **common))


def written(field, batch):
    queries = batch.queries(field)
    writer = batch.writer(queries)
    return b"".join([*(writer.add(ImpulseResponse.compute(field, query)) for query in queries), writer.end()])


@pytest.fixture(scope="module")
def directional(tmp_path_factory):
    return AcousticField.load(write_directional(tmp_path_factory.mktemp("scenes") / "flat"))


@pytest.mark.parametrize("common", OUTPUTS, ids=str)
def test_arrays_hold_the_single_responses(directional, common):
    content = written(directional, parsed(poses=POSES, **common))
    arrays = np.load(io.BytesIO(content), allow_pickle=False)
    expected = [single(directional, pose, **common) for pose in POSES]
    assert arrays["responses"].dtype == np.float32
    assert_array_equal(arrays["responses"], [each.samples for each in expected])
    assert arrays["channels"].tolist() == list(expected[0].channels)
    assert (arrays["sample_rate"], arrays["scene"], arrays["level"]) == (24_000, "flat", directional.level.name)
    for name in ("listener", "emitter"):
        assert_array_equal(arrays[f"{name}s"], [pose[name] for pose in POSES])
    assert_allclose(np.linalg.norm(arrays["orientations"], axis=-1), 1.0)
    assert_allclose(arrays["orientations"][0], (0, 0, 0, 1))


def test_wav_files_hold_the_single_responses(directional):
    archive = zipfile.ZipFile(io.BytesIO(written(directional, parsed(poses=POSES, format="zip"))))
    assert archive.testzip() is None
    told = json.loads(archive.read("poses.json"))
    assert [each["file"] for each in told["poses"]] == ["0.wav", "1.wav", "2.wav"]
    for each, pose in zip(told["poses"], POSES, strict=True):
        assert archive.read(each["file"]) == single(directional, pose).encode("wav")
        samples, rate = soundfile.read(io.BytesIO(archive.read(each["file"])), dtype="float32")
        assert rate == told["sample_rate"]
        assert_array_equal(samples.T, single(directional, pose).samples)
        assert each["listener"] == pose["listener"]


@pytest.mark.parametrize("common", OUTPUTS, ids=str)
def test_one_sofa_file_holds_the_single_responses_and_their_places(directional, tmp_path, common):
    path = tmp_path / "batch.sofa"
    path.write_bytes(written(directional, parsed(poses=POSES, format="sofa", **common)))
    content = sofar.read_sofa(str(path), verbose=False)
    content.verify()
    assert content.GLOBAL_SOFAConventions == "SingleRoomSRIR"
    assert_array_equal(content.Data_IR, [single(directional, pose, **common).samples for pose in POSES])
    assert_array_equal(content.ListenerPosition, [pose["listener"] for pose in POSES])
    assert_array_equal(content.SourcePosition, [pose["emitter"] for pose in POSES])
    assert_allclose(content.ListenerView[1], (0.0, 1.0, 0.0), atol=1e-12)


def test_a_sofa_file_of_one_pose_is_that_of_a_single_response(field):
    assert written(field, parsed(poses=POSES[1:2], format="sofa")) == single(field, POSES[1]).encode("sofa")


@pytest.mark.parametrize("name", BATCH_FORMATS)
def test_the_same_request_is_the_same_bytes(field, name):
    first, second = (written(field, parsed(poses=POSES, format=name)) for _ in range(2))
    assert first == second


@pytest.mark.parametrize("name", BATCH_FORMATS)
def test_a_long_answer_is_never_held_whole(field, name):
    batch = parsed(poses=POSES[:1] * 400, format=name)
    queries = batch.queries(field)
    response = ImpulseResponse.compute(field, queries[0])
    batch.writer(queries[:1]).add(response)  # what is imported for it
    tracemalloc.start()
    try:
        writer = batch.writer(queries)
        length = sum(len(writer.add(response)) for _ in queries) + len(writer.end())
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert length > 400 * response.samples.nbytes
    assert peak < length / 10


@pytest.mark.parametrize(
    ("request_", "code", "at_fault"),
    [
        ({}, "malformed_request", "poses"),
        ({"poses": []}, "malformed_request", "poses"),
        ({"poses": POSES, "pose": 1}, "malformed_request", "pose"),
        ({"poses": POSES, "format": "mp3"}, "unknown_format", "format"),
        ({"poses": POSES, "output": "stereo"}, "unknown_output", "output"),
        ({"poses": POSES, "output": "ambisonics", "order": 4}, "malformed_request", "order"),
        ({"poses": POSES, "output": "ambisonics"}, "no_directions", "output"),
        ({"poses": POSES, "order": 1}, "contradicting_parameters", "order"),
        ({"poses": POSES, "output": "mono", "hrtf": "kemar"}, "contradicting_parameters", "hrtf"),
        ({"poses": [*POSES, {"listener": [1, 2, 1.5]}]}, "malformed_pose", "poses[3].emitter"),
        ({"poses": [POSES[0], POSES[1] | {"listener": [1, 2]}]}, "malformed_pose", "poses[1].listener[2]"),
        ({"poses": [POSES[0], POSES[1] | {"listener": "1,2,1.5"}]}, "malformed_pose", "poses[1].listener"),
        ({"poses": [POSES[0], POSES[1] | {"emitter": [1, 2, "x"]}]}, "malformed_pose", "poses[1].emitter[2]"),
        ({"poses": [POSES[0], POSES[1] | {"yaw": 1}]}, "malformed_request", "poses[1].yaw"),
        ({"poses": [POSES[0] | {"emitter": [1e162, 2, 1.5]}]}, "malformed_pose", "poses[0].emitter[0]"),
        ({"poses": [POSES[0] | {"listener": [10**400, 2, 1.5]}]}, "malformed_pose", "poses[0].listener[0]"),
        ({"poses": [POSES[0] | {"yaw_deg": 36_001}]}, "malformed_pose", "poses[0].yaw_deg"),
        ({"poses": [POSES[0] | {"orientation": [0, 0, 0, 0]}]}, "malformed_pose", "poses[0].orientation"),
        (
            {"poses": [POSES[2], POSES[2] | {"pitch_deg": 1}]},
            "contradicting_parameters",
            "poses[1].orientation",
        ),
        ({"poses": [*POSES, POSES[0] | {"emitter": [99, 0, 0]}]}, "position_out_of_bounds", "poses[3].emitter"),
    ],
)
def test_what_is_wrong_is_told_with_its_place(field, request_, code, at_fault):
    with pytest.raises(RequestError) as refused:
        parsed(**request_).queries(field)
    assert (refused.value.code, refused.value.field) == (code, at_fault)
    assert at_fault.partition(".")[0] in str(refused.value)


@pytest.mark.parametrize("text", [b"", b"{", b"\xff", b"[]", b"null", b'{"poses": [{"listener": [1e999, 0, 0]}]}'])
def test_what_is_no_request_is_refused(text):
    with pytest.raises(RequestError, match=r"malformed|body|poses") as refused:
        ResponseBatch.parse(text)
    assert refused.value.code in {"malformed_request", "malformed_pose"}


def test_a_key_given_twice_is_refused():
    text = json.dumps({"poses": POSES, "level": "a"}).replace('"level"', '"level": "b", "level"')
    with pytest.raises(RequestError, match="level is there twice"):
        ResponseBatch.parse(text.encode())


def test_number_and_length_are_bounded(directional):
    with pytest.raises(RequestError, match="3 are more than 2") as refused:
        ResponseBatch.parse(json.dumps({"poses": POSES}).encode(), most=2)
    assert refused.value.code == "too_many_poses"
    most = MOST_BYTES // (16 * directional.ir_samples * 8)
    asked = {"output": "ambisonics", "order": 3, "format": "sofa"}
    batch = parsed(poses=POSES[:1], **asked)
    with pytest.raises(RequestError, match=f"which {most} poses fit") as refused:
        batch.model_copy(update={"poses": batch.poses * (most + 1)}).queries(directional)
    assert refused.value.code == "answer_too_long"


def test_the_example_is_one(field):
    assert len(parsed(**BATCH_EXAMPLE).queries(field)) == 2
