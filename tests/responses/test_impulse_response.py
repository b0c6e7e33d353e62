import io
import json
import math
import re
import time

import netCDF4
import numpy as np
import pytest
import scipy.io.wavfile
import soundfile
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from server.acoustics.geometry import Pose, Quaternion
from server.core.errors import RequestError
from server.field.field import AcousticField
from server.rendering.hrtf import KEMAR, HeadFilters, Hrtf, kemar
from server.responses.ambisonic_response import AmbisonicResponse
from server.responses.binaural import Binauralization
from server.responses.full_response import FullResponse
from server.responses.impulse_response import (
    IR_FORMATS,
    IR_OUTPUTS,
    ORIENTATION_PATTERN,
    POSITION_PATTERN,
    ImpulseResponse,
    IrQuery,
    parse_format,
    parse_orientation,
    parse_position,
)
from tests.directional_flat import write_directional

PLACES = ("1,2,1.5", "6,3,1.5")
QUERY = IrQuery((1.0, 2.0, 1.5), (6.0, 3.0, 1.5), 90.0)


def read(name, data):
    match name:
        case "wav":
            samples, rate = soundfile.read(io.BytesIO(data), dtype="float32", always_2d=True)
            assert rate == 24_000
            return samples.T
        case "npy":
            return np.load(io.BytesIO(data))
        case "json":
            return np.array(json.loads(data)["samples"], np.float32)
        case "sofa":
            with netCDF4.Dataset("ir.sofa", memory=data) as file:
                assert file["Data.SamplingRate"][:] == [24_000]
                return file["Data.IR"][0].filled().astype(np.float32)


@pytest.mark.parametrize("name", IR_FORMATS)
def test_every_format_carries_the_same_samples_exactly(field, name):
    response = ImpulseResponse.compute(field, QUERY)
    assert response.samples.shape == (2, field.ir_samples)
    assert_array_equal(read(name, response.encode(name)), response.samples)


@pytest.mark.parametrize("channels", [("left", "right"), ("centre",)])
def test_a_wav_file_is_scipys_to_the_byte(channels):
    samples = np.random.default_rng(0).standard_normal((len(channels), 1_001)).astype(np.float32)
    expected = io.BytesIO()
    scipy.io.wavfile.write(expected, 44_100, samples.T)
    assert ImpulseResponse("flat", "full", QUERY, 44_100, channels, samples).encode("wav") == expected.getvalue()


@pytest.mark.parametrize("name", IR_FORMATS)
def test_the_same_ir_is_the_same_bytes_at_another_time(field, name, monkeypatch):
    first = ImpulseResponse.compute(field, QUERY).encode(name)
    monkeypatch.setattr(time, "time", lambda: 4e9)
    assert ImpulseResponse.compute(field, QUERY).encode(name) == first


def test_degrees_become_radians_counter_clockwise(field):
    # Looking north along +y at 90 degrees, an emitter to the west is on the left.
    energy = np.sum(
        ImpulseResponse.compute(field, IrQuery((4.0, 2.0, 1.5), (1.0, 2.0, 1.5), 90.0)).samples ** 2, axis=1
    )
    assert energy[0] > 2 * energy[1]


def test_json_says_what_it_is(field):
    document = json.loads(ImpulseResponse.compute(field, QUERY).encode("json"))
    assert {name: document[name] for name in ("scene", "sample_rate", "channels", "listener", "yaw_deg")} == {
        "scene": "flat",
        "sample_rate": 24_000,
        "channels": ["left", "right"],
        "listener": [1.0, 2.0, 1.5],
        "yaw_deg": 90.0,
    }


def test_tags_tell_queries_and_formats_apart(field):
    queries = [QUERY, IrQuery(QUERY.emitter, QUERY.listener, 90.0), IrQuery(QUERY.listener, QUERY.emitter, 90.001)]
    tags = {query.etag(field, name) for query in queries for name in IR_FORMATS}
    assert len(tags) == len(queries) * len(IR_FORMATS)
    assert QUERY.etag(field, "wav") == QUERY.etag(field, "wav")


