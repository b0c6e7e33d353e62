"""A lattice of nodes that represent the poses around them. A quality level that reuses responses computes them only at
nodes.

Around a corner, a node would have other walls near it than the pose. Therefore a pose only gets a node that it can see,
and listener and emitter see each other in the node if and only if they do in the poses. Poses close to a wall may find
no such node in their cell, and get one of a smaller cell; within centimetres of the wall, they are nodes themselves.

Metres, radians; positions in world axes.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import Pose, Vector3
from server.acoustics.sound_path import SoundPathFinder
from server.field.lattice_kernel import find_node
from server.scene.bundle import Bundle
from server.scene.manifest import Reuse

_LEAST_STEP_M = 0.25
"""Responses are shifted in time in steps of at least the time that sound takes for this distance. An error of at most
0.4 ms is inaudible in reflected sound, while every step costs an exchange of responses."""
_ARRIVALS = 4096
_LEAST_M, _LEAST_RAD = 1e-6, 1e-9
"""Margins to the points at which rounding changes the result; within them, a neighbourhood is not certain."""
_MOST_MOVED_M = 0.25


class Node(NamedTuple):
    """The positions of listener and emitter, and the heading of the listener."""

    listener: Vector3
    emitter: Vector3
    yaw: float


class Snapped(NamedTuple):
    """The response that stands for a pair of poses: that of `node`, shifted by `later_samples` of the scene's own rate
    (earlier if negative) so that reflected sound keeps its delay after the direct sound."""

    node: Node
    later_samples: int


class Neighbourhood(NamedTuple):
    """The listener poses around one pose that are certain to have the same response for an emitter at rest: positions
    within a ball and between two distances from the emitter, headings within an arc."""

    listener: Vector3
    radius_m: float
    emitter: Vector3
    nearest_m: float
    farthest_m: float
    yaw: float
    arc_rad: float
    """Half the arc, to either side of `yaw`."""

    def holds(self, pose: Pose) -> bool:
        """Whether a pose is in the neighbourhood. This takes less than a microsecond, while `Lattice.find` takes
        several."""
        if math.dist(pose.position, self.listener) >= self.radius_m:
            return False
        if not self.nearest_m < math.dist(pose.position, self.emitter) < self.farthest_m:
            return False
        return self.arc_rad == math.inf or abs(math.remainder(pose.yaw - self.yaw, math.tau)) < self.arc_rad


class Lattice:
    """The nodes of one scene for one `Reuse`; safe to share between threads.

    Cells fill the bounds evenly, and nodes are in the middle of cells. `offset` (3,) moves the nodes by less than half
    a cell, and `turned` turns their headings.
    """

    def __init__(
        self,
        bundle: Bundle,
        reuse: Reuse,
        paths: SoundPathFinder,
        offset: Vector3 = (0.0, 0.0, 0.0),
        turned: float = 0.0,
    ) -> None:
        manifest = bundle.manifest
        self._bundle, self._reuse, self._paths = bundle, reuse, paths
        self._spacing_m = reuse.spacing_m
        self._turns = math.ceil(360 / reuse.turn_deg - 1e-9)
        self._turn_rad = math.tau / self._turns
        self._corners = np.ascontiguousarray(bundle.floor_plan.walls[:, 0])
        self._low, self._high = np.array(manifest.bounds.minimum), np.array(manifest.bounds.maximum)
        self._offset = np.array(offset)
        self._turned = turned
        self._step_m = max(_LEAST_STEP_M, reuse.spacing_m / 4)
        self._samples_per_step = self._step_m / manifest.speed_of_sound * manifest.codec.sample_rate
        self._bent_m = lru_cache(_ARRIVALS)(self._length_m)

    def snap(self, listener: Vector3, emitter: Vector3, yaw: float) -> Snapped:
        """The node and delay for poses within the bounds. They depend only on the poses; this takes a few
        microseconds."""
        return self._find(listener, emitter, yaw, looks_about=False)[0]

    def find(self, listener: Vector3, emitter: Vector3, yaw: float) -> tuple[Snapped, Neighbourhood]:
        """As `snap`, and also the other listener poses that certainly have the same result."""
        return self._find(listener, emitter, yaw, looks_about=True)

    def moved(self, rng: np.random.Generator) -> "Lattice":
        """The same lattice with its nodes moved at random, by up to 25 cm or half a cell, and its headings turned by
        any angle."""
        most_m = min(_MOST_MOVED_M, self._reuse.spacing_m / 2)
        x, y, z = map(float, rng.uniform(-most_m, most_m, 3))
        turned = rng.uniform(-math.pi, math.pi)
        return Lattice(self._bundle, self._reuse, self._paths, (x, y, z), turned)

    def _find(
        self, listener: Vector3, emitter: Vector3, yaw: float, *, looks_about: bool
    ) -> tuple[Snapped, Neighbourhood]:
        in_sight, (*place, ex, ey, ez), radius_m = find_node(
            self._corners, self._low, self._high, self._offset, self._spacing_m, *listener, *emitter, looks_about
        )
        there: Vector3 = (place[0], place[1], place[2])
        turns = (yaw - self._turned) / self._turn_rad
        heading = round(turns)
        node = Node(there, (ex, ey, ez), heading % self._turns * self._turn_rad + self._turned)
        reach_m = self._step_m / 2 - _LEAST_M
        nearest_m, farthest_m = -math.inf, math.inf
        if in_sight:
            way_m, there_m = math.dist(listener, emitter), math.dist(there, node.emitter)
            steps = round((way_m - there_m) / self._step_m)
            nearest_m = there_m + steps * self._step_m - reach_m
            farthest_m = there_m + steps * self._step_m + reach_m
        else:
            way_m, there_m = self._length_m(listener, emitter), self._bent_m(there, node.emitter)
            steps = round((way_m - there_m) / self._step_m)
            # A path around corners becomes longer by at most the distance that the listener moves.
            radius_m = min(radius_m, reach_m - abs(way_m - there_m - steps * self._step_m))
        arc_rad = math.inf if self._turns == 1 else (0.5 - abs(turns - heading)) * self._turn_rad - _LEAST_RAD
        around = Neighbourhood(
            listener=listener,
            radius_m=radius_m,
            emitter=emitter,
            nearest_m=nearest_m,
            farthest_m=farthest_m,
            yaw=yaw,
            arc_rad=arc_rad,
        )
        return Snapped(node, round(steps * self._samples_per_step)), around

    def _length_m(self, listener: Vector3, emitter: Vector3) -> float:
        return float(self._paths.find(np.array(listener), np.array([emitter])).length_m[0])


def delay_response(
    response: npt.NDArray[np.float32], later_samples: int, result: npt.NDArray[np.float32] | None = None
) -> npt.NDArray[np.float32]:
    """Delay a response (channel, sample) by `later_samples`, padded with zeros; samples beyond its end or before its
    beginning are lost. Written to `result` if that is given."""
    later_samples = max(-response.shape[1], min(later_samples, response.shape[1]))
    if result is None:
        result = np.empty_like(response)
    if later_samples >= 0:
        result[:, :later_samples] = 0
        result[:, later_samples:] = response[:, : response.shape[1] - later_samples]
    else:
        result[:, :later_samples] = response[:, -later_samples:]
        result[:, later_samples:] = 0
    return result
