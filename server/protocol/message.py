"""The base class and the common types of all messages of a stream."""

from typing import Annotated

from pydantic import BaseModel, BeforeValidator, ConfigDict, FiniteFloat

from server.core.numerals import as_whole

WHOLE = BeforeValidator(as_whole)
"""Accepts 1.0 as an integer (`as_whole`). It has to come after the other annotations of a number, or the schema leaves
those out."""
Integer = Annotated[int, WHOLE]
Position = tuple[FiniteFloat, FiniteFloat, FiniteFloat]


class Message(BaseModel):
    # Unknown fields are refused. With a misspelt "orientaton" the head would otherwise never turn.
    # guard: numbers are not read from anything else
    # guard: fields that are unknown are refused
    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")

    def serialize(self) -> str:
        return self.model_dump_json()
