"""The responses that a benchmark scores: of a published layout, or of a dataset of `nafir-train`.

A case is what is read at once: one response, or those of a pair at all its orientations.
"""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from training.baselines.baselines import TrainingPairs
from training.baselines.held_out import EvaluationError, HeldOut, open_held_out, unique_points
from training.data.dataset import SPEED_OF_SOUND
from training.data.importers.audio import UnreadableError
from training.data.importers.conditioning import SourceError
from training.data.importers.entries import Entry, Pose
from training.data.importers.layouts import Options, layout_of, without_suffix
from training.data.importers.report import ImportReport
from training.data.responses import FILE
from training.data.splits import Split
from training.evaluation.literature import resampled

PAIRS = "pairs.h5"
OWN_LAYOUT = "nafir"
_Responses = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Case:
    """names: of each row. truth: reads (row, channel, sample). poses: of each row. in_sight: False if it is known that
    the ends do not see each other."""

    names: tuple[str, ...]
    truth: Callable[[], _Responses]
    poses: Callable[[], tuple[Pose, ...]]
    in_sight: bool = True


@dataclass(frozen=True)
class Group:
    """Held-out pairs that methods of ours can predict. names: by index and yaw index."""

    held_out: HeldOut
    names: Callable[[int, int], str]


@dataclass(frozen=True)
class BenchmarkData:
    """known: names of all responses of the dataset. normal: turns names of files into names of responses. groups: for
    methods of ours, which may learn from the other part of the split. files: that hold the references. file_digest: of
    the file that references are drawn from, where they are drawn; otherwise what is read is digested. scored_rate,
    duration_s: the rate that responses are resampled to, and the first part that is scored, if not all of it."""

    name: str
    layout: str
    channels: int
    sample_rate: int
    split: Split
    cases: Sequence[Case]
    known: frozenset[str]
    normal: Callable[[str], str]
    groups: Callable[[], list[Group]]
    files: tuple[Path, ...]
    file_digest: Callable[[], str] | None = None
    scored_rate: int = 0
    duration_s: float | None = None

    def __post_init__(self) -> None:
        if not self.scored_rate:
            object.__setattr__(self, "scored_rate", self.sample_rate)

    def identity(self) -> list[object]:
        """What errors depend on besides the predictions, in plain values; the samples of references are not read."""
        files = [[str(path), path.stat().st_size, path.stat().st_mtime_ns] for path in self.files]
        return [self.name, self.layout, self.split.digest, self.sample_rate, self.scored_rate, self.duration_s, files]

    @property
    def scored(self) -> frozenset[str]:
        return frozenset(name for case in self.cases for name in case.names)

    def fit(self, responses: _Responses) -> _Responses:
        """References (..., sample) as they are scored: resampled as waveforms, and cut."""
        if self.scored_rate != self.sample_rate:
            responses = resampled(responses, self.sample_rate, self.scored_rate).astype(np.float32)
        return responses if self.duration_s is None else responses[..., : round(self.duration_s * self.scored_rate)]


def open_benchmark(folder: Path, *, layout: str = "", split: str = "", options: Options | None = None) -> BenchmarkData:
    """Opens a dataset of a published layout, or one of `nafir-train`, whose held-out pairs are its split.

    Raises NafirError for a folder that is neither, or damaged, and for a split that does not fit.
    """
    if not folder.is_dir():
        raise SourceError(folder, "dataset", "there is no such folder")
    is_own = (folder / PAIRS).exists() or (folder / FILE).exists()
    if layout == OWN_LAYOUT or (is_own and not layout):
        if split:
            raise SourceError(folder, "split", "a dataset of nafir-train has its own; leave --split out")
        return _own(folder)
    return _published(folder, layout, split, options or Options())


def _own(folder: Path) -> BenchmarkData:
    with open_held_out(folder) as held_out:
        pairs = held_out.pairs

        def name(pair: int, yaw_index: int) -> str:
            return f"{pairs.pair_listener[pair]}_{pairs.pair_emitter[pair]}_{yaw_index}"

        def names(pair: int) -> tuple[str, ...]:
            return tuple(name(pair, int(yaw_index)) for yaw_index in held_out.yaw_indices)

        test = {name for pair in held_out.held_out for name in names(int(pair))}
        train = {name for pair in np.flatnonzero(pairs.training) for name in names(int(pair))}
        return BenchmarkData(
            name=held_out.name,
            layout=OWN_LAYOUT,
            channels=held_out.channels,
            sample_rate=held_out.sample_rate,
            split=Split("held out", "the dataset's own held-out pairs", frozenset(train), frozenset(test)),
            cases=[
                Case(
                    names(int(pair)),
                    partial(_own_truth, held_out, index),
                    partial(_own_poses, held_out, index),
                    bool(held_out.visible[index]),
                )
                for index, pair in enumerate(held_out.held_out)
            ],
            known=frozenset(test | train),
            normal=without_suffix,
            groups=lambda: [Group(held_out, lambda index, yaw: name(int(held_out.held_out[index]), yaw))],
            files=(folder / (FILE if held_out.simulated is None else PAIRS),),
            file_digest=None if held_out.simulated is None else partial(_digest, folder / PAIRS),
        )


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _own_truth(held_out: HeldOut, index: int) -> _Responses:
    return np.asarray(held_out.reference(index), dtype=np.float32)


