"""Reads predicted impulse responses from a folder: one WAV or NumPy file a response, named as the response is.

A file of another rate is resampled as a waveform, so amplitudes stay. What cannot be a prediction raises
PredictionError, which names the file and what to do.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from server.assets.audio_file import AudioFileError, read_audio
from server.core.errors import NafirError
from server.core.npy import NpyError, read_npy
from training.evaluation.literature import resampled

SUFFIXES = (".wav", ".npy")
PADDED_S = 0.025
"""A prediction that is shorter than the reference by no more than this is padded with zeros: transforms lose a hop."""
_LISTED = 5


class PredictionError(NafirError):
    """A prediction, or a folder of them, that cannot be scored."""


@dataclass(frozen=True)
class Fitted:
    """A prediction (channel, sample) with the rate and length of the reference, and what was done for it.

    rate: of the file. padded, cut: samples that were added or taken off at the end.
    """

    response: npt.NDArray[np.float32]
    rate: int
    padded: int
    cut: int


@dataclass(frozen=True)
class Predictions:
    """The files of a folder by name of response. `unused` are files of responses that are not scored, `others` are no
    predictions at all. npy_rate: the rate of NumPy files."""

    folder: Path
    files: Mapping[str, Path]
    unused: int
    others: tuple[str, ...]
    npy_rate: int

    @classmethod
    def find(
        cls,
        folder: Path,
        scored: Collection[str],
        known: Collection[str],
        normal: Callable[[str], str],
        *,
        npy_rate: int,
    ) -> "Predictions":
        """The predictions of a folder for the responses `scored`, of all that are `known`.

        Raises PredictionError for a folder that is none, names that no response has, two files of one response, and
        links that lead out of the folder.
        """
        if not folder.is_dir():
            raise PredictionError(f"{folder}: there is no such folder of predictions")
        root = folder.resolve()
        files: dict[str, Path] = {}
        unknown, others, unused = [], [], 0
        for path in _files(folder):
            told = path.relative_to(folder).as_posix()
            if path.suffix.lower() not in SUFFIXES:
                others.append(told)
                continue
            if not path.resolve().is_relative_to(root):
                raise PredictionError(f"{path}: is a link out of the folder: put the file itself there")
            name = normal(told)
            if name in files:
                raise PredictionError(f"{path}: {files[name].name} is the same response: keep one of them")
            if name in scored:
                files[name] = path
            elif name in known:
                unused += 1
            else:
                unknown.append(told)
        if unknown:
            example = min(scored)
            raise PredictionError(
                f"{folder}: {len(unknown)} files are named by no response of the dataset: {first(unknown)}; a name is "
                f"like {example}.wav (nafir-train benchmark DATASET --list names all)"
            )
        return cls(folder, files, unused, tuple(others), npy_rate)

    def signature(self) -> list[object]:
        """Name, size and time of each file, and the rate of NumPy files, in plain values."""
        files = [(name, path.stat().st_size, path.stat().st_mtime_ns) for name, path in self.files.items()]
        return [self.npy_rate, files]

    def missing(self, scored: Collection[str]) -> list[str]:
        return sorted(set(scored) - self.files.keys())

    def read(self, name: str, *, channels: int, samples: int, sample_rate: int) -> Fitted:
        """The prediction of a response, with the rate and length of the reference. Raises PredictionError."""
        path = self.files[name]
        values, rate = _samples(path, self.npy_rate)
        _require_sound(path, values, channels)
        response = resampled(values, rate, sample_rate)
        lacking = samples - response.shape[-1]
        if lacking > round(PADDED_S * sample_rate):
            length_s, needed_s = response.shape[-1] / sample_rate, samples / sample_rate
            raise PredictionError(
                f"{path}: lasts {length_s:.3f} s, and its reference {needed_s:.3f} s: predict all of it, or score the "
                f"first part alone by --duration-s {length_s:.3f}"
            )
        response = np.pad(response, ((0, 0), (0, max(lacking, 0))))[:, :samples]
        _require_sound(path, response, channels)
        return Fitted(response.astype(np.float32), rate, max(lacking, 0), max(-lacking, 0))


def first(names: Collection[str]) -> str:
    """The first few names in words."""
    listed = sorted(names)
    return ", ".join(listed[:_LISTED]) + (f" and {len(listed) - _LISTED} more" if len(listed) > _LISTED else "")


def _files(folder: Path) -> Iterator[Path]:
    """All files below a folder, in order; nothing that is hidden. Links to folders are not followed."""
    for path in sorted(folder.iterdir()):
        if path.name.startswith("."):
            continue
        if path.is_dir() and not path.is_symlink():
            yield from _files(path)
        elif path.is_dir():
            raise PredictionError(f"{path}: is a link to a folder: put the folder itself there")
        else:
            yield path


def _samples(path: Path, npy_rate: int) -> tuple[npt.NDArray[np.floating], int]:
    """(channel, sample) and the sample rate."""
    if path.suffix.lower() == ".wav":
        try:
            recording = read_audio(path)
        except AudioFileError as exc:
            raise PredictionError(f"{path}: {exc}: write it anew, as 32-bit float WAV") from exc
        if recording.is_cut:
            raise PredictionError(f"{path}: {recording.finding}: write it anew")
        return recording.samples.T, recording.sample_rate
    try:
        values = read_npy(path)
    except (OSError, NpyError) as exc:
        raise PredictionError(f"{path}: {exc}: write it anew by numpy.save") from exc
    if values.dtype.kind != "f":
        raise PredictionError(f"{path}: holds {values.dtype}: write floats, with 1 for the amplitude of full scale")
    if values.ndim == 1:
        values = values[np.newaxis]
    if values.ndim != 2 or values.shape[0] > values.shape[1]:
        raise PredictionError(f"{path}: has shape {values.shape}: write (channel, sample)")
    return values.astype(np.float64), npy_rate


def _require_sound(path: Path, values: npt.NDArray[np.floating], channels: int) -> None:
    if len(values) != channels:
        held, needed = (f"{count} channel{'s' if count > 1 else ''}" for count in (len(values), channels))
        raise PredictionError(f"{path}: has {held}, and the dataset {needed}: predict {needed}")
    if not np.isfinite(values).all():
        at = int(np.argmax(~np.isfinite(values).all(axis=0)))
        raise PredictionError(f"{path}: is not a number or infinite at sample {at}: predict finite samples")
    silent = [str(channel) for channel in range(channels) if not values[channel].any()]
    if silent:
        of = f"channel {' and '.join(silent)} " if channels > 1 else ""
        raise PredictionError(f"{path}: {of}is silent: predict a response, or leave the file out with --allow-missing")
