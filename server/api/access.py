"""Who may use the server: callers with an API key or a token, and what each of them may do.

Access is *on* if the operator named a file of keys or of token keys, and *off* otherwise. Both files are read again
when they change, so keys come and go without a restart. A file that has become unreadable changes nothing: the keys
that were read last stay, and the log says so.
"""

import asyncio
import hashlib
import hmac
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, Self

from server.api.api_keys import PREFIX, SCOPES, ApiKey, ApiKeys, Scope, digest
from server.api.settings import Settings
from server.api.tokens import TokenError, TokenKey, TokenVerifier
from server.core.errors import NafirError

LOOK_S: Final = 1.0
"""Seconds between two looks at the files, and at the callers of open streams."""
Ending = Literal["key_expired", "key_revoked"]
"""Why a caller may not go on."""
OwnScope = Literal["process"]
OWN_SCOPE: Final[OwnScope] = "process"
"""What the processes of a server may do with each other, and no key or token can say."""
_SHOWN_SUBJECT = 64
"""Characters of a token's subject that logs show."""

_logger = logging.getLogger(__name__)


class AccessError(NafirError):
    """A key or token is refused. `code` is stable; the message repeats nothing of what was given."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


@dataclass(frozen=True)
class Caller:
    """Who sends a request or has a stream open."""

    name: str
    """For logs and limits: `key ID` or `token SUBJECT`."""
    scopes: frozenset[Scope | OwnScope]
    expires_s: float | None
    """When the key or token ends, in seconds since 1970."""
    proof: ApiKey | TokenKey | None
    """What admitted the caller, as it was read from its file; None for the server's own processes."""
    subject: str | None = None
    """Of a token, whole: what tells its bearers apart. None for a key."""

    @property
    def is_own_process(self) -> bool:
        """Whether it is another process of this server."""
        return OWN_SCOPE in self.scopes

    @property
    def identity(self) -> str:
        """The same for one key, and for all tokens of one subject, and for nobody else. It shows neither."""
        told = self.name if self.subject is None else f"subject {self.subject}"
        return hashlib.sha256(told.encode("utf-8", "surrogatepass")).hexdigest()


@dataclass(frozen=True)
class _FileState:
    """Tells versions of a file apart."""

    mtime_ns: int
    size: int
    inode: int

    @classmethod
    def of(cls, path: Path) -> Self | None:
        try:
            found = path.stat()
        except OSError:
            return None
        return cls(found.st_mtime_ns, found.st_size, found.st_ino)


