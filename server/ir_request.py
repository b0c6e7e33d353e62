"""Impulse responses (IRs) that a session asks for, and how they are computed."""

from collections.abc import Hashable
from dataclasses import dataclass

import numpy as np

from server.acoustics.directivity import Directivity
from server.acoustics.geometry import Pose
from server.binaural import Binauralization
from server.early_reflections import EarlyReflections
from server.field.levels import Levels
from server.kept_irs import Preparer, prepared_irs
from server.rendering.convolver import PartitionedIr


@dataclass(frozen=True)
class EmitterSnapshot:
    """An emitter as it was when its IR was asked for; `serial` tells it from others of the same id."""

    serial: int
    pose: Pose
    directivity: Directivity
    identity: Hashable | None = None
    """Of the response asked for, where poses share responses."""


@dataclass(frozen=True)
class IrRequest:
    """IRs of a quality level wanted for the poses as they were when `pose_id` was the newest."""

    pose_id: int
    level: str
    listener: Pose
    emitters: tuple[EmitterSnapshot, ...]
    """Those whose IR is out of date."""
    early_reflections: EarlyReflections | None
    """What the field's IRs leave out, as this session's head hears it; None where they hold it."""
    binauralization: Binauralization | None = None
    """How this session's head hears the IRs of a field that has no ears."""


@dataclass(frozen=True)
class IrResponse:
    request: IrRequest
    irs: tuple[PartitionedIr, ...]
    """One per emitter of the request."""


def compute_irs(levels: Levels, request: IrRequest, preparer: Preparer) -> IrResponse:
    """Answer a request: milliseconds of work, for a worker thread. Raises FieldError where the field has no finite response."""
    field, early = levels[request.level], request.early_reflections
    if field.level.reuse is not None:
        irs_at_nodes = prepared_irs(field, levels.kept, early, preparer, request.listener, request.emitters)
        return IrResponse(request, irs_at_nodes)
    count = len(request.emitters)
    places = [emitter.pose.position for emitter in request.emitters]
    irs = field.impulse_responses(
        np.tile(np.asarray(request.listener.position), (count, 1)),
        np.asarray(places),
        np.full(count, request.listener.yaw),
        remember=True,
    )
    if early is not None:
        early.add(irs, request.listener, request.emitters)
    if request.binauralization is not None:
        irs = request.binauralization.hear(irs, request.listener, places)
    return IrResponse(request, tuple(preparer.prepare(ir) for ir in irs))
