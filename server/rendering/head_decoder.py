"""Filters by which a head's two ears hear ambisonic channels.

Ambisonics of a low order cannot describe the waves at both ears above a few hundred hertz: decoded by least squares,
high frequencies would be far too weak and the sound dull. But above some 1.5 kHz the ear hardly hears the phase of a
wave. So there the filters fit magnitudes and leave the phase free: magnitude least squares (Schoerkhuber, Zaunschirm
and Hoeldrich, "Binaural rendering of ambisonic signals via magnitude least squares", DAGA 2018). A matrix for each
frequency gives diffuse sound the level and the interaural coherence that the head has (Zaunschirm, Schoerkhuber and
Hoeldrich, "Binaural rendering of ambisonic signals by head-related impulse response time alignment and a diffuseness
constraint", J. Acoust. Soc. Am. 143, 3616, 2018).

Filters with a free phase spread over time. They are fitted and cut to their length in turn, each time with the phase
that the cut ones have (alternating projections, as in Griffin and Lim's method).

Channels are ACN and SN3D (`server.acoustics.spherical_harmonics`), in the head's frame: x ahead, y left, z up.
"""

from collections.abc import Callable
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from server.acoustics.spherical_harmonics import even_directions, mean_squares, real_harmonics
from server.rendering.ear_products import wave_spectra
from server.rendering.hrtf import HeadFilters

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]

ORDERS = (1, 2, 3)
_DIRECTIONS = 300
_BINS = 513
_FITS_PHASE_BELOW_HZ, _FITS_MAGNITUDE_FROM_HZ = 1000.0, 2000.0
_DIFFUSE_FROM_HZ, _DIFFUSE_FULLY_FROM_HZ = 300.0, 600.0
"""Times the order: below, the channels describe the waves at both ears."""
_RESTRAINT = 1e-4
"""Share of the mean of both ears' power that is added to either in the diffuse field: at low frequencies the ears are
so alike that the matrix would be singular."""
_DELAY_S = 0.001
_LENGTH_S = 0.0053
_RISE_SHARE, _FALL_SHARE = 1 / 3, 0.15
"""Of the delay and of the length, at the ends of the filters."""
_ROUNDS = 15


@dataclass(frozen=True, eq=False)
class HeadDecoder:
    """Filters (ear, k, tap) of a head for ambisonic channels k of one order. Ear 0 is the left one. Sound in the middle
    of the head is heard `delay` samples later."""

    order: int
    sample_rate: int
    filters: npt.NDArray[np.float32]
    delay: int

    @classmethod
    def of(cls, filters: HeadFilters, order: int, *, rest: Callable[[], None] = lambda: None) -> "HeadDecoder":
        """Design the filters of a head, half a second of work; for the same head they are kept. Meanwhile `rest` is
        called often: it may sleep, or raise what ends the work.

        Raises ValueError for an order that is none of ORDERS.
        """
        if order not in ORDERS:
            raise ValueError(f"order: is {order}, must be 1, 2 or 3")
        kept = _KEPT.setdefault(filters, {})
        if order not in kept:
            kept[order] = cls(order, filters.sample_rate, *_design(filters, order, rest))
        return kept[order]


_KEPT: "WeakKeyDictionary[HeadFilters, dict[int, HeadDecoder]]" = WeakKeyDictionary()


