"""Durations in a stream, of its work and of its waits, in seconds."""

from collections import deque

from server.core.durations import DurationHistogram

_MOST_WAITING = 1024
"""Poses of a stream that may wait: half a minute of them."""


class PoseTimes:
    """Durations from a pose's arrival to the first block that uses it or a newer one."""

    def __init__(self) -> None:
        self.durations = DurationHistogram()
        self._waiting: deque[tuple[int, float]] = deque()

    def arrive(self, pose_id: int, now_s: float) -> None:
        if len(self._waiting) == _MOST_WAITING:
            # If a field fails, poses never take effect. The oldest counts with its wait so far, or waits would look
            # the better the more poses never take effect.
            self.durations.add(now_s - self._waiting.popleft()[1])
        self._waiting.append((pose_id, now_s))

    def take_effect(self, pose_id: int, now_s: float) -> None:
        while self._waiting and self._waiting[0][0] <= pose_id:
            self.durations.add(now_s - self._waiting.popleft()[1])


class StreamTimes:
    """All durations since the stream began."""

    def __init__(self) -> None:
        self.render = DurationHistogram()
        """Time to render a block."""
        self.lateness = DurationHistogram()
        """Time from a block's due time until it was ready."""
        self.response = DurationHistogram()
        """Time of a request for impulse responses on its worker."""
        self.pose = PoseTimes()
        """Time until the direct sound follows a pose."""
        self.reverberation = PoseTimes()
        """Time until reflections and reverberation follow a pose."""

    def arrive(self, pose_id: int, now_s: float) -> None:
        self.pose.arrive(pose_id, now_s)
        self.reverberation.arrive(pose_id, now_s)

    def merge(self, other: "StreamTimes") -> None:
        """Add the durations of others."""
        self.render.merge(other.render)
        self.lateness.merge(other.lateness)
        self.response.merge(other.response)
        self.pose.durations.merge(other.pose.durations)
        self.reverberation.durations.merge(other.reverberation.durations)


class ResponseWait:
    """Waiting times for impulse responses, from when they are needed to their answer; waiting for a turn counts."""

    def __init__(self) -> None:
        self.since_s: float | None = None
        """Since when impulse responses are needed; None if none are."""
        self._longest_s: float | None = None

    def note(self, is_waiting: bool, now_s: float) -> None:
        """Note whether impulse responses are needed now."""
        if not is_waiting:
            self.since_s = None
        elif self.since_s is None:
            self.since_s = now_s

    def end(self, now_s: float) -> None:
        """Note that the answer has arrived."""
        if self.since_s is not None:
            self._longest_s = max(self._longest_s or 0.0, now_s - self.since_s)
            self.since_s = None

    def restart(self, now_s: float) -> None:
        """Restart the present wait from now."""
        self._longest_s = None
        if self.since_s is not None:
            self.since_s = now_s

    def take_longest_s(self, now_s: float) -> float | None:
        """Return the longest wait since the last call, finished or not; None if no impulse responses were needed."""
        waits_s = [] if self.since_s is None else [now_s - self.since_s]
        if self._longest_s is not None:
            waits_s.append(self._longest_s)
        self._longest_s = None
        return max(waits_s, default=None)
