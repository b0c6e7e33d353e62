import io
import json
import time

import numpy as np
import pytest
import scipy.io.wavfile
import soundfile
from numpy.testing import assert_array_equal

from server.core.errors import RequestError
from server.responses.impulse_response import IR_FORMATS, ImpulseResponse, IrQuery, parse_format, parse_position

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
