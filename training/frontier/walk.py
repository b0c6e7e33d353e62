"""The walk on which quality levels are measured: a listener strolls through a scene and looks around.

Metres, radians, seconds.
"""

import math
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import Pose, Vector3
from server.scene.bundle import Bundle

SPEED_M_PER_S = 1.4
POSES_PER_S = 20
_GLANCE_RAD = math.radians(60)
_GLANCE_S = 5.0
_MOST_TURN_RAD_PER_S = math.pi
_Floats = npt.NDArray[np.float64]


def walk(bundle: Bundle, *, duration_s: float, poses_per_s: float = POSES_PER_S, seed: int) -> list[Pose]:
    """The poses of a listener who walks straight from one place to the next one in sight, at constant ear height,
    looking ahead and to both sides in turn. The places are the same for the same seed, at any rate of poses."""
    rng = np.random.default_rng([seed, 11])
    step_m = SPEED_M_PER_S / poses_per_s
    poses: list[Pose] = []
    places = _places(bundle, rng)
    at, heading = next(places), 0.0
    towards = next(places)
    while len(poses) < duration_s * poses_per_s:
        left_m = float(np.linalg.norm(towards - at))
        if left_m <= step_m:
            at, towards = towards, next(places)
        else:
            at = at + (towards - at) * (step_m / left_m)
        ahead = math.atan2(towards[1] - at[1], towards[0] - at[0])
        most = _MOST_TURN_RAD_PER_S / poses_per_s
        heading += min(most, max(-most, math.remainder(ahead - heading, math.tau)))
        glance = _GLANCE_RAD * math.sin(math.tau * len(poses) / poses_per_s / _GLANCE_S)
        poses.append(Pose.from_yaw(_point(at), heading + glance))
    return poses


def _places(bundle: Bundle, rng: np.random.Generator) -> Iterator[_Floats]:
    """An endless sequence of places at the height of the scene's start, each in sight of the one before."""
    low, high = np.array(bundle.manifest.bounds.minimum), np.array(bundle.manifest.bounds.maximum)
    at = np.array(bundle.manifest.start.listener)
    low[2] = high[2] = at[2]
    while True:
        yield at
        while True:
            place = rng.uniform(low, high)
            if bundle.surroundings.contains(place) and bundle.surroundings.is_visible(at, place):
                break
        at = place


def _point(place: _Floats) -> Vector3:
    x, y, z = place.tolist()
    return (x, y, z)
