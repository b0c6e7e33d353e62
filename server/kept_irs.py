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
from server.early_reflections import EarlyReflections
from server.field.field import AcousticField
from server.field.lattice import Neighbourhood, moved
from server.field.reuse import Kept, NodeResponses
from server.node_reflections import Snapping, add_first_reflections
from server.radiation import Placed
from server.rendering.convolver import PartitionedIr


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
    reuse = field.level.reuse
    if reuse is None or (early is not None and reuse.first_reflections == "pose"):
        return None
    beam = None
    if early is not None and emitter.directivity != OMNIDIRECTIONAL:
        beam = emitter.directivity, emitter.pose.orientation
    snapped, around = field.find(listener.position, emitter.pose.position, listener.yaw)
    return Shared((field.level.name, snapped, beam), around)


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
    shared = shared_response(field, early, listener, emitter)
    if shared is None and early is not None:
        return _with_first_reflections(field, nodes, kept, early, preparer, listener, emitter)
    key = shared and shared.identity, None if early is None else early.filters, preparer.preparation
    ir = kept.get(key)
    if not isinstance(ir, PartitionedIr):
        node, later = field.snap(listener.position, emitter.pose.position, listener.yaw)
        samples = moved(nodes.at(node), later)
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
        samples = moved(nodes.at(node), later)
        late = _Late(samples, preparer.prepare(samples))
        kept.put(key, late, samples.nbytes + late.prepared.nbytes)
    samples = late.samples.copy()
    early.add(samples[np.newaxis], listener, [emitter])
    return preparer.prepare(samples, like=late.prepared, same_from=early.end_samples)