class Access:
    """The keys in force. Belongs to the event loop, except that files are read on another thread."""

    def __init__(
        self,
        *,
        read_keys: Callable[[], ApiKeys] | None = None,
        read_tokens: Callable[[], TokenVerifier] | None = None,
        files: tuple[Path, ...] = (),
        own_key: str | None = None,
        time_s: Callable[[], float] = time.time,
    ) -> None:
        """`own_key` is the one by which the processes of a server ask each other for metrics and streams. Raises
        NafirError for files that cannot be used."""
        self._read_keys = read_keys
        self._read_tokens = read_tokens
        self._files = files
        self._own = None if own_key is None else digest(own_key)
        self._time_s = time_s
        self._states = self._look()
        self._keys = ApiKeys({}) if read_keys is None else read_keys()
        self._tokens = None if read_tokens is None else read_tokens()

    @classmethod
    def of(cls, settings: Settings, *, own_key: str | None = None) -> Self | None:
        """The access that settings describe; None if it is off. Raises NafirError for files that cannot be used, and if
        access is off where it must not be."""
        keys, tokens = settings.keys_file, settings.jwt_keys_file
        if keys is None and tokens is None:
            if settings.require_auth:
                raise NafirError(
                    "require_auth: there are no keys: name a file of keys with NAFIR_KEYS_FILE (`nafir keys create` "
                    "makes one) or of token keys with NAFIR_JWT_KEYS_FILE"
                )
            return None

        def read_tokens() -> TokenVerifier:
            assert tokens is not None
            assert settings.jwt_audience is not None  # as the settings require
            return TokenVerifier.read(
                tokens, audience=settings.jwt_audience, issuer=settings.jwt_issuer, leeway_s=settings.jwt_leeway_s
            )

        return cls(
            read_keys=None if keys is None else lambda: ApiKeys.read(keys),
            read_tokens=None if tokens is None else read_tokens,
            files=tuple(each for each in (keys, tokens) if each is not None),
            own_key=own_key,
        )

    def admit(self, credential: str) -> Caller:
        """The caller that a key or token stands for. Raises AccessError."""
        if credential.startswith(PREFIX):
            return self._admit_key(credential)
        if self._tokens is None:
            raise AccessError("key_refused", "there is no such key: it may have been revoked")
        try:
            claims = self._tokens.verify(credential)
        except TokenError as exc:
            raise AccessError("key_refused", f"the token is refused: {exc}") from exc
        return Caller(
            name=f"token {_printable(claims.subject)}",
            scopes=frozenset(scope for scope in SCOPES if scope in claims.scopes),
            expires_s=claims.expires_s + self._tokens.leeway_s,
            proof=claims.key,
            subject=claims.subject,
        )

    def _admit_key(self, key: str) -> Caller:
        if self._own is not None and hmac.compare_digest(digest(key), self._own):
            return Caller("own process", frozenset({"metrics", OWN_SCOPE}), None, None)
        entry = self._keys.find(key)
        if entry is None:
            raise AccessError("key_refused", "there is no such key: it may have been revoked")
        expires_s = None if entry.expires is None else entry.expires.timestamp()
        if expires_s is not None and expires_s <= self._time_s():
            raise AccessError("key_refused", "the key has expired: ask the operator for a new one")
        return Caller(f"key {entry.id}", frozenset(entry.scopes), expires_s, entry)

    def ending(self, caller: Caller) -> Ending | None:
        """Why a caller who was admitted is not any more; None if that has not changed."""
        if caller.expires_s is not None and caller.expires_s <= self._time_s():
            return "key_expired"
        match caller.proof:
            case ApiKey() as entry if self._keys.by_id.get(entry.id) != entry:
                return "key_revoked"
            case TokenKey() as key if self._tokens is None or key not in self._tokens.keys:
                return "key_revoked"
        return None

    async def ended(self, caller: Caller) -> Ending:
        """Return once a caller may not go on, with the reason."""
        while (reason := self.ending(caller)) is None:
            left_s = LOOK_S if caller.expires_s is None else caller.expires_s - self._time_s()
            await asyncio.sleep(min(LOOK_S, max(0.0, left_s)))
        return reason

    async def watch(self) -> None:
        """Read files again when they have changed, until cancelled."""
        while True:
            await asyncio.sleep(LOOK_S)
            await self.refresh()

    async def refresh(self) -> None:
        """Read the files again if they have changed. If one cannot be used, all keys stay as they are."""
        states = await asyncio.to_thread(self._look)
        if states == self._states:
            return
        self._states = states
        try:
            keys = self._keys if self._read_keys is None else await asyncio.to_thread(self._read_keys)
            tokens = self._tokens if self._read_tokens is None else await asyncio.to_thread(self._read_tokens)
        except NafirError as exc:
            _logger.error("keys were not read again, those read before stay in force: %s", exc)
            return
        self._keys, self._tokens = keys, tokens
        count = len(tokens.keys) if tokens else 0
        _logger.info("keys were read again: %d API keys, %d token keys", len(keys.by_id), count)

    def _look(self) -> tuple[_FileState | None, ...]:
        return tuple(_FileState.of(path) for path in self._files)


def _printable(subject: str) -> str:
    """A subject as logs show it: one line, and short. A long one ends in a digest, so that two stay different."""
    shown = subject if subject.isprintable() else subject.encode("unicode_escape").decode()
    if len(shown) <= _SHOWN_SUBJECT:
        return shown
    return f"{shown[:_SHOWN_SUBJECT]}…{hashlib.sha256(subject.encode('utf-8', 'surrogatepass')).hexdigest()[:8]}"
