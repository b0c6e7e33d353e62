"""What a client measures of its stream."""

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

_KEPT = 1_000
"""Durations of which quantiles are made: the newest so many."""


class Durations:
    """The newest durations of a kind, in milliseconds."""

    def __init__(self) -> None:
        self._ms: deque[float] = deque(maxlen=_KEPT)

    def __len__(self) -> int:
        return len(self._ms)

    def add(self, duration_s: float) -> None:
        self._ms.append(1000 * duration_s)

    def quantile_ms(self, share: float) -> float:
        """NaN before the first."""
        return float(np.quantile(list(self._ms), share)) if self._ms else math.nan

    @property
    def median_ms(self) -> float:
        return self.quantile_ms(0.5)


class PoseWaits:
    """Durations from a pose to the first block that has it or a newer one."""

    def __init__(self) -> None:
        self.durations = Durations()
        self._sent_s: dict[int, float] = {}

    def send(self, pose_id: int, now_s: float) -> None:
        self._sent_s[pose_id] = now_s
        if len(self._sent_s) > _KEPT:
            del self._sent_s[next(iter(self._sent_s))]

    def receive(self, pose_id: int, now_s: float) -> None:
        while self._sent_s and (oldest := next(iter(self._sent_s))) <= pose_id:
            self.durations.add(now_s - self._sent_s.pop(oldest))

    def forget(self) -> None:
        """Poses on their way are lost with the connection."""
        self._sent_s.clear()


@dataclass
class ListenerStatistics:
    """Counts of one listener's blocks since it began, over all connections, and durations of late."""

    blocks: int = 0
    blocks_late: int = 0
    """Blocks that the server sent too late."""
    blocks_skipped: int = 0
    """Blocks that the server left out while the client acknowledged nothing."""
    blocks_dropped: int = 0
    """Blocks that were not taken from the stream in time."""
    blocks_limited: int = 0
    underruns: int = 0
    """How often a player found nothing to play."""
    pose_to_sound: PoseWaits = field(default_factory=PoseWaits)
    """From a pose of the listener to its direct sound; of the first listener's also from those of emitters."""
    pose_to_reverberation: PoseWaits = field(default_factory=PoseWaits)

    def sentences(self) -> list[str]:
        """What is worth telling after a recording, a line each."""
        kinds = {"direct sound": self.pose_to_sound.durations, "reverberation": self.pose_to_reverberation.durations}
        waits = [
            f"{kind}: {len(waits)} poses, received {waits.median_ms:.0f} ms after they were sent"
            for kind, waits in kinds.items()
        ]
        return [*waits, f"{self.blocks_late} blocks late"]

    def summary(self) -> dict[str, float]:
        """Everything as numbers: counts, and medians in milliseconds; NaN where nothing was measured."""
        counts = "blocks", "blocks_late", "blocks_skipped", "blocks_dropped", "blocks_limited", "underruns"
        return {
            **{name: getattr(self, name) for name in counts},
            "pose_to_sound_ms": self.pose_to_sound.durations.median_ms,
            "pose_to_reverberation_ms": self.pose_to_reverberation.durations.median_ms,
        }


@dataclass
class StreamStatistics(ListenerStatistics):
    """Those of the first listener, and of the stream's connections."""

    reconnections: int = 0
    resumptions: int = 0
    """How many of them went on with the stream; the others began it anew."""
    round_trip: Durations = field(default_factory=Durations)

    def summary(self) -> dict[str, float]:
        return {
            **super().summary(),
            "reconnections": self.reconnections,
            "resumptions": self.resumptions,
            "round_trip_ms": self.round_trip.median_ms,
        }
