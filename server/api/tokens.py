"""JSON Web Tokens (RFC 7519) that somebody else signs: a game's backend, or an identity provider.

The keys that check them come from one file, a JSON Web Key Set (RFC 7517). Each key names the one algorithm that it is
for. The algorithm of a token's header is only compared with it and chooses nothing: a token cannot ask for `none`, or
for HS256 with a public key as the secret.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

from server.core.errors import NafirError

if TYPE_CHECKING:
    from jwt import PyJWK

_KINDS: Final[Mapping[str, str]] = {"HS256": "oct", "RS256": "RSA", "ES256": "EC"}
"""Algorithms that a key may be for, and its `kty`."""
_PRIVATE: Final = ("d", "p", "q", "dp", "dq", "qi")
_SHORTEST_SECRET_BYTES = 32
_SHORTEST_RSA_BITS = 2048
_MOST_KEYS = 64
_LATEST_S = 253_402_300_800
"""The end of the year 9999, in seconds since 1970."""
_UNREADABLE = (ValueError, TypeError, OverflowError, RecursionError)
"""What JSON may raise besides: numbers without bounds, lists within lists within lists."""
_LARGEST_FILE_BYTES = 1024 * 1024


class TokenError(NafirError):
    """A token is refused. The message says why, and repeats nothing of the token."""


@dataclass(frozen=True)
class TokenClaims:
    """What a valid token says."""

    subject: str
    """`sub`; without one, the id of the key that signed the token."""
    scopes: frozenset[str]
    expires_s: float
    """`exp`, in seconds since 1970."""
    key: "TokenKey"


@dataclass(frozen=True)
class TokenKey:
    """A key of the set; `id` is its `kid`, and `digest` tells it from another key of the same id."""

    id: str | None
    algorithm: str
    digest: str


@dataclass(frozen=True)
class TokenVerifier:
    """Checks tokens for one audience, and one issuer if it is given. `leeway_s` forgives clocks that differ."""

    keys: "Mapping[TokenKey, PyJWK]"
    audience: str
    issuer: str | None
    leeway_s: float

    @classmethod
    def read(cls, path: Path, *, audience: str, issuer: str | None, leeway_s: float) -> Self:
        """Raises NafirError, which names the file and the key, for a key set that cannot be used."""
        try:
            if path.stat().st_size > _LARGEST_FILE_BYTES:
                raise NafirError(f"{path}: a key set has at most {_LARGEST_FILE_BYTES} bytes")
            document = json.loads(path.read_bytes())
        except OSError as exc:
            raise NafirError(f"{path}: {exc.strerror}") from exc
        except ValueError as exc:
            raise NafirError(f"{path}: is not JSON: {exc}") from exc
        entries = document.get("keys") if isinstance(document, dict) else None
        if not isinstance(entries, list) or len(entries) > _MOST_KEYS:
            raise NafirError(f"{path}: keys: a JSON Web Key Set has a list of at most {_MOST_KEYS} keys")
        keys = dict(_parsed(entry, f"{path}: keys.{number}") for number, entry in enumerate(entries))
        if len({key.id for key in keys}) < len(entries):
            raise NafirError(f"{path}: keys: two keys have the same kid, or none; give each its own")
        return cls(keys, audience, issuer, leeway_s)

    def verify(self, token: str) -> TokenClaims:
        """Raises TokenError for a token that is not valid now, here and for this server."""
        import jwt

        try:
            header = jwt.get_unverified_header(token)
        except (jwt.InvalidTokenError, *_UNREADABLE) as exc:
            raise TokenError("it is not a token") from exc
        key = self._key_of(header)
        try:
            claims = jwt.decode(
                token,
                self.keys[key],
                algorithms=[key.algorithm],
                audience=self.audience,
                issuer=self.issuer,
                leeway=self.leeway_s,
                options={"require": ["exp", "aud", *(["iss"] if self.issuer else [])]},
            )
        except jwt.ExpiredSignatureError as exc:
            raise TokenError("it has expired: get a new one") from exc
        except jwt.ImmatureSignatureError as exc:
            raise TokenError("it is not valid yet") from exc
        except jwt.InvalidAudienceError as exc:
            raise TokenError("it is for another audience") from exc
        except jwt.InvalidIssuerError as exc:
            raise TokenError("it is from another issuer") from exc
        except jwt.MissingRequiredClaimError as exc:
            raise TokenError(f"it has no {exc.claim}") from exc
        except (jwt.InvalidTokenError, *_UNREADABLE) as exc:
            raise TokenError("its signature or its form is wrong") from exc
        expires_s = claims["exp"]
        if not isinstance(expires_s, int | float) or not expires_s < _LATEST_S:
            raise TokenError("its exp is no time")
        subject = claims.get("sub")
        return TokenClaims(
            subject=subject if isinstance(subject, str) and subject else f"signed-by-{key.id}",
            scopes=_scopes(claims),
            expires_s=float(expires_s),
            key=key,
        )

    def _key_of(self, header: Mapping[str, Any]) -> TokenKey:
        """The key that a token's header names, if the algorithm is that key's. Raises TokenError."""
        if "crit" in header or "b64" in header:
            raise TokenError("its header has extensions that this server does not know")
        kid = header.get("kid")
        found = [key for key in self.keys if kid is None or key.id == kid]
        if len(found) != 1:
            raise TokenError("its kid names no key of this server")
        if header.get("alg") != found[0].algorithm:
            raise TokenError("its algorithm is not that of its key")
        return found[0]


def _parsed(entry: Any, place: str) -> "tuple[TokenKey, PyJWK]":
    """A key of the set. Raises NafirError, which says what is wrong at `place`."""
    try:
        import jwt
    except ModuleNotFoundError as exc:
        raise NafirError("jwt_keys_file: needs PyJWT: pip install 'nafir[jwt]'") from exc
    if not isinstance(entry, dict):
        raise NafirError(f"{place}: is no JSON Web Key")
    algorithm, kind = entry.get("alg"), entry.get("kty")
    if not isinstance(algorithm, str) or algorithm not in _KINDS:
        raise NafirError(f"{place}: alg: give the one algorithm of the key, {', '.join(_KINDS)}")
    if kind != _KINDS[algorithm]:
        raise NafirError(f"{place}: kty: a key for {algorithm} is {_KINDS[algorithm]!r}, not {kind!r}")
    if kind != "oct" and (private := [name for name in _PRIVATE if name in entry]):
        raise NafirError(f"{place}: {private[0]}: this is a private key: give only its public part")
    if entry.get("use", "sig") != "sig":
        raise NafirError(f"{place}: use: the key is not for signatures")
    if not isinstance(entry.get("kid"), str | None):
        raise NafirError(f"{place}: kid: is text")
    try:
        key = jwt.PyJWK(entry, algorithm)
    except (jwt.PyJWTError, ValueError, TypeError) as exc:
        # Its message may repeat the key.
        raise NafirError(f"{place}: is no key for {algorithm}") from exc
    if kind == "oct" and len(key.key) < _SHORTEST_SECRET_BYTES:
        raise NafirError(f"{place}: k: a secret for HS256 has at least {_SHORTEST_SECRET_BYTES} bytes")
    if kind == "RSA" and key.key.key_size < _SHORTEST_RSA_BITS:
        raise NafirError(f"{place}: n: an RSA key has at least {_SHORTEST_RSA_BITS} bits")
    if kind == "EC" and entry.get("crv") != "P-256":
        raise NafirError(f"{place}: crv: a key for ES256 is on P-256")
    material = json.dumps([entry.get(name) for name in ("k", "n", "e", "x", "y")])
    return TokenKey(entry.get("kid"), algorithm, hashlib.sha256(material.encode()).hexdigest()), key


def _scopes(claims: Mapping[str, Any]) -> frozenset[str]:
    """Scopes of a token: `scope`, separated by spaces (RFC 8693, 4.2), or a list, which some providers call `scp`."""
    given = claims.get("scope", claims.get("scp"))
    if isinstance(given, str):
        return frozenset(given.split())
    return frozenset(each for each in given if isinstance(each, str)) if isinstance(given, list) else frozenset()
