"""Signatures of scene bundles, as minisign (https://jedisct1.github.io/minisign/) writes and checks them: Ed25519 over
the BLAKE2b digest of a file. `scene.json` lists the SHA-256 of every other file, so a signature of it is one of the
bundle; it stands beside it in `scene.json.minisig`.

A signature says who made a bundle, and nothing of what is in it. The trusted comment is signed as well; it is for
people, and nothing is decided by it.
"""

import base64
import binascii
import hashlib
import os
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

from server.core.errors import BundleError, NafirError

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

SIGNATURE_FILE: Final = "scene.json.minisig"
_UNTRUSTED, _TRUSTED = "untrusted comment: ", "trusted comment: "
_ALGORITHM, _OF_DIGEST = b"Ed", b"ED"
_ID_BYTES, _KEY_BYTES, _SIGNATURE_BYTES = 8, 32, 64
_SALT_AND_LIMITS_BYTES = 32 + 8 + 8
_NO_PASSWORD, _CHECKSUM = b"\0\0", b"B2"
_SECRET_BYTES = len(_ALGORITHM + _NO_PASSWORD + _CHECKSUM) + _SALT_AND_LIMITS_BYTES + _ID_BYTES + 3 * _KEY_BYTES
_MOST_KEYS = 64
MOST_SIGNATURE_BYTES: Final = 8 * 1024
_MOST_BYTES = 16 * 1024
_LONGEST_COMMENT = 1_000


def _ed25519() -> Any:
    try:
        from cryptography.hazmat.primitives.asymmetric import ed25519
    except ImportError as exc:
        raise NafirError("signatures of bundles need `pip install 'nafir[sign]'`") from exc
    return ed25519


def _decoded(text: str, size: int) -> bytes | None:
    """Bytes in base64, of which each text stands for others; None unless there are so many."""
    try:
        data = base64.b64decode(text.strip(), validate=True)
    except (binascii.Error, ValueError):
        return None
    return data if len(data) == size and _text(data) == text.strip() else None


def _lines(path: Path) -> list[str]:
    """Raises NafirError for a file that cannot be read."""
    try:
        with path.open("rb") as file:
            text = file.read(_MOST_BYTES + 1)
        if len(text) > _MOST_BYTES:
            raise NafirError(f"{path}: has more than {_MOST_BYTES} bytes")
        return text.decode().splitlines()
    except OSError as exc:
        raise NafirError(f"{path}: {exc.strerror}") from exc
    except UnicodeDecodeError as exc:
        raise NafirError(f"{path}: is not text") from exc


