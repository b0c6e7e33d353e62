"""Reads Real Acoustic Fields: rooms measured with an array of omnidirectional microphones and a tracked loudspeaker.

Each folder of `data/` holds one response: `rir.wav`; `rx_pos.txt`, the microphone's "x,y,z"; `tx_pos.txt`, the
loudspeaker's "qx,qy,qz,qw,x,y,z", orientation and then position, with the quaternion's real part last. Metres. (README
of https://github.com/facebookresearch/real-acoustic-fields, Chen et al., CVPR 2024.) Their axes are x ahead, y up, z
left, a left-handed frame. Reordered to x, z, y they are the right-handed frame used here, as in AVR's loader of these
data.
"""

from collections.abc import Callable, Generator, Iterable
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from server.core.numerals import parse_decimal
from training.data.importers.audio import UnreadableError, read_response
from training.data.importers.conditioning import SourceError
from training.data.importers.entries import Entry, Pose, Sound
from training.data.importers.report import ImportReport
from training.data.responses import SAME_POINT_M, Measurement

_Vector = tuple[float, float, float]
_SAME_WAY = 0.999  # cosine of half the angle between orientations: 5 degrees


def read(
    folder: Path, report: ImportReport, *, track: Callable[[list[Path]], Iterable[Path]] = iter
) -> Generator[tuple[str, Measurement]]:
    """Yields a name and a measurement for each response in a room's folder or its `data` folder.

    Fields do not take the orientation of an emitter as an input. If a loudspeaker had several orientations at one
    place, only the first is kept. Raises SourceError for a folder without responses.
    """
    first_orientation: dict[tuple[int, ...], npt.NDArray[np.float64]] = {}
    for path in track(_responses(folder, report)):
        try:
            pose, quaternion = _placed(path)
            response, rate = read_response(path / "rir.wav", channels=1, report=report)
        except UnreadableError as exc:
            report.skip(path.name, str(exc))
            continue
        if not 0.9 < np.linalg.norm(quaternion) < 1.1:
            report.skip(path.name, "tx_pos.txt does not begin with a unit quaternion")
            continue
        place = tuple(round(coordinate / SAME_POINT_M) for coordinate in pose.emitter)
        kept = first_orientation.setdefault(place, quaternion)
        if abs(kept @ quaternion) < _SAME_WAY * np.linalg.norm(kept) * np.linalg.norm(quaternion):
            report.skip(path.name, "loudspeaker has another orientation than at first")
            continue
        yield path.name, Measurement(pose.listener, pose.emitter, response, rate, name=path.name)


def entries(folder: Path, report: ImportReport) -> list[Entry]:
    """All responses of a room, each named by its numbered folder, whichever way the loudspeaker faced.

    Raises SourceError as `read` does.
    """
    return [
        Entry(path.name, path / "rir.wav", path.name, partial(_pose, path), partial(_response, path, report))
        for path in _responses(folder, report)
    ]


def _responses(folder: Path, report: ImportReport) -> list[Path]:
    inside = folder / "data" if (folder / "data").is_dir() else folder
    found = sorted(inside.iterdir())
    responses = [path for path in found if path.is_dir() and (path / "tx_pos.txt").exists()]
    if not responses:
        raise SourceError(inside, "responses", "no folder has a tx_pos.txt")
    for path in sorted({*found} - {*responses}):
        report.skip(path.name, "a folder without tx_pos.txt" if path.is_dir() else "a file beside the folders")
    return responses


def _placed(path: Path) -> tuple[Pose, npt.NDArray[np.float64]]:
    """The pose of one response, and the quaternion of its loudspeaker."""
    listener = _position(_numbers(path / "rx_pos.txt", 3))
    *orientation, x, y, z = _numbers(path / "tx_pos.txt", 7)
    return Pose(listener, _position((x, y, z))), np.array(orientation)


def _pose(path: Path) -> Pose:
    return _placed(path)[0]


def _response(path: Path, report: ImportReport) -> Sound:
    return read_response(path / "rir.wav", channels=1, report=report)


def _position(values: tuple[float, ...]) -> _Vector:
    x, y, z = values
    return x, z, y


def _numbers(path: Path, count: int) -> tuple[float, ...]:
    """Raises UnreadableError if the file does not hold exactly `count` finite numbers."""
    try:
        words = path.read_text(encoding="utf-8").replace(",", " ").split()
    except (OSError, UnicodeDecodeError) as exc:
        raise UnreadableError(f"{path.name} unreadable") from exc
    try:
        values = tuple(map(parse_decimal, words))
    except ValueError as exc:
        raise UnreadableError(f"{path.name} has not {count} finite numbers") from exc
    if len(values) != count:
        raise UnreadableError(f"{path.name} has not {count} finite numbers")
    return values
