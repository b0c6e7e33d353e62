"""Keys that sign tokens, and the key sets with their public parts."""

import base64
import json
import time
from functools import cache

import jwt
from cryptography.hazmat.primitives.asymmetric import ec, rsa

SECRET = b"a secret of a server for its tests"
AUDIENCE = "nafir"


def encoded(data: bytes) -> str:
    return base64.urlsafe_b64encode(data).rstrip(b"=").decode()


@cache
def rsa_key(bits: int = 2048) -> rsa.RSAPrivateKey:
    return rsa.generate_private_key(65_537, bits)


@cache
def curve_key() -> ec.EllipticCurvePrivateKey:
    return ec.generate_private_key(ec.SECP256R1())


def public(kid: str, algorithm: str) -> dict:
    """The entry of a key set."""
    if algorithm == "HS256":
        return {"kty": "oct", "kid": kid, "alg": algorithm, "k": encoded(SECRET)}
    made = {
        "RS256": lambda: jwt.algorithms.RSAAlgorithm.to_jwk(rsa_key().public_key(), as_dict=True),
        "ES256": lambda: jwt.algorithms.ECAlgorithm.to_jwk(curve_key().public_key(), as_dict=True),
    }[algorithm]()
    return {key: value for key, value in made.items() if key != "key_ops"} | {"kid": kid, "alg": algorithm}


KEY_SET = {"keys": [public("h", "HS256"), public("r", "RS256"), public("e", "ES256")]}
SIGNERS = {"HS256": ("h", lambda: SECRET), "RS256": ("r", rsa_key), "ES256": ("e", curve_key)}


def token(algorithm: str = "HS256", *, headers=None, **claims) -> str:
    """A token that is valid for a minute and for this audience, but for what `claims` say; None leaves one out."""
    kid, key = SIGNERS[algorithm]
    said = {"sub": "player", "aud": AUDIENCE, "exp": int(time.time()) + 60, "scope": "listen render", **claims}
    said = {name: value for name, value in said.items() if value is not None}
    return jwt.encode(said, key(), algorithm, headers={"kid": kid, **(headers or {})})


def forged(header: dict, claims: dict, signature: bytes = b"") -> str:
    """A token of any parts."""
    return ".".join([encoded(json.dumps(header).encode()), encoded(json.dumps(claims).encode()), encoded(signature)])
