"""Impulse responses with their poses: one interface to simulated ones (`training.simulation.responses`) and measured
ones.

A row is one response with its pose in metres and radians; yaw is counter-clockwise, 0 along +x. `ImportedDataset` is
the folder that importers write. Its `responses.h5` has one row per measured response: float32, whole, with the direct
sound.
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Protocol

import h5py
import numpy as np
import numpy.typing as npt

from server.core.errors import NafirError
from training.data.dataset import SPEED_OF_SOUND
from training.data.dataset_check import DatasetError
from training.data.importers.report import ImportReport

FORMAT = 1
FILE = "responses.h5"
SAME_POINT_M = 1e-3
_SAMPLES_PER_READ = 2**22

_Floats = npt.NDArray[np.float64]
_Integers = npt.NDArray[np.int64]
_Booleans = npt.NDArray[np.bool_]
_Generic = npt.NDArray[np.generic]
_Responses = npt.NDArray[np.float32]


class ResponsesError(NafirError):
    """A folder of measured responses is missing, damaged or of another format. The message names file and field."""

    def __init__(self, path: Path, field: str, problem: str) -> None:
        super().__init__(f"{path}: {field}: {problem}")
        self.path = path
        self.field = field
        self.problem = problem


class ResponseSet(Protocol):
    """Impulse responses with their poses, one response per row."""

    @property
    def sample_rate(self) -> int: ...
    @property
    def samples(self) -> int: ...
    @property
    def channels(self) -> int:
        """2 for responses at two ears (channel 0 is left), 1 for a microphone."""
        ...

    @property
    def listener(self) -> _Floats:
        """(row, 3) metres."""
        ...

    @property
    def emitter(self) -> _Floats:
        """(row, 3) metres."""
        ...

    @property
    def yaw(self) -> _Floats:
        """(row,) radians."""
        ...

    @property
    def pair(self) -> _Integers:
        """(row,) number of the pair, from 0; rows of one pair differ only in yaw."""
        ...

    @property
    def held_out(self) -> _Booleans:
        """(row,) True for rows that training never sees: all yaws and both directions of a pair."""
        ...

    @property
    def onset_s(self) -> _Floats:
        """(row,) seconds until the first sound can arrive, from geometry."""
        ...

    @property
    def file(self) -> Path:
        """The HDF5 file that holds the responses."""
        ...

    def read(self, rows: npt.ArrayLike) -> _Responses:
        """(n, channel, sample)"""
        ...


@dataclass(frozen=True)
class Measurement:
    """One response `(channel, sample)` with its pose, as an importer yields it. name: what splits call it. held_out:
    whether training never sees it; None if that is to be drawn."""

    listener: tuple[float, float, float]
    emitter: tuple[float, float, float]
    response: _Responses
    sample_rate: int
    yaw: float = 0.0
    name: str = ""
    held_out: bool | None = None


@dataclass(frozen=True)
class ImportedDataset:
    """A folder of measured responses that is open for reading. `write` makes one."""

    folder: Path
    layout: str
    """The importer's name."""
    source: str
    """The path that the responses were imported from."""
    sample_rate: int
    samples: int
    channels: int
    listener: _Floats
    emitter: _Floats
    yaw: _Floats
    held_out: _Booleans
    report: ImportReport

    @cached_property
    def pair(self) -> _Integers:
        _, pair = np.unique(np.concatenate([self.emitter, self.listener], axis=1), axis=0, return_inverse=True)
        return np.asarray(pair.reshape(-1))

    @cached_property
    def onset_s(self) -> _Floats:
        """(row,) seconds along the straight line. The walls are unknown, so a pair that is out of sight hears its first
        sound later."""
        return np.asarray(np.linalg.norm(self.emitter - self.listener, axis=-1) / SPEED_OF_SOUND)

    @property
    def file(self) -> Path:
        return self.folder / FILE

    def read(self, rows: npt.ArrayLike) -> _Responses:
        rows = np.asarray(rows, dtype=np.int64)
        ascending, which = np.unique(rows, return_inverse=True)  # HDF5 reads rows in ascending order
        with h5py.File(self.folder / FILE, "r") as file:
            return _require_finite_samples(np.asarray(file["responses"][ascending], dtype=np.float32), self.file)[which]

    @classmethod
    def open(cls, folder: Path) -> "ImportedDataset":
        """Raises ResponsesError if the folder holds no imported responses or damaged ones."""
        path = folder / FILE
        if not path.is_file():
            raise ResponsesError(
                path,
                "file",
                "no such file; nafir-train simulate SCENE.toml -o DATA or nafir-train import makes a dataset",
            )
        try:
            file = h5py.File(path, "r")
        except OSError as exc:
            raise ResponsesError(path, "file", f"not a readable HDF5 file ({exc})") from exc
        with file:
            if file.attrs.get("format") != FORMAT:
                raise ResponsesError(path, "format", f"is {file.attrs.get('format')}, expected {FORMAT}")
            shape = _array(path, file, "responses").shape
            if len(shape) != 3 or 0 in shape or shape[1] not in {1, 2}:
                raise ResponsesError(path, "responses", f"has shape {shape}, not (row, one or two channels, sample)")
            rows = {
                name: _rows(path, file, name, (shape[0], *rest))
                for name, rest in (("listener", (3,)), ("emitter", (3,)), ("yaw", ()), ("held_out", ()))
            }
            try:
                report = ImportReport.parse(file.attrs["report"])
            except (KeyError, TypeError, ValueError) as exc:
                raise ResponsesError(path, "report", f"not an import report ({exc})") from exc
            rate = int(file.attrs.get("sample_rate", 0))
            if rate <= 0:
                raise ResponsesError(path, "sample_rate", f"is {rate}")
            _require_finite(path, file["responses"], rows["listener"], rows["emitter"])
            return cls(
                folder,
                str(file.attrs.get("layout", "")),
                str(file.attrs.get("source", "")),
                rate,
                shape[2],
                shape[1],
                rows["listener"],
                rows["emitter"],
                rows["yaw"],
                rows["held_out"].astype(bool),
                report,
            )

    @classmethod
    def write(
        cls,
        folder: Path,
        measurements: Iterable[Measurement],
        report: ImportReport,
        *,
        layout: str,
        source: str,
        held_out_share: float = 0.1,
        seed: int = 0,
    ) -> "ImportedDataset":
        """Writes the measurements to a folder and counts them in the report, which the iteration may still extend.
        Measurements may differ in length; shorter ones are padded with zeros. Unless they all say whether they are held
        out, a share of their pairs is drawn. The folder appears only when it is complete, and an earlier import in it
        is replaced.

        Raises ResponsesError if there are no measurements, if they differ in sample rate or channels, or if one is
        empty or not finite, and DatasetError if the folder holds a simulated dataset.
        """
        if (folder / "pairs.h5").exists():
            raise DatasetError(f"{folder}: holds a simulated dataset; choose another folder")
        remaining = iter(measurements)
        first = next(remaining, None)  # before a folder is made: a bad source leaves none behind
        if first is None:
            reasons = "; ".join(f"{skipped.count} {reason}" for reason, skipped in report.skipped.items())
            raise ResponsesError(Path(source), "responses", f"none could be read ({reasons or 'none found'})")
        _require_usable(first, 0, source)
        is_new = not folder.exists()
        folder.mkdir(parents=True, exist_ok=True)
        partial = folder / "responses.partial"
        try:
            held_out = held_out_share, seed
            _write_rows(partial, first, remaining, report, layout=layout, source=source, held_out=held_out)
            partial.replace(folder / FILE)
        except BaseException:
            partial.unlink(missing_ok=True)
            if is_new:
                folder.rmdir()
            raise
        return cls.open(folder)


