"""Impulse responses (IRs) ready to be convolved, kept where a quality level reuses them.

What a response is made of says which poses share it, so that none is asked for that is already heard. Where first
reflections are the pose's own, the rest is kept, and the stages of partitions that they do not reach are used again.
"""

from collections.abc import Hashable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from server.acoustics.directivity import OMNIDIRECTIONAL
from server.acoustics.geometry import Pose
from server.field.field import AcousticField
from server.field.lattice import Neighbourhood, Snapped
from server.field.node_responses import NodeCache
from server.rendering.convolver import PartitionedIr
from server.rendering.renderer import Renderer
from server.responses.early_reflections import EarlyReflections
from server.responses.emitter_state import EmitterState
from server.responses.node_reflections import add_first_reflections
from server.scene.manifest import QualityLevel


class _Late(NamedTuple):
    samples: npt.NDArray[np.float32]
    prepared: PartitionedIr


class Shared(NamedTuple):
    """What is equal where poses have the same response, whole, and which listeners are sure to have that one too as
    long as nothing else changes."""

    identity: Hashable
    around: Neighbourhood


def shared_response(
    field: AcousticField, early: EarlyReflections | None, listener: Pose, emitter: EmitterState
) -> Shared | None:
    """At a field's level; None where each pose has a response of its own."""
    if not field.kind.shares_whole_responses(has_reflections=early is not None):
        return None
    snapped, around = field.find(listener.position, emitter.pose.position, listener.yaw)
    return Shared(_identity(field.level, early, snapped, emitter), around)


def _identity(level: QualityLevel, early: EarlyReflections | None, snapped: Snapped, emitter: EmitterState) -> Hashable:
    beam = None
    if early is not None and emitter.directivity != OMNIDIRECTIONAL:
        beam = emitter.directivity, emitter.pose.orientation
    return level.name, snapped, beam


def prepared_irs(
    field: AcousticField,
    cache: NodeCache,
    early: EarlyReflections | None,
    renderer: Renderer,
    listener: Pose,
    emitters: Sequence[EmitterState],
) -> tuple[PartitionedIr, ...]:
    """One per emitter, at a level that reuses responses: taken from `cache` as far as they are there. Raises ValueError
    where the field is not finite."""
    if early is None or field.kind.shares_reflections:
        return tuple(_whole(field, cache, early, renderer, listener, emitter) for emitter in emitters)
    return tuple(_with_first_reflections(field, cache, early, renderer, listener, emitter) for emitter in emitters)


def _whole(
    field: AcousticField,
    cache: NodeCache,
    early: EarlyReflections | None,
    renderer: Renderer,
    listener: Pose,
    emitter: EmitterState,
) -> PartitionedIr:
    snapped = field.snap(listener.position, emitter.pose.position, listener.yaw)
    identity = _identity(field.level, early, snapped, emitter)
    key = identity, None if early is None else early.filters, renderer.preparation
    ir = cache.get(key)
    if not isinstance(ir, PartitionedIr):
        samples = field.source.response(snapped)
        if early is not None:
            add_first_reflections(field, early, samples[np.newaxis], listener, [emitter])
        ir = renderer.prepare(samples)
        cache.put(key, ir, ir.nbytes)
    return ir


def _with_first_reflections(
    field: AcousticField,
    cache: NodeCache,
    early: EarlyReflections,
    renderer: Renderer,
    listener: Pose,
    emitter: EmitterState,
) -> PartitionedIr:
    snapped = field.snap(listener.position, emitter.pose.position, listener.yaw)
    key = field.level.name, *snapped, renderer.preparation
    late = cache.get(key)
    if not isinstance(late, _Late):
        samples = field.source.response(snapped)
        late = _Late(samples, renderer.prepare(samples))
        cache.put(key, late, samples.nbytes + late.prepared.nbytes)
    samples = late.samples.copy()
    early.add(samples[np.newaxis], listener, [emitter])
    return renderer.prepare(samples, like=late.prepared, same_from=early.end_samples)
