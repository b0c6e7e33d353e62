"""Clients that connect hundreds of times a second and leave, at every stage of a stream's beginning."""

import socket
import time

import pytest
from websockets.frames import Frame, Opcode

from server.protocol.client_messages import PROTOCOL, AddEmitter, Hello

pytestmark = pytest.mark.attack

PER_S = 200
ATTACK_S = 5.0
UPGRADE = (
    b"GET /v1/stream HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
)


def frame(message):
    return Frame(Opcode.TEXT, message.encode()).serialize(mask=True)


HELLO = frame(Hello(protocol=PROTOCOL, scene="apartment").serialize())
EMITTERS = b"".join(
    frame(AddEmitter(id=str(number), clip="man-reading", position=(6.0, 3.0, 1.5)).serialize()) for number in range(16)
)
BEGINNINGS = {
    "no hello": UPGRADE,
    "an invalid hello": UPGRADE + frame("?"),
    "an unknown scene": UPGRADE + frame(Hello(protocol=PROTOCOL, scene="nowhere").serialize()),
    "a hello": UPGRADE + HELLO,
    "sixteen emitters": UPGRADE + HELLO + EMITTERS,
}


@pytest.mark.parametrize("beginning", BEGINNINGS.values(), ids=BEGINNINGS)
def test_who_connects_and_leaves_two_hundred_times_a_second_harms_nobody(address, endures, beginning):
    """Each connection is left 0.1 s after it was made, whatever has become of it."""
    host, _, port = address.rpartition(":")

    def attack():
        opened = []
        began_s = time.monotonic()
        for number in range(round(PER_S * ATTACK_S)):
            time.sleep(max(0.0, began_s + number / PER_S - time.monotonic()))
            client = socket.create_connection((host, int(port)), timeout=10)
            client.sendall(beginning)
            opened.append(client)
            if len(opened) > PER_S // 10:
                opened.pop(0).close()
        for client in opened:
            client.close()
        return (number + 1) / (time.monotonic() - began_s)

    assert endures(attack) > PER_S / 2
