"""Reads responses from audio files."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from server.assets.audio_file import AudioFileError, read_audio
from training.data.importers.report import ImportReport


class UnreadableError(Exception):
    """A file whose response cannot be read. The message says what is wrong in a few words."""


def read_response(path: Path, channels: int, report: ImportReport) -> tuple[npt.NDArray[np.float32], int]:
    """Returns (channel, sample) and the sample rate.

    Raises UnreadableError, also for a file whose end is missing, because training would learn the missing part of the
    decay as silence. If the header announces less sound than the file holds, all of it is read and the report gets a
    note.
    """
    if not path.is_file():
        raise UnreadableError("no such file")
    if path.stat().st_size == 0:
        raise UnreadableError("empty file")
    try:
        recording = read_audio(path)
    except AudioFileError as exc:
        raise UnreadableError("unreadable") from exc
    if recording.is_cut:
        raise UnreadableError("cut off: it holds less than its header promises")
    if recording.samples.shape[1] != channels:
        raise UnreadableError(f"not {channels} channel{'s' if channels > 1 else ''}")
    if recording.finding:
        report.note("some headers do not say how much sound follows; everything that follows was read")
    return recording.samples.T, recording.sample_rate