def _own_poses(held_out: HeldOut, index: int) -> tuple[Pose, ...]:
    listener, emitter = tuple(held_out.listeners[index].tolist()), tuple(held_out.emitters[index].tolist())
    return tuple(Pose(listener, emitter, float(held_out.yaws[yaw])) for yaw in held_out.yaw_indices)


def _published(folder: Path, layout_name: str, split_name: str, options: Options) -> BenchmarkData:
    layout = layout_of(folder, layout_name)
    entries = layout.entries(folder, ImportReport(), options)
    split = layout.split_of(folder, entries, split_name)
    by_name = {entry.name: entry for entry in entries}
    test = [by_name[name] for name in sorted(split.test)]
    _, rate = _read(test[0])
    return BenchmarkData(
        name=folder.resolve().name,
        layout=layout.name,
        channels=layout.channels,
        sample_rate=rate,
        split=split,
        cases=[Case((entry.name,), partial(_truth, entry, rate), partial(_poses, entry)) for entry in test],
        known=frozenset(by_name),
        normal=layout.normal,
        groups=lambda: _groups(folder, layout.name, entries, split, rate),
        files=tuple(entry.file for entry in test),
    )


def _read(entry: Entry) -> tuple[_Responses, int]:
    try:
        return entry.response()
    except UnreadableError as exc:
        raise SourceError(entry.file, "response", f"{exc}: download it again; every test response is needed") from exc


def _truth(entry: Entry, rate: int) -> _Responses:
    response, own_rate = _read(entry)
    if own_rate != rate:
        raise SourceError(entry.file, "sample_rate", f"is {own_rate} Hz, and others have {rate} Hz")
    if not np.isfinite(response).all():
        raise SourceError(entry.file, "response", "has samples that are not finite: download it again")
    return response[np.newaxis]


def _poses(entry: Entry) -> tuple[Pose, ...]:
    try:
        return (entry.pose(),)
    except UnreadableError as exc:
        raise SourceError(entry.file, "places", str(exc)) from exc


@dataclass(frozen=True)
class _EntryResponses:
    """The responses of entries, each cut or padded to the same length."""

    entries: Sequence[Entry]
    rate: int
    samples: int

    def __getitem__(self, pair: int) -> _Responses:
        response = _truth(self.entries[pair], self.rate)[..., : self.samples]
        return np.pad(response, ((0, 0), (0, 0), (0, self.samples - response.shape[-1])))


def _groups(folder: Path, layout: str, entries: Sequence[Entry], split: Split, rate: int) -> list[Group]:
    """A group for each heading or room that has test responses, with the training responses of the same group."""
    by_group: dict[str, list[Entry]] = {}
    for entry in entries:
        if entry.name in split.test or entry.name in split.train:
            by_group.setdefault(entry.group, []).append(entry)
    groups = []
    for group, members in by_group.items():
        held_out = np.array([entry.name in split.test for entry in members])
        if not held_out.any():
            continue
        if held_out.all():
            raise EvaluationError(f"{folder}: {group}: the split leaves no response to learn from there")
        groups.append(_group(folder, layout, members, held_out, rate))
    return groups


def _group(folder: Path, layout: str, members: list[Entry], held_out: npt.NDArray[np.bool_], rate: int) -> Group:
    poses = [_poses(entry)[0] for entry in members]
    listeners, listener = unique_points(np.array([pose.listener for pose in poses]))
    emitters, emitter = unique_points(np.array([pose.emitter for pose in poses]))
    tested = np.flatnonzero(held_out)
    channels, samples = _read(members[tested[0]])[0].shape
    for index in tested[1:]:
        samples = max(samples, _read(members[index])[0].shape[-1])
    pairs = TrainingPairs(_EntryResponses(members, rate, samples), listener, emitter, listeners, emitters, ~held_out)
    distance = np.linalg.norm(emitters[emitter] - listeners[listener], axis=-1)
    return Group(
        HeldOut(
            folder=folder,
            name=f"{folder.name} (measured, {layout})",
            sample_rate=rate,
            samples=samples,
            channels=channels,
            pairs=pairs,
            held_out=tested,
            repeats=None,
            delays_s=distance / SPEED_OF_SOUND,
            yaws=np.array([poses[0].yaw]),
            yaw_indices=np.array([0]),
            visible=np.ones(len(tested), dtype=bool),
            simulated=None,
        ),
        lambda index, _: members[int(tested[index])].name,
    )


def truth_digest(names: Sequence[str], responses: Mapping[str, str]) -> str:
    """SHA-256 of all references: a line for each, by name, of its name and the digest of its samples."""
    lines = "".join(f"{name} {responses[name]}\n" for name in sorted(names))
    return hashlib.sha256(lines.encode()).hexdigest()
