"""Reads AcousticRooms: simulated rooms of ten kinds, one omnidirectional channel at 22,050 Hz.

`single_channel_ir/<kind>/<room>/S<source>_R<receiver>_hybrid_IR.wav` are the responses; in some copies the folder ends
in `_1`. `metadata/<kind>/<room>/S00<source>_R00<receiver>.json` has `src_loc` and `rec_loc`, [x, y, z] in metres, z up
(Liu et al., "Hearing Anywhere in Any Environment", CVPR 2025; `get_receiver_source_location` in
https://github.com/DragonLiu1995/xRIR_code).
"""

import json
import re
from collections.abc import Callable, Generator, Iterable
from functools import partial
from pathlib import Path

import numpy as np

from training.data.importers.audio import UnreadableError, read_response
from training.data.importers.conditioning import SourceError
from training.data.importers.entries import Entry, Pose
from training.data.importers.report import ImportReport
from training.data.responses import Measurement

RESPONSES = ("single_channel_ir", "single_channel_ir_1")
SUFFIX = "_hybrid_IR"
_FILE = re.compile(rf"S([0-9]+)_R([0-9]+){SUFFIX}\.wav")


def read(
    folder: Path,
    report: ImportReport,
    *,
    room: str = "",
    track: Callable[[list[Entry]], Iterable[Entry]] = iter,
) -> Generator[tuple[str, Measurement]]:
    """Yields a name and a measurement for each response of one `room`, `<kind>/<room>`, which may be left out where the
    folder has one room only.

    Raises SourceError for a folder without responses, or if it is not clear which room is meant.
    """
    found = entries(folder, report)
    rooms = sorted({entry.group for entry in found})
    if room not in rooms and (room or len(rooms) > 1):
        problem = f"{room!r} is not there" if room else "one has to be chosen, by --room"
        raise SourceError(folder, "room", f"{problem}: there are {len(rooms)}, {', '.join(rooms[:3])} ...")
    for entry in track([entry for entry in found if not room or entry.group == room]):
        try:
            pose = entry.pose()
            response, rate = entry.response()
        except UnreadableError as exc:
            report.skip(entry.name, str(exc))
            continue
        yield entry.name, Measurement(pose.listener, pose.emitter, response, rate, name=entry.name)


def entries(folder: Path, report: ImportReport) -> list[Entry]:
    """The responses of all rooms, each named `<kind>/<room>/S<source>_R<receiver>`, with the digits of its file.

    Raises SourceError for a folder without responses.
    """
    roots = [folder / name for name in RESPONSES if (folder / name).is_dir()]
    found = []
    for path in [path for root in roots for path in sorted(root.glob("*/*/*"))]:
        kind, room = path.parts[-3:-1]
        ends = _FILE.fullmatch(path.name)
        if ends is None:
            report.skip(f"{kind}/{room}/{path.name}", f"not named S<source>_R<receiver>{SUFFIX}.wav")
            continue
        name = f"{kind}/{room}/{path.stem.removesuffix(SUFFIX)}"
        source, receiver = int(ends[1]), int(ends[2])
        told = folder / "metadata" / kind / room
        candidates = [told / f"S00{source}_R00{receiver}.json", told / f"{path.stem.removesuffix(SUFFIX)}.json"]
        entry = Entry(
            name, path, name, partial(_pose, candidates), partial(read_response, path, 1, report), f"{kind}/{room}"
        )
        found.append(entry)
    if not found:
        raise SourceError(folder, "responses", f"there are none in {' or '.join(RESPONSES)}/<kind>/<room>")
    return found


def _pose(candidates: list[Path]) -> Pose:
    path = next((each for each in candidates if each.is_file()), None)
    if path is None:
        raise UnreadableError(f"no metadata ({candidates[0].name})")
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        places = np.array([told["rec_loc"], told["src_loc"]], dtype=np.float64)
    except (OSError, ValueError, KeyError, TypeError) as exc:
        raise UnreadableError(f"{path.name} has no src_loc and rec_loc") from exc
    if places.shape != (2, 3) or not np.isfinite(places).all():
        raise UnreadableError(f"{path.name} has not three finite numbers for each place")
    (x, y, z), (source_x, source_y, source_z) = places.tolist()
    return Pose((x, y, z), (source_x, source_y, source_z))
