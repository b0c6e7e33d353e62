"""Poses at which a scene is checked. A client may ask for each of them.

A pose is a row of seven: listener x, y, z, emitter x, y, z, and yaw, in metres and radians.
"""

from itertools import product

import numpy as np
import numpy.typing as npt
from scipy.stats import qmc

from server.scene.bundle import Bundle

Poses = npt.NDArray[np.float64]
"""(pose, 7) array of poses."""

LISTENER, EMITTER, YAW = slice(0, 3), slice(3, 6), 6
_QUARTERS = np.array([0.0, 0.5, 1.0, -0.5]) * np.pi


def allowed(bundle: Bundle, poses: Poses) -> npt.NDArray[np.bool_]:
    """(pose,) whether listener and emitter are within bounds and not inside a wall."""
    bounds, surroundings = bundle.manifest.bounds, bundle.surroundings
    return np.asarray(
        np.logical_and.reduce(
            [
                np.all((ends >= bounds.minimum) & (ends <= bounds.maximum), axis=-1) & surroundings.contains(ends)
                for ends in (poses[:, LISTENER], poses[:, EMITTER])
            ]
        )
    )


def corners(bundle: Bundle) -> Poses:
    """Poses with listener and emitter at every corner of the bounds that is allowed, also both at the same corner. The
    head turns by a quarter from pose to pose."""
    bounds = bundle.manifest.bounds
    points = list(product(*zip(bounds.minimum, bounds.maximum, strict=True)))
    poses = np.array([(*listener, *emitter) for listener in points for emitter in points])
    yaws = _QUARTERS[np.arange(len(poses)) % len(_QUARTERS)]
    return within(bundle, np.concatenate([poses, yaws[:, None]], axis=1))


def scattered(bundle: Bundle, count: int, seed: int) -> Poses:
    """`count` poses spread evenly over all that are allowed (Sobol sequence). A larger count adds poses and keeps the
    first ones."""
    bounds = bundle.manifest.bounds
    low = np.array([*bounds.minimum, *bounds.minimum, -np.pi])
    high = np.array([*bounds.maximum, *bounds.maximum, np.pi])
    sequence = qmc.Sobol(7, rng=np.random.default_rng([seed, 1]))
    found = np.empty((0, 7))
    while len(found) < count:
        found = np.concatenate([found, within(bundle, low + sequence.random(1024) * (high - low))])
    return found[:count]


def within(bundle: Bundle, poses: Poses) -> Poses:
    """The poses that are allowed."""
    return poses[allowed(bundle, poses)]
