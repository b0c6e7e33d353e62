"""Computes the targets of all responses that may be trained on, once, and stores them in a file. Pairs are computed in
threads.

HDF5 lets one process at a time write the file. The rows lie in one piece, and are then read through a memory map.
"""

import hashlib
import json
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import h5py
import numpy as np
import numpy.typing as npt
from rich.progress import Progress

from server.acoustics.codec import Codec
from training.data.dataset_check import DatasetError
from training.data.responses import ResponseSet
from training.models.cells import Cells
from training.models.directional_targets import DirectionalTargets
from training.models.expected_targets import ExpectedTargets
from training.models.targets import align, delay_samples, flat_targets
from training.simulation.half_precision import to_half
from training.simulation.responses import SimulatedResponses

_FORMAT = 1
_FLUSH_S = 10.0
_PAIRS_AT_A_TIME = 64


@dataclass(frozen=True)
class Targets:
    """Poses and flat targets, one row per response that is not held out, or one per pair; `flat` is a memory map.
    `seconds` is the time of the processor that their computation took."""

    listener: npt.NDArray[np.float32]
    emitter: npt.NDArray[np.float32]
    yaw: npt.NDArray[np.float32]
    flat: npt.NDArray[np.float16]
    seconds: float


class _Computation(Protocol):
    def of_rows(self, rows: npt.NDArray[np.int64]) -> npt.NDArray[np.float16]:
        """(row, n) flat targets of some responses of one pair."""
        ...


def load_targets(
    responses: ResponseSet, cells: Cells, folder: Path, progress: Progress, *, expected: bool = False
) -> Targets:
    """Targets at the ears for all responses that are not held out, stored in `folder` in one file for each choice of
    `cells` and `expected`. An interrupted computation continues where it stopped, and targets are computed again when
    the responses have been rewritten.

    With `expected`, for simulated responses only, targets are expected values over all draws of a response's noise.
    Raises DatasetError if another process is computing the same, or if the file is
    damaged.
    """
    choice = {"format": _FORMAT, "cells": asdict(cells), "expected": expected}

    def computation() -> _Computation:
        return _Expected(_simulated(responses), cells) if expected else _Drawn(responses, cells)

    return _load(responses, np.flatnonzero(~responses.held_out), choice, computation, folder, progress)


def load_directional_targets(responses: ResponseSet, cells: Cells, folder: Path, progress: Progress) -> Targets:
    """Targets of directions, of the highest order, with one row for each pair that is not held out, in the order of
    pairs. They are stored and raise errors like those at the ears."""
    rows = np.flatnonzero(~responses.held_out)
    first = rows[np.flatnonzero(np.diff(responses.pair[rows], prepend=-1))]
    choice = {"format": _FORMAT, "cells": asdict(cells), "predicts": "directions"}
    return _load(responses, first, choice, lambda: _Directional(_simulated(responses), cells), folder, progress)


def load_expected_points(responses: ResponseSet, codec: Codec, folder: Path, progress: Progress) -> Targets:
    """Expected log-magnitude and instantaneous frequency of every point (channel, frequency, frame, 2) of all responses
    that are not held out, for fields that learn other points of them in every step. Some gigabytes a scene. They are
    stored and raise errors like targets."""
    rows = np.flatnonzero(~responses.held_out)
    choice = {"format": _FORMAT, "expected_points": True, "codec": asdict(codec)}
    return _load(responses, rows, choice, lambda: _ExpectedPoints(_simulated(responses), codec), folder, progress)


def load_aligned(responses: ResponseSet, folder: Path, progress: Progress) -> Targets:
    """The aligned responses that are not held out, one after the other (channel, sample), for fields that learn other
    points of them in every step. They are stored and raise errors like targets."""
    whole = isinstance(responses, SimulatedResponses) and responses.whole
    choice = {"format": _FORMAT, "aligned": True, "whole": whole}
    return _load(responses, np.flatnonzero(~responses.held_out), choice, lambda: _Aligned(responses), folder, progress)


def _load(
    responses: ResponseSet,
    rows: npt.NDArray[np.int64],
    choice: dict[str, Any],
    computation: Callable[[], _Computation],
    folder: Path,
    progress: Progress,
) -> Targets:
    """Targets of these rows; `choice` names their file."""
    path = folder / f"targets-{hashlib.sha256(json.dumps(choice).encode()).hexdigest()[:12]}.h5"
    key = json.dumps({"written": responses.file.stat().st_mtime_ns, "rows": len(rows)})
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with h5py.File(path, "a") as file:
            if file.attrs.get("key") != key:
                file.clear()
                file.attrs.update(key=key, pairs=0, seconds=0.0)
            _complete(file, responses.pair[rows], rows, computation, progress)
            offset, shape = file["flat"].id.get_offset(), file["flat"].shape
            seconds = float(file.attrs["seconds"])
    except BlockingIOError as exc:
        raise DatasetError(f"{path}: another process is computing these targets; wait for it") from exc
    except OSError as exc:
        raise DatasetError(f"{path}: not a file of targets; delete it, and it will be computed again ({exc})") from exc
    listener, emitter, yaw = (
        part[rows].astype(np.float32) for part in (responses.listener, responses.emitter, responses.yaw)
    )
    return Targets(listener, emitter, yaw, np.memmap(path, np.float16, "r", offset, shape), seconds)


