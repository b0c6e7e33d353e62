"""Checks every array of a dataset before training uses it. One sample that is not finite would spoil everything that is
computed from it, hours later, when its origin can no longer be found.

Energies are read one pair at a time.
"""

from pathlib import Path

import h5py
import numpy as np

from server.core.errors import NafirError

_LOUDEST_LOG_ENERGY = 80.0  # exp(88) overflows single precision


class DatasetError(NafirError):
    """A dataset folder is missing, unfinished or of another format, or holds impossible values."""


def require_possible_energies(path: Path, file: h5py.File, shape: tuple[int, ...]) -> None:
    """Raises DatasetError, naming array and pair, for energies of another shape than `shape` (take, emitter, listener,
    ...), not finite, or too large for sound."""
    stored = file["log_energy"]
    if stored.shape != shape:
        raise DatasetError(f"{path}: log_energy: has shape {stored.shape}, expected {shape}; simulate anew")
    if stored.chunks != (1, 1, 1, *shape[3:]):
        raise DatasetError(f"{path}: log_energy: is not stored pair by pair; simulate into an empty folder")
    for take, emitter, listener in _pairs_in(stored):
        # Energy 0 has the logarithm -inf. NumPy compares half precision three times as slowly.
        if not np.max(stored[take, emitter, listener].astype(np.float32)) <= _LOUDEST_LOG_ENERGY:
            raise DatasetError(
                f"{path}: log_energy: the pair of emitter {emitter} and listener {listener} has energies that are not "
                "finite, or not of sound; simulate into an empty folder"
            )
    if "tail" in file:
        energies, start_s = file["tail/energies"][()], file["tail/start_s"][()]
        for name, values in (("energies", energies), ("start_s", start_s)):
            if not np.isfinite(values).all() or np.min(values, initial=0) < 0:
                raise DatasetError(f"{path}: tail.{name}: has values that are negative or not finite; simulate anew")
        # Files of earlier versions have one tail for a take, and none of the training pairs' own.
        if len(energies) not in (shape[0], shape[0] + 1) or energies.shape[1:3] != shape[3:5]:
            raise DatasetError(
                f"{path}: tail.energies: has shape {energies.shape}, expected takes, directions and bands of {shape}; "
                "simulate anew"
            )


def _pairs_in(stored: h5py.Dataset) -> list[tuple[int, int, int]]:
    """Take, emitter and listener of the pairs that were simulated. All others of an array of one chunk for each pair
    take no place in the file, and would take minutes to read."""
    found: list[tuple[int, int, int]] = []
    stored.id.chunk_iter(lambda chunk: found.append(chunk.chunk_offset[:3]))
    return sorted(found)
