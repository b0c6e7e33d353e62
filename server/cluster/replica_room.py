"""What a replica says about its room for more streams, and how much of it is left after some more were sent there."""

from collections.abc import Mapping
from typing import Any

HEADROOM = "headroom"
"""The name of a replica's measurement: the share of it that is free for more streams, from 0 to 1."""
STREAMS = "streams"
"""The name of the number of its streams at that time."""
_SHARE = 1 / 64
"""Share of a replica that a stream is taken to cost where there is none to judge by."""


def room(measured: Mapping[str, Any], streams: int | None) -> float:
    """The share of a replica that is left, from what it has `measured`, now that it has so many `streams` (None if that
    is not known): each that is new costs as much as the others do on average. Below 0 it was sent more than fits."""
    headroom, before = float(measured.get(HEADROOM, 1.0)), int(measured.get(STREAMS, 0))
    share = (1.0 - headroom) / before if before else _SHARE
    return headroom - share * max(0, (before if streams is None else streams) - before)
