"""How long things take in a stream, and how long it waits for them. Seconds."""

from collections import deque

from server.core.durations import DurationHistogram


class PoseTimes:
    """How long poses take from their arrival to the first block that has them, or a newer one."""

    def __init__(self) -> None:
        self.durations = DurationHistogram()
        # Where a field fails, poses wait in vain; the oldest are forgotten.
        self._waiting: deque[tuple[int, float]] = deque(maxlen=1024)

    def arrive(self, pose_id: int, now_s: float) -> None:
        self._waiting.append((pose_id, now_s))

    def take_effect(self, pose_id: int, now_s: float) -> None:
        while self._waiting and self._waiting[0][0] <= pose_id:
            self.durations.add(now_s - self._waiting.popleft()[1])


class StreamTimes:
    """Since the stream began."""

    def __init__(self) -> None:
        self.render = DurationHistogram()
        """Of a block."""
        self.lateness = DurationHistogram()
        """After a block was due, until it was ready."""
        self.response = DurationHistogram()
        """Of a request for impulse responses, on its worker."""
        self.pose = PoseTimes()
        """Until the direct sound follows."""
        self.reverberation = PoseTimes()
        """Until what comes after it does."""

    def arrive(self, pose_id: int, now_s: float) -> None:
        self.pose.arrive(pose_id, now_s)
        self.reverberation.arrive(pose_id, now_s)


class ResponseWait:
    """How long impulse responses are in coming: from when they are called for, be it that they wait for their turn, to
    their answer."""

    def __init__(self) -> None:
        self.since_s: float | None = None
        """None where none are called for."""
        self._longest_s: float | None = None

    def note(self, is_waiting: bool, now_s: float) -> None:
        """Whether some are called for now."""
        if not is_waiting:
            self.since_s = None
        elif self.since_s is None:
            self.since_s = now_s

    def end(self, now_s: float) -> None:
        """The answer is there."""
        if self.since_s is not None:
            self._longest_s = max(self._longest_s or 0.0, now_s - self.since_s)
            self.since_s = None

    def restart(self, now_s: float) -> None:
        """Forget how long it has been so far."""
        self._longest_s = None
        if self.since_s is not None:
            self.since_s = now_s

    def take_longest_s(self, now_s: float) -> float | None:
        """Since this was asked last, of answers and of what still waits; None where nothing was called for."""
        waits_s = [] if self.since_s is None else [now_s - self.since_s]
        if self._longest_s is not None:
            waits_s.append(self._longest_s)
        self._longest_s = None
        return max(waits_s, default=None)
