"""API keys and the file that holds them: of each key a digest, what it may do, and until when.

A key is `nafir_ID_SECRET`. The id finds the entry in the file, is shown in logs and lists, and opens nothing. The
secret has 256 random bits, so a plain SHA-256 of the key is enough: slow digests protect what people choose, and would
cost each request a tenth of a second.
"""

import hashlib
import hmac
import json
import os
import secrets
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal, Self, get_args

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, ValidationError, model_validator

from server.core.errors import NafirError

Scope = Literal["listen", "render", "upload", "metrics", "admin"]
SCOPES: tuple[Scope, ...] = get_args(Scope)
PREFIX = "nafir_"
_ID_BYTES, _SECRET_BYTES = 6, 32
_LARGEST_FILE_BYTES = 4 * 1024 * 1024
_NOBODY = hashlib.sha256(secrets.token_bytes()).hexdigest()
"""What a key of unknown id is compared with, so that such a key takes as long as any."""


class ApiKey(BaseModel):
    """The entry of one key in the file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    id: Annotated[str, Field(pattern=r"^[0-9a-f]{12}$")]
    name: Annotated[str, Field(max_length=100)] = ""
    """Says to people whose key it is."""
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    """Of the whole key, in hexadecimal digits."""
    scopes: Annotated[tuple[Scope, ...], Field(min_length=1)]
    created: AwareDatetime
    expires: AwareDatetime | None = None


class _KeyDocument(BaseModel):
    model_config = ConfigDict(extra="forbid")

    keys: tuple[ApiKey, ...] = ()

    @model_validator(mode="after")
    def _has_each_id_once(self) -> Self:
        if len({key.id for key in self.keys}) < len(self.keys):
            raise ValueError("two keys have the same id")
        return self


@dataclass(frozen=True)
class ApiKeys:
    """The keys of a file by id."""

    by_id: dict[str, ApiKey]

    @classmethod
    def read(cls, path: Path) -> Self:
        """Raises NafirError, which names the file and the field, for a file that cannot be read."""
        try:
            if path.stat().st_size > _LARGEST_FILE_BYTES:
                raise NafirError(f"{path}: a file of keys has at most {_LARGEST_FILE_BYTES} bytes")
            document = _KeyDocument.model_validate_json(path.read_bytes())
        except OSError as exc:
            raise NafirError(f"{path}: {exc.strerror}") from exc
        except ValidationError as exc:
            first = exc.errors()[0]
            place = ".".join(str(part) for part in first["loc"])
            raise NafirError(f"{path}: {place}{': ' if place else ''}{first['msg']}") from exc
        return cls({key.id: key for key in document.keys})

    def find(self, given: str) -> ApiKey | None:
        """The entry of a key; None if there is no such key. The time this takes says nothing about the digest."""
        parts = given.split("_", 2)
        entry = self.by_id.get(parts[1]) if len(parts) == 3 else None
        expected = _NOBODY if entry is None else entry.sha256
        is_right = hmac.compare_digest(digest(given), expected)
        return entry if is_right else None


def digest(key: str) -> str:
    """SHA-256 of a key, in hexadecimal digits."""
    return hashlib.sha256(key.encode("utf-8", "surrogatepass")).hexdigest()


def random_key() -> tuple[str, str]:
    """A new key and its id."""
    identifier = secrets.token_hex(_ID_BYTES)
    return f"{PREFIX}{identifier}_{secrets.token_urlsafe(_SECRET_BYTES)}", identifier


def create_key(path: Path, name: str, scopes: Sequence[Scope], expires: datetime | None) -> tuple[str, ApiKey]:
    """Add a new key to a file, which is made if there is none. The key is returned and kept nowhere. Raises NafirError
    for a file that cannot be read or written."""
    keys = ApiKeys.read(path).by_id if path.exists() else {}
    key, identifier = random_key()
    entry = ApiKey(
        id=identifier,
        name=name,
        sha256=digest(key),
        scopes=tuple(dict.fromkeys(scopes)),
        created=datetime.now(UTC).replace(microsecond=0),
        expires=expires,
    )
    _write(path, [*keys.values(), entry])
    return key, entry


def revoke_key(path: Path, identifier: str) -> ApiKey:
    """Take a key out of a file. Raises NafirError if it is not there."""
    keys = dict(ApiKeys.read(path).by_id)
    # Whoever has only the key may give it in place of its id.
    entry = keys.pop(identifier.removeprefix(PREFIX).partition("_")[0], None)
    if entry is None:
        raise NafirError(f"{path}: there is no key {identifier[:20]!r}: `nafir keys list` shows the ids")
    _write(path, list(keys.values()))
    return entry


def _write(path: Path, keys: Sequence[ApiKey]) -> None:
    """Replace the file at once, so that a server that reads it meanwhile finds either."""
    text = json.dumps({"keys": [key.model_dump(mode="json") for key in keys]}, indent=2) + "\n"
    mode = path.stat().st_mode & 0o777 if path.exists() else 0o600
    try:
        descriptor, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        try:
            with os.fdopen(descriptor, "w") as file:
                file.write(text)
            Path(name).chmod(mode)
            Path(name).replace(path)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise
    except OSError as exc:
        raise NafirError(f"{path}: {exc.strerror}") from exc
