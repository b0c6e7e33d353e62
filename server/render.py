"""Rendering to a file: the live renderer, fed from a path instead of a connection.

A path says from which sample on the listener has which pose. Poses take effect at block boundaries, as they do live; so
a live session whose poses are written down with the sample clock of the block that first applied them renders the same.
"""

import csv
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import Pose, Vector3
from server.errors import NafirError
from server.rendering.renderer import Renderer

FloatArray = npt.NDArray[np.float32]

MAX_RENDER_S = 2 * 3600
"""A render is held in memory as a whole: two hours of stereo at 48 kHz are 2.8 GB."""

_CLOCKS = ("sample", "time_s")
_POSITION = ("x", "y", "z")
_QUATERNION = ("qx", "qy", "qz", "qw")
_YAW = ("yaw_deg",)


class PathError(NafirError):
    """A path file that cannot be followed; the message names the line and the column."""


class ImpulseResponses(Protocol):
    """What an acoustic field gives: IRs (batch, ear, `ir_samples`) for poses in metres and radians."""

    @property
    def ir_samples(self) -> int: ...

    def impulse_responses(
        self, listeners: npt.ArrayLike, emitters: npt.ArrayLike, yaws: npt.ArrayLike
    ) -> FloatArray: ...


@dataclass(frozen=True)
class RenderedEmitter:
    """A clip (n,) at the scene's rate, played at a place; `gain` is linear amplitude."""

    clip: FloatArray
    position: Vector3
    gain: float = 1.0
    loop: bool = False


@dataclass(frozen=True)
class PathPoint:
    """The listener's pose from `sample` on."""

    sample: int
    pose: Pose


def read_path(path: Path, sample_rate: int) -> list[PathPoint]:
    """Read a CSV file with a header line, columns in any order.

    They are `sample` or `time_s`; `x`, `y`, `z` in metres; and `qx`, `qy`, `qz`, `qw` or `yaw_deg` (counter-clockwise,
    0 looks along +x). Samples increase from line to line, up to `MAX_RENDER_S`. Raises PathError.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.reader(stream, strict=True)
            lines = [(reader.line_num, row) for row in reader]
    except OSError as exc:
        raise PathError(f"{path.name}: {exc.strerror}") from exc
    except (UnicodeDecodeError, csv.Error) as exc:
        raise PathError(f"{path.name}: not a CSV file ({exc})") from exc
    return list(_parse(lines, path.name, sample_rate))


def _parse(lines: list[tuple[int, list[str]]], name: str, sample_rate: int) -> Iterator[PathPoint]:
    columns = [column.strip() for column in lines[0][1]] if lines else []
    _check_header(columns, name)
    last_sample = -1
    for line, row in lines[1:]:
        if not row:
            continue
        where = f"{name}: line {line}"
        if len(row) != len(columns):
            raise PathError(f"{where}: {len(row)} values for {len(columns)} columns")
        values = {name: _number(text, f"{where}, column '{name}'") for name, text in zip(columns, row, strict=True)}
        clock = "sample" if "sample" in values else "time_s"
        if clock == "sample" and not values["sample"].is_integer():
            raise PathError(f"{where}, column 'sample': {values['sample']:g} is not a whole number")
        at = values[clock] * (sample_rate if clock == "time_s" else 1)
        if at > MAX_RENDER_S * sample_rate:
            problem = f"{values[clock]:g} is beyond the {MAX_RENDER_S} s that a render may last"
            raise PathError(f"{where}, column '{clock}': {problem}")
        sample = round(max(at, -1.0))  # any negative number is refused, and -inf cannot be rounded
        if sample <= last_sample:
            problem = "must not be negative" if last_sample < 0 else "must be later than on the line before"
            raise PathError(f"{where}, column '{clock}': {problem}")
        last_sample = sample
        yield PathPoint(sample, _pose(values, where))
    if last_sample < 0:
        raise PathError(f"{name}: no poses below the header line")


def _check_header(columns: list[str], name: str) -> None:
    where = f"{name}: line 1"
    if not any(columns):
        raise PathError(f"{where}: expected a header line such as sample,x,y,z,yaw_deg")
    for column in columns:
        if column not in _CLOCKS + _POSITION + _QUATERNION + _YAW:
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
        number = float(text)
    except ValueError:
        raise PathError(f"{where}: {text.strip()!r} is not a number") from None
    if not math.isfinite(number):
        raise PathError(f"{where}: {text.strip()!r} is not finite")
    return number


def _pose(values: dict[str, float], where: str) -> Pose:
    position = (values["x"], values["y"], values["z"])
    if "yaw_deg" in values:
        return Pose.from_yaw(position, math.radians(values["yaw_deg"]))
    try:
        return Pose(position, (values["qx"], values["qy"], values["qz"], values["qw"]))
    except ValueError as exc:
        raise PathError(f"{where}, columns 'qx' to 'qw': {exc}") from exc


def render(
    field: ImpulseResponses,
    emitters: Sequence[RenderedEmitter],
    path: Sequence[PathPoint],
    *,
    block_size: int = 256,
    length: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> FloatArray:
    """What a listener on `path` (one point or more, by rising sample) hears of `emitters` (one or more): (2, length).

    A point takes effect with the first block that begins at its sample or later, faded to over that block, unless a
    later point does too. The emitters start with the first point. `length` in samples defaults to the end of the path
    or of the longest clip, whichever is later, and the reverberation after it. `progress` is told the fraction done.
    """
    if not path or not emitters:
        raise ValueError("a render needs a path and an emitter")
    if length is None:
        last_start = max(path[-1].sample, path[0].sample + max(emitter.clip.size for emitter in emitters))
        length = _block_at(last_start, block_size) * block_size + field.ir_samples
    renderer = Renderer(block_size=block_size, ir_samples=field.ir_samples, max_emitters=len(emitters))
    names = [str(number) for number in range(len(emitters))]
    for name, emitter in zip(names, emitters, strict=True):
        renderer.add_emitter(name, emitter.clip, gain=emitter.gain, loop=emitter.loop)
    poses = {_block_at(point.sample, block_size): point.pose for point in path}
    blocks = -(-length // block_size)
    output = np.empty((renderer.channels, blocks, block_size), np.float32)
    for block in range(blocks):
        if block in poses:
            irs = _irs(field, [emitter.position for emitter in emitters], poses[block])
            for name, ir in zip(names, irs, strict=True):
                renderer.set_ir(name, ir)
        output[:, block] = renderer.process()
        if progress:
            progress((block + 1) / blocks)
    return output.reshape(renderer.channels, -1)[:, :length]


def _block_at(sample: int, block_size: int) -> int:
    """The first block that begins at `sample` or later."""
    return -(-sample // block_size)


def _irs(field: ImpulseResponses, emitters: Sequence[Vector3], listener: Pose) -> FloatArray:
    count = len(emitters)
    return field.impulse_responses([listener.position] * count, emitters, [listener.yaw] * count)