def test_positions_are_three_finite_numbers():
    assert parse_position(" 1, -2.5,3e-1", "listener") == (1.0, -2.5, 0.3)
    for text in ("", "1,2", "1,2,3,4", "a,b,c", "1,2,nan", "inf,0,0", "1;2;3"):
        with pytest.raises(RequestError) as refusal:
            parse_position(text, "listener")
        assert (refusal.value.code, refusal.value.field) == ("malformed_pose", "listener")


def test_unknown_formats_are_refused():
    assert parse_format("npy") == "npy"
    with pytest.raises(RequestError) as refusal:
        parse_format("mp3")
    assert refusal.value.code == "unknown_format"


@pytest.mark.parametrize("query", [IrQuery((9.0, 2.0, 1.5), QUERY.emitter), IrQuery(QUERY.listener, (1.0, 2.0, -1.0))])
def test_places_outside_the_scene_are_refused(field, query):
    with pytest.raises(RequestError) as refusal:
        ImpulseResponse.compute(field, query)
    assert refusal.value.code == "position_out_of_bounds"


@pytest.fixture(scope="module")
def directional(tmp_path_factory):
    return AcousticField.load(write_directional(tmp_path_factory.mktemp("scenes") / "flat"))


@pytest.fixture(scope="module")
def other_head():
    """KEMAR with its ears exchanged by a mirror."""
    head = Hrtf.read(KEMAR, 24_000)
    mirrored = Hrtf(head.directions * [1, -1, 1], head.impulse_responses[:, ::-1] * 0.5, 24_000, head.lead_samples)
    return HeadFilters.from_hrtf(mirrored)


def refused(field, *places, **asked):
    with pytest.raises(RequestError) as refusal:
        IrQuery.of(field, *(places or PLACES), **asked)
    return refusal.value.code, refusal.value.field


def samples(field, filters=None, **asked):
    return ImpulseResponse.compute(field, IrQuery.of(field, *PLACES, **asked), filters).samples


def test_a_head_may_be_turned_by_angles_or_by_a_quaternion(directional):
    turned = Quaternion.from_angles(*np.radians((40.0, 30.0, -20.0)))
    by_angles = samples(directional, yaw_deg=40.0, pitch_deg=30.0, roll_deg=-20.0)
    poses = [QUERY.listener], [QUERY.emitter], [turned]
    expected = FullResponse.through_kemar(directional).impulse_responses(*poses)[0]
    assert_array_equal(by_angles, expected)
    scaled = ",".join(str(3 * component) for component in turned)
    assert_allclose(samples(directional, orientation=scaled), expected, atol=1e-6)
    assert not np.array_equal(samples(directional, yaw_deg=40.0), expected)


def test_pitch_and_roll_turn_the_direct_sound_of_a_field_that_knows_one_head(mirrored_field):
    level, rolled = (samples(mirrored_field, yaw_deg=90.0, roll_deg=roll) for roll in (0.0, 180.0))
    late = slice(2_000, None)  # after the last of the first reflections
    assert_array_equal(level[:, late], rolled[:, late])
    assert not np.allclose(level, rolled, atol=1e-3)


def test_another_head_hears_other_things(directional, other_head):
    through = samples(directional, other_head, hrtf="other")
    poses = [QUERY.listener], [QUERY.emitter], [0.0]
    assert_array_equal(through, FullResponse(directional, other_head).impulse_responses(*poses)[0])
    assert np.sum(through**2) < 0.5 * np.sum(samples(directional) ** 2)


def test_ambisonics_have_the_first_order_unless_another_is_asked_for(directional):
    first, third = (samples(directional, output="ambisonics", order=order, yaw_deg=30.0) for order in (None, 3))
    assert (len(first), len(third)) == (4, 16)
    assert_allclose(first, third[:4], atol=1e-6)
    poses = [QUERY.listener], [QUERY.emitter], [np.radians(30.0)]
    assert_array_equal(third, AmbisonicResponse(directional).impulse_responses(*poses, 3)[0])


