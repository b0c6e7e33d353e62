"""Which tokens are valid: RFC 7519, and the attacks of RFC 8725 (best current practices)."""

import hashlib
import hmac
import json
import time

import pytest
from cryptography.hazmat.primitives import serialization

from server.api.tokens import TokenError, TokenVerifier
from server.core.errors import NafirError
from tests.api.token_keys import AUDIENCE, KEY_SET, SECRET, encoded, forged, public, rsa_key, token

ALGORITHMS = ["HS256", "RS256", "ES256"]


@pytest.fixture
def read(tmp_path):
    def read(document=KEY_SET, *, issuer=None, leeway_s=0.0):
        file = tmp_path / "jwks.json"
        file.write_text(json.dumps(document))
        return TokenVerifier.read(file, audience=AUDIENCE, issuer=issuer, leeway_s=leeway_s)

    return read


def refusal(verifier, given):
    with pytest.raises(TokenError) as refused:
        verifier.verify(given)
    return str(refused.value)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_a_signed_token_says_who_it_is_and_what_it_may_do(read, algorithm):
    expires_s = int(time.time()) + 30
    claims = read().verify(token(algorithm, exp=expires_s, scope="listen openid"))
    assert (claims.subject, claims.scopes, claims.expires_s) == ("player", {"listen", "openid"}, expires_s)
    assert claims.key.algorithm == algorithm


def test_scopes_may_be_a_list_and_a_subject_may_be_missing(read):
    verifier = read()
    assert verifier.verify(token(scope=None, scp=["listen", 3])).scopes == {"listen"}
    assert verifier.verify(token(scope=None)).scopes == frozenset()
    assert verifier.verify(token(scope={"listen": True})).scopes == frozenset()
    assert verifier.verify(token(sub=None)).subject == "signed-by-h"


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_a_changed_token_is_refused(read, algorithm):
    verifier, good = read(), token(algorithm)
    head, body, signature = good.split(".")
    claims = {"sub": "player", "aud": AUDIENCE, "exp": int(time.time()) + 60, "scope": "listen admin"}
    for given in (
        f"{head}.{encoded(json.dumps(claims).encode())}.{signature}",
        f"{head}.{body}.{'A' if signature[0] != 'A' else 'B'}{signature[1:]}",
        f"{head}.{body}.",
    ):
        assert "signature" in refusal(verifier, given)


def test_no_token_chooses_its_algorithm(read):
    """RFC 8725, 2.1 and 3.1."""
    verifier = read()
    claims = {"sub": "player", "aud": AUDIENCE, "exp": int(time.time()) + 60, "scope": "admin"}
    for none in ("none", "None", "NONE", "nOnE", ""):
        for kid in ("h", "r", "e"):
            assert "algorithm" in refusal(verifier, forged({"alg": none, "kid": kid}, claims))
    # The public key, which everybody has, as the secret of HS256, in each of its usual forms.
    pem = serialization.PublicFormat.SubjectPublicKeyInfo
    for encoding in (serialization.Encoding.PEM, serialization.Encoding.DER):
        secret = rsa_key().public_key().public_bytes(encoding, pem)
        unsigned = forged({"alg": "HS256", "kid": "r"}, claims).rpartition(".")[0]
        signature = encoded(hmac.digest(secret, unsigned.encode(), hashlib.sha256))
        assert "algorithm" in refusal(verifier, f"{unsigned}.{signature}")
    assert "algorithm" in refusal(verifier, token("HS256", headers={"kid": "r"}))
    assert "algorithm" in refusal(verifier, token("RS256", headers={"kid": "e"}))
    for other in ("HS512", "RS512", "PS256", "ES384", "EdDSA"):
        assert "algorithm" in refusal(verifier, forged({"alg": other, "kid": "r"}, claims, b"x" * 64))


def test_no_token_brings_its_own_key(read):
    verifier = read()
    claims = {"sub": "player", "aud": AUDIENCE, "exp": int(time.time()) + 60}
    own = {"kty": "oct", "k": encoded(b"x" * 32)}
    for headers in ({"jwk": own}, {"jku": "http://127.0.0.1/keys"}, {"x5u": "http://127.0.0.1/keys"}):
        unsigned = forged({"alg": "HS256", "kid": "h", **headers}, claims).rpartition(".")[0]
        signature = encoded(hmac.digest(b"x" * 32, unsigned.encode(), hashlib.sha256))
        assert "signature" in refusal(verifier, f"{unsigned}.{signature}")
    for kid in ("x", "../../keys", "h' OR 1=1", ["h"], None):
        headers = {"alg": "HS256", "kid": kid}
        assert refusal(verifier, forged(headers, claims, b"x" * 32))