def _design(filters: HeadFilters, order: int, rest: Callable[[], None]) -> tuple[npt.NDArray[np.float32], int]:
    """Filters (ear, k, tap), and their delay in samples."""
    rate = filters.sample_rate
    delay, taps = round(_DELAY_S * rate), round(_LENGTH_S * rate)
    n_fft = 2 * (_BINS - 1)
    bins = np.arange(_BINS)[:, None, None]
    late = np.exp(-2j * np.pi * bins * delay / n_fft)
    frequencies = bins * rate / n_fft
    window = _window(delay, taps)[:, None, None]
    directions = even_directions(_DIRECTIONS)
    harmonics = real_harmonics(directions, order)
    inverse = np.asarray(np.linalg.pinv(harmonics), dtype=np.float64)
    waves = np.moveaxis(wave_spectra(filters, directions, _BINS), -1, 0)
    is_free = _share(frequencies, _FITS_PHASE_BELOW_HZ, _FITS_MAGNITUDE_FROM_HZ)
    is_mixed = _share(frequencies, order * _DIFFUSE_FROM_HZ, order * _DIFFUSE_FULLY_FROM_HZ)
    fitted = _from_low_to_high(waves, harmonics, inverse, is_free, rest)
    for _ in range(_ROUNDS):
        rest()
        fitted += is_mixed * (_with_diffuse_field(fitted, waves, mean_squares(order)) - fitted)
        late_ones = fitted * late
        late_ones[[0, -1]] = late_ones[[0, -1]].real
        responses = np.fft.irfft(late_ones, n_fft, axis=0)[:taps] * window
        heard = harmonics @ np.swapaxes(np.fft.rfft(responses, n_fft, axis=0) / late, 1, 2)
        fitted = _least_squares(inverse, _with_free_phase(waves, heard, is_free))
    return np.ascontiguousarray(np.moveaxis(responses, 0, -1), dtype=np.float32), delay


def _share(frequencies: _Floats, none_below: float, all_from: float) -> _Floats:
    return np.clip((frequencies - none_below) / (all_from - none_below), 0, 1)


def _window(delay: int, taps: int) -> _Floats:
    rise, fall = round(_RISE_SHARE * delay), round(_FALL_SHARE * taps)
    window = np.ones(taps)
    window[:rise] = 0.5 - 0.5 * np.cos(np.pi * (np.arange(rise) + 0.5) / rise)
    window[-fall:] = 0.5 + 0.5 * np.cos(np.pi * (np.arange(fall) + 0.5) / fall)
    return window


def _from_low_to_high(
    waves: _Complex, harmonics: _Floats, inverse: _Floats, is_free: _Floats, rest: Callable[[], None]
) -> _Complex:
    """(bin, ear, k) filters that fit waves (bin, direction, ear). A free phase is the one that the filters of the bin
    before make."""
    fitted = np.empty((len(waves), waves.shape[-1], harmonics.shape[1]), dtype=np.complex128)
    before = waves[0]
    for number, wave in enumerate(waves):
        fitted[number] = _least_squares(inverse, _with_free_phase(wave, before, is_free[number]))
        before = harmonics @ fitted[number].T
        rest()
    return fitted


def _least_squares(inverse: _Floats, waves: _Complex) -> _Complex:
    return np.swapaxes(inverse @ waves, -1, -2)


def _with_free_phase(waves: _Complex, heard: _Complex, is_free: _Floats) -> _Complex:
    """The waves, but with the phases that are heard where the phase is free."""
    return np.asarray((1 - is_free) * waves + is_free * np.abs(waves) * np.exp(1j * np.angle(heard)))


def _with_diffuse_field(fitted: _Complex, waves: _Complex, powers: _Floats) -> _Complex:
    """The filters, mixed so that channels of diffuse sound, with these powers, have the head's level at each ear and
    its cross-spectrum between both. Of all such mixtures it is the one that changes least."""
    wanted = np.einsum("fde,fdg->feg", waves, np.conj(waves)) / waves.shape[1]
    found = np.einsum("fek,k,fgk->feg", fitted, powers, np.conj(fitted))
    wanted_root, found_root = (np.linalg.cholesky(_restrained(covariance)) for covariance in (wanted, found))
    left, _, right = np.linalg.svd(np.conj(np.swapaxes(wanted_root, -1, -2)) @ found_root)
    return np.asarray(wanted_root @ left @ right @ np.linalg.inv(found_root) @ fitted)


def _restrained(covariance: _Complex) -> _Complex:
    mean = np.trace(covariance, axis1=-2, axis2=-1).real / 2
    return np.asarray(covariance + _RESTRAINT * mean[:, None, None] * np.eye(2))
