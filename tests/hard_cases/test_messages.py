"""Messages that no client of ours would send: each is refused with a code, and the stream goes on."""

import importlib.util
import json
import random
import subprocess
import sys
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.core.errors import RequestError
from server.protocol.client_messages import Hello, TextMessage, parse_client_message
from tests.hard_cases.doors import BLOCKS, MESSAGES, receive
from tests.hard_cases.listening import Listening, not_finite

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=12), inner, max_size=5),
    max_leaves=20,
)


@given(st.text(max_size=200))
def test_any_text_is_a_message_or_a_refusal(text):
    receive(text)


@given(st.binary(max_size=200))
def test_any_bytes_are_a_message_or_a_refusal(data):
    receive(data)


@given(JSON)
def test_any_document_is_a_message_or_a_refusal(document):
    receive(json.dumps(document))


@given(st.sampled_from(MESSAGES), st.data())
def test_a_message_with_one_value_replaced_by_any_is_a_message_or_a_refusal(text, data):
    document = json.loads(text)
    field = data.draw(st.sampled_from(sorted(document)))
    document[field] = data.draw(JSON)
    receive(json.dumps(document))


@given(st.sampled_from(BLOCKS), st.integers(0, 200), st.binary(min_size=1, max_size=4))
def test_a_binary_message_with_any_bytes_overwritten_is_a_message_or_a_refusal(data, at, patch):
    at %= len(data)
    receive(data[:at] + patch + data[at + len(patch) :])


@pytest.mark.parametrize("kind", [2, 3])
def test_a_binary_message_of_any_wrong_length_is_refused_by_code(kind):
    whole = next(data for data in BLOCKS if data[0] == kind)
    for length in [*range(1, len(whole)), len(whole) + 1, len(whole) + 4, 10_000]:
        with pytest.raises(RequestError) as caught:
            parse_client_message(whole[:length] + bytes(max(0, length - len(whole))))
        assert caught.value.code in {"malformed_pose", "malformed_block"}


@pytest.mark.parametrize("frames", [0, 1, 2**16, 2**31, 2**32 - 1])
def test_a_block_that_says_it_is_longer_than_it_is_allocates_nothing(frames):
    data = bytearray(BLOCKS[1])
    data[8:12] = frames.to_bytes(4, "little")
    with pytest.raises(RequestError, match="frames"):
        parse_client_message(bytes(data))


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000,
        '{"type":' * 10_000,
        '{"type": "ping", "id": ' + "9" * 10_000 + "}",
        '{"type": "ping", "id": 1e400}',
        '{"type": "ping", "id": 1.5}',
        '{"type": "ping", "id": true}',
        '{"type": "ping", "id": "5"}',
        '{"type": "ping", "type": "hello", "id": 5}',
        '{"type": ["ping"], "id": 5}',
        '{"type": null}',
        "",
        "\ufeff{}",
        '{"type": "remove_emitter", "id": "\\ud800"}',
        '{"type": "listener", "pose_id": 1, "position": [1, 2]}',
        '{"type": "listener", "pose_id": 1, "position": [1, 2, 3, 4]}',
        '{"type": "listener", "pose_id": 1, "position": {"0": 1, "1": 2, "2": 3}}',
        '{"type": "listener", "pose_id": 1, "position": [1, 2, 3], "orientaton": [0, 0, 0, 1]}',
    ],
    ids=lambda text: text[:40],
)
def test_a_message_that_only_looks_like_one_is_refused(text):
    assert receive(text) is None


@pytest.mark.parametrize(
    "change",
    [
        {"block_size": 0},
        {"block_size": 255},
        {"block_size": 2**40},
        {"buffer_blocks": 0},
        {"buffer_blocks": 10**9},
        {"encoding": "s24"},
        {"sample_rate": "24000"},
        {"scene": "x" * 300},
        {"listener": {"position": [float("nan"), 0, 0]}},
        {"level": "x" * 300},
    ],
    ids=str,
)
def test_a_hello_that_cannot_be_is_refused_and_names_its_field(change):
    document = json.loads(MESSAGES[0]) | change
    with pytest.raises(RequestError) as caught:
        parse_client_message(json.dumps(document))
    assert next(iter(change)) in str(caught.value)


@pytest.mark.parametrize(
    "pattern",
    [
        {"pattern": "cardioid", "order": 0},
        {"pattern": "cardioid", "order": 1e9},
        {"pattern": "measured"},
        {"pattern": "measured", "angles_deg": [0, 180], "gains_db": [[0, 0]]},
        {"pattern": "measured", "angles_deg": [0, 90], "gains_db": [[0, 0]] * 7},
        {"pattern": "measured", "angles_deg": [0, 180], "gains_db": [[0, 41]] * 7},
        {"pattern": "measured", "angles_deg": [], "gains_db": []},
        {"pattern": "omnidirectional", "angles_deg": [0, 180]},
        {"pattern": "shotgun"},
    ],
    ids=str,
)
def test_a_pattern_that_nothing_can_radiate_is_refused_by_code(pattern):
    message = {"type": "add_emitter", "id": "a", "clip": "x", "position": [1, 1, 1], "directivity": pattern}
    with pytest.raises(RequestError) as caught:
        parse_client_message(json.dumps(message))
    assert caught.value.code == "malformed_directivity"


def test_a_session_hears_any_thousand_messages_and_goes_on(measured, field, filters):
    """Whole ones and spoilt ones in any order; what is understood is obeyed, the rest refused."""
    listening = Listening(field, filters)
    listening.add("a")
    draw = random.Random(1)
    bad, refused = 0, 0
    for _ in range(1_000):
        data = draw.choice([*MESSAGES, *BLOCKS])
        if draw.random() < 0.5:
            raw = bytearray(data.encode() if isinstance(data, str) else data)
            raw[draw.randrange(len(raw))] = draw.randrange(256)
            data = raw.decode(errors="replace") if isinstance(data, str) else bytes(raw)
        message = receive(data)
        refused += message is None
        if message is not None and getattr(message, "type", "") not in {"set_level", "ping"}:
            listening.say(message)
        if draw.random() < 0.3:
            bad += not_finite(listening.hear(1))
    assert refused > 100
    measured("samples not finite", bad, 0)
    measured("level afterwards", float(np.abs(listening.hear(5)).max()), 1.0)


def test_every_kind_of_message_is_understood():
    """So that the cases above spoil what would have been heard."""
    assert all(receive(data) is not None for data in (*MESSAGES, *BLOCKS))
    assert isinstance(receive(MESSAGES[0]), Hello)
    kinds = {message.model_fields["type"].default for message in get_args(TextMessage)}
    assert {json.loads(text)["type"] for text in MESSAGES} == kinds


@pytest.mark.skipif(importlib.util.find_spec("atheris") is None, reason="atheris has no build for this platform")
@pytest.mark.parametrize("door", ["messages", "bundles"])
def test_a_fuzzer_finds_nothing_in_a_short_run(measured, door, tmp_path):
    """`make fuzz` runs longer."""
    command = [sys.executable, str(Path(__file__).parent / "fuzz.py"), door, "--runs", "2000", "--seconds", "8"]
    # The fuzzer limits its peak of memory, which a process inherits from the one that starts it: that is a shell.
    shell = ["sh", "-c", '"$@"; exit $?', "sh"]
    done = subprocess.run([*shell, *command, "--findings", str(tmp_path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3_000:]
    assert not list(tmp_path.iterdir())
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("stat::number_of_executed_units")]
    measured("inputs tried", int(line.split()[-1]), 200, at_least=True)
