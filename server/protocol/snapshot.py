"""The state of a stream as plain data, from which it goes on after its connection, its process or its host was lost.

A snapshot consists of the messages that would bring about the state: a hello, an `add_emitter` for each emitter, and an
`add_listener` for each listener but the first. So it is validated as they are when it comes back, and a field that a
message gains is kept by itself. Where clips are follows from the sample clock.

A *sealed* snapshot is one that a client keeps: text with a signature, which any server takes that has the same secret.
It is no secret, since it says only what the client itself has said.
"""

import base64
import binascii
import hashlib
import hmac
import struct
import zlib
from dataclasses import dataclass
from typing import Annotated, Final

from pydantic import Field, ValidationError

from server.core.errors import RequestError
from server.protocol.client_messages import MOST_LISTENERS, AddEmitter, AddListener, Hello, PoseId, StopEmitter
from server.protocol.message import Message

MOST_SEALED: Final = 48 * 1024
"""Longest sealed snapshot, which fits into a message."""
_SIGNED_FOR: Final = b"nafir snapshot 2:"
"""Keeps signatures apart from any others by the same secret, and of another form."""
_TIMES: Final = struct.Struct("<dd")
_SIGNATURE_BYTES: Final = hashlib.sha256().digest_size
MOST_BYTES = 512 * 1024
"""Longest snapshot as JSON. Sixteen emitters with measured directivities of five degrees have a tenth of it."""


class KeptEmitter(Message):
    """An emitter of a stream. `emitter` is the message that adds it as it is now. It is audible `since` this sample
    clock; null means not yet. `stop` is the message that stops its clip, if one came. `ends` says whether an
    `emitter_ended` is still to come. `newest_block` is the sequence of its newest dry block, -1 before the first."""

    emitter: AddEmitter
    since: Annotated[int, Field(ge=0)] | None
    stop: StopEmitter | None = None
    ends: bool = False
    newest_block: Annotated[int, Field(ge=-1, lt=2**32)] = -1


class KeptListener(Message):
    """A listener beside the first: the message that adds it as it is now, and its number."""

    listener: AddListener
    index: Annotated[int, Field(ge=1, le=255)]


class Snapshot(Message):
    """A stream before the block that begins at `sample_clock` and would be sent with `sequence`. `pose_id` is the
    newest pose, and `handled` how many of the client's other messages are in effect or were refused."""

    session: Annotated[str, Field(max_length=64)]
    hello: Hello
    sample_clock: Annotated[int, Field(ge=0, lt=2**62)]
    sequence: Annotated[int, Field(ge=0, lt=2**62)]
    pose_id: PoseId
    handled: Annotated[int, Field(ge=0, lt=2**53)]
    emitters: Annotated[tuple[KeptEmitter, ...], Field(max_length=64)]
    listeners: Annotated[tuple[KeptListener, ...], Field(max_length=MOST_LISTENERS)] = ()

    @classmethod
    def parse(cls, data: bytes) -> "Snapshot":
        """Read a snapshot from JSON. Raises RequestError unknown_resume_token for one that this version cannot read."""
        try:
            return cls.model_validate_json(data)
        except ValidationError as exc:
            problem = "the snapshot was made by another version of the server: begin with a hello"
            raise RequestError("unknown_resume_token", problem, field="snapshot") from exc


@dataclass(frozen=True)
class Seal:
    """Signs snapshots by HMAC-SHA256 with a `secret`. They are good for `lifetime_s`, and for the `owner` alone that
    they were closed for: text without a colon, empty where callers are not told apart."""

    secret: bytes
    lifetime_s: float

    def close(self, data: bytes, *, plays_at: float, now: float, owner: str = "") -> str | None:
        """Seal a snapshot as JSON whose next block plays at `plays_at`; None if it is too long. Times are seconds since
        1970."""
        payload = _TIMES.pack(plays_at, now + self.lifetime_s) + zlib.compress(data)
        sealed = base64.urlsafe_b64encode(self._sign(payload, owner) + payload).decode()
        return sealed if len(sealed) <= MOST_SEALED else None

    def open(self, sealed: str, *, now: float, owner: str = "") -> tuple[bytes, float]:
        """Return the snapshot as JSON, and when its next block would have played. Raises RequestError
        unknown_resume_token for one that this secret has not signed for this owner, or whose time is over."""
        try:
            signed = base64.b64decode(sealed, altchars=b"-_", validate=True)
        except (binascii.Error, ValueError):
            signed = b""
        signature, payload = signed[:_SIGNATURE_BYTES], signed[_SIGNATURE_BYTES:]
        # guard: nothing of a snapshot is read before its signature is checked
        if not hmac.compare_digest(signature, self._sign(payload, owner)):
            raise _unusable("the snapshot is not one of this server's, or was changed")
        plays_at, until = _TIMES.unpack_from(payload)
        if now > until:
            raise _unusable(f"the snapshot is older than {self.lifetime_s:g} s")
        return zlib.decompress(payload[_TIMES.size :]), plays_at

    def _sign(self, payload: bytes, owner: str) -> bytes:
        return hmac.digest(self.secret, _SIGNED_FOR + owner.encode() + b":" + payload, "sha256")


def _unusable(problem: str) -> RequestError:
    return RequestError("unknown_resume_token", f"{problem}: begin with a hello", field="snapshot", status=404)
