"""First reflections at quality levels that reuse responses together with them.

Metres; responses (B, channel, sample).
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from server.acoustics.directivity import Directivity
from server.acoustics.geometry import Pose, Vector3
from server.field.lattice import Neighbourhood, Snapped, delay_response
from server.responses.early_reflections import EarlyReflections
from server.responses.radiation import Placed
from server.scene.manifest import QualityLevel


class Snapping(Protocol):
    """A field, as far as it says what stands for a pair of poses."""

    @property
    def level(self) -> QualityLevel: ...

    def snap(self, listener: Vector3, emitter: Vector3, yaw: float) -> Snapped: ...

    def find(self, listener: Vector3, emitter: Vector3, yaw: float) -> tuple[Snapped, Neighbourhood]: ...


class _AtNode(NamedTuple):
    pose: Pose
    directivity: Directivity


def add_first_reflections(
    field: Snapping,
    early: EarlyReflections,
    responses: npt.NDArray[np.float32],
    listener: Pose,
    emitters: Sequence[Placed],
) -> None:
    """As `EarlyReflections.add`, at a field's level: those of the poses, or those kept with the node's response."""
    reuse = field.level.reuse
    if reuse is None or reuse.first_reflections == "pose":
        early.add(responses, listener, emitters)
        return
    for response, emitter in zip(responses, emitters, strict=True):
        node, later = field.snap(listener.position, emitter.pose.position, listener.yaw)
        there = np.zeros_like(response)
        placed = _AtNode(Pose(node.emitter, emitter.pose.orientation), emitter.directivity)
        early.add(there[np.newaxis], Pose.from_yaw(node.listener, node.yaw), [placed])
        response += delay_response(there, later)
