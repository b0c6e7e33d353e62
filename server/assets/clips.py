"""Clips: dry recordings that emitters play, bundled or from the user's files.

A clip is decoded once for each sample rate that streams ask for, to mono. A file without samples, or with samples that
are not audio, is refused as a whole.
"""

import copy
import logging
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from threading import Lock

import numpy as np
import numpy.typing as npt
import soxr

from server.assets.audio_file import AudioFileError, Limit, read_audio, to_mono, unlimited
from server.core.errors import NafirError, RequestError
from server.rendering.ingest import LOUDEST, DryAudio

FloatArray = npt.NDArray[np.float32]

_logger = logging.getLogger(__name__)

_BUNDLED = Path(__file__).parent / "clips_data"


class DecodeError(NafirError):
    """A file cannot be played; `reason` says why."""

    def __init__(self, name: str, reason: str) -> None:
        super().__init__(f"{name}: {reason}")
        self.name = name
        self.reason = reason


class UnknownClipError(RequestError):
    """There is no clip of that name."""

    def __init__(self, name: str) -> None:
        super().__init__("unknown_clip", f"there is no clip {name!r}", field="clip", status=404)
        self.name = name


@dataclass(frozen=True)
class Clip:
    """Description of a clip. `credit` is empty for the user's own files. Uploaded clips expire at `expires_at` (ISO
    8601)."""

    name: str
    title: str
    duration_s: float
    credit: str
    expires_at: str | None = None


def decode(path: Path, sample_rate: int, *, channel: int | None = None) -> DryAudio:
    """Read an audio file (wav, flac, ogg or another format of libsndfile) as mono at `sample_rate`.

    The channels are averaged, unless `channel`, counted from 0, selects one. If they would cancel each other, the
    louder one is used. The log warns of that and of wrong headers. Raises DecodeError.
    """
    try:
        mono, rate, findings = read_mono(path, channel=channel)
    except AudioFileError as exc:
        raise DecodeError(path.name, str(exc)) from exc
    for finding in findings:
        _logger.warning("warning: %s: %s", path, finding)
    if rate != sample_rate:
        mono = soxr.resample(mono, rate, sample_rate, quality="VHQ")
        if mono.size == 0:
            raise DecodeError(path.name, f"too short to be heard at {sample_rate} Hz")
    return DryAudio(mono)


def read_mono(
    path: Path, *, channel: int | None = None, limit: Limit = unlimited
) -> tuple[FloatArray, int, tuple[str, ...]]:
    """The samples of an audio file, mixed as `decode` does, their rate, and warnings. `limit` is that of `read_audio`.
    Raises AudioFileError."""
    recording = read_audio(path, limit)
    samples = recording.samples
    if samples.shape[0] == 0:
        raise AudioFileError("it holds no samples")
    # Before averaging and resampling, which would spread one bad sample over many.
    is_bad = ~np.isfinite(samples).all(axis=1)
    # guard: a file of no audio is refused
    if is_bad.any():
        raise AudioFileError(f"{is_bad.sum()} samples are not finite, the first at {is_bad.argmax()}")
    # guard: a file beyond the loudest is refused
    if (peak := np.abs(samples).max()) > LOUDEST:
        raise AudioFileError(f"its peak of {peak:.3g} is not audio, where full scale is 1")
    mono, downmix = to_mono(samples, channel)
    return mono, recording.sample_rate, tuple(filter(None, (recording.finding, downmix)))


class ClipLibrary:
    """Clips by name at one sample rate: the bundled ones and `files`, which replace bundled ones of the same name.

    Safe to use from any thread. A clip is decoded on its first use and kept.
    """

    def __init__(self, sample_rate: int, files: Mapping[str, Path] | None = None) -> None:
        self.sample_rate = sample_rate
        self._at_rates = {sample_rate: self}
        self._rates_lock = Lock()  # of its own, since decoding holds the other for long
        with (_BUNDLED / "clips.toml").open("rb") as stream:
            self._labels: dict[str, dict[str, str]] = tomllib.load(stream)
        self._paths = {name: _BUNDLED / f"{name}.ogg" for name in self._labels}
        for name, path in (files or {}).items():
            if name in self._paths:
                _logger.warning("warning: %s takes the place of the bundled clip %r", path, name)
            self._paths[name] = path
            self._labels[name] = {"title": name, "credit": ""}
        self._decoded: dict[str, DryAudio] = {}
        self._lock = Lock()

    def at_rate(self, sample_rate: int) -> "ClipLibrary":
        """The library of the same clips at another sample rate. There is one for each rate, and it decodes clips
        anew, from their files."""
        with self._rates_lock:
            if sample_rate not in self._at_rates:
                other = copy.copy(self)
                other.sample_rate, other._decoded, other._lock = sample_rate, {}, Lock()
                self._at_rates[sample_rate] = other
            return self._at_rates[sample_rate]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all clips in alphabetical order."""
        return tuple(sorted(self._paths))

    def load(self, name: str) -> DryAudio:
        """Raises UnknownClipError and DecodeError."""
        path = self.file(name)
        with self._lock:
            if name not in self._decoded:
                self._decoded[name] = decode(path, self.sample_rate)
            return self._decoded[name]

    def describe(self, name: str) -> Clip:
        """Raises UnknownClipError and DecodeError."""
        self.file(name)
        labels = self._labels[name]
        return Clip(name, labels["title"], self.load(name).size / self.sample_rate, labels["credit"])

    def file(self, name: str) -> Path:
        """The file of a clip, as it was given. Raises UnknownClipError."""
        try:
            return self._paths[name]
        except KeyError:
            raise UnknownClipError(name) from None
