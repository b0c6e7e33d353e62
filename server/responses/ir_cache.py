"""Impulse responses (IRs) ready to be convolved, kept where a quality level reuses them.

What a response is made of says which poses share it, so that nobody asks for one that is already heard. Where first
reflections are the pose's own, the rest is kept, and the stages of partitions that they do not reach are used again.
"""

from collections.abc import Hashable, Sequence
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from server.acoustics.directivity import OMNIDIRECTIONAL
from server.acoustics.geometry import Pose
from server.field.field import AcousticField
from server.field.lattice import Neighbourhood, Snapped, delay_response
from server.field.reuse import Kept, NodeResponses
from server.rendering.convolver import PartitionedIr
from server.responses.early_reflections import EarlyReflections
from server.responses.node_reflections import Snapping, add_first_reflections
from server.responses.radiation import Placed
from server.scene.manifest import QualityLevel


class Preparer(Protocol):
    """A renderer, as far as it makes IRs ready on any thread."""

    @property
    def preparation(self) -> Hashable: ...

    def prepare(
        self, ir: npt.NDArray[np.floating], *, like: PartitionedIr | None = None, same_from: int = 0
    ) -> PartitionedIr: ...


class _Late(NamedTuple):
    samples: npt.NDArray[np.float32]
    prepared: PartitionedIr


class Shared(NamedTuple):
    """What is equal where poses have the same response, whole, and which listeners are sure to have that one too as
    long as nothing else changes."""

    identity: Hashable
    around: Neighbourhood


def shared_response(field: Snapping, early: EarlyReflections | None, listener: Pose, emitter: Placed) -> Shared | None:
    """At a field's level; None where each pose has a response of its own."""
    if field.level.reuse is None or _has_own_reflections(field.level, early):
        return None
    snapped, around = field.find(listener.position, emitter.pose.position, listener.yaw)
    return Shared(_identity(field.level, early, snapped, emitter), around)


def _has_own_reflections(level: QualityLevel, early: EarlyReflections | None) -> bool:
    """Of each pose, at a level that reuses responses."""
    return early is not None and level.reuse is not None and level.reuse.first_reflections == "pose"


def _identity(level: QualityLevel, early: EarlyReflections | None, snapped: Snapped, emitter: Placed) -> Hashable:
    beam = None
    if early is not None and emitter.directivity != OMNIDIRECTIONAL:
        beam = emitter.directivity, emitter.pose.orientation
    return level.name, snapped, beam


def prepared_irs(
    field: AcousticField,
    kept: Kept,
    early: EarlyReflections | None,
    preparer: Preparer,
    listener: Pose,
    emitters: Sequence[Placed],
) -> tuple[PartitionedIr, ...]:
    """One per emitter, at a level that reuses responses: taken from `kept` as far as they are there. Raises ValueError
    where the field is not finite."""
    assert field.nodes is not None
    return tuple(_prepared(field, field.nodes, kept, early, preparer, listener, emitter) for emitter in emitters)


def _prepared(
    field: AcousticField,
    nodes: NodeResponses,
    kept: Kept,
    early: EarlyReflections | None,
    preparer: Preparer,
    listener: Pose,
    emitter: Placed,
) -> PartitionedIr:
    if early is not None and _has_own_reflections(field.level, early):
        return _with_first_reflections(field, nodes, kept, early, preparer, listener, emitter)
    snapped = field.snap(listener.position, emitter.pose.position, listener.yaw)
    identity = _identity(field.level, early, snapped, emitter)
    key = identity, None if early is None else early.filters, preparer.preparation
    ir = kept.get(key)
    if not isinstance(ir, PartitionedIr):
        node, later = snapped
        samples = delay_response(nodes.at(node), later)
        if early is not None:
            add_first_reflections(field, early, samples[np.newaxis], listener, [emitter])
        ir = preparer.prepare(samples)
        kept.put(key, ir, ir.nbytes)
    return ir


def _with_first_reflections(
    field: AcousticField,
    nodes: NodeResponses,
    kept: Kept,
    early: EarlyReflections,
    preparer: Preparer,
    listener: Pose,
    emitter: Placed,
) -> PartitionedIr:
    node, later = field.snap(listener.position, emitter.pose.position, listener.yaw)
    key = field.level.name, node, later, preparer.preparation
    late = kept.get(key)
    if not isinstance(late, _Late):
        samples = delay_response(nodes.at(node), later)
        late = _Late(samples, preparer.prepare(samples))
        kept.put(key, late, samples.nbytes + late.prepared.nbytes)
    samples = late.samples.copy()
    early.add(samples[np.newaxis], listener, [emitter])
    return preparer.prepare(samples, like=late.prepared, same_from=early.end_samples)