def _write_rows(
    path: Path,
    first: Measurement,
    remaining: Iterable[Measurement],
    report: ImportReport,
    *,
    layout: str,
    source: str,
    held_out: tuple[float, int],
) -> None:
    """Writes the measurements to the file `path`. `held_out` is the share of couples that are held out, and the seed
    that chooses them."""
    listener, emitter, yaw, held_out_rows = [], [], [], []
    with h5py.File(path, "w") as file:
        channels, samples = first.response.shape
        responses = file.create_dataset(
            "responses",
            (0, channels, 0),
            np.float32,
            maxshape=(None, channels, None),
            chunks=(1, channels, samples),
        )
        for row, measurement in enumerate(chain([first], remaining)):
            _require_usable(measurement, row, source)
            channels, samples = measurement.response.shape
            if measurement.sample_rate != first.sample_rate:
                problem = f"{measurement.sample_rate} Hz in row {row} after {first.sample_rate} Hz; ask for one rate"
                raise ResponsesError(Path(source), "sample_rate", problem)
            if channels != len(first.response):
                problem = f"{channels} in row {row} after {len(first.response)}"
                raise ResponsesError(Path(source), "channels", problem)
            responses.resize((row + 1, channels, max(samples, responses.shape[2])))
            responses[row, :, :samples] = measurement.response
            listener.append(measurement.listener)
            emitter.append(measurement.emitter)
            yaw.append(measurement.yaw)
            held_out_rows.append(measurement.held_out)
            report.read += 1
        file["listener"], file["emitter"], file["yaw"] = np.array(listener), np.array(emitter), np.array(yaw)
        file["held_out"] = (
            choose_held_out(np.array(emitter), np.array(listener), *held_out)
            if None in held_out_rows
            else np.array(held_out_rows, dtype=bool)
        )
        file.attrs.update(
            format=FORMAT,
            sample_rate=first.sample_rate,
            layout=layout,
            source=source,
            report=json.dumps(report.to_json()),
        )


