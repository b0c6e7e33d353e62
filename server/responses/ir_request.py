"""Requests of a session for impulse responses (IRs), and their computation."""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.acoustics.doors import Openness
from server.acoustics.geometry import Pose
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.field.resampled_field import ResampledField
from server.rendering.convolver import PartitionedIr
from server.rendering.renderer import Renderer
from server.responses.direct_sound import DirectSound
from server.responses.downmix import binaural_to_mono
from server.responses.emitter_state import EmitterState
from server.responses.ir_cache import prepared_irs
from server.responses.node_reflections import add_first_reflections


@dataclass(frozen=True)
class AskedIr:
    """A requested response for one emitter, in the `state` that it had then. `serial` tells the emitter from others
    with the same id, and `identity` the response from others where poses share responses. If `like` is given, only the
    early part is computed, and the rest is that of `like`."""

    serial: int
    state: EmitterState
    identity: Hashable | None = None
    like: PartitionedIr | None = None


@dataclass(frozen=True)
class IrRequest:
    """A request for IRs of one quality level, for the poses at the time when `pose_id` was the newest, with two
    channels through a head, one without, or ambisonic ones."""

    pose_id: int
    level: str
    listener: Pose
    asked: tuple[AskedIr, ...]
    """The responses of emitters whose IR is out of date."""
    direct_sound: DirectSound
    """The direct sound and first reflections that the field's IRs leave out, as this session hears them."""
    channels: int = 2
    openness: Openness = ()
    """How far the scene's doors are open in the levels by which it is computed."""
    is_first: bool = False
    """Whether an emitter in the request waits for its first IR to become audible."""


@dataclass(frozen=True)
class IrResponse:
    request: IrRequest
    irs: tuple[PartitionedIr, ...]
    """One prepared IR for each that was requested."""


def compute_irs(levels: FieldsByLevel, request: IrRequest, renderer: Renderer) -> IrResponse:
    """Answer a request: milliseconds of work, for a worker thread. Raises ValueError if the field's output is not
    finite."""
    field, direct = levels[request.level], request.direct_sound
    renderer.prepare_hearing(request.channels)
    emitters = [asked.state for asked in request.asked]
    effects = [emitter.effects for emitter in emitters]
    is_whole = all(each.late and each.early for each in effects)
    reflects_all = is_whole and not any(each.bakes_direct for each in effects)
    if reflects_all and field.kind.reuses_responses and request.channels == 2:
        early = direct.early_reflections
        kept = prepared_irs(field, levels.node_cache, early, renderer, request.listener, emitters)
        return IrResponse(request, kept)
    likes = [asked.like for asked in request.asked]
    if not any(likes):
        irs = _streamed_irs(field, request, emitters, None, reflects_all=reflects_all)
        return IrResponse(request, tuple([renderer.prepare(ir if is_whole else _without_end(ir)) for ir in irs]))
    prepared: dict[int, PartitionedIr] = {}
    for is_early in (False, True):
        rows = [row for row, like in enumerate(likes) if (like is not None) == is_early]
        if not rows:
            continue
        samples = renderer.early_samples(request.channels) if is_early else None
        some = [emitters[row] for row in rows]
        irs = _streamed_irs(field, request, some, samples, reflects_all=reflects_all)
        for row, ir in zip(rows, irs, strict=True):
            if samples is not None:
                prepared[row] = renderer.prepare(ir, like=likes[row], same_from=samples)
            else:
                prepared[row] = renderer.prepare(ir if is_whole else _without_end(ir))
    return IrResponse(request, tuple([prepared[row] for row in range(len(emitters))]))


def _streamed_irs(
    field: AcousticField,
    request: IrRequest,
    emitters: Sequence[EmitterState],
    samples: int | None,
    *,
    reflects_all: bool,
) -> npt.NDArray[np.float32]:
    """Return what `composed_irs` does, in less time if the emitters' effects call for all reflected sound and nothing
    else (`reflects_all`), and two ears hear the field just as it answers."""
    direct, listener = request.direct_sound, request.listener
    if reflects_all and request.channels == 2 and field.level.tail == "bands" and direct.leaves_field_as_it_is:
        heard = direct.heard(field, 2)
        if heard.has_tail_apart:
            irs = heard.heard_by(listener, [emitter.pose.position for emitter in emitters], samples)
            if direct.early_reflections is not None:
                direct.early_reflections.add(irs, listener, emitters, remember=True)
            return irs
    return composed_irs(field, direct, listener, emitters, request.channels, remember=True, samples=samples)


