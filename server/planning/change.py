"""The change in sound that leaving something out makes."""

from dataclasses import dataclass

from server.acoustics.audibility import JND_THRESHOLDS

MOST_JND = 100.0
"""Upper limit of a change, reached where a part of the sound is missing altogether: numbers stay finite."""


@dataclass(frozen=True)
class Change:
    """The change of the parameter that changes most, in just-noticeable differences (JND)."""

    jnd: float
    parameter: str


UNCHANGED = Change(0.0, "level")


def in_jnd(parameter: str, amount: float) -> Change:
    """Return the change for an amount in the parameter's own unit."""
    return Change(min(abs(float(amount)) / JND_THRESHOLDS[parameter].amount, MOST_JND), parameter)


def most(*changes: Change) -> Change:
    """Return the largest change, or the first of equal ones."""
    return max(changes, key=lambda change: change.jnd)
