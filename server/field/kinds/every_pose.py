"""Levels whose responses are computed anew for every pose."""

import numpy as np

from server.acoustics.geometry import Vector3
from server.acoustics.sound_path import SoundPathFinder
from server.field.kinds.level_kind import LevelKind
from server.field.lattice import Neighbourhood, Node, Snapped
from server.field.node_responses import NodeCache
from server.field.response_source import Compute, Float32, Floats, ResponseSource
from server.scene.bundle import Bundle
from server.scene.manifest import QualityLevel


class EveryPose(LevelKind):
    reuses_responses = False

    @classmethod
    def matches(cls, level: QualityLevel) -> bool:  # noqa: ARG003  any, if no other kind has it
        return True

    def open(
        self,
        bundle: Bundle,  # noqa: ARG002  the network knows the scene
        paths: SoundPathFinder,  # noqa: ARG002
        compute: Compute,
        cache: NodeCache,  # noqa: ARG002  nothing is kept
    ) -> ResponseSource:
        return ComputedResponses(compute)


class ComputedResponses(ResponseSource):
    """The source of responses that are computed for every pose: each pose represents itself."""

    def __init__(self, compute: Compute) -> None:
        self._compute = compute

    def responses(self, listeners: Floats, emitters: Floats, heads: Floats, *, remember: bool = False) -> Float32:
        return self._compute(listeners, emitters, heads, remember=remember)

    def computed_for(self, listeners: Floats, emitters: Floats, heads: Floats) -> tuple[Floats, Floats, Floats]:
        return listeners, emitters, heads

    def snap(self, listener: Vector3, emitter: Vector3, yaw: float) -> Snapped:
        return Snapped(Node(listener, emitter, yaw), 0)

    def find(self, listener: Vector3, emitter: Vector3, yaw: float) -> tuple[Snapped, Neighbourhood]:
        no_other = Neighbourhood(
            listener=listener, radius_m=0.0, emitter=emitter, nearest_m=0.0, farthest_m=0.0, yaw=yaw, arc_rad=0.0
        )
        return self.snap(listener, emitter, yaw), no_other

    def response(self, snapped: Snapped) -> Float32:
        node = snapped.node
        (response,) = self._compute(np.array([node.listener]), np.array([node.emitter]), np.array([node.yaw]))
        return np.asarray(response)

    def moved(self, rng: np.random.Generator) -> "ComputedResponses":  # noqa: ARG002  there is nothing to move
        return self
