"""Impulse responses (IRs) that a session asks for, and how they are computed."""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import Pose
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.rendering.convolver import PartitionedIr
from server.rendering.renderer import Renderer
from server.responses.direct_sound import DirectSound
from server.responses.downmix import binaural_to_mono
from server.responses.emitter_state import EmitterState
from server.responses.ir_cache import prepared_irs
from server.responses.node_reflections import add_first_reflections


@dataclass(frozen=True)
class AskedIr:
    """The response of one emitter as it was; `serial` tells it from others of the same id, and `identity` its response
    from others where poses share responses."""

    serial: int
    state: EmitterState
    identity: Hashable | None = None


@dataclass(frozen=True)
class IrRequest:
    """IRs of a quality level wanted for the poses as they were when `pose_id` was the newest, for two ears of a head or
    for one without."""

    pose_id: int
    level: str
    listener: Pose
    asked: tuple[AskedIr, ...]
    """Of those emitters whose IR is out of date."""
    direct_sound: DirectSound
    """What the field's IRs leave out, as this session's head hears it."""
    channels: int = 2
    is_first: bool = False
    """Whether an emitter has none yet, and waits to be heard."""


@dataclass(frozen=True)
class IrResponse:
    request: IrRequest
    irs: tuple[PartitionedIr, ...]
    """One for each that was asked for."""


def compute_irs(levels: FieldsByLevel, request: IrRequest, renderer: Renderer) -> IrResponse:
    """Answer a request: milliseconds of work, for a worker thread. Raises ValueError where the field is not finite."""
    field, direct = levels[request.level], request.direct_sound
    renderer.prepare_hearing(request.channels)
    emitters = [asked.state for asked in request.asked]
    is_whole = all(emitter.effects.late and emitter.effects.early for emitter in emitters)
    bakes_direct = any(emitter.effects.bakes_direct for emitter in emitters)
    if field.kind.reuses_responses and is_whole and not bakes_direct and request.channels == 2:
        early = direct.early_reflections
        kept = prepared_irs(field, levels.node_cache, early, renderer, request.listener, emitters)
        return IrResponse(request, kept)
    irs = composed_irs(field, direct, request.listener, emitters, request.channels, remember=True)
    return IrResponse(request, tuple(renderer.prepare(ir if is_whole else _without_end(ir)) for ir in irs))


def composed_irs(
    field: AcousticField,
    direct: DirectSound,
    listener: Pose,
    emitters: Sequence[EmitterState],
    channels: int = 2,
    *,
    remember: bool = False,
) -> npt.NDArray[np.float32]:
    """(B, channel, sample) the responses of emitters, of the parts that their effects call for: the field is asked for
    none but those whose late part is. `remember` is as in `AcousticField.impulse_responses`."""
    count = len(emitters)
    held = _held(field, direct, listener, emitters, remember=remember)
    if direct.binauralization is not None:
        places = [emitter.pose.position for emitter in emitters]
        return direct.binauralization.binauralize(held, listener, places) if channels == 2 else held
    irs = binaural_to_mono(held, field.sample_rate) if channels == 1 else held
    early = direct.early(channels)
    mirrored = [row for row, emitter in enumerate(emitters) if emitter.effects.early]
    if early is not None and 0 < len(mirrored) == count:
        add_first_reflections(field, early, irs, listener, emitters)
    elif early is not None and mirrored:
        reflected = irs[mirrored]
        add_first_reflections(field, early, reflected, listener, [emitters[row] for row in mirrored])
        irs[mirrored] = reflected
    standing = [row for row, emitter in enumerate(emitters) if emitter.effects.bakes_direct]
    if standing:
        whole = irs[standing]
        direct.add(whole, listener, [emitters[row] for row in standing])
        irs[standing] = whole
    return irs


def _held(
    field: AcousticField, direct: DirectSound, listener: Pose, emitters: Sequence[EmitterState], *, remember: bool
) -> npt.NDArray[np.float32]:
    """(B, channel, sample) of the field, an array of its own; zeros for those whose late part is off."""
    late = [row for row, emitter in enumerate(emitters) if emitter.effects.late]
    channels = 2 if direct.binauralization is None else 1
    if not late:
        return np.zeros((len(emitters), channels, field.ir_samples), np.float32)
    heads = np.tile(np.asarray(listener.position), (len(late), 1))
    places = np.array([emitters[row].pose.position for row in late])
    answer = field.impulse_responses(heads, places, np.full(len(late), listener.yaw), remember=remember)
    if direct.field_gain != 1.0:
        answer *= np.float32(direct.field_gain)
    if len(late) == len(emitters):
        return answer
    held = np.zeros((len(emitters), channels, field.ir_samples), np.float32)
    held[late] = answer
    return held


def _without_end(ir: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """(channel, sample) up to the last sample that is not zero, one at least."""
    if ir[:, -1].any():
        return ir  # nearly always, and at once
    heard = ir != 0
    ends = [ir.shape[1] - int(np.argmax(channel[::-1])) for channel in heard if channel.any()]
    return ir[:, : max(ends, default=1)]
