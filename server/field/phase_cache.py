"""A cache of recent responses, whose phases are the starting points for nearby poses.

Metres. Orientations are quaternions (4,) x, y, z, w.
"""

import math
import threading
from collections import OrderedDict

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import axes_of

Float32 = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]

CELL_M = 0.05
"""Of poses that agree within this distance, only the newest response is kept."""
RADIUS_M = 0.5
"""Poses within this distance are near. The distance is the root of a sum of squares: of the listener's motion, the
emitter's motion, and the motion of an ear as the head turns."""
CAPACITY = 64

_EAR_M = 0.0875
_NOWHERE = math.inf


class PhaseCache:
    """The last `capacity` responses by pose; safe to share between threads. The least recently used one is replaced."""

    def __init__(self, capacity: int = CAPACITY) -> None:
        self._lock = threading.Lock()
        self._places: OrderedDict[tuple[int, ...], int] = OrderedDict()
        self._poses = np.full((capacity, 9), _NOWHERE)
        self._responses: list[Float32 | None] = [None] * capacity

    def nearest(self, listener: Floats, emitter: Floats, orientation: Floats) -> Float32 | None:
        """The response of the nearest pose within RADIUS_M, or None; read-only."""
        pose = _pose(listener, emitter, orientation)
        with self._lock:
            distance = np.linalg.norm(self._poses - pose, axis=-1)
            place = int(np.argmin(distance))
            # guard: warm phases are those near by
            if not distance[place] <= RADIUS_M:
                return None
            self._places.move_to_end(_cell(self._poses[place]))
            return self._responses[place]

    def keep(self, listener: Floats, emitter: Floats, orientation: Floats, response: Float32) -> None:
        """Store a copy of a response; a silent one has no phase and is not stored."""
        # guard: a silent response gives no phase
        if not response.any():
            return
        pose, own = _pose(listener, emitter, orientation), response.copy()
        cell = _cell(pose)
        with self._lock:
            if cell in self._places:
                place = self._places[cell]
            elif len(self._places) < len(self._responses):
                place = len(self._places)
            else:
                _, place = self._places.popitem(last=False)
            self._places[cell] = place
            self._places.move_to_end(cell)
            self._poses[place] = pose
            self._responses[place] = own


def _pose(listener: Floats, emitter: Floats, orientation: Floats) -> Floats:
    """(9,) metres: coordinates of the poses, with the head as the position of an ear, such that their
    Euclidean distance measures how far two pairs of poses are apart."""
    _, left, _ = axes_of(orientation)
    return np.array([*listener, *emitter, *(_EAR_M * left)])


def _cell(pose: Floats) -> tuple[int, ...]:
    return tuple(np.floor(pose / CELL_M).astype(int).tolist())
