"""Responses in audio files."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import soundfile


class UnreadableError(Exception):
    """A file that stands for a missing response; says what is wrong in a word or two."""


def read_response(path: Path, channels: int) -> tuple[npt.NDArray[np.float32], int]:
    """(channel, sample) and the rate. Raises UnreadableError."""
    if not path.is_file():
        raise UnreadableError("no such file")
    if path.stat().st_size == 0:
        raise UnreadableError("empty file")
    try:
        samples, rate = soundfile.read(path, dtype="float32", always_2d=True)
    except (OSError, soundfile.SoundFileError) as exc:
        raise UnreadableError("unreadable") from exc
    if samples.shape[1] != channels:
        raise UnreadableError(f"not {channels} channel{'s' if channels > 1 else ''}")
    return samples.T, int(rate)
