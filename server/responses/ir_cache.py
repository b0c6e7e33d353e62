"""A cache of impulse responses (IRs), prepared for convolution, at quality levels that reuse them.

The identity of a response tells which poses share it, so that a response that is already playing is not requested
again. Where first reflections differ between poses, the rest of the response is cached, with the partitions that the
reflections do not reach.
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
    """The `identity` of a response, which is equal for all poses with the same full response, and the listener poses
    `around` it that are sure to have it as long as nothing else changes."""

    identity: Hashable
    around: Neighbourhood


def shared_response(
    field: AcousticField, early: EarlyReflections | None, listener: Pose, emitter: EmitterState
) -> Shared | None:
    """Return the shared response of a pose at a field's level; None where each pose has a response of its own."""
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
    """Return a prepared IR per emitter at a level that reuses responses, taken from `cache` where possible. Raises
    ValueError if the field's output is not finite."""
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
    key = identity, field.sample_rate, None if early is None else early.filters, renderer.preparation
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
    key = field.level.name, *snapped, field.sample_rate, renderer.preparation
    late = cache.get(key)
    if not isinstance(late, _Late):
        samples = field.source.response(snapped)
        late = _Late(samples, renderer.prepare(samples))
        cache.put(key, late, samples.nbytes + late.prepared.nbytes)
    samples = late.samples.copy()
    early.add(samples[np.newaxis], listener, [emitter], remember=True)
    return renderer.prepare(samples, like=late.prepared, same_from=early.end_samples)