def test_a_measurement_of_one_microphone_is_heard_through_a_head_when_asked_for(measured_bundle):
    field = AcousticField.load(measured_bundle)
    places = ("0,0.4,0", "1.5,0.4,0")
    raw = ImpulseResponse.compute(field, IrQuery.of(field, *places))
    assert raw.channels == ("mono",)
    heard = ImpulseResponse.compute(field, IrQuery.of(field, *places, output="binaural", yaw_deg=90.0, hrtf="kemar"))
    assert heard.channels == ("left", "right")
    through = Binauralization(kemar(24_000), speed_of_sound=343.0)
    listener = Pose.from_yaw((0.0, 0.4, 0.0), np.pi / 2)
    assert_allclose(heard.samples, through.binauralize(raw.samples[None], listener, [(1.5, 0.4, 0.0)])[0], atol=1e-6)
    energy = np.sum(heard.samples**2, axis=-1)
    assert energy[1] > energy[0]


@pytest.mark.parametrize(
    ("asked", "channels", "told"),
    [
        ({}, ["left", "right"], {"yaw_deg": 0.0}),
        ({"output": "binaural", "hrtf": "kemar"}, ["left", "right"], {"yaw_deg": 0.0}),
        ({"output": "mono"}, ["mono"], {"yaw_deg": 0.0, "output": "mono"}),
        (
            {"output": "ambisonics", "pitch_deg": 5.0},
            ["acn-0", "acn-1", "acn-2", "acn-3"],
            {"yaw_deg": 0.0, "pitch_deg": 5.0, "roll_deg": 0.0, "output": "ambisonics", "order": 1},
        ),
        (
            {"orientation": "0,0,0,2", "hrtf": "other"},
            ["left", "right"],
            {"orientation": [0.0, 0.0, 0.0, 1.0], "hrtf": "other"},
        ),
    ],
)
def test_json_says_what_was_asked_for(directional, asked, channels, told):
    document = json.loads(
        ImpulseResponse.compute(directional, IrQuery.of(directional, *PLACES, **asked)).encode("json")
    )
    assert document["channels"] == channels
    usual = {"scene", "level", "listener", "emitter", "sample_rate", "channels", "samples"}
    assert {name: value for name, value in document.items() if name not in usual} == told


@pytest.mark.parametrize(
    ("asked", "code", "at_fault"),
    [
        ({"orientation": "0,0,0,1", "yaw_deg": 0.0}, "contradicting_parameters", "orientation"),
        ({"orientation": "0,0,0,1", "roll_deg": 3.0}, "contradicting_parameters", "orientation"),
        ({"orientation": "0,0,0,0"}, "malformed_pose", "orientation"),
        ({"orientation": "0,0,1"}, "malformed_pose", "orientation"),
        ({"orientation": "0,0,nan,1"}, "malformed_pose", "orientation"),
        ({"orientation": "0,0,0e9,-.0e-200"}, "malformed_pose", "orientation"),
        ({"orientation": "1e260,0,0,0"}, "malformed_pose", "orientation"),
        ({"orientation": "1e-260,0,0,0"}, "malformed_pose", "orientation"),
        ({"pitch_deg": float("nan")}, "malformed_pose", "pitch_deg"),
        ({"yaw_deg": float("inf")}, "malformed_pose", "yaw_deg"),
        ({"output": "stereo"}, "unknown_output", "output"),
        ({"output": "ambisonics", "order": 4}, "malformed_request", "order"),
        ({"output": "ambisonics", "order": 0}, "malformed_request", "order"),
        ({"order": 1}, "contradicting_parameters", "order"),
        ({"output": "mono", "order": 1}, "contradicting_parameters", "order"),
        ({"output": "mono", "hrtf": "kemar"}, "contradicting_parameters", "hrtf"),
        ({"output": "ambisonics", "hrtf": "kemar"}, "contradicting_parameters", "hrtf"),
    ],
)
def test_impossible_queries_are_refused_by_their_parameter(directional, asked, code, at_fault):
    assert refused(directional, **asked) == (code, at_fault)


