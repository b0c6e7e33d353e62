"""The spectra of a wave at the ears, from each direction: minimum phase and a delay per ear. The band gains of the
wave's path are applied as a minimum-phase filter, too.

Logarithms of spectra are interpolated between measured directions and added. So each wave takes one exponential and one
sine per bin, computed eight bins at a time.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ, band_weights
from server.acoustics.minimum_phase import folded_cepstrum
from server.kernels.compiled import compiled
from server.kernels.simd import (
    LANES,
    broadcast,
    cosine_sine,
    exponential,
    load,
    multiply,
    multiply_add,
    store,
)
from server.rendering.hrtf import HeadFilters
from server.rendering.sphere import find_triangle

_Floats = npt.NDArray[np.float64]
_Singles = npt.NDArray[np.float32]
_Spectra = npt.NDArray[np.complex64]


@dataclass(frozen=True)
class HeadSpectra:
    """The spectra of a head at the frequencies of a transform of `n_fft` samples."""

    head: HeadFilters
    n_fft: int

    @property
    def bins(self) -> int:
        return self.n_fft // 2 + 1

    def arriving(self, directions: _Floats) -> _Spectra:
        """(..., ear, bin) spectra of waves from directions (..., xyz) relative to the head."""
        flat = np.ascontiguousarray(directions.reshape(-1, 3))
        unit_gains = np.ones((len(flat), len(OCTAVE_BANDS_HZ)))
        return self.specular(flat[:, None], unit_gains, np.zeros(len(flat))).reshape(
            *directions.shape[:-1], 2, self.bins
        )

    def specular(self, directions: _Floats, amplitudes: _Floats, delays: _Floats) -> _Spectra:
        """(wave, yaw, ear, bin) spectra of waves from directions (wave, yaw, xyz) relative to the head, with gains
        (wave, band) and delays (wave,) in samples to the middle of the head."""
        waves, yaws, _ = directions.shape
        mesh = self.head.triangulation
        flat = np.ascontiguousarray(directions.reshape(-1, 3))
        triangles, shares = _triangles_around(mesh.across, mesh.inverses, flat)
        corners = mesh.triangles[triangles]
        later = np.einsum("dc,dce->de", shares, self.head.delays_s[corners]) * self.head.sample_rate
        later += np.repeat(delays, yaws)[:, None]
        gains = np.log(np.maximum(amplitudes, 1e-12)).astype(np.float32)
        path_logs = gains @ self._band_logs.reshape(len(gains.T), -1)
        spectra = np.empty((waves, yaws, 2, self.bins), np.complex64)
        _spectra(
            corners,
            shares.astype(np.float32),
            (later * (-2 * np.pi / self.n_fft)).astype(np.float32),
            path_logs.reshape(waves, *self._band_logs.shape[1:]),
            self._logs,
            np.arange(self._logs.shape[-1], dtype=np.float32),
            spectra.reshape(waves, yaws, 2 * self.bins),
        )
        return spectra

    @cached_property
    def _logs(self) -> _Singles:
        """(measured direction, ear, part, bin) log spectra of the head's filters; bins are padded to whole vectors."""
        return self._in_parts(np.fft.rfft(self.head.cepstra, self.n_fft))

    @cached_property
    def _band_logs(self) -> _Singles:
        """(band, part, bin) log spectra of minimum-phase filters with gain e in one band; bins are padded. Multiplied
        by the logarithms of a wave's gains, they give the filter of its path."""
        weights = band_weights(np.asarray(np.fft.rfftfreq(self.n_fft, 1 / self.head.sample_rate), np.float64))
        return self._in_parts(np.fft.rfft(folded_cepstrum(weights), self.n_fft))

    def _in_parts(self, spectra: npt.NDArray[np.complexfloating]) -> _Singles:
        parts = np.zeros((*spectra.shape[:-1], 2, -(-self.bins // LANES) * LANES), np.float32)
        parts[..., 0, : self.bins], parts[..., 1, : self.bins] = spectra.real, spectra.imag
        return parts


@compiled
def _spectra(corners, shares, turns, path_logs, logs, numbers, spectra):
    """Fill `spectra` (wave, yaw, ear and bin). `turns` (direction, ear) are radians per bin; a direction is a wave at a
    yaw."""
    waves, yaws, _ = spectra.shape
    padded = logs.shape[-1]
    bins = spectra.shape[2] // 2
    parts = np.empty((2, padded), np.float32)
    real, imaginary = parts[0].ctypes.data, parts[1].ctypes.data
    for wave in range(waves):
        for yaw in range(yaws):
            direction = wave * yaws + yaw
            for ear in range(2):
                turn = broadcast(turns[direction, ear])
                for first in range(0, padded, 8):
                    size = load(path_logs[wave, 0].ctypes.data, first)
                    phase = load(path_logs[wave, 1].ctypes.data, first)
                    for corner in range(3):
                        share = broadcast(shares[direction, corner])
                        of_corner = logs[corners[direction, corner], ear]
                        size = multiply_add(load(of_corner[0].ctypes.data, first), share, size)
                        phase = multiply_add(load(of_corner[1].ctypes.data, first), share, phase)
                    phase = multiply_add(load(numbers.ctypes.data, first), turn, phase)
                    size = exponential(size)
                    cosine, sine = cosine_sine(phase)
                    store(real, first, multiply(size, cosine))
                    store(imaginary, first, multiply(size, sine))
                for number in range(bins):
                    spectra[wave, yaw, ear * bins + number] = complex(parts[0, number], parts[1, number])


@compiled
def _triangles_around(across, inverses, directions):
    """(direction,) the triangle that contains each direction, and (direction, 3) the weights of its corners."""
    triangles, shares = np.empty(len(directions), np.int64), np.empty((len(directions), 3))
    triangle = 0
    for index in range(len(directions)):
        triangle = find_triangle(across, inverses, directions[index], triangle, shares[index])
        triangles[index] = triangle
    return triangles, shares
