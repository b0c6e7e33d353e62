"""Reads MeshRIR's npy layout: one room, microphones on a mesh, several loudspeakers, no heads.

`pos_mic.npy` (microphone, 3) and `pos_src.npy` (loudspeaker, 3) are in metres, z up; `ir_<microphone>.npy` is
(loudspeaker, sample). Koyama et al., "MeshRIR: a dataset of room impulse responses on meshed grid points" (WASPAA
2021); https://www.sh01.org/MeshRIR/. The files do not contain the sample rate; the published sets have 48 kHz.
"""

from collections.abc import Callable, Generator, Iterable
from fnmatch import fnmatch
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from server.core.npy import NpyError, read_npy
from training.data.importers.audio import UnreadableError
from training.data.importers.conditioning import SourceError, positions
from training.data.importers.entries import Entry, Pose, Sound, at
from training.data.importers.report import ImportReport
from training.data.responses import Measurement

TRAIN, TEST = "train", "test"


def read(
    folder: Path,
    report: ImportReport,
    *,
    source_rate: int = 48_000,
    track: Callable[[list[int]], Iterable[int]] = iter,
) -> Generator[tuple[str, Measurement]]:
    """Yields a name and a measurement for each microphone and loudspeaker. A microphone without a readable file is
    skipped. Files may lie in the folder, or in `train` and `test` folders inside it, as some others sort them.

    Raises SourceError if the positions cannot be read.
    """
    microphones = positions(folder / "pos_mic.npy", "positions", _array(folder / "pos_mic.npy"))
    loudspeakers = positions(folder / "pos_src.npy", "positions", _array(folder / "pos_src.npy"))
    for microphone in track(list(range(len(microphones)))):
        path = _file(folder, microphone)
        if path is None:
            report.skip(f"ir_{microphone}.npy", "no such file", len(loudspeakers))
            continue
        try:
            responses = _array(path)
        except SourceError:
            report.skip(path.name, "unreadable", len(loudspeakers))
            continue
        if responses.ndim != 2 or len(responses) != len(loudspeakers) or responses.dtype.kind not in "fiu":
            report.skip(path.name, f"not {len(loudspeakers)} rows of samples", len(loudspeakers))
            continue
        listener = tuple(microphones[microphone])
        for loudspeaker, response in enumerate(responses):
            samples = response[np.newaxis].astype(np.float32)
            emitter = tuple(loudspeakers[loudspeaker])
            name = f"{microphone}_{loudspeaker}"
            yield f"{path.name}[{loudspeaker}]", Measurement(listener, emitter, samples, source_rate, name=name)
    read_here = {"pos_mic.npy", "pos_src.npy", *(f"ir_{index}.npy" for index in range(len(microphones)))}
    parts = {TRAIN, TEST} if (folder / TEST).is_dir() else set()
    for name in sorted({path.name for path in folder.iterdir()} - read_here - parts):
        if fnmatch(name, "ir_*.npy"):
            report.skip(name, "no such microphone in pos_mic.npy", len(loudspeakers))
        else:
            report.skip(name, "not of this layout")


def entries(folder: Path, report: ImportReport, *, source_rate: int = 48_000) -> list[Entry]:
    """The responses of a room, each named `<microphone>_<loudspeaker>`; files may lie where `read` finds them.

    Raises SourceError if the positions cannot be read.
    """
    microphones = positions(folder / "pos_mic.npy", "positions", _array(folder / "pos_mic.npy"))
    loudspeakers = positions(folder / "pos_src.npy", "positions", _array(folder / "pos_src.npy"))
    found = []
    for microphone, (x, y, z) in enumerate(microphones):
        path = _file(folder, microphone)
        if path is None:
            report.skip(f"ir_{microphone}.npy", "no such file", len(loudspeakers))
            continue
        for loudspeaker, emitter in enumerate(loudspeakers):
            name = f"{microphone}_{loudspeaker}"
            pose = Pose((x, y, z), (emitter[0], emitter[1], emitter[2]))
            read_row = partial(_row, path, loudspeaker, len(loudspeakers), source_rate)
            found.append(Entry(name, path, name, at(pose), read_row))
    return found


def _file(folder: Path, microphone: int) -> Path | None:
    places = [inside / f"ir_{microphone}.npy" for inside in (folder, folder / TRAIN, folder / TEST)]
    return next((path for path in places if path.is_file()), None)


def _row(path: Path, loudspeaker: int, loudspeakers: int, source_rate: int) -> Sound:
    try:
        responses = _array(path)
    except SourceError as exc:
        raise UnreadableError("unreadable") from exc
    if responses.ndim != 2 or len(responses) != loudspeakers or responses.dtype.kind not in "fiu":
        raise UnreadableError(f"not {loudspeakers} rows of samples")
    return responses[loudspeaker][np.newaxis].astype(np.float32), source_rate


def _array(path: Path) -> npt.NDArray[np.generic]:
    try:
        return read_npy(path)
    except FileNotFoundError as exc:
        raise SourceError(path, "file", "no such file") from exc
    except (OSError, NpyError) as exc:
        raise SourceError(path, "file", f"not a readable array ({exc})") from exc
