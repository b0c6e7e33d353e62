"""First reflections at quality levels that reuse responses together with their reflections.

Lengths are in metres; responses are (B, channel, sample).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import Pose
from server.field.field import AcousticField
from server.field.lattice import delay_response
from server.responses.early_reflections import EarlyReflections
from server.responses.emitter_state import EmitterState


def add_first_reflections(
    field: AcousticField,
    early: EarlyReflections,
    responses: npt.NDArray[np.float32],
    listener: Pose,
    emitters: Sequence[EmitterState],
    *,
    remember: bool = False,
) -> None:
    """Add first reflections as `EarlyReflections.add` does, at a field's level: those of the poses, or those of the
    lattice node whose response is reused."""
    if not field.kind.shares_reflections:
        early.add(responses, listener, emitters, remember=remember)
        return
    for response, emitter in zip(responses, emitters, strict=True):
        node, later = field.snap(listener.position, emitter.pose.position, listener.yaw)
        there = np.zeros_like(response)
        at_node = replace(emitter, pose=Pose(node.emitter, emitter.pose.orientation))
        early.add(there[np.newaxis], Pose.from_yaw(node.listener, node.yaw), [at_node])
        own_rate = field.bundle.manifest.codec.sample_rate
        response += delay_response(there, round(later * field.sample_rate / own_rate))
