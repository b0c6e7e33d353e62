"""Responses of a published layout that are listed first and read when they are asked for."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

_Point = tuple[float, float, float]
Sound = tuple[npt.NDArray[np.float32], int]
"""(channel, sample) and the sample rate."""


@dataclass(frozen=True)
class Pose:
    """Where a response was measured: metres, and radians counter-clockwise from +x."""

    listener: _Point
    emitter: _Point
    yaw: float = 0.0


@dataclass(frozen=True)
class Entry:
    """One response of a source.

    name: what splits and predictions call it. file: the file that holds it. pair: the same for all headings, and for
    both directions between two places, where one place can be either end. group: the responses between which a method
    may interpolate without turning a head or changing the room. `pose` and `response` read from the source; both raise
    UnreadableError.
    """

    name: str
    file: Path
    pair: str
    pose: Callable[[], Pose]
    response: Callable[[], Sound]
    group: str = ""


def at(pose: Pose) -> Callable[[], Pose]:
    """The `pose` of an entry whose place is known already."""
    return lambda: pose
