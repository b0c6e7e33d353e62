"""Sealed snapshots: who made them, and for how long they are good."""

import base64
import hashlib

import pytest

from server.core.errors import RequestError
from server.protocol.snapshot import MOST_SEALED, Seal

SEAL = Seal(b"a secret of servers", lifetime_s=60.0)
DATA = b'{"hello": "state"}' * 40


def refused(seal, sealed, now=1_000.0):
    with pytest.raises(RequestError) as refusal:
        seal.open(sealed, now=now)
    assert (refusal.value.code, refusal.value.field) == ("unknown_resume_token", "snapshot")


def test_what_was_sealed_is_read_by_whoever_has_the_secret():
    sealed = SEAL.close(DATA, plays_at=1_000.25, now=1_000.0)
    assert Seal(b"a secret of servers", lifetime_s=5.0).open(sealed, now=1_059.0) == (DATA, 1_000.25)
    assert len(sealed) < len(DATA)


def test_after_its_time_it_is_refused():
    sealed = SEAL.close(DATA, plays_at=1_000.0, now=1_000.0)
    refused(SEAL, sealed, now=1_060.1)


def test_no_bit_of_it_can_be_changed():
    sealed = SEAL.close(b"state", plays_at=1_000.0, now=1_000.0)
    raw = base64.urlsafe_b64decode(sealed)
    for bit in range(8 * len(raw)):
        changed = bytearray(raw)
        changed[bit // 8] ^= 1 << bit % 8
        refused(SEAL, base64.urlsafe_b64encode(changed).decode())


def test_another_secret_and_what_is_none_are_refused():
    refused(Seal(b"another secret of servers", lifetime_s=60.0), SEAL.close(DATA, plays_at=1_000.0, now=1_000.0))
    whole = SEAL.close(DATA, plays_at=1_000.0, now=1_000.0)
    for sealed in ("", "?", "\u00e4", "A" * 43 + "=", whole[:-4], whole[4:], whole + "AAAA"):
        refused(SEAL, sealed)


def test_it_is_good_for_the_owner_alone_that_it_was_closed_for():
    sealed = SEAL.close(DATA, plays_at=1_000.0, now=1_000.0, owner="abc")
    assert SEAL.open(sealed, now=1_000.0, owner="abc") == (DATA, 1_000.0)
    for other in ("", "ab", "abcd"):
        with pytest.raises(RequestError, match="not one of this server's"):
            SEAL.open(sealed, now=1_000.0, owner=other)


def test_one_too_long_for_a_message_is_not_made():
    long = bytes(byte * 31 % 251 ^ byte >> 8 & 255 for byte in range(3 * MOST_SEALED))
    noise = b"".join(hashlib.sha256(bytes([n % 256, n // 256])).digest() for n in range(2_000))
    assert SEAL.close(noise, plays_at=1_000.0, now=1_000.0) is None
    assert len(SEAL.close(long[:1_000], plays_at=1_000.0, now=1_000.0)) <= MOST_SEALED
