"""Losing a client's connection, and what its player plays then: float32 samples of two ears at 48 kHz, in a file."""

import subprocess
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from server.assets.clips import ClipLibrary

RATE = 48_000
CLIP = "woman-reading"
_QUIET = 1e-6


@dataclass(frozen=True)
class Gap:
    """A silence in what was heard, in samples."""

    start: int
    end: int

    @property
    def seconds(self) -> float:
        return (self.end - self.start) / RATE


def until(lines: Iterable[str], *beginnings: str) -> str:
    """The next line that begins with one of these."""
    seen = []
    for line in lines:
        seen.append(line)
        if line.startswith(beginnings):
            return line.strip()
    raise AssertionError(f"no line begins with {beginnings}; there were {seen}")


def lines_of(process: "subprocess.Popen[str]") -> Iterable[str]:
    assert process.stdout is not None
    return process.stdout


def read(path: Path) -> npt.NDArray[np.float32]:
    """(n,) what the left ear heard."""
    return np.fromfile(path, np.float32).reshape(-1, 2)[:, 0]


def gap_around(heard: npt.NDArray[np.float32], sample: int) -> Gap:
    """The silence in which a sample lies."""
    sounding = np.flatnonzero(np.abs(heard) > _QUIET)
    after = int(np.searchsorted(sounding, sample))
    return Gap(int(sounding[after - 1]) + 1, int(sounding[after]))


def assert_no_click(heard: npt.NDArray[np.float32], gap: Gap) -> None:
    """Sound that is cut off, or jumps in, has a step as high as itself."""
    steps = np.abs(np.diff(heard))
    usual = np.quantile(steps[np.abs(heard[1:]) > _QUIET], 0.999)
    for edge in (gap.start, gap.end):
        assert steps[max(0, edge - 64) : edge + 64].max() < 1.5 * usual
    assert np.abs(heard[gap.start - 3 : gap.start]).max() < 0.05 * np.abs(heard).max()


def clip_position_s(heard: npt.NDArray[np.float32], start: int, seconds: float = 1.5) -> float:
    """By how many seconds the clip, which is played again and again, began before `heard` did, by what is heard from a
    sample on. Modulo the length of the clip."""
    clip = ClipLibrary(RATE).load(CLIP).samples
    piece = heard[start : start + round(seconds * RATE)]
    clip_twice = np.concatenate([clip, clip[: len(piece)]])
    size = len(clip_twice) + len(piece)
    fits = np.fft.irfft(np.fft.rfft(clip_twice, size) * np.conj(np.fft.rfft(piece, size)), size)[: len(clip)]
    return float((int(np.argmax(fits)) - start) % len(clip)) / RATE


def assert_same_clip_position(heard: npt.NDArray[np.float32], gap: Gap, at_most_s: float = 0.08) -> None:
    """After the gap the clip is where it would be without one, but for what waits in buffers."""
    length_s = len(ClipLibrary(RATE).load(CLIP).samples) / RATE
    before = clip_position_s(heard, gap.start - round(1.5 * RATE))
    moved_s = clip_position_s(heard, gap.end + RATE // 4) - before
    assert abs((moved_s + length_s / 2) % length_s - length_s / 2) < at_most_s
