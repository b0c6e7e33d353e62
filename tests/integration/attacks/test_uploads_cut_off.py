"""Uploads while the server is killed, and while its disk is full: nothing half-written is served, nothing that was
stored is lost, and the quota is right afterwards."""

import asyncio
import http.client
import json
import os
import random
import shutil
import signal
import socket
import subprocess
import time

import pytest

from tests.assets.uploads import encoded
from tests.integration.churn import visit

pytestmark = pytest.mark.attack

KILLS = 6
CLIP = encoded("flac", 1.5)
DECODED_BYTES = 300_000
"""What a clip takes at most: 72,000 samples of 4 bytes and some more."""


def ask(address, method, path, body=None):
    connection = http.client.HTTPConnection(address, timeout=60)
    try:
        connection.request(method, path, body)
        answer = connection.getresponse()
        return answer.status, json.loads(answer.read() or b"{}")
    finally:
        connection.close()


def request(body):
    """An upload as it goes over the wire."""
    return f"POST /v1/clips HTTP/1.1\r\nHost: localhost\r\nContent-Length: {len(body)}\r\n\r\n".encode() + body


def clips(address):
    listed = ask(address, "GET", "/v1/clips")[1]["clips"]
    return {clip["name"]: clip for clip in listed if clip["name"].startswith("upload-")}


def different(number):
    """A clip of its own content, as long as any other."""
    return encoded("flac", 1.5 + number / 48_000)


def test_a_server_that_is_killed_again_and_again_serves_only_whole_clips(serving, tmp_path):
    folder, quota = tmp_path / "clips", 5 * DECODED_BYTES
    settings = {"NAFIR_CLIPS_FOLDER": str(folder), "NAFIR_CLIPS_QUOTA_BYTES": str(quota)}
    rng, number, stored = random.Random(1), 0, set()
    for _ in range(KILLS):
        with serving(**settings) as (address, pid):
            assert stored <= clips(address).keys(), "what was stored is there after a kill"
            for name in list(clips(address))[2:]:
                assert ask(address, "DELETE", f"/v1/clips/{name}")[0] == 204
            stored = set(clips(address))
            host, port = address.split(":")
            with socket.create_connection((host, int(port))) as half:  # one is under way
                half.sendall(request(CLIP)[: len(CLIP) // 2])
                number += 1
                status, clip = ask(address, "POST", "/v1/clips", different(number))
                assert status == 201, clip
                stored.add(clip["name"])
                with socket.create_connection((host, int(port))) as decoding:  # and one is decoded or stored
                    number += 1
                    decoding.sendall(request(different(number)))
                    time.sleep(rng.uniform(0.0, 1.5))
                    os.kill(pid, signal.SIGKILL)
    with serving(**settings) as (address, _):
        left = clips(address)
        assert stored <= left.keys()
        assert len(left) <= 5
        for name, clip in left.items():
            sound = (folder / f"{name}.wav").read_bytes()
            samples = (len(sound) - sound.index(b"data") - 8) // 4
            assert samples == pytest.approx(clip["duration_s"] * 48_000, abs=1)
        # The quota counts what is there, and nothing of what was cut off.
        for each in range(5 - len(left)):
            assert ask(address, "POST", "/v1/clips", different(100 + each))[0] == 201
        status, refusal = ask(address, "POST", "/v1/clips", different(200))
        assert (status, refusal["code"]) == (507, "clips_full")
        for name in clips(address):
            assert ask(address, "DELETE", f"/v1/clips/{name}")[0] == 204
        assert [path.name for path in folder.iterdir()] == [".lock"]


@pytest.fixture
def small_disk(tmp_path):
    """A disk of a megabyte and a half."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounting = ["mount", "-t", "tmpfs", "-o", "size=1500k", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(mounting, capture_output=True, check=False).returncode:
        pytest.skip("a disk cannot be mounted here: it takes the rights of root")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_a_full_disk_is_told_and_streams_go_on(serving, small_disk):
    with serving(NAFIR_CLIPS_FOLDER=str(small_disk), NAFIR_LOG_LEVEL="error") as (address, _):
        statuses = []
        for number in range(8):
            status, told = ask(address, "POST", "/v1/clips", different(number))
            statuses.append(status)
            assert status == 201 or (status, told["code"]) == (507, "storage_failed"), told
            assert str(small_disk) not in json.dumps(told)
        assert statuses == [201] * statuses.count(201) + [507] * statuses.count(507)
        assert 2 < statuses.count(201) < 7
        stored = clips(address)
        assert len(stored) == statuses.count(201)
        asyncio.run(visit(address, blocks=20, emitters=2, scene="apartment"))
        assert ask(address, "DELETE", f"/v1/clips/{next(iter(stored))}")[0] == 204
        assert ask(address, "POST", "/v1/clips", different(50))[0] == 201
        assert {path.suffix for path in small_disk.iterdir()} <= {".wav", ".json", ""}
