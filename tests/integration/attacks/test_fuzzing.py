"""Messages, requests and uploads that are wrong in every way, over real connections: the server answers or refuses all
of them, none is answered by a fault of its own, and its memory stays flat. FUZZ_SECONDS says how long each goes on."""

import asyncio
import copy
import http.client
import json
import os
import subprocess
import sys
import time
import urllib.request
from collections import Counter
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake

from server.protocol.blocks import DryBlock
from server.protocol.client_messages import PROTOCOL, Hello
from server.protocol.codes import INTERNAL_ERROR
from server.protocol.server_messages import Error, parse_server_message
from tests.assets.uploads import KINDS, encoded, mutated
from tests.integration.churn import visit

pytestmark = pytest.mark.attack

SCENE = "apartment"
SECONDS = float(os.environ.get("FUZZ_SECONDS", "60"))
QUOTA_BYTES = 20_000_000
MOST_GROWTH = 0.10
_AT_ONCE = 4
_FAULTS = ("nafir_thread_restarts_total", "nafir_samples_not_finite_total")

MESSAGES = (
    {"type": "hello", "protocol": PROTOCOL, "scene": SCENE, "block_size": 256, "encoding": "s16", "buffer_blocks": 8},
    {"type": "resume", "protocol": PROTOCOL, "token": "x" * 32, "sequence": 7, "sample_clock": 256},
    {"type": "add_emitter", "id": "a", "clip": "trumpet", "position": [6, 3, 1.5], "gain_db": -6.0, "loop": True},
    {"type": "add_emitter", "id": "b", "live": True, "position": [6, 3, 1.5], "directivity": {"pattern": "cardioid"}},
    {"type": "move_emitter", "id": "a", "position": [1, 1, 1], "pose_id": 7},
    {"type": "set_gain", "id": "a", "gain_db": 3.5},
    {"type": "set_door", "door": "kitchen", "openness": 0.5},
    {"type": "set_level", "level": "auto"},
    {"type": "set_effects", "effects": {"directivity": True}},
    {"type": "stop_emitter", "id": "a", "stop_at": 4_800},
    {"type": "remove_emitter", "id": "a"},
    {"type": "add_listener", "id": "p2", "position": [3, 2, 1.5], "yaw": 0.5},
    {"type": "add_listener", "id": "p3", "position": [3, 3, 1.5], "hrtf": "kemar"},
    {"type": "listener", "position": [2, 2, 1.5], "yaw": 1.0, "pose_id": 9},
    {"type": "listener", "position": [2, 2, 1.5], "yaw": 1.0, "pose_id": 10, "listener": "p2"},
    {"type": "listener", "position": [2, 2, 1.5], "pose_id": 11, "index": 1},
    {"type": "remove_listener", "id": "p2"},
    {"type": "acknowledge", "sequence": 12},
    {"type": "acknowledge", "sequence": 12, "listener": "p3"},
    {"type": "ping", "id": 5},
)
BLOCKS = (
    b"\x02\0\0\0\7\0\0\0" + np.array([2, 2, 1.5, 0, 0, 0, 1], "<f4").tobytes(),
    b"\x02\1\0\0\7\0\0\0" + np.array([2, 2, 1.5, 0, 0, 0, 1], "<f4").tobytes(),  # of the listener with the number 1
    DryBlock("b", 3, np.ones(256, np.float32)).serialize("f32"),
)
ODD = (None, True, -1, 0, 2**63, 1e308, float("nan"), "", "\0", "é" * 300, [], {}, [[[]]], {"": None}, "apartment")
REQUEST = (
    b"POST /v1/scenes/apartment/impulse-responses HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
    b'Content-Length: 62\r\n\r\n{"poses": [{"listener": [2, 2, 1.5], "emitter": [6, 3, 1.5]}]}'
)


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    return {
        "NAFIR_CLIPS_FOLDER": str(tmp_path_factory.mktemp("clips")),
        "NAFIR_CLIPS_QUOTA_BYTES": str(QUOTA_BYTES),
        "NAFIR_LOG_LEVEL": "error",
    }


