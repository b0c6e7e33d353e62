"""Checks every array of a dataset before training uses it. One sample that is not finite would spoil everything that is
computed from it, hours later, when its origin can no longer be found.

Arrays are read one pair at a time; half-precision values are checked as the integers that their bits are, which reads
1.8 GB/s from memory.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from server.core.errors import NafirError

_LOUDEST_LOG_ENERGY = 80.0  # exp(88) overflows single precision


class DatasetError(NafirError):
    """A dataset folder is missing, unfinished or of another format, or holds impossible values."""


def require_finite_pairs(
    path: Path, file: h5py.File, *, probes: int, yaws: int, samples: int, takes: tuple[str, ...]
) -> None:
    """Raises DatasetError, naming array and pair, for shapes that do not fit each other, responses or energies that are
    not finite, and energies that are too large for sound."""
    for name in takes:
        _require_shape(path, file[name], (probes, probes, yaws, 2, samples))
        for emitter, listener, response in _pairs(file[name]):
            if not _is_finite(response):
                _refuse(path, name, emitter, listener, "has samples that are not finite")
    if "log_energy" in file:
        shape = file["log_energy"].shape
        if len(shape) != 5 or shape[:2] != (probes, probes):
            raise DatasetError(f"{path}: log_energy: has shape {shape}, expected {(probes, probes)} and three more")
        for emitter, listener, logarithms in _pairs(file["log_energy"]):
            # Energy 0 has the logarithm -inf.
            if not np.all(logarithms <= _LOUDEST_LOG_ENERGY):
                _refuse(path, "log_energy", emitter, listener, "has energies that are not finite, or not of sound")
    if "tail" in file:
        _require_tail(path, file, probes, takes)


def _pairs(array: h5py.Dataset) -> Iterator[tuple[int, int, npt.NDArray[Any]]]:
    """Yields emitter, listener and stored values of each pair of different probes."""
    for emitter in range(array.shape[0]):
        for listener in range(array.shape[1]):
            if emitter != listener:
                yield emitter, listener, array[emitter, listener]


def _is_finite(values: npt.NDArray[Any]) -> bool:
    if values.dtype == np.float16 and values.dtype.isnative:
        return bool((values.view(np.uint16) & 0x7FFF).max(initial=0) < 0x7C00)
    return bool(np.isfinite(values).all())


def _require_tail(path: Path, file: h5py.File, probes: int, takes: tuple[str, ...]) -> None:
    tail = file["tail"]
    for name in ("energies", "amplitudes", "start_s", "first"):
        values = tail[name][()]
        if not np.isfinite(values).all() or np.min(values, initial=0) < 0:
            raise DatasetError(f"{path}: tail.{name}: has values that are negative or not finite; simulate anew")
    length = tail["noise"].shape[-1]
    _require_shape(path, file["tail_begin"], (len(takes), probes, probes))
    begins = file["tail_begin"][()]
    is_outside = (begins < 0) | (begins >= length)
    if is_outside.any():
        _, emitter, listener = (int(index) for index in np.argwhere(is_outside)[0])
        _refuse(path, "tail_begin", emitter, listener, f"begins outside the {length} samples of the tail's noise")


def _require_shape(path: Path, array: h5py.Dataset, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise DatasetError(f"{path}: {array.name.strip('/')}: has shape {array.shape}, expected {shape}; simulate anew")


def _refuse(path: Path, name: str, emitter: int, listener: int, problem: str) -> None:
    pair = f"the pair of emitter {emitter} and listener {listener}"
    raise DatasetError(f"{path}: {name}: {pair} {problem}; simulate into an empty folder")
