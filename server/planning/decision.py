"""A decision about an effect and its threshold, shared by the planners of rendering and of simulations."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Generic, TypeVar

Name = TypeVar("Name", bound=StrEnum)


@dataclass(frozen=True)
class Decision(Generic[Name]):
    """Whether one effect is on, and why. `change_jnd` is what leaving it out changes, in just-noticeable differences of
    the `parameter` that changes most. For a decision that was `overridden`, `reason` includes the prediction too."""

    name: Name
    called_for: bool
    change_jnd: float
    parameter: str
    reason: str
    overridden: bool = False


@dataclass(frozen=True)
class Threshold:
    """An effect switches on at `enter_jnd` and stays on down to `leave_jnd`, so that it does not flutter."""

    enter_jnd: float
    leave_jnd: float

    def is_reached(self, change_jnd: float, *, was_on: bool = False) -> bool:
        return change_jnd >= (self.leave_jnd if was_on else self.enter_jnd)

    def decides(self, change_jnd: float, wanted: bool | None, *, was_on: bool = False) -> bool:
        """Return whether an effect is on: `wanted` if it is not None, else whether the threshold is reached."""
        return self.is_reached(change_jnd, was_on=was_on) if wanted is None else wanted
