"""A cache of responses at nodes, reused for poses near them.

Axes: B poses; responses (B, channel, sample). Metres, radians.
"""

import copy
from typing import Protocol

import numpy as np

from server.acoustics.geometry import Vector3, yaws_of
from server.core.bounded_cache import BoundedCache
from server.field.lattice import Neighbourhood, Node, Snapped, delay_response
from server.field.response_source import Compute, Float32, Floats, ResponseSource
from server.kernels.array_pool import ArrayPool
from server.scene.manifest import QualityLevel

NodeCache = BoundedCache[tuple[object, ...], object]
"""Responses of the nodes of all levels of a scene, and objects prepared from them, each by a key of everything that it
depends on."""

NODE_CACHE_BYTES = 64 * 1024 * 1024
_POOL = ArrayPool(16 * 1024 * 1024)


class Nodes(Protocol):
    """Maps a pair of poses to the node that represents it, depending only on the poses; for example
    `server.field.lattice.Lattice`."""

    def snap(self, listener: Vector3, emitter: Vector3, yaw: float) -> Snapped: ...

    def find(self, listener: Vector3, emitter: Vector3, yaw: float) -> tuple[Snapped, Neighbourhood]: ...

    def moved(self, rng: np.random.Generator) -> "Nodes": ...


class NodeResponses(ResponseSource):
    """The responses of one level at its nodes. They depend only on the poses: it makes no difference, not even to the
    last bit, whether a response was cached or which others were requested with it."""

    def __init__(self, level: QualityLevel, nodes: Nodes, compute: Compute, cache: NodeCache) -> None:
        self._nodes = nodes
        self._compute = compute
        self._cache = cache
        # Levels that differ only in their nodes share the responses of common nodes.
        self._made_by = (level.field, level.phase, level.frames)

    def responses(
        self,
        listeners: Floats,
        emitters: Floats,
        heads: Floats,
        *,
        remember: bool = False,  # noqa: ARG002  a node's response does not depend on the one before it
    ) -> Float32:
        found = [(self._at(node), later) for node, later in self._snapped(listeners, emitters, heads)]
        responses = _POOL.floats(len(found), *found[0][0].shape)
        for (response, later), result in zip(found, responses, strict=True):
            delay_response(response, later, result)
        return responses

    def computed_for(self, listeners: Floats, emitters: Floats, heads: Floats) -> tuple[Floats, Floats, Floats]:
        nodes = [node for node, _ in self._snapped(listeners, emitters, heads)]
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
        """The same with moved nodes and the same cache."""
        moved = copy.copy(self)
        moved._nodes = self._nodes.moved(rng)
        return moved

    def _at(self, node: Node) -> Float32:
        """The response (channel, sample) of a node; read-only."""
        key = (self._made_by, node)
        response = self._cache.get(key)
        if not isinstance(response, np.ndarray):
            # One by one, because in a batch the last bits depend on the other poses.
            response = self._compute(np.array([node.listener]), np.array([node.emitter]), np.array([node.yaw]))[0]
            self._cache.put(key, response, response.nbytes)
        return response

    def _snapped(self, listeners: Floats, emitters: Floats, heads: Floats) -> list[Snapped]:
        poses = zip(listeners.tolist(), emitters.tolist(), yaws_of(heads).tolist(), strict=True)
        return [self._nodes.snap(_point(listener), _point(emitter), yaw) for listener, emitter, yaw in poses]


def _point(values: list[float]) -> Vector3:
    x, y, z = values
    return (x, y, z)
