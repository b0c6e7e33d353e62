"""The state of a stream as plain data, from which it goes on after its connection, its process or its host was lost.

A snapshot consists of the messages that would bring about the state: a hello, and an `add_emitter` for each emitter. So
it is validated as they are when it comes back, and a field that a message gains is kept by itself. Where clips are
follows from the sample clock.
"""

from typing import Annotated

from pydantic import Field, ValidationError

from server.core.errors import RequestError
from server.protocol.client_messages import AddEmitter, Hello, PoseId, StopEmitter
from server.protocol.message import Message

MOST_BYTES = 512 * 1024
"""Longest snapshot as JSON. Sixteen emitters with measured directivities of five degrees have a tenth of it."""


class KeptEmitter(Message):
    """An emitter: the message that adds it as it is now, the sample clock `since` which it is audible, or null, the
    message that stops its clip, if one came, whether an `emitter_ended` is still to come, and the sequence of its
    newest dry block, -1 before the first."""

    emitter: AddEmitter
    since: Annotated[int, Field(ge=0)] | None
    stop: StopEmitter | None = None
    ends: bool = False
    newest_block: Annotated[int, Field(ge=-1, lt=2**32)] = -1


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

    @classmethod
    def parse(cls, data: bytes) -> "Snapshot":
        """Read a snapshot from JSON. Raises RequestError unknown_resume_token for one that this version cannot read."""
        try:
            return cls.model_validate_json(data)
        except ValidationError as exc:
            problem = "the snapshot was made by another version of the server: begin with a hello"
            raise RequestError("unknown_resume_token", problem, field="snapshot") from exc
