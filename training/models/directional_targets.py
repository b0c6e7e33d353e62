"""Training targets of the directional field: the expected power of a simulated pair in each octave band and cell of
frames, and where it arrives from, as spherical harmonics.

Powers of all arrivals are added, because most of them are noise, and the phase between the others changes within a few
centimetres.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from server.acoustics.spherical_harmonics import HIGHEST_ORDER, real_harmonics
from training.data.dataset import Dataset
from training.models.cells import Cells
from training.models.targets import LEAD_SAMPLES
from training.simulation.expected import ExpectedSpectrograms

_Floats = npt.NDArray[np.float64]

_AUDIBLE = 10.0
"""Directions are learned of powers above this many times the power of the codec's floor."""


def harmonic_powers(directions: _Floats, powers: npt.NDArray[np.floating], order: int = HIGHEST_ORDER) -> _Floats:
    """(harmonic, ...) powers in spherical harmonics, of arrivals from `directions` (arrival, xyz) with `powers`
    (arrival, ...)."""
    return np.tensordot(real_harmonics(directions, order).T, powers, 1)


class DirectionalTargets:
    """Computes targets of the highest order for the pairs of a simulated dataset."""

    def __init__(self, dataset: Dataset, cells: Cells) -> None:
        self._dataset, self._codec = dataset, cells.codec
        self._spectrograms = ExpectedSpectrograms(dataset, cells.codec)
        self._pool = cells.all_frames.pool()

    def of_pair(self, emitter: int, listener: int) -> npt.NDArray[np.float16]:
        """(size of the heads,) flat target, aligned like those of ears."""
        advance = self._dataset.onset_s[emitter, listener] * self._dataset.sample_rate - LEAD_SAMPLES
        arrivals = self._spectrograms.arrivals(emitter, listener, self._pool, advance)
        power, *others = harmonic_powers(*arrivals)
        floor = self._codec.log_floor**2
        # guard: silence comes from nowhere
        shares = np.where(power > _AUDIBLE * floor, np.stack(others) / np.maximum(power, floor), 0.0)
        parts: tuple[npt.NDArray[Any], ...] = self._codec.log_magnitude(np.sqrt(power)), shares
        return np.concatenate([part.ravel() for part in parts]).astype(np.float16)
