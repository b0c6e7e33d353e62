"""Responses that are kept to be used again for poses near those that they were computed for.

Axes: B poses; responses (B, channel, sample). Metres, radians.
"""

import copy
from typing import Protocol

import numpy as np

from server.acoustics.geometry import Vector3
from server.core.bounded_cache import BoundedCache
from server.field.lattice import Neighbourhood, Node, Snapped, delay_response
from server.field.response_source import Compute, Float32, Floats, ResponseSource
from server.kernels.array_pool import ArrayPool
from server.scene.manifest import QualityLevel

NodeCache = BoundedCache[tuple[object, ...], object]
"""Responses of nodes, and what was prepared of them, of all levels of a scene, by whatever they depend on."""

NODE_CACHE_BYTES = 64 * 1024 * 1024
_POOL = ArrayPool(16 * 1024 * 1024)


class Nodes(Protocol):
    """Says which node stands for a pair of poses; `server.field.lattice.Lattice` is one. A function of poses alone."""

    def snap(self, listener: Vector3, emitter: Vector3, yaw: float) -> Snapped: ...

    def find(self, listener: Vector3, emitter: Vector3, yaw: float) -> tuple[Snapped, Neighbourhood]: ...

    def moved(self, rng: np.random.Generator) -> "Nodes": ...


class NodeResponses(ResponseSource):
    """The responses of one level at its nodes. They are a function of the poses alone: whether a response was kept, or
    with which others it was asked for, makes no difference to a bit."""

    def __init__(self, level: QualityLevel, nodes: Nodes, compute: Compute, cache: NodeCache) -> None:
        self._nodes = nodes
        self._compute = compute
        self._cache = cache
        # Levels that differ in their nodes alone share those that they have in common.
        self._made_by = (level.field, level.phase, level.frames)

    def responses(
        self,
        listeners: Floats,
        emitters: Floats,
        yaws: Floats,
        *,
        remember: bool = False,  # noqa: ARG002  a node's response does not depend on the one before it
    ) -> Float32:
        found = [(self._at(node), later) for node, later in self._snapped(listeners, emitters, yaws)]
        responses = _POOL.floats(len(found), *found[0][0].shape)
        for (response, later), result in zip(found, responses, strict=True):
            delay_response(response, later, result)
        return responses

    def computed_for(self, listeners: Floats, emitters: Floats, yaws: Floats) -> tuple[Floats, Floats, Floats]:
        nodes = [node for node, _ in self._snapped(listeners, emitters, yaws)]
        return (
            np.array([node.listener for node in nodes]),
            np.array([node.emitter for node in nodes]),
            np.array([node.yaw for node in nodes]),
        )

    def snap(self, listener: Vector3, emitter: Vector3, yaw: float) -> Snapped:
        return self._nodes.snap(listener, emitter, yaw)

    def find(self, listener: Vector3, emitter: Vector3, yaw: float) -> tuple[Snapped, Neighbourhood]:
        return self._nodes.find(listener, emitter, yaw)

    def response(self, snapped: Snapped) -> Float32:
        return delay_response(self._at(snapped.node), snapped.later_samples)

    def moved(self, rng: np.random.Generator) -> "NodeResponses":
        """Keeps responses in the same cache."""
        moved = copy.copy(self)
        moved._nodes = self._nodes.moved(rng)
        return moved

    def _at(self, node: Node) -> Float32:
        """(channel, sample); not to be written to."""
        key = (self._made_by, node)
        response = self._cache.get(key)
        if not isinstance(response, np.ndarray):
            # One by one: in a batch the last bits depend on the others.
            response = self._compute(np.array([node.listener]), np.array([node.emitter]), np.array([node.yaw]))[0]
            self._cache.put(key, response, response.nbytes)
        return response

    def _snapped(self, listeners: Floats, emitters: Floats, yaws: Floats) -> list[Snapped]:
        poses = zip(listeners.tolist(), emitters.tolist(), yaws.tolist(), strict=True)
        return [self._nodes.snap(_point(listener), _point(emitter), yaw) for listener, emitter, yaw in poses]


def _point(values: list[float]) -> Vector3:
    x, y, z = values
    return (x, y, z)