@dataclass(frozen=True)
class BundleKeys:
    """Public keys by their ids, of whom bundles are taken."""

    by_id: Mapping[bytes, bytes]

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a file of public keys, one after the other, as `minisign -G` and `nafir sign-bundle --new-key` write
        them. Raises NafirError, also where signatures cannot be checked."""
        _ed25519()
        found: dict[bytes, bytes] = {}
        for number, line in enumerate(_lines(path), start=1):
            if not line.strip() or line.startswith((_UNTRUSTED, "#")):
                continue
            data = _decoded(line, len(_ALGORITHM) + _ID_BYTES + _KEY_BYTES)
            if data is None or not data.startswith(_ALGORITHM):
                raise NafirError(f"{path}: line {number}: is no public key of minisign")
            if data[2:10] in found:
                raise NafirError(f"{path}: line {number}: key {_name(data[2:10])} is there twice: give it once")
            found[data[2:10]] = data[10:]
        if not 1 <= len(found) <= _MOST_KEYS:
            raise NafirError(f"{path}: has {len(found)} public keys: give 1 to {_MOST_KEYS}")
        return cls(found)

    def require(self, folder: Path, manifest: bytes, text: bytes) -> None:
        """Raises BundleError unless `text`, the signature of the bundle in a folder, is one of its `manifest` by one of
        the keys."""
        path = folder / SIGNATURE_FILE
        try:
            signature = Signature.parse(text.decode().splitlines())
        except (NafirError, UnicodeDecodeError) as exc:
            raise BundleError(path, "signature", "is no signature of minisign") from exc
        key = self.by_id.get(signature.key_id)
        if key is None:
            raise BundleError(path, "signature", f"is by key {signature.name}, which is none of bundle_keys")
        if not signature.is_of(manifest, key):
            raise BundleError(path, "signature", f"does not fit {folder.name}/scene.json: it was changed, or forged")


@dataclass(frozen=True)
class Signature:
    """A signature by the key `key_id` of a file, or with `is_of_digest` of the file's digest."""

    key_id: bytes
    is_of_digest: bool
    signature: bytes
    comment: str
    of_comment: bytes

    @property
    def name(self) -> str:
        """The key's id as minisign shows it."""
        return _name(self.key_id)

    @classmethod
    def parse(cls, lines: list[str]) -> Self:
        """Raises NafirError for what is no signature."""
        if len(lines) != 4 or not lines[0].startswith(_UNTRUSTED) or not lines[2].startswith(_TRUSTED):
            raise NafirError("is no signature of minisign")
        data = _decoded(lines[1], len(_ALGORITHM) + _ID_BYTES + _SIGNATURE_BYTES)
        of_comment = _decoded(lines[3], _SIGNATURE_BYTES)
        if data is None or of_comment is None or data[:2] not in {_ALGORITHM, _OF_DIGEST}:
            raise NafirError("is no signature of minisign")
        return cls(data[2:10], data[:2] == _OF_DIGEST, data[10:], lines[2].removeprefix(_TRUSTED), of_comment)

    def is_of(self, content: bytes, key: bytes) -> bool:
        """Whether it is a signature of this content by a public key, with this comment."""
        from cryptography.exceptions import InvalidSignature

        public = _ed25519().Ed25519PublicKey.from_public_bytes(key)
        try:
            # guard: a bundle is as it was signed
            public.verify(self.signature, _digest(content) if self.is_of_digest else content)
            public.verify(self.of_comment, self.signature + self.comment.encode())
        except InvalidSignature:
            return False
        return True

    def serialize(self) -> str:
        data = (_OF_DIGEST if self.is_of_digest else _ALGORITHM) + self.key_id + self.signature
        lines = (
            f"{_UNTRUSTED}signature of a scene bundle",
            _text(data),
            f"{_TRUSTED}{self.comment}",
            _text(self.of_comment),
        )
        return "".join(f"{line}\n" for line in lines)


