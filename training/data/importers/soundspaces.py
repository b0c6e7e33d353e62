"""Reads SoundSpaces 1.0: binaural responses between the points of a scene, at a few head orientations.

A scene's `points.txt` has a row "index, x, y, z" for each point, in the mesh's coordinates: metres, x right, y forward,
z up, at ear height. (Habitat's y-up coordinates are derived from them, and not used here.)
`<azimuth>/<receiver>_<source>.wav` are the responses. The azimuth is the heading in degrees, 0 along +y and clockwise
seen from above, so 90 is +x: yaw = 90 degrees - azimuth. In SoundSpaces, a file that is empty or cannot be read stands
for zeros; here it counts as missing (Chen et al., "SoundSpaces: audio-visual navigation in 3D environments", ECCV 2020;
`azimuth_angle` and `load_metadata` in https://github.com/facebookresearch/sound-spaces).
"""

import math
import re
from collections.abc import Callable, Generator, Iterable
from functools import partial
from pathlib import Path

from server.core.numerals import parse_decimal, parse_integer
from training.data.importers.audio import UnreadableError, read_response
from training.data.importers.conditioning import SourceError
from training.data.importers.entries import Entry, Pose, at
from training.data.importers.report import ImportReport
from training.data.responses import Measurement

_PAIR = re.compile(r"[0-9]+_[0-9]+\.wav")
_Point = tuple[float, float, float]


def read(
    folder: Path,
    report: ImportReport,
    *,
    points: Path | None = None,
    track: Callable[[list[Entry]], Iterable[Entry]] = iter,
) -> Generator[tuple[str, Measurement]]:
    """Yields a name and a measurement for each response of the scene folder that holds the azimuths. Without `points`,
    points.txt is looked for in that folder, and where a SoundSpaces download has it (`metadata` beside
    `binaural_rirs`).

    Raises SourceError for missing or malformed points, or for a folder without azimuths.
    """
    for entry in track(entries(folder, report, points=points)):
        name = f"{entry.name}.wav"
        try:
            response, rate = entry.response()
        except UnreadableError as exc:
            report.skip(name, str(exc))
            continue
        pose = entry.pose()
        yield name, Measurement(pose.listener, pose.emitter, response, rate, pose.yaw, entry.name)


def entries(folder: Path, report: ImportReport, *, points: Path | None = None) -> list[Entry]:
    """The responses of a scene folder, each named `<azimuth>/<receiver>_<source>`. The report gets what is skipped.

    Raises SourceError as `read` does.
    """
    positions = read_points(points or _points_file(folder))
    azimuths = _azimuths(folder, report)
    by_azimuth: dict[Path, set[str]] = {}
    for azimuth in azimuths:
        names = {path.name for path in azimuth.iterdir()}
        by_azimuth[azimuth] = {name for name in names if _PAIR.fullmatch(name)}
        for name in sorted(names - by_azimuth[azimuth]):
            report.skip(f"{azimuth.name}/{name}", "not named <receiver>_<source>.wav")
        for name in _duplicates(by_azimuth[azimuth]):
            by_azimuth[azimuth].remove(name)
            report.skip(f"{azimuth.name}/{name}", "a pair that another file is named by too")
    everywhere = set().union(*by_azimuth.values())
    for azimuth, names in by_azimuth.items():
        for name in sorted(everywhere - names):
            report.skip(f"{azimuth.name}/{name}", "missing at this azimuth")
    found = []
    for path in [azimuth / name for azimuth, names in by_azimuth.items() for name in sorted(names)]:
        receiver, source = (int(index) for index in path.stem.split("_"))
        if receiver not in positions or source not in positions:
            report.skip(f"{path.parent.name}/{path.name}", "a point that points.txt does not have")
            continue
        pose = Pose(positions[receiver], positions[source], heading_to_yaw(_azimuth(path.parent)))
        found.append(
            Entry(
                f"{path.parent.name}/{path.stem}",
                path,
                "_".join(map(str, sorted((receiver, source)))),
                at(pose),
                partial(read_response, path, 2, report),
                path.parent.name,
            )
        )
    return found


def heading_to_yaw(azimuth_deg: float) -> float:
    """Converts degrees clockwise from +y to radians counter-clockwise from +x, within [-pi, pi)."""
    return math.radians((90.0 - azimuth_deg + 180.0) % 360.0 - 180.0)


def read_points(path: Path) -> dict[int, _Point]:
    """Positions by index. Raises SourceError naming the line at fault."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as exc:
        raise SourceError(path, "file", f"cannot be read ({exc})") from exc
    points: dict[int, _Point] = {}
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            index, x, y, z = line.split()
            key, point = parse_integer(index), (parse_decimal(x), parse_decimal(y), parse_decimal(z))
        except ValueError as exc:
            raise SourceError(path, f"line {number}", f"{line!r} is not an index and three numbers") from exc
        if key in points:
            raise SourceError(path, f"line {number}", f"index {key} is there twice")
        points[key] = point
    if not points:
        raise SourceError(path, "points", "none")
    return points


def _azimuths(folder: Path, report: ImportReport) -> list[Path]:
    """The folders that are named by a heading in degrees, ordered by heading from 0 to 360. The report lists everything
    else.

    Raises SourceError if there is no such folder, or if two have the same heading.
    """
    found: dict[float, Path] = {}
    for path in sorted(folder.iterdir()):
        if not path.is_dir():
            if path.name != "points.txt":
                report.skip(path.name, "a file beside the azimuths")
            continue
        try:
            azimuth = _azimuth(path)
        except ValueError:
            inside = sum(1 for each in path.rglob("*") if each.is_file())
            report.skip(f"{path.name}/", "in a folder that is not named by an azimuth in degrees", inside)
            continue
        other = found.setdefault(azimuth, path)
        if other != path:
            problem = f"{other.name!r} and {path.name!r} are one azimuth; leave one out"
            raise SourceError(folder, "azimuths", problem)
    if not found:
        raise SourceError(folder, "azimuths", "no folder is named by an azimuth in degrees")
    return [found[azimuth] for azimuth in sorted(found)]


def _duplicates(names: set[str]) -> list[str]:
    """File names whose pair has a shorter name already, as `00_1.wav` beside `0_1.wav`."""
    pairs: set[tuple[int, ...]] = set()
    duplicates = []
    for name in sorted(names, key=lambda each: (len(each), each)):
        pair = tuple(int(index) for index in name.removesuffix(".wav").split("_"))
        if pair in pairs:
            duplicates.append(name)
        pairs.add(pair)
    return duplicates


def _azimuth(folder: Path) -> float:
    """Degrees, from 0 to below 360. Raises ValueError for a folder that is not named by a number."""
    return parse_decimal(folder.name) % 360.0


def _points_file(folder: Path) -> Path:
    beside = folder / "points.txt"
    parts = folder.resolve().parts
    if beside.is_file() or "binaural_rirs" not in parts:
        return beside
    return Path(*("metadata" if part == "binaural_rirs" else part for part in parts)) / "points.txt"