def _complete(
    file: h5py.File,
    pairs: npt.NDArray[np.int64],
    rows: npt.NDArray[np.int64],
    computation: Callable[[], _Computation],
    progress: Progress,
) -> None:
    """Computes the pairs that the file does not have yet. Its attribute `pairs` counts those it has; `pairs` (row,) are
    those of the rows."""
    starts = np.flatnonzero(np.diff(pairs, prepend=-1))
    done = int(file.attrs["pairs"])
    if done == len(starts):
        return
    targets = computation()
    task = progress.add_task("targets", total=len(starts), completed=done)
    flushed_s, began_s = time.monotonic(), time.process_time()
    bounds = np.append(starts, len(rows))
    workers = os.cpu_count() or 1

    def of_pair(number: int) -> npt.NDArray[np.float16]:
        return targets.of_rows(rows[bounds[number] : bounds[number + 1]])

    # Pairs come in the order of emitters, whose images are found once for all of them: threads take pairs in order.
    with ThreadPoolExecutor(workers, "targets") as pool:
        for first in range(done, len(starts), _PAIRS_AT_A_TIME):
            numbers = range(first, min(first + _PAIRS_AT_A_TIME, len(starts)))
            for number, flat in zip(numbers, pool.map(of_pair, numbers), strict=True):
                if "flat" not in file:
                    file.create_dataset("flat", (len(rows), flat.shape[-1]), np.float16)
                file["flat"][bounds[number] : bounds[number + 1]] = flat
                progress.advance(task)
            if time.monotonic() - flushed_s > _FLUSH_S or numbers.stop == len(starts):
                file.flush()
                file.attrs["pairs"] = numbers.stop
                now_s = time.process_time()
                file.attrs["seconds"] += now_s - began_s
                flushed_s, began_s = time.monotonic(), now_s


def _simulated(responses: ResponseSet) -> SimulatedResponses:
    if not isinstance(responses, SimulatedResponses):
        raise DatasetError("expected targets exist for simulated responses only")
    return responses


@dataclass(frozen=True)
class _Drawn:
    responses: ResponseSet
    cells: Cells

    def of_rows(self, rows: npt.NDArray[np.int64]) -> npt.NDArray[np.float16]:
        responses = self.responses
        return flat_targets(align(responses.read(rows), delay_samples(responses, rows[0])), self.cells)


@dataclass(frozen=True)
class _Aligned:
    responses: ResponseSet

    def of_rows(self, rows: npt.NDArray[np.int64]) -> npt.NDArray[np.float16]:
        responses = self.responses
        aligned = align(responses.read(rows), delay_samples(responses, rows[0]))
        return to_half(aligned.astype(np.float32)).reshape(len(rows), -1)


class _Expected:
    def __init__(self, responses: SimulatedResponses, cells: Cells) -> None:
        self._responses, self._targets = responses, ExpectedTargets(responses.dataset, cells)

    def of_rows(self, rows: npt.NDArray[np.int64]) -> npt.NDArray[np.float16]:
        emitter, listener = self._responses.ends(rows[0])
        return self._targets.of_pair(emitter, listener)[rows % len(self._responses.dataset.yaws)]


class _ExpectedPoints:
    def __init__(self, responses: SimulatedResponses, codec: Codec) -> None:
        cells = Cells(codec, fine_frames=codec.frames, known_frames=codec.frames)
        self._responses, self._targets = responses, ExpectedTargets(responses.dataset, cells)

    def of_rows(self, rows: npt.NDArray[np.int64]) -> npt.NDArray[np.float16]:
        points = self._targets.points_of_pair(*self._responses.ends(rows[0]))
        return points[rows % len(self._responses.dataset.yaws)].reshape(len(rows), -1)


class _Directional:
    def __init__(self, responses: SimulatedResponses, cells: Cells) -> None:
        self._responses, self._targets = responses, DirectionalTargets(responses.dataset, cells)

    def of_rows(self, rows: npt.NDArray[np.int64]) -> npt.NDArray[np.float16]:
        return self._targets.of_pair(*self._responses.ends(rows[0]))[None]
