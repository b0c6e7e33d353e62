"""Where the listeners of a crowd walk in a scene, and where its emitters are."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from server.acoustics.geometry import Vector3
from server.core.errors import NafirError
from server.scene.bundle import Bundle

_WALK_M = 1.0
_LEAST_WALK_M = 0.05
_SWAY_M = 0.5
_CIRCLE = 64
"""Points of a circle at which it is checked."""
_TRIES = 10_000


@dataclass(frozen=True)
class Circle:
    """A horizontal circle on which a listener or an emitter moves."""

    centre: Vector3
    radius_m: float

    def at(self, angle: float) -> Vector3:
        """The point at an angle in radians."""
        x, y, z = self.centre
        return x + self.radius_m * math.cos(angle), y + self.radius_m * math.sin(angle), z


@dataclass(frozen=True)
class Places:
    """Places of a scene. Everything on the `walk`, and every emitter, is within the bounds and in sight of its
    centre."""

    bundle: Bundle
    walk: Circle
    """The way of every listener, around the place where the scene begins."""

    @classmethod
    def of(cls, bundle: Bundle) -> "Places":
        """Raises NafirError if there is no room to walk where the scene begins."""
        walk = largest_circle(bundle, bundle.manifest.start.listener, _WALK_M)
        if walk.radius_m < _LEAST_WALK_M:
            raise NafirError(f"scene {bundle.id}: nobody can walk around start.listener, it is too near to a wall")
        return cls(bundle, walk)

    def emitters(self, count: int, rng: np.random.Generator) -> list[Circle]:
        """`count` random places of emitters within the bounds, each with room to move.

        Raises NafirError if the bounds hold hardly any place inside the walls.
        """
        bounds, surroundings = self.bundle.manifest.bounds, self.bundle.surroundings
        found: list[Circle] = []
        for _ in range(_TRIES * count):
            x, y, z = rng.uniform(bounds.minimum, bounds.maximum).tolist()
            if surroundings.holds((x, y, z)):
                found.append(largest_circle(self.bundle, (x, y, z), _SWAY_M))
                if len(found) == count:
                    return found
        raise NafirError(f"scene {self.bundle.id}: its bounds hold no places for emitters")


def largest_circle(bundle: Bundle, centre: Vector3, most_m: float) -> Circle:
    """The largest horizontal circle around a place, of `most_m` or halves of it, of which all points are allowed
    positions in sight of the centre; of radius 0 if that would be under a centimetre."""
    radius_m = most_m
    while radius_m >= 0.01:
        circle = Circle(centre, radius_m)
        if _is_free(bundle, [circle.at(2 * math.pi * number / _CIRCLE) for number in range(_CIRCLE)], centre):
            return circle
        radius_m /= 2
    return Circle(centre, 0.0)


def _is_free(bundle: Bundle, points: Sequence[Vector3], centre: Vector3) -> bool:
    bounds, surroundings = bundle.manifest.bounds, bundle.surroundings
    at = np.asarray(points)
    is_allowed = np.all((at >= bounds.minimum) & (at <= bounds.maximum), axis=-1) & surroundings.contains(at)
    return bool(np.all(is_allowed & surroundings.is_visible(np.asarray(centre), at)))
