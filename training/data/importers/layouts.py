"""Published layouts that a benchmark reads: how each names its responses, and which splits of it are published.

A layout is an object: how a folder is recognised, its responses, their names, and its splits, each with its source.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from training.data.importers import acousticrooms, meshrir, raf, soundspaces
from training.data.importers.conditioning import SourceError
from training.data.importers.entries import Entry
from training.data.importers.report import ImportReport
from training.data.splits import Split, hashed_split, read_split, split_of_groups


@dataclass(frozen=True)
class Options:
    """What some layouts have to be told. points: SoundSpaces' points.txt. source_rate: rate of MeshRIR's arrays."""

    points: Path | None = None
    source_rate: int = 48_000


@dataclass(frozen=True, kw_only=True)
class Layout:
    """name: as in commands. channels: of each response. normal: turns what split files and folders of predictions call
    a response into its name. files: where a dataset keeps a published split, relative to its folder, as patterns.
    built_in: splits that are known without a file, the first of which is the default."""

    name: str
    channels: int
    recognises: Callable[[Path], bool]
    entries: Callable[[Path, ImportReport, Options], list[Entry]]
    normal: Callable[[str], str]
    files: tuple[str, ...] = ()
    built_in: Mapping[str, Callable[[list[Entry]], Split]] | None = None

    def split_of(self, folder: Path, entries: list[Entry], asked: str = "") -> Split:
        """The split that is `asked` for: a built-in one by name, or a file. If none is, the one that the dataset ships,
        or else the layout's own.

        Raises SplitError if it cannot be read or does not fit the entries, and SourceError if several files are found.
        """
        if asked == HASHED:
            return hashed_split({entry.name: entry.pair for entry in entries})
        if self.built_in is not None and asked in self.built_in:
            return self.built_in[asked](entries)
        names = [entry.name for entry in entries]
        if asked:
            return read_split(Path(asked), names, self.normal)
        shipped = sorted({path for pattern in self.files for path in folder.glob(pattern)})
        if len(shipped) > 1:
            listed = ", ".join(str(path.relative_to(folder)) for path in shipped)
            raise SourceError(folder, "split", f"several files are found ({listed}): choose one by --split")
        if shipped:
            return read_split(shipped[0], names, self.normal)
        if self.built_in is not None:
            return next(iter(self.built_in.values()))(entries)
        return hashed_split({entry.name: entry.pair for entry in entries})


HASHED = "hashed"
"""Asks for the split that depends on names alone, whatever the dataset ships."""

# Rooms that xRIR never trains on; its paper calls this the unseen split.
_UNSEEN_ROOMS = frozenset(
    {
        "Apartments/Apartments_idx_42",
        "Apartments/Apartments_idx_50",
        "Auditorium/Auditorium_idx_1",
        "Bathrooms/Bathrooms_idx_14",
        "Bathrooms/Bathrooms_idx_18",
        "Bedrooms/Bedrooms_idx_18",
        "Bedrooms/Bedrooms_idx_33",
        "Cafe/Cafe_idx_1",
        "ListeningRoom/ListeningRoom_idx_2",
        "LivingRoomsWithHallway/LivingRoomsWithHallway_idx_25",
        "LivingRoomsWithHallway/LivingRoomsWithHallway_idx_30",
        "MeetingRoom/MeetingRoom_idx_20",
        "MeetingRoom/MeetingRoom_idx_32",
        "Office/Office_idx_10",
        "Office/Office_idx_11",
        "Restaurants/Restaurants_idx_22",
        "Restaurants/Restaurants_idx_24",
    }
)


def without_suffix(name: str) -> str:
    """The name of a file of sound or of an array, without its ending."""
    for suffix in (".wav", ".npy"):
        if name.lower().endswith(suffix):
            return name[: -len(suffix)]
    return name


def _of_acousticrooms(name: str) -> str:
    parts = without_suffix(name).split("/")
    if parts[0] in acousticrooms.RESPONSES:
        parts = parts[1:]
    return "/".join(parts).removesuffix(acousticrooms.SUFFIX)


def _of_raf(name: str) -> str:
    return without_suffix(name).removeprefix("data/").removesuffix("/rir")


def _unseen(entries: list[Entry]) -> Split:
    return split_of_groups(
        {entry.name: entry.group for entry in entries},
        _UNSEEN_ROOMS,
        name="unseen",
        source="the 17 test rooms of treble_xRIR_dataset.py in https://github.com/DragonLiu1995/xRIR_code",
    )


def _of_folders(entries: list[Entry]) -> Split:
    """The split by the folders `train` and `test`, or the hashed one where there are none."""
    by_name = {entry.name: entry.file.parent.name for entry in entries}
    if meshrir.TEST not in by_name.values():
        return hashed_split({entry.name: entry.pair for entry in entries})
    source = (
        "the folders train and test, as meshrir_split.py in https://github.com/penn-waves-lab/AVR makes them, at random"
    )
    return split_of_groups(by_name, {meshrir.TEST}, name="folders", source=source)


LAYOUTS: Mapping[str, Layout] = {
    layout.name: layout
    for layout in (
        Layout(
            name="soundspaces",
            channels=2,
            recognises=lambda folder: any(
                path.is_dir() and path.name in {"0", "90", "180", "270"} for path in folder.iterdir()
            ),
            entries=lambda folder, report, options: soundspaces.entries(folder, report, points=options.points),
            normal=without_suffix,
            files=("split.json", "metadata_AudioNeRF/split.json"),
        ),
        Layout(
            name="raf",
            channels=1,
            recognises=lambda folder: any(
                (path / "tx_pos.txt").exists()
                for path in (folder / "data" if (folder / "data").is_dir() else folder).iterdir()
            ),
            entries=lambda folder, report, _: raf.entries(folder, report),
            normal=_of_raf,
            files=("data-split*.json", "data-split/data-split*.json", "metadata/data-split*.json"),
        ),
        Layout(
            name="meshrir",
            channels=1,
            recognises=lambda folder: (folder / "pos_mic.npy").is_file(),
            entries=lambda folder, report, options: meshrir.entries(folder, report, source_rate=options.source_rate),
            normal=without_suffix,
            built_in={"folders": _of_folders},
        ),
        Layout(
            name="acousticrooms",
            channels=1,
            recognises=lambda folder: any((folder / name).is_dir() for name in acousticrooms.RESPONSES),
            entries=lambda folder, report, _: acousticrooms.entries(folder, report),
            normal=_of_acousticrooms,
            built_in={"unseen": _unseen},
        ),
    )
}


def layout_of(folder: Path, name: str = "") -> Layout:
    """The layout called `name`, or the one that the folder is recognised by.

    Raises SourceError for an unknown name, or if the folder is of no known layout.
    """
    if name:
        if name not in LAYOUTS:
            raise SourceError(folder, "layout", f"there is no {name!r}, but {', '.join(LAYOUTS)}")
        return LAYOUTS[name]
    if folder.is_dir():
        for layout in LAYOUTS.values():
            if layout.recognises(folder):
                return layout
    raise SourceError(
        folder, "layout", f"is none of {', '.join(LAYOUTS)}, and no dataset of nafir-train: name --layout"
    )
