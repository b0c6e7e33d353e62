"""A decision about an effect, and when it is called for: what the planners of rendering and of simulations share."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Generic, TypeVar

Name = TypeVar("Name", bound=StrEnum)


@dataclass(frozen=True)
class Decision(Generic[Name]):
    """On or off of one effect. `change_jnd` is what leaving it out changes, in just-noticeable differences of the
    `parameter` that changes most. Where it was `overridden`, `reason` says what was predicted too."""

    name: Name
    called_for: bool
    change_jnd: float
    parameter: str
    reason: str
    overridden: bool = False


@dataclass(frozen=True)
class Threshold:
    """An effect is called for from `enter_jnd` on, and stays so down to `leave_jnd`: nothing flutters about it."""

    enter_jnd: float
    leave_jnd: float

    def is_reached(self, change_jnd: float, *, was_on: bool = False) -> bool:
        return change_jnd >= (self.leave_jnd if was_on else self.enter_jnd)

    def decides(self, change_jnd: float, wanted: bool | None, *, was_on: bool = False) -> bool:
        """Whether an effect is on: as it is `wanted`, if anybody wants anything."""
        return self.is_reached(change_jnd, was_on=was_on) if wanted is None else wanted
