"""What a field says in several states of its scene's doors."""

from collections.abc import Callable
from typing import Generic, TypeVar

from server.acoustics.doors import Openness
from server.field.field import AcousticField

_T = TypeVar("_T")


class ByState(Generic[_T]):
    """What is made of a field, once for each state in which it is asked for."""

    def __init__(self, field: AcousticField, make: Callable[[AcousticField], _T]) -> None:
        self._field, self._make = field, make
        self._made: dict[Openness | None, _T] = {}

    def at(self, openness: Openness | None) -> _T:
        """With the doors so far open, or for None as at the beginning."""
        if openness not in self._made:
            field = self._field
            moved = field if openness is None else field.within(field.bundle.with_doors(openness))
            self._made[openness] = self._make(moved)
        return self._made[openness]
