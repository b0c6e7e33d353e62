"""Responses kept to be used again for poses near those that they were computed for.

Axes: B poses; responses (B, channel, sample). Metres, radians.
"""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import Vector3
from server.acoustics.sound_path import SoundPathFinder
from server.core.bounded_cache import BoundedCache
from server.field.lattice import Lattice, Node, Snapped, delay_response
from server.kernels.array_pool import ArrayPool
from server.scene.bundle import Bundle
from server.scene.manifest import QualityLevel

Float32 = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]
Kept = BoundedCache[tuple[object, ...], object]
"""What all levels of a scene keep, by whatever it depends on."""

KEPT_BYTES = 64 * 1024 * 1024
_POOL = ArrayPool(16 * 1024 * 1024)


class NodeResponses:
    """The responses of one level at the nodes of its lattice; thread-safe, and a function of the poses alone: whether
    a response was kept, or with which others it was asked for, makes no difference to a bit."""

    def __init__(
        self,
        bundle: Bundle,
        level: QualityLevel,
        paths: SoundPathFinder,
        compute: Callable[[Floats, Floats, Floats], Float32],
        kept: Kept,
    ) -> None:
        """`compute` gives responses of listeners (B, 3), emitters (B, 3), yaws (B,)."""
        assert level.reuse is not None
        self.lattice = Lattice(bundle, level.reuse, paths)
        self._compute = compute
        self._kept = kept
        # Levels that differ in their lattice alone share the nodes they have in common.
        self._made_by = (level.field, level.phase, level.frames)

    def at(self, node: Node) -> Float32:
        """(channel, sample); not to be written to."""
        key = (self._made_by, node)
        response = self._kept.get(key)
        if not isinstance(response, np.ndarray):
            # One by one: in a batch the last bits depend on the others.
            response = self._compute(np.array([node.listener]), np.array([node.emitter]), np.array([node.yaw]))[0]
            self._kept.put(key, response, response.nbytes)
        return response

    def responses(self, listeners: Floats, emitters: Floats, yaws: Floats) -> Float32:
        """(B, channel, sample), arrays of their own."""
        found = [(self.at(node), later) for node, later in self._snapped(listeners, emitters, yaws)]
        responses = _POOL.floats(len(found), *found[0][0].shape)
        for (response, later), result in zip(found, responses, strict=True):
            delay_response(response, later, result)
        return responses

    def nodes(self, listeners: Floats, emitters: Floats, yaws: Floats) -> tuple[Floats, Floats, Floats]:
        """Listeners, emitters and yaws of the nodes."""
        nodes = [node for node, _ in self._snapped(listeners, emitters, yaws)]
        return (
            np.array([node.listener for node in nodes]),
            np.array([node.emitter for node in nodes]),
            np.array([node.yaw for node in nodes]),
        )

    def _snapped(self, listeners: Floats, emitters: Floats, yaws: Floats) -> list[Snapped]:
        poses = zip(listeners.tolist(), emitters.tolist(), yaws.tolist(), strict=True)
        return [self.lattice.snap(_point(listener), _point(emitter), yaw) for listener, emitter, yaw in poses]


def _point(values: list[float]) -> Vector3:
    x, y, z = values
    return (x, y, z)
