"""By how much leaving something out changes what is heard."""

from dataclasses import dataclass

from server.acoustics.audibility import JND_THRESHOLDS

MOST_JND = 100.0
"""Where something is missing altogether; numbers stay finite."""


@dataclass(frozen=True)
class Change:
    """Of the parameter that changes most, in just-noticeable differences (JND)."""

    jnd: float
    parameter: str


UNCHANGED = Change(0.0, "level")


def in_jnd(parameter: str, amount: float) -> Change:
    """Of an amount in the parameter's own unit."""
    return Change(min(abs(float(amount)) / JND_THRESHOLDS[parameter].amount, MOST_JND), parameter)


def most(*changes: Change) -> Change:
    """The largest, the first of several that are as large."""
    return max(changes, key=lambda change: change.jnd)
