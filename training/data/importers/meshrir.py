"""Reads MeshRIR's npy layout: one room, microphones on a mesh, several loudspeakers, no heads.

`pos_mic.npy` (microphone, 3) and `pos_src.npy` (loudspeaker, 3) are in metres, z up; `ir_<microphone>.npy` is
(loudspeaker, sample). Koyama et al., "MeshRIR: a dataset of room impulse responses on meshed grid points" (WASPAA
2021); https://www.sh01.org/MeshRIR/. The files do not contain the sample rate; the published sets have 48 kHz.
"""

from collections.abc import Callable, Generator, Iterable
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
import numpy.typing as npt

from server.core.npy import NpyError, read_npy
from training.data.importers.conditioning import SourceError, positions
from training.data.importers.report import ImportReport
from training.data.responses import Measurement


def read(
    folder: Path,
    report: ImportReport,
    *,
    source_rate: int = 48_000,
    track: Callable[[list[int]], Iterable[int]] = iter,
) -> Generator[tuple[str, Measurement]]:
    """Yields a name and a measurement for each microphone and loudspeaker. A microphone without a readable file is
    skipped.

    Raises SourceError if the positions cannot be read.
    """
    microphones = positions(folder / "pos_mic.npy", "positions", _array(folder / "pos_mic.npy"))
    loudspeakers = positions(folder / "pos_src.npy", "positions", _array(folder / "pos_src.npy"))
    for microphone in track(list(range(len(microphones)))):
        path = folder / f"ir_{microphone}.npy"
        if not path.is_file():
            report.skip(path.name, "no such file", len(loudspeakers))
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
            yield f"{path.name}[{loudspeaker}]", Measurement(listener, emitter, samples, source_rate)
    read_here = {"pos_mic.npy", "pos_src.npy", *(f"ir_{index}.npy" for index in range(len(microphones)))}
    for name in sorted({path.name for path in folder.iterdir()} - read_here):
        if fnmatch(name, "ir_*.npy"):
            report.skip(name, "no such microphone in pos_mic.npy", len(loudspeakers))
        else:
            report.skip(name, "not of this layout")


def _array(path: Path) -> npt.NDArray[np.generic]:
    try:
        return read_npy(path)
    except FileNotFoundError as exc:
        raise SourceError(path, "file", "no such file") from exc
    except (OSError, NpyError) as exc:
        raise SourceError(path, "file", f"not a readable array ({exc})") from exc
