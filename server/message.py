"""What messages of a stream have in common, whichever way they go."""

from pydantic import BaseModel, ConfigDict, FiniteFloat

Position = tuple[FiniteFloat, FiniteFloat, FiniteFloat]


class Message(BaseModel):
    # Unknown fields are refused: a misspelt "orientaton" would otherwise be heard as a head that never turns.
    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")

    def serialize(self) -> str:
        return self.model_dump_json()