def composed_irs(
    field: AcousticField,
    direct: DirectSound,
    listener: Pose,
    emitters: Sequence[EmitterState],
    channels: int = 2,
    *,
    remember: bool = False,
    samples: int | None = None,
) -> npt.NDArray[np.float32]:
    """Return responses (B, channel, sample) with the parts that the emitters' effects call for. The field computes only
    those of emitters with `late` on. `remember` is as in `AcousticField.impulse_responses`. With `samples`, only so
    many of each response are computed."""
    count = len(emitters)
    field, listener = direct.heard(field, channels), direct.axes_for(listener, channels)
    irs = _field_part(field, direct, listener, emitters, channels, remember=remember, samples=samples)
    if direct.binauralization is not None:
        return irs
    early = direct.early(channels)
    mirrored = [row for row, emitter in enumerate(emitters) if emitter.effects.early]
    if early is not None and 0 < len(mirrored) == count:
        add_first_reflections(field, early, irs, listener, emitters, remember=remember)
    elif early is not None and mirrored:
        reflected = irs[mirrored]
        some = [emitters[row] for row in mirrored]
        add_first_reflections(field, early, reflected, listener, some, remember=remember)
        irs[mirrored] = reflected
    standing = [row for row, emitter in enumerate(emitters) if emitter.effects.bakes_direct]
    if standing:
        whole = irs[standing]
        direct.add(whole, listener, [emitters[row] for row in standing])
        irs[standing] = whole
    return irs


def _field_part(
    field: AcousticField,
    direct: DirectSound,
    listener: Pose,
    emitters: Sequence[EmitterState],
    channels: int,
    *,
    remember: bool,
    samples: int | None,
) -> npt.NDArray[np.float32]:
    """Return the part of the responses that the field knows. It is made at the rate of the scene, and then resampled
    if a stream has another."""
    if isinstance(field, ResampledField):
        own = None if samples is None else field.own_samples(samples)
        irs = _field_part(field.resampled, direct, listener, emitters, channels, remember=remember, samples=own)
        return field.resample(irs, samples)
    held = _held(field, direct, listener, emitters, remember=remember, samples=samples)
    if direct.binauralization is not None:
        places = [emitter.pose.position for emitter in emitters]
        return direct.binauralization.binauralize(held, listener, places) if channels == 2 else held
    return binaural_to_mono(held, field.sample_rate) if channels == 1 else held


def _held(
    field: AcousticField,
    direct: DirectSound,
    listener: Pose,
    emitters: Sequence[EmitterState],
    *,
    remember: bool,
    samples: int | None,
) -> npt.NDArray[np.float32]:
    """Return the field's responses (B, channel, sample) in an array of their own; zeros for emitters with `late`
    off."""
    late = [row for row, emitter in enumerate(emitters) if emitter.effects.late]
    shape = len(emitters), field.channels, field.ir_samples if samples is None else samples
    if not late:
        return np.zeros(shape, np.float32)
    ears = np.array([listener.position] * len(late))
    places = np.array([emitters[row].pose.position for row in late])
    heads = np.array([listener.orientation] * len(late))
    if samples is None:
        answer = field.impulse_responses(ears, places, heads, remember=remember)
    else:
        answer = field.first_samples(ears, places, heads, samples)
    if direct.field_gain != 1.0:
        answer *= np.float32(direct.field_gain)
    if len(late) == len(emitters):
        return answer
    held = np.zeros(shape, np.float32)
    held[late] = answer
    return held


def _without_end(ir: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return the response (channel, sample) up to its last sample that is not zero; at least one sample."""
    if ir[:, -1].any():
        return ir  # the usual case, found without a search
    heard = ir != 0
    ends = [ir.shape[1] - int(np.argmax(channel[::-1])) for channel in heard if channel.any()]
    return ir[:, : max(ends, default=1)]