def resident_mb(pid):
    with open(f"/proc/{pid}/statm") as statm:  # noqa: PTH123  not a file
        return int(statm.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def check_whole(address):
    """The server still does its work, and nothing in it has failed."""
    asyncio.run(visit(address, blocks=20, emitters=2, scene=SCENE))
    with urllib.request.urlopen(f"http://{address}/metrics", timeout=60) as answer:
        families = text_string_to_metric_families(answer.read().decode())
    faults = {sample.name: sample.value for family in families for sample in family.samples if sample.name in _FAULTS}
    assert set(faults.values()) == {0}, faults


def endured(address, pid, attack):
    """Attacks for SECONDS; `attack` is given how long to go on, and returns what came of it. Memory is compared with
    that after the first third, when all that is kept for later is there."""
    outcomes = attack(SECONDS / 3)
    before_mb = resident_mb(pid)
    outcomes += attack(SECONDS * 2 / 3)
    time.sleep(1.0)
    check_whole(address)
    after_mb = resident_mb(pid)
    assert after_mb < (1 + MOST_GROWTH) * before_mb, (before_mb, after_mb)
    print(dict(outcomes), f"{before_mb:.0f} MB, then {after_mb:.0f} MB")
    return outcomes


def oddly(message, rng):
    """The message with a value changed, or a field more or less, anywhere in it."""
    changed = copy.deepcopy(message)
    place = changed
    while True:
        keys = list(place) if isinstance(place, dict) else list(range(len(place)))
        if not keys:
            break
        key = keys[rng.integers(len(keys))]
        if isinstance(place[key], dict | list) and rng.random() < 0.7:
            place = place[key]
            continue
        if rng.random() < 0.2:
            del place[key]
        else:
            place[key] = ODD[rng.integers(len(ODD))]
        break
    if rng.random() < 0.1:
        changed["also"] = 1
    return changed


def a_message(rng):
    """A message as it should be, or one that is wrong in its values or in its bytes."""
    whole = MESSAGES[rng.integers(len(MESSAGES))]
    match rng.integers(5):
        case 0:
            return json.dumps(whole)
        case 1 | 2:
            return json.dumps(oddly(whole, rng))
        case 3:
            return mutated(json.dumps(whole).encode(), rng).decode(errors="replace")
    block = BLOCKS[rng.integers(len(BLOCKS))]
    return block if rng.random() < 0.2 else mutated(block, rng)


async def babble(address, rng, until_s, outcomes):
    """One connection after another, each until it is closed or has sent enough."""
    while time.monotonic() < until_s:
        try:
            async with connect(f"ws://{address}/v1/stream", compression=None, max_queue=None) as socket:
                hello = Hello(protocol=PROTOCOL, scene=SCENE).serialize()
                await socket.send(hello if rng.random() < 0.8 else a_message(rng))
                listening = asyncio.create_task(listen(socket, outcomes))
                for _ in range(rng.integers(1, 400)):
                    await socket.send(a_message(rng))
                    await asyncio.sleep(0.005 * rng.random())
                if rng.random() < 0.5:
                    socket.transport.abort()
                else:
                    await socket.close()
                await listening
        except (ConnectionClosed, InvalidHandshake, OSError):
            await asyncio.sleep(0.05)
        outcomes["connections"] += 1


async def listen(socket, outcomes):
    try:
        async for message in socket:
            if isinstance(message, str):
                told = parse_server_message(message)
                outcomes[told.code if isinstance(told, Error) else told.type] += 1
                assert not isinstance(told, Error) or told.code != "internal_error", message
    except ConnectionClosed:
        assert socket.close_code != INTERNAL_ERROR


async def garble(address, rng, until_s, outcomes):
    """Requests that are not quite HTTP."""
    host, port = address.split(":")
    while time.monotonic() < until_s:
        reader, writer = await asyncio.open_connection(host, int(port))
        try:
            writer.write(mutated(REQUEST, rng))
            writer.write_eof()
            async with asyncio.timeout(20):
                answer = await reader.read(64)
        except (OSError, TimeoutError):
            answer = b""
        finally:
            writer.close()
        status = answer[9:12].decode(errors="replace")
        outcomes[f"HTTP {status}"] += 1
        assert not status.startswith("5") or status == "503", answer


def test_no_message_and_no_request_is_answered_by_a_fault(measured, server_pid):
    rng = np.random.default_rng(1)

    def attack(seconds):
        async def all_at_once():
            outcomes = Counter()
            until_s = time.monotonic() + seconds
            async with asyncio.TaskGroup() as group:
                for _ in range(_AT_ONCE):
                    group.create_task(babble(measured, rng, until_s, outcomes))
                group.create_task(garble(measured, rng, until_s, outcomes))
            return outcomes

        return asyncio.run(all_at_once())

    outcomes = endured(measured, server_pid, attack)
    assert min(outcomes[each] for each in ("welcome", "listener_added", "listener_removed", "unknown_listener")) > 1
    assert outcomes["malformed_message"] > 10
    assert outcomes["HTTP 400"] > 10


def test_no_upload_is_answered_by_a_fault(measured, server_pid):
    originals = [encoded(kind, 0.2, channels=1 + number % 2) for number, kind in enumerate(KINDS)]

    def one_after_another(seed, seconds):
        outcomes, rng = Counter(), np.random.default_rng(seed)
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            content = mutated(originals[rng.integers(len(originals))], rng) if rng.random() < 0.9 else rng.bytes(2_000)
            status, told = post(measured, content)
            outcomes[f"{status} {told.get('code', '')}".strip()] += 1
            assert status in {200, 201, 413, 422, 429} or told["code"] in {"server_busy", "clips_full"}, told
            if "name" in told and rng.random() < 0.5:
                ask(measured, "DELETE", f"/v1/clips/{told['name']}")
        return outcomes

    def attack(seconds):
        first = int(1_000 * seconds)
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            seeds = range(first, first + _AT_ONCE)
            return sum(pool.map(one_after_another, seeds, [seconds] * _AT_ONCE), Counter())

    outcomes = endured(measured, server_pid, attack)
    assert outcomes["201"] > 1
    assert outcomes["422 undecodable_clip"] > 1
    for name in uploaded(measured):
        ask(measured, "DELETE", f"/v1/clips/{name}")
    assert not uploaded(measured)


def ask(address, method, path, body=None):
    connection = http.client.HTTPConnection(address, timeout=60)
    try:
        connection.request(method, path, body)
        answer = connection.getresponse()
        content = answer.read()
        return answer.status, json.loads(content) if content else {}
    finally:
        connection.close()


def post(address, content):
    return ask(address, "POST", "/v1/clips?title=fuzz", content)


def uploaded(address):
    names = [clip["name"] for clip in ask(address, "GET", "/v1/clips")[1]["clips"]]
    return [name for name in names if name.startswith("upload-")]


_EXAMPLES = 10
"""Of each operation, at random, in a run: more runs have more."""

# No schema can say that bytes are an audio file, so clips may be refused although they are as the document says. What
# is wrong may be too long to be looked at (413), which schemathesis does not count among refusals by itself.
_BY_ITS_DOCUMENT = f"""\
request-timeout = 60.0
[parameters]
"path.scene" = "{SCENE}"
"path.file" = "scene.json"
[checks.negative_data_rejection]
expected-statuses = ["400", "401", "403", "404", "405", "406", "409", "413", "415", "422", "428", "429", "503", "507"]
[[operations]]
include-name = "POST /v1/clips"
checks.positive_data_acceptance.expected-statuses = ["2xx", "413", "422", "503", "507"]
"""


def test_requests_by_the_document_are_answered_as_it_says(measured, server_pid, tmp_path):
    """The first run has every case that schemathesis makes of the document, and a few at random; those after it have
    others at random. How much a run asks bounds it, and how long an answer may take: a busy machine only takes longer
    for it."""
    (tmp_path / "schemathesis.toml").write_text(_BY_ITS_DOCUMENT)
    seeds = iter(range(1, 1_000_000))

    def attack(seconds):
        outcomes = Counter()
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            seed = next(seeds)
            phases = "examples,coverage,fuzzing" if seed == 1 else "fuzzing"
            command = [
                *(sys.executable, "-m", "schemathesis.cli", "run", f"http://{measured}/openapi.json"),
                *("--checks", "all", "--seed", str(seed), "--max-examples", str(_EXAMPLES), "--no-color"),
                *("--phases", phases, "--max-response-time", "60"),
                # Few random bodies of an upload are as the document asks; the attack on uploads has its own.
                *("--suppress-health-check", "filter_too_much"),
            ]
            ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
            assert ran.returncode == 0, f"seed {seed}\n{ran.stdout}{ran.stderr}"
            outcomes["runs"] += 1
        return outcomes

    endured(measured, server_pid, attack)
