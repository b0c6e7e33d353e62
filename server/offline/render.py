"""Rendering to a file: the live renderer, driven by a path instead of a connection.

A path gives the listener's poses with the samples from which they apply, separately for the direct sound and for the
reflected field. Poses take effect at block boundaries, as they do live. So a path with the poses of a live session, and
the sample clocks of the blocks that first applied them, renders the same samples.
"""

import csv
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from server.acoustics.decibels import amplitude_to_db
from server.acoustics.directivity import OMNIDIRECTIONAL, Directivity
from server.acoustics.geometry import Pose, Quaternion
from server.core.errors import NafirError
from server.core.numerals import parse_decimal
from server.field.field import AcousticField, Silence
from server.field.fields_by_level import FieldsByLevel
from server.planning.places import place_of_field
from server.planning.planned_effects import PlannedEffects
from server.planning.scene_acoustics import Output
from server.rendering.ingest import DryAudio, require_gain
from server.rendering.sources import ClipPlayer
from server.responses.direct_sound import DirectSound
from server.responses.emitter_state import EmitterState
from server.responses.ir_request import composed_irs
from server.responses.radiation import reverberation_gain
from server.scene.effects import EffectName, require_effect
from server.streaming.active_effects import ActiveEffects
from server.streaming.direct_path_tracker import DirectPathTracker
from server.streaming.emitters import Stage, StreamedEmitter

FloatArray = npt.NDArray[np.float32]

MAX_RENDER_S = 2 * 3600
"""Longest render. It is held in memory as a whole: two hours of stereo at 48 kHz are 2.8 GB."""

_LEAST_GAIN = 1e-6
"""Least amplitude that a plan assumes, since silence has no level in dB."""
_CLOCKS = ("sample", "time_s")
_REVERBERATION = "reverberation_sample"
_LEVEL = "level"
_POSITION = ("x", "y", "z")
_QUATERNION = ("qx", "qy", "qz", "qw")
_YAW = ("yaw_deg",)


class PathError(NafirError):
    """A path file is invalid. The message names the line and the column."""


@dataclass(frozen=True)
class RenderedEmitter:
    """An emitter that plays a clip (n,) at the rate of the render. `gain` is a linear amplitude.

    Raises ValueError for a gain that is not finite or beyond `LOUDEST_GAIN`.
    """

    clip: DryAudio | FloatArray
    pose: Pose
    directivity: Directivity = OMNIDIRECTIONAL
    gain: float = 1.0
    loop: bool = False

    def __post_init__(self) -> None:
        require_gain(self.gain)


@dataclass(frozen=True)
class PathPoint:
    """A pose of the listener. It applies to the direct sound from `sample` on, and to the reflected field from
    `reverberation_sample` on; None means never, because a later pose overtook it. Responses are of quality level
    `level` from then on; None keeps the level."""

    sample: int
    pose: Pose
    reverberation_sample: int | None
    level: str | None = None

    @classmethod
    def at(cls, sample: int, pose: Pose) -> "PathPoint":
        """A pose that applies to direct sound and reflected field from the same sample on."""
        return cls(sample, pose, sample)


