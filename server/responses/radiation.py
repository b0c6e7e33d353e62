"""How oriented emitters radiate: their gain in a direction of the world, and the level at which they excite a room."""

import math

import numpy as np
import numpy.typing as npt

from server.acoustics.decibels import db_to_power
from server.acoustics.directivity import OMNIDIRECTIONAL, Directivity
from server.acoustics.geometry import Quaternion, Vector3
from server.responses.emitter_state import EmitterState


def departure_gain_db(emitter: EmitterState, departure: npt.NDArray[np.float64]) -> npt.NDArray[np.float64] | float:
    """Return the gain (band,) in dB of sound that leaves an emitter in a direction (3,) of the world; 0 for an
    omnidirectional one."""
    if emitter.directivity == OMNIDIRECTIONAL:
        return 0.0
    return emitter.directivity.gain_db(seen_from(emitter.pose.orientation, departure.tolist()))


def seen_from(orientation: Quaternion, direction: Vector3) -> Vector3:
    """Return a direction of the world in the frame of an object turned by `orientation`."""
    qx, qy, qz, qw = orientation
    x, y, z = direction
    # v - w t + q x t with t = 2 q x v, in scalars: NumPy takes ten times as long for three numbers.
    tx, ty, tz = 2 * (qy * z - qz * y), 2 * (qz * x - qx * z), 2 * (qx * y - qy * x)
    return (
        x - qw * tx + qy * tz - qz * ty,
        y - qw * ty + qz * tx - qx * tz,
        z - qw * tz + qx * ty - qy * tx,
    )


def reverberation_gain(directivity: Directivity) -> float:
    """Return the amplitude at which an emitter excites a room, relative to an omnidirectional one as loud as this one
    ahead: the root of the power averaged over all directions and octave bands."""
    return math.sqrt(np.mean(db_to_power(directivity.diffuse_gain_db)))
