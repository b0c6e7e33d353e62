"""What nobody waits for is not computed, and what is computed for HTTP stays behind the streams."""

import contextlib
import http.client
import socket
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

pytestmark = pytest.mark.attack

LOUDNESS = "/v1/scenes/apartment/loudness?emitter={x:.3f},2,1.5&spacing_m=0.15"
IR = "/v1/scenes/apartment/impulse-response?listener={x:.4f},2,1.5&emitter=6,3,1.5"


def get(address, path, timeout=15):
    """Status and headers."""
    with contextlib.closing(http.client.HTTPConnection(address, timeout=timeout)) as connection:
        connection.request("GET", path)
        answer = connection.getresponse()
        answer.read()
        return answer.status, dict(answer.getheaders())


def abandon(address, path):
    """Ask, and be gone before there is an answer."""
    host, _, port = address.rpartition(":")
    with socket.create_connection((host, int(port)), timeout=5) as client:
        client.sendall(f"GET {path} HTTP/1.1\r\nHost: {address}\r\n\r\n".encode())
        time.sleep(0.01)


def test_maps_that_nobody_waits_for_keep_no_others_waiting(address, endures):
    def attack():
        for number in range(34):
            abandon(address, LOUDNESS.format(x=1 + 0.01 * number + time.monotonic() % 0.01))
        waits_s = []
        for number in range(8):
            began_s = time.monotonic()
            status, _ = get(address, IR.format(x=1 + 0.01 * number + time.monotonic() % 0.01))
            waits_s.append(time.monotonic() - began_s)
            assert status == 200
        return max(waits_s)

    assert endures(attack) < 2.0


def test_who_asks_for_many_responses_at_once_does_not_harm_a_stream(address, endures):
    def attack():
        until_s = time.monotonic() + 5

        def ask(number):
            statuses = []
            while time.monotonic() < until_s:
                statuses.append(get(address, IR.format(x=1 + number / 16 + time.monotonic() % 0.06))[0])
            return statuses

        with ThreadPoolExecutor(16) as askers:
            return {status for statuses in askers.map(ask, range(16)) for status in statuses}

    assert endures(attack) == {200}
