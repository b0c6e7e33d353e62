"""Whether something moves, and how fast, estimated from its latest poses.

Lengths are in metres; clocks are in seconds of sound.
"""

import math

from server.acoustics.geometry import Pose
from server.planning.scene_acoustics import WALKING_M_S

REST_S = 2.0
"""Time after the last change of a pose from which an object counts as at rest."""
_FASTEST_M_S = 100.0
_SHORTEST_S = 0.02
"""Least interval between two poses for an estimate of speed: shorter ones say nothing of it."""


class Motion:
    """The motion of a listener or an emitter that is at `pose` from `clock_s` on, and rests there until it is moved."""

    def __init__(self, pose: Pose, clock_s: float) -> None:
        self._pose = pose
        self._clock_s = clock_s
        self._moved_s = self._turned_s = -math.inf
        self._speed_m_s = 0.0

    def follow(self, pose: Pose, clock_s: float) -> None:
        """Note a pose from now on, whether or not it has changed."""
        if pose.position != self._pose.position:
            took_s = max(clock_s - self._clock_s, _SHORTEST_S)
            speed_m_s = min(math.dist(pose.position, self._pose.position) / took_s, _FASTEST_M_S)
            before_m_s = self._speed_m_s if self.moves(clock_s) else 0.0
            self._speed_m_s = max(speed_m_s, before_m_s * math.exp((self._clock_s - clock_s) / REST_S))
            self._moved_s = clock_s
        if pose.orientation != self._pose.orientation:
            self._turned_s = clock_s
        self._pose, self._clock_s = pose, clock_s

    def moves(self, clock_s: float) -> bool:
        return clock_s - self._moved_s < REST_S

    def turns(self, clock_s: float) -> bool:
        return clock_s - self._turned_s < REST_S

    def speed_m_s(self, clock_s: float) -> float:
        """Return an upper bound of the speed, in steps that double from walking pace; 0 at rest."""
        if not self.moves(clock_s):
            return 0.0
        doublings = math.ceil(math.log2(max(self._speed_m_s / WALKING_M_S, 1.0)))
        return WALKING_M_S * float(2**doublings)