def test_a_token_is_for_its_time_only_but_for_the_leeway(read):
    now_s = int(time.time())
    exact, patient = read(), read(leeway_s=10.0)
    assert "expired" in refusal(exact, token(exp=now_s - 1))
    assert patient.verify(token(exp=now_s - 5)).expires_s == now_s - 5
    assert "expired" in refusal(patient, token(exp=now_s - 11))
    assert "not valid yet" in refusal(exact, token(nbf=now_s + 5))
    assert patient.verify(token(nbf=now_s + 5))
    assert "not valid yet" in refusal(patient, token(nbf=now_s + 30))
    assert "not valid yet" in refusal(patient, token(iat=now_s + 30))
    assert "no exp" in refusal(exact, token(exp=None))


@pytest.mark.parametrize("exp", ["soon", "9999999999", [], {}, True, 1e400, -1e400, 10**15, 10**400, float("nan")])
def test_a_time_that_is_none_is_refused(read, exp):
    """A token that never ends would leave a stream open for ever."""
    assert refusal(read(), token(exp=exp))


def test_a_token_is_for_its_audience_and_from_its_issuer(read):
    assert "audience" in refusal(read(), token(aud="another"))
    assert "no aud" in refusal(read(), token(aud=None))
    assert read().verify(token(aud=["another", AUDIENCE]))
    strict = read(issuer="https://id.example")
    assert strict.verify(token(iss="https://id.example"))
    assert "issuer" in refusal(strict, token(iss="https://evil.example"))
    assert "no iss" in refusal(strict, token())


def test_an_extension_that_must_be_understood_is_refused(read):
    """RFC 7515, 4.1.11, and RFC 7797."""
    assert refusal(read(), token(headers={"crit": ["exp"]}))
    assert "extensions" in refusal(read(), token(headers={"b64": False}))


@pytest.mark.parametrize(
    "given",
    [
        "",
        "a",
        "a.b",
        "a.b.c",
        "a.b.c.d",
        "....",
        "e30.e30.",
        "W10.e30.e30",
        forged({"alg": "HS256", "kid": "h"}, {}),
        ".".join([encoded(b"[" * 5_000), "e30", "e30"]),
        ".".join([encoded(b'{"alg":"HS256","kid":"h","x":' + b"[" * 4_000 + b"]" * 4_000 + b"}"), "e30", "e30"]),
        "\ud800.\ud800.\ud800",
        "é.é.é",
        ".".join([encoded(b'{"alg":"HS256","kid":' + b"9" * 5_000 + b"}"), "e30", "e30"]),
    ],
)
def test_whatever_is_sent_in_place_of_a_token_is_refused(read, given):
    assert refusal(read(), given)


def test_a_token_without_the_name_of_its_key_is_checked_by_the_only_one(read):
    only = read({"keys": [{key: value for key, value in public("h", "HS256").items() if key != "kid"}]})
    claims = {"sub": "player", "aud": AUDIENCE, "exp": int(time.time()) + 60}
    unsigned = forged({"alg": "HS256"}, claims).rpartition(".")[0]
    good = f"{unsigned}.{encoded(hmac.digest(SECRET, unsigned.encode(), hashlib.sha256))}"
    assert only.verify(good).subject == "player"
    assert "kid" in refusal(read(), good)


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({"alg": None}, "alg"),
        ({"alg": "none"}, "alg"),
        ({"alg": "HS512"}, "alg"),
        ({"alg": ["HS256"]}, "alg"),
        ({"alg": "RS256"}, "kty"),
        ({"k": encoded(b"short")}, "at least 32 bytes"),
        ({"k": 3}, "is no key"),
        ({"use": "enc"}, "use"),
        ({"kid": 3}, "kid"),
    ],
)
def test_a_key_set_that_could_not_hold_is_refused(read, entry, words):
    with pytest.raises(NafirError, match=words) as refused:
        read({"keys": [public("h", "HS256") | entry]})
    assert "keys.0" in str(refused.value)
    assert encoded(SECRET) not in str(refused.value)


def test_weak_private_and_doubled_keys_are_refused(read):
    weak = rsa_key(1024).public_key().public_numbers().n
    n = encoded(weak.to_bytes(128, "big"))
    with pytest.raises(NafirError, match="at least 2048 bits"):
        read({"keys": [public("r", "RS256") | {"n": n}]})
    with pytest.raises(NafirError, match="private"):
        read({"keys": [public("r", "RS256") | {"d": "AQAB"}]})
    with pytest.raises(NafirError, match="same kid"):
        read({"keys": [public("h", "HS256"), public("h", "RS256")]})
    for document in ({}, [], {"keys": {}}, {"keys": [3]}):
        with pytest.raises(NafirError, match="keys"):
            read(document)


def test_a_key_set_shows_no_secret(read):
    """Wherever it may be printed."""
    assert encoded(SECRET) not in repr([*read().keys])
