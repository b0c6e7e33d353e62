"""What `nafir serve` writes while clients come with keys in every place where one could be put."""

import asyncio
import base64
import json
import os
import subprocess
import sys
import time
import urllib.error
import urllib.request

import pytest
import websockets

from server.api.api_keys import create_key
from server.protocol.client_messages import PROTOCOL
from tests.api.token_keys import AUDIENCE, KEY_SET, SECRET, encoded, token
from tests.visitor import free_port

pytestmark = pytest.mark.untimed


def answered(url, headers=None):
    """Status and request id of an answer; None if there is none."""
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers or {}), timeout=10) as answer:
            return answer.status, answer.headers["X-Request-ID"]
    except urllib.error.HTTPError as exc:
        exc.close()
        return exc.code, exc.headers["X-Request-ID"]
    except (urllib.error.URLError, ConnectionError, TimeoutError):
        return None


async def try_streams(address, secrets):
    for secret in secrets:
        carried = base64.urlsafe_b64encode(secret.encode()).rstrip(b"=").decode()
        ways = (
            (address, {"subprotocols": ["nafir.v3", f"nafir.key.{carried}"]}),
            (address, {"additional_headers": {"Authorization": f"Bearer {secret}"}}),
            (f"{address}?key={secret}", {}),
            (address, {"additional_headers": {"Authorization": f"Basic {secret}", "X-Api-Key": secret}}),
        )
        for url, options in ways:
            try:
                async with websockets.connect(url, **options) as stream:
                    await stream.send(json.dumps({"type": "hello", "protocol": PROTOCOL, "scene": "open-field"}))
                    await stream.recv()
                    await stream.send(secret)  # not a message
                    await stream.recv()
            except (websockets.InvalidStatus, websockets.ConnectionClosed):
                pass


def test_no_line_of_the_log_has_a_key_and_every_stream_has_its_lines(tmp_path):
    key, entry = create_key(tmp_path / "keys.json", "", ["listen", "render"], None)
    (tmp_path / "jwks.json").write_text(json.dumps(KEY_SET))
    secrets = [key, token("RS256"), token("HS256", exp=1), "nafir_000000000000_of-somebody-else"]
    port = free_port()
    environment = {
        "NAFIR_KEYS_FILE": str(tmp_path / "keys.json"),
        "NAFIR_JWT_KEYS_FILE": str(tmp_path / "jwks.json"),
        "NAFIR_JWT_AUDIENCE": AUDIENCE,
        "NAFIR_LOG_FORMAT": "json",
        "NAFIR_LOG_LEVEL": "debug",
    }
    url = f"http://127.0.0.1:{port}"
    with (tmp_path / "log").open("w") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "server", "serve", "--port", str(port)],
            stdout=subprocess.DEVNULL,
            stderr=log,
            env={**os.environ, **environment},
        )
        try:
            deadline = time.monotonic() + 180
            while (ready := answered(f"{url}/readyz")) is None or ready[0] != 200:
                assert process.poll() is None
                assert time.monotonic() < deadline
                time.sleep(0.1)
            for secret in secrets:
                answered(f"{url}/v1/scenes", {"Authorization": f"Bearer {secret}", "X-Request-ID": "of-the-test"})
                answered(f"{url}/v1/scenes", {"Authorization": secret, "Sec-WebSocket-Protocol": secret})
                answered(f"{url}/v1/scenes?key={secret}", {"Authorization": f"Bearer {key}"})
                answered(f"{url}/v1/scenes", {"Authorization": f"Bearer {secret}" + "x" * 8_000})
                answered(f"{url}/v1/scenes", {"X-Request-ID": secret + " "})
            asyncio.run(try_streams(f"ws://127.0.0.1:{port}/v1/stream", secrets))
        finally:
            process.terminate()
            process.wait(timeout=20)
    text = (tmp_path / "log").read_text()
    lines = [json.loads(line) for line in text.splitlines()]
    for secret in (*secrets, encoded(SECRET)):
        for part in (secret, secret.rpartition(".")[2], secret.rpartition("_")[2]):
            assert part not in text
        assert base64.urlsafe_b64encode(secret.encode()).rstrip(b"=").decode() not in text
    assert all({"timestamp", "level", "event"} <= line.keys() for line in lines)
    by_event = {}
    for line in lines:
        by_event.setdefault(line["event"], []).append(line)
    named = [line for line in by_event["request"] if line["request_id"] == "of-the-test"]
    assert [(line["status"], line.get("caller")) for line in named] == [
        (200, f"key {entry.id}"),
        (200, "token player"),
        (401, None),
        (401, None),
    ]
    opened, ended = by_event["stream opened"], by_event["stream ended"]
    assert len(opened) == len(ended) == 4
    assert {line["session"] for line in opened} == {line["session"] for line in ended}
    assert all(line["reason"] and line["close_code"] and line["duration_s"] >= 0 for line in ended)
    assert {line["code"] for line in by_event["request refused unread"]} == {"header_too_long"}