def read_path(path: Path, sample_rate: int, levels: Collection[str] | None = None) -> list[PathPoint]:
    """Read a CSV file with a header line and columns in any order.

    The columns are `sample` or `time_s`; `x`, `y`, `z` in metres; and `qx`, `qy`, `qz`, `qw` or `yaw_deg`
    (counter-clockwise, 0 looks along +x). Optional columns are `reverberation_sample`, by default the same sample and
    empty for never, and `level`, empty to keep the level. If `levels` are given, `level` has to be one of them. Times
    never go back from line to line nor exceed `MAX_RENDER_S`. Raises PathError.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.reader(stream, strict=True)
            lines = [(reader.line_num, row) for row in reader]
    except OSError as exc:
        raise PathError(f"{path.name}: {exc.strerror}") from exc
    except (UnicodeDecodeError, csv.Error) as exc:
        raise PathError(f"{path.name}: not a CSV file ({exc})") from exc
    return list(_parse(lines, path.name, sample_rate, levels))


def _parse(
    lines: list[tuple[int, list[str]]], name: str, sample_rate: int, levels: Collection[str] | None
) -> Iterator[PathPoint]:
    columns = [column.strip() for column in lines[0][1]] if lines else []
    _check_header(columns, name)
    latest = dict.fromkeys((*_CLOCKS, _REVERBERATION), 0)
    points = 0
    for line, row in lines[1:]:
        if not row:
            continue
        where = f"{name}: line {line}"
        if len(row) != len(columns):
            raise PathError(f"{where}: {len(row)} values for {len(columns)} columns")
        texts = dict(zip(columns, row, strict=True))
        level = texts.pop(_LEVEL, "").strip() or None
        if level is not None and levels is not None and level not in levels:
            problem = f"the scene has no quality level {level!r}, only {', '.join(levels)}"
            raise PathError(f"{where}, column '{_LEVEL}': {problem}")
        is_silent = _REVERBERATION in texts and not texts[_REVERBERATION].strip()
        if is_silent:
            del texts[_REVERBERATION]
        values = {column: _number(text, f"{where}, column '{column}'") for column, text in texts.items()}
        samples = {column: _sample(values, column, sample_rate, where) for column in latest if column in values}
        for column, sample in samples.items():
            if sample < latest[column]:
                raise PathError(f"{where}, column '{column}': must not be earlier than on the line before")
            latest[column] = sample
        clock = "sample" if "sample" in samples else "time_s"
        reverberation = None if is_silent else samples.get(_REVERBERATION, samples[clock])
        if reverberation is not None and reverberation < samples[clock]:
            raise PathError(f"{where}, column '{_REVERBERATION}': must not be before '{clock}'")
        points += 1
        yield PathPoint(samples[clock], _pose(values, where), reverberation, level)
    if not points:
        raise PathError(f"{name}: no poses below the header line")


def _sample(values: dict[str, float], column: str, sample_rate: int, where: str) -> int:
    value = values[column]
    if column != "time_s" and not value.is_integer():
        raise PathError(f"{where}, column '{column}': {value:g} is not a whole number")
    if value < 0:
        raise PathError(f"{where}, column '{column}': must not be negative")
    at = value * (sample_rate if column == "time_s" else 1)
    if at > MAX_RENDER_S * sample_rate:
        problem = f"{value:g} is beyond the {MAX_RENDER_S} s that a render may last"
        raise PathError(f"{where}, column '{column}': {problem}")
    return round(at)


def _check_header(columns: list[str], name: str) -> None:
    where = f"{name}: line 1"
    if not any(columns):
        raise PathError(f"{where}: expected a header line such as sample,x,y,z,yaw_deg")
    for column in columns:
        if column not in (*_CLOCKS, _REVERBERATION, *_POSITION, *_QUATERNION, *_YAW, _LEVEL):
            raise PathError(f"{where}: unknown column '{column}'")
        if columns.count(column) > 1:
            raise PathError(f"{where}: column '{column}' is there twice")
    if len(set(_CLOCKS).intersection(columns)) != 1:
        raise PathError(f"{where}: expected either column 'sample' or column 'time_s'")
    if set(_YAW).intersection(columns) and set(_QUATERNION).intersection(columns):
        raise PathError(f"{where}: expected either column 'yaw_deg' or a quaternion, not both")
    orientation = _YAW if "yaw_deg" in columns else _QUATERNION
    for column in _POSITION + orientation:
        if column not in columns:
            hint = " (or 'yaw_deg')" if column in _QUATERNION else ""
            raise PathError(f"{where}: column '{column}'{hint} is missing")


def _number(text: str, where: str) -> float:
    try:
        return parse_decimal(text)
    except ValueError as exc:
        raise PathError(f"{where}: {exc}") from exc


def _pose(values: dict[str, float], where: str) -> Pose:
    position = (values["x"], values["y"], values["z"])
    if "yaw_deg" in values:
        return Pose.from_yaw(position, math.radians(values["yaw_deg"]))
    try:
        return Pose(position, Quaternion(values["qx"], values["qy"], values["qz"], values["qw"]))
    except ValueError as exc:
        # guard: a path file's orientation is refused by its line
        raise PathError(f"{where}, columns 'qx' to 'qw': {exc}") from exc


def render(
    field: AcousticField,
    direct_sound: DirectSound,
    emitters: Sequence[RenderedEmitter],
    path: Sequence[PathPoint],
    *,
    block_size: int = 256,
    length: int | None = None,
    progress: Callable[[float], None] | None = None,
    planned: PlannedEffects | None = None,
    levels: Mapping[str, AcousticField] | None = None,
) -> FloatArray:
    """Render at least one emitter for a listener on `path`, which has at least one point. Returns (channel, length):
    two ears, one channel for a mono loudspeaker, or the ambisonic channels of `direct_sound`.

    A point takes effect with the first block that begins at its sample or later, unless a later point does too. The
    emitters start at the beginning of the path. `length`, in samples, defaults to the end of the path or of the longest
    clip, whichever is later, and the reverberation after it. `progress` gets the fraction done. With `planned` only the
    planned effects are rendered, otherwise all. Responses are those of `field` until a point names another of
    `levels`. To get the same samples as a stream, `levels` has to have all levels of the scene. Raises KeyError for a
    level that is not among them.
    """
    if not path or not emitters:
        raise ValueError("a render needs a path and an emitter")
    fields = _fields(field, path, levels or {})
    ir_samples = max(each.ir_samples for each in (field, *(levels or {}).values()))
    if length is None:
        last_start = max(path[-1].sample, path[0].sample + max(emitter.clip.size for emitter in emitters))
        length = _block_at(last_start, block_size) * block_size + max(each.ir_samples for each in fields)
    direct = {_block_at(point.sample, block_size): point.pose for point in path}
    reverberation = {
        _block_at(point.reverberation_sample, block_size): (point.pose, each)
        for point, each in zip(path, fields, strict=True)
        if point.reverberation_sample is not None
    }
    shares_tail = any(each.kind.shares_tail for each in (field, *(levels or {}).values()))
    buses = FieldsByLevel([*(levels or {}).values(), *fields]).buses
    walk = _Walk(fields[0], direct_sound, emitters, path[0].pose, block_size, planned, ir_samples, shares_tail, buses)
    blocks = -(-length // block_size)
    output = np.empty((walk.renderer.outputs, blocks, block_size), np.float32)
    for block in range(blocks):
        walk.go_on(direct.get(block), reverberation.get(block))
        output[:, block] = walk.renderer.process()
        if progress:
            progress((block + 1) / blocks)
    return output.reshape(len(output), -1)[:, :length]


def _fields(
    field: AcousticField, path: Sequence[PathPoint], levels: Mapping[str, AcousticField]
) -> list[AcousticField]:
    """The field that computes the responses of each point; it is `field` until a point names a level."""
    fields = []
    for point in path:
        field = field if point.level is None else levels[point.level]
        fields.append(field)
    return fields


def planned_effects(
    choice: str, field: AcousticField, listener: Pose, *, output: Output, block_size: int = 256
) -> PlannedEffects | None:
    """The effects to render in blocks of `block_size` by the option `choice`: `all` (returns None), those that a `plan`
    calls for, or exactly those named, separated by commas.

    Raises RequestError unknown_effect.
    """
    if choice == "all" and output != "mono":
        return None
    own: dict[EffectName, bool] = {}
    if choice == "all":
        own = dict.fromkeys(EffectName, True) | {EffectName.HRTF: False}
    elif choice != "plan":
        named = {require_effect(name.strip()) for name in choice.split(",") if name.strip()}
        own = {name: name in named for name in EffectName}
    place = place_of_field(field, block_size)
    return PlannedEffects(place, listener, output=output, scene=field.bundle.manifest.effects, own=own)


class _Walk:
    """Drives a renderer block by block as a session does, but with plans and responses computed at once."""

    def __init__(
        self,
        field: AcousticField,
        direct_sound: DirectSound,
        emitters: Sequence[RenderedEmitter],
        start: Pose,
        block_size: int,
        planned: PlannedEffects | None,
        ir_samples: int,
        shares_tail: bool,
        buses: Iterable[int],
    ) -> None:
        """`ir_samples` is the length of the longest response. `shares_tail` says whether any level has a shared
        tail, `buses` are the orders of the levels that are heard by a bus."""
        self.renderer = direct_sound.renderer(
            block_size=block_size,
            ir_samples=ir_samples,
            sample_rate=field.sample_rate,
            max_emitters=len(emitters),
            switches_tail=planned is not None or shares_tail,
            outputs=1 if planned is not None and planned.output == "mono" else 2,
            has_head=planned is None or planned.shared.head,
            buses=buses,
        )
        self._field = field
        self.renderer.share(field.kind.sharing)
        self._direct_sound = direct_sound
        self._effects = ActiveEffects(
            self.renderer,
            planned,
            sample_rate=field.sample_rate,
            has_early=direct_sound.early_reflections is not None,
            has_late=not isinstance(field, Silence),
        )
        self._effects.bus = field.level.bus
        self._listener = start
        self._responded_at: dict[str, Pose] = {}
        """The pose of each emitter's newest response."""
        self._has_begun = False
        self._emitters: dict[str, StreamedEmitter] = {}
        self._aim = DirectPathTracker(direct_sound, self.renderer, self._emitters)
        for number, emitter in enumerate(emitters):
            name = str(number)
            self.renderer.add_emitter(name, ClipPlayer(emitter.clip, loop=emitter.loop), gain=emitter.gain)
            if emitter.directivity != OMNIDIRECTIONAL:
                self.renderer.set_reverberation_gain(name, reverberation_gain(emitter.directivity))
            gain_db = float(amplitude_to_db(max(emitter.gain, _LEAST_GAIN)))
            state = EmitterState(emitter.pose, emitter.directivity, gain_db=gain_db)
            stage = Stage.DECIDED if planned is None else Stage.UNDECIDED
            self._emitters[name] = StreamedEmitter(number, state, stage=stage)
            if planned is not None:
                planned.follow_emitter(name, emitter.pose, 0.0)

    def go_on(self, direct: Pose | None, reverberation: tuple[Pose, AcousticField] | None) -> None:
        """Set the state for the next block: the pose of the direct sound, and the pose and field of the responses. None
        keeps the present one."""
        if direct is not None:
            self._move(direct)
        self._plan()
        if self._has_begun:
            self._aim.follow(self._listener)
        if reverberation is not None:
            pose, field = reverberation
            is_other, self._field = field is not self._field, field
            self._effects.bus = field.level.bus
            for name, emitter in self._emitters.items():
                emitter.is_outdated |= is_other or self._calls_for_response(name, pose)
            self._respond(pose)
            if is_other:
                self._effects.share(field.kind.sharing, self._emitters)
        elif self._effects.planned is not None and self._has_begun:
            self._respond(self._listener)

    def _calls_for_response(self, emitter: str, pose: Pose) -> bool:
        """Whether a pose calls for another response than the newest."""
        before = self._responded_at.get(emitter)
        if before is None or pose.position != before.position:
            return True
        return pose.orientation != before.orientation and self._effects.turns_ask

    def _move(self, pose: Pose) -> None:
        moves, turns = pose.position != self._listener.position, pose.orientation != self._listener.orientation
        for name, emitter in self._emitters.items():
            if moves or (turns and self._effects.shared.head):
                self._effects.unbake(name, emitter)
        self._listener, self._has_begun = pose, True
        self.renderer.set_orientation(pose.orientation)
        if self._effects.planned is not None:
            self._effects.planned.follow_listener(pose, self._effects.clock_s)

    def _plan(self) -> None:
        planned = self._effects.planned
        if planned is None:
            return
        states = {name: emitter.state for name, emitter in self._emitters.items()}
        request = planned.take_request(self._listener, states, self._effects.clock_s)
        if request is not None:
            planned.accept(request.plan())
            self._effects.enforce(self._emitters)
            self._effects.share(self._field.kind.sharing, self._emitters)

    def _respond(self, listener: Pose) -> None:
        """Compute the outdated responses and give them to the renderer."""
        named = {
            name: emitter
            for name, emitter in self._emitters.items()
            if emitter.effects.has_response and (emitter.is_outdated or self._effects.wants_baking(emitter))
        }
        if self._effects.awaits_ears:
            self.renderer.set_channels(self._effects.channels)
        if not named:
            return
        self._responded_at |= dict.fromkeys(named, listener)
        asked = [self._effects.as_asked(emitter) for emitter in named.values()]
        irs = composed_irs(self._field, self._direct_sound, listener, asked, self._effects.channels)
        for (name, emitter), state, ir in zip(named.items(), asked, irs, strict=True):
            emitter.is_outdated = False
            self._effects.accept_ir(name, emitter, self.renderer.prepare(ir), state.effects, 0)


def _block_at(sample: int, block_size: int) -> int:
    """The first block that begins at `sample` or later."""
    return -(-sample // block_size)
