"""What messages of a stream have in common, whichever way they go."""

from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, FiniteFloat


def _read_whole(value: Any) -> Any:
    return int(value) if isinstance(value, float) and value.is_integer() else value


WHOLE = BeforeValidator(_read_whole)
"""Takes 1.0 for the integer that JSON Schema says it is: encoders of Lua and C# write integers so. It has to come last,
after what else is asked of a number, or the schema does not tell the rest."""
Integer = Annotated[int, WHOLE]
Position = tuple[FiniteFloat, FiniteFloat, FiniteFloat]


class Message(BaseModel):
    # Unknown fields are refused: a misspelt "orientaton" would otherwise be heard as a head that never turns.
    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")

    def serialize(self) -> str:
        return self.model_dump_json()