def choose_held_out(emitter: _Floats, listener: _Floats, share: float, seed: int) -> _Booleans:
    """(row,) True for all rows of a random share of the couples of points: every yaw, and both directions if both were
    measured, because by reciprocity one direction would reveal the other. Unless the share is zero, at least one couple
    is held out, and never all."""
    ends = np.round(np.stack([emitter, listener], axis=1) / SAME_POINT_M).astype(np.int64)
    _, point = np.unique(ends.reshape(-1, 3), axis=0, return_inverse=True)
    couples, couple = np.unique(np.sort(point.reshape(-1, 2), axis=1), axis=0, return_inverse=True)
    # guard: one couple at least is not held out
    wanted = 0 if share == 0 else min(max(1, round(share * len(couples))), len(couples) - 1)
    chosen = np.random.default_rng([seed, 1]).choice(len(couples), wanted, replace=False)
    return np.isin(couple.reshape(-1), chosen)


def _require_usable(measurement: Measurement, row: int, source: str) -> None:
    pose = (*measurement.listener, *measurement.emitter, measurement.yaw)
    # guard: a response without samples is not stored
    if measurement.response.shape[-1] == 0:
        raise ResponsesError(Path(source), "responses", f"row {row} has no samples; leave it out")
    # guard: a response that is not finite is not stored
    if not np.isfinite(measurement.response).all() or not np.isfinite(pose).all():
        raise ResponsesError(Path(source), "responses", f"row {row} is not finite, response or pose; leave it out")


def _require_finite_samples(responses: _Responses, path: Path) -> _Responses:
    """Returns the responses; raises ResponsesError if a sample is not finite."""
    # guard: a damaged file is not learned from
    if not np.isfinite(responses).all():
        raise ResponsesError(path, "responses", "hold samples that are not finite; simulate or import them anew")
    return responses


def _require_finite(path: Path, responses: h5py.Dataset, listener: _Generic, emitter: _Generic) -> None:
    """Raises ResponsesError, naming the first row whose samples are not finite and its positions. Reads a few rows at a
    time."""
    size = max(1, _SAMPLES_PER_READ // (responses.shape[1] * responses.shape[2]))
    for start in range(0, len(responses), size):
        is_bad = ~np.isfinite(responses[start : start + size]).all(axis=(1, 2))
        # guard: a damaged file is not opened
        if is_bad.any():
            row = start + int(np.argmax(is_bad))
            ends = f"listener {listener[row].tolist()}, emitter {emitter[row].tolist()}"
            raise ResponsesError(path, "responses", f"row {row} ({ends}) has samples that are not finite; import anew")


def _array(path: Path, file: h5py.File, name: str) -> h5py.Dataset:
    values = file.get(name)
    if not isinstance(values, h5py.Dataset):
        raise ResponsesError(path, name, "is missing")
    return values


def _rows(path: Path, file: h5py.File, name: str, shape: tuple[int, ...]) -> npt.NDArray[np.float64]:
    values = _array(path, file, name)
    if values.shape != shape:
        raise ResponsesError(path, name, f"has shape {values.shape}, expected {shape}")
    content = np.asarray(values[()])
    if not np.isfinite(content).all():
        raise ResponsesError(path, name, "has values that are not finite")
    return content