def test_ambisonics_of_a_scene_that_knows_one_head_are_refused(field, measured_bundle):
    assert refused(field, output="ambisonics") == ("no_directions", "output")
    measured = AcousticField.load(measured_bundle)
    assert refused(measured, "0,0.4,0", "1.5,0.4,0", output="ambisonics") == ("no_directions", "output")
    assert refused(measured, "0,0.4,0", "1.5,0.4,0", hrtf="kemar") == ("contradicting_parameters", "hrtf")


def test_an_order_belongs_to_ambisonics():
    for asked in ({"output": "ambisonics"}, {"order": 1}, {"output": "mono", "order": 1}):
        with pytest.raises(ValueError, match="order"):
            IrQuery(QUERY.listener, QUERY.emitter, **asked)


def test_every_parameter_changes_the_tag(directional, other_head):
    asked = [
        {},
        {"pitch_deg": 1.0},
        {"roll_deg": 1.0},
        {"orientation": "0,0,1,1"},
        {"orientation": "0,0,1,2"},
        {"output": "mono"},
        *({"output": "ambisonics", "order": order} for order in (1, 2, 3)),
    ]
    tags = {IrQuery.of(directional, *PLACES, **each).etag(directional, "wav", kemar(24_000)) for each in asked}
    assert len(tags) == len(asked)
    assert QUERY.etag(directional, "wav", kemar(24_000)) != QUERY.etag(directional, "wav", other_head)
    # Spelt otherwise, they are the same.
    same = [{}, {"output": "binaural"}, {"hrtf": "kemar"}, {"yaw_deg": 0.0, "pitch_deg": 0.0}]
    assert len({IrQuery.of(directional, *PLACES, **each).etag(directional, "wav") for each in same}) == 1
    one, usual = ({"output": "ambisonics", "order": order} for order in (1, None))
    assert IrQuery.of(directional, *PLACES, **one) == IrQuery.of(directional, *PLACES, **usual)


def test_an_orientation_is_made_a_unit_quaternion():
    assert parse_orientation(" 0,0, 3,4e0", "orientation") == (0.0, 0.0, 0.6, 0.8)
    assert parse_orientation("0,0,3e162,4e162", "orientation") == (0.0, 0.0, 0.6, 0.8)
    assert parse_orientation("0,0,3e-259,4e-259", "orientation") == pytest.approx((0.0, 0.0, 0.6, 0.8))


READ = {
    "position": (re.compile(POSITION_PATTERN[1:-1]), parse_position),
    "orientation": (re.compile(ORIENTATION_PATTERN.removeprefix("^").removesuffix("$")), parse_orientation),
}
PIECES = [
    *("0", "7", ".0", "0e5", "1e162", "2E+259", "1e260", "1e-259", "1e-260"),
    *("-", "+", ".", "e", " ", "\n", "٣"),
]
NEARLY_NUMBERS = st.one_of(
    st.sampled_from(PIECES), st.lists(st.sampled_from(PIECES), min_size=1, max_size=3).map("".join)
)


def is_read(parse, text):
    try:
        components = parse(text, "place")
    except RequestError:
        return False
    assert all(map(math.isfinite, components))
    return True


@pytest.mark.parametrize("kind", READ)
@given(data=st.data())
def test_whatever_the_schema_of_a_pose_admits_is_read(kind, data):
    pattern, parse = READ[kind]
    assert is_read(parse, data.draw(st.from_regex(pattern, fullmatch=True)))


@pytest.mark.parametrize("kind", READ)
@given(texts=st.lists(NEARLY_NUMBERS, min_size=2, max_size=5))
def test_a_pose_is_read_exactly_if_its_schema_admits_it(kind, texts):
    pattern, parse = READ[kind]
    text = ",".join(texts)
    assert is_read(parse, text) == (pattern.fullmatch(text) is not None)


@pytest.mark.parametrize("output", IR_OUTPUTS)
def test_the_same_samples_in_every_format_of_every_output(directional, output):
    response = ImpulseResponse.compute(directional, IrQuery.of(directional, *PLACES, output=output))
    for name in IR_FORMATS:
        assert_array_equal(read(name, response.encode(name)), response.samples)