@dataclass(frozen=True)
class SigningKey:
    """A key that signs bundles, with its id."""

    id: bytes
    seed: bytes

    @classmethod
    def new(cls) -> Self:
        return cls(secrets.token_bytes(_ID_BYTES), secrets.token_bytes(_KEY_BYTES))

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a secret key as `nafir sign-bundle --new-key` and `minisign -G -W` write it: without a password. Raises
        NafirError, also for a damaged one: its seed has to fit the public half beside it and the checksum, where there
        is one. Minisign writes none without a password."""
        lines = _lines(path)
        data = _decoded(lines[1], _SECRET_BYTES) if len(lines) == 2 and lines[0].startswith(_UNTRUSTED) else None
        if data is None or not data.startswith(_ALGORITHM):
            raise NafirError(f"{path}: is no secret key of minisign")
        if data[2:4] != _NO_PASSWORD:
            raise NafirError(f"{path}: has a password: sign with minisign itself, `minisign -S -m scene.json`")
        at = len(_ALGORITHM + _NO_PASSWORD + _CHECKSUM) + _SALT_AND_LIMITS_BYTES
        key = cls(data[at : at + _ID_BYTES], data[at + _ID_BYTES : at + _ID_BYTES + _KEY_BYTES])
        kind = data[len(_ALGORITHM + _NO_PASSWORD) :][: len(_CHECKSUM)]
        public, checksum = data[-2 * _KEY_BYTES : -_KEY_BYTES], data[-_KEY_BYTES:]
        # guard: nothing is signed with a damaged key
        if kind != _CHECKSUM or public != key.public or checksum not in {key._checksum, bytes(_KEY_BYTES)}:
            raise NafirError(f"{path}: is damaged: take a copy of it, or make a new key with --new-key")
        return key

    @property
    def _private(self) -> "Ed25519PrivateKey":
        private: Ed25519PrivateKey = _ed25519().Ed25519PrivateKey.from_private_bytes(self.seed)
        return private

    @property
    def public(self) -> bytes:
        return self._private.public_key().public_bytes_raw()

    @property
    def _checksum(self) -> bytes:
        return hashlib.blake2b(_ALGORITHM + self.id + self.seed + self.public, digest_size=_KEY_BYTES).digest()

    def sign(self, content: bytes, comment: str) -> Signature:
        """Raises NafirError for a comment that is no line."""
        if len(comment) > _LONGEST_COMMENT or not comment.isprintable():
            raise NafirError(f"comment: is one line of at most {_LONGEST_COMMENT} characters")
        signature = self._private.sign(_digest(content))
        return Signature(self.id, True, signature, comment, self._private.sign(signature + comment.encode()))

    def write(self, path: Path) -> Path:
        """Write the key to a file that only its owner can read, and the public key beside it, to PATH.pub, which is
        returned. Raises NafirError where there is a file already; then neither is written."""
        public_path = path.with_name(f"{path.name}.pub")
        for each in (path, public_path):
            if os.path.lexists(each):
                raise NafirError(f"{each}: File exists")
        public, checksum = self.public, self._checksum
        limits = bytes(_SALT_AND_LIMITS_BYTES)
        data = _ALGORITHM + _NO_PASSWORD + _CHECKSUM + limits + self.id + self.seed + public + checksum
        _write_new(path, f"{_UNTRUSTED}secret key for scene bundles\n{_text(data)}\n", mode=0o600)
        told = f"{_UNTRUSTED}public key for scene bundles\n{_text(_ALGORITHM + self.id + public)}\n"
        try:
            _write_new(public_path, told, mode=0o644)
        except NafirError:
            path.unlink()
            raise
        return public_path


def sign_bundle(folder: Path, key: SigningKey, comment: str) -> Path:
    """Sign the bundle in a folder as it is, and return the file with the signature. Raises NafirError."""
    from server.scene.bundle import MANIFEST_FILE, Bundle

    bundle = Bundle.load(folder)  # so that nothing is signed that no server would load
    try:
        manifest = (folder / MANIFEST_FILE).read_bytes()
        if hashlib.sha256(manifest).hexdigest() != bundle.digest:
            raise NafirError(f"{folder / MANIFEST_FILE}: changes while it is signed")
        path = folder / SIGNATURE_FILE
        partial = path.with_name(f".{path.name}.partial")
        try:
            partial.write_text(key.sign(manifest, comment).serialize())
            partial.replace(path)  # at once, so that a server that reads it meanwhile finds either
        finally:
            partial.unlink(missing_ok=True)
    except OSError as exc:
        raise NafirError(f"{folder}: {exc.strerror}") from exc
    return path


def _digest(content: bytes) -> bytes:
    return hashlib.blake2b(content).digest()


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode()


def _name(key_id: bytes) -> str:
    """A key's id as minisign shows it."""
    return f"{int.from_bytes(key_id, 'little'):016X}"


def _write_new(path: Path, text: str, *, mode: int) -> None:
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        try:
            with os.fdopen(descriptor, "w") as file:
                file.write(text)
        except OSError:
            path.unlink()
            raise
    except OSError as exc:
        raise NafirError(f"{path}: {exc.strerror}") from exc
