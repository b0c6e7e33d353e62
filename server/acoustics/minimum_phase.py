"""Minimum-phase filters by the cepstrum. Of all filters of one magnitude, the minimum-phase one has its energy
earliest.

A folded cepstrum is the power series of the logarithm of a causal minimum-phase filter, log H(z) = sum_n c[n] z**-n
(Oppenheim & Schafer, "Discrete-Time Signal Processing", ch. 13). Adding folded cepstra multiplies magnitudes.
"""

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import FILTER_BANDS_HZ

_Floats = npt.NDArray[np.float64]

_ITD_BAND_HZ = 1500.0
_LONGEST_ADVANCE_S = 0.002


def folded_cepstrum(log_magnitude: _Floats) -> _Floats:
    """Natural logarithms of magnitude (..., n_fft / 2 + 1) to coefficients (..., n_fft / 2 + 1)."""
    cepstrum = np.fft.irfft(log_magnitude)
    half = cepstrum.shape[-1] // 2
    cepstrum[..., 1:half] *= 2
    return np.asarray(cepstrum[..., : half + 1])


def excess_delays_samples(pairs: _Floats, sample_rate: float) -> _Floats:
    """(..., ear) delays of the impulse responses (..., ear, sample) of two ears relative to minimum-phase responses of
    the same magnitude.

    The delay between the ears is the peak of their cross-correlation below 1.5 kHz, where it is audible (Wightman &
    Kistler, "The dominant role of low-frequency interaural time differences in sound localization", 1992), minus that
    of the minimum-phase pair. The common delay is the peak of the envelope of the correlation with the minimum-phase
    pair. The phase of the loudspeaker used in the measurement does not move that envelope.
    """
    n_fft = 4 * 2 ** int(np.ceil(np.log2(max(pairs.shape[-1], 64))))
    spectra = np.fft.rfft(pairs, n_fft)
    magnitude = np.maximum(np.abs(spectra), 1e-6 * np.abs(spectra).max(axis=-1, keepdims=True))
    minimum = np.exp(np.fft.rfft(folded_cepstrum(np.log(magnitude)), n_fft))
    low = 1 / (1 + (np.fft.rfftfreq(n_fft, 1 / sample_rate) / _ITD_BAND_HZ) ** 8)
    advance = round(_LONGEST_ADVANCE_S * sample_rate)

    def between(pair: npt.NDArray[np.complex128]) -> _Floats:
        return _peak(np.fft.irfft(pair[..., 1, :] * np.conj(pair[..., 0, :]) * low, n_fft), advance)

    analytic = np.zeros((*spectra.shape[:-1], n_fft), np.complex128)
    analytic[..., : spectra.shape[-1]] = spectra * np.conj(minimum) * low
    both = np.mean(_peak(np.abs(np.fft.ifft(analytic)), advance), axis=-1)
    half = 0.5 * (between(spectra) - between(minimum))
    return np.stack([both - half, both + half], axis=-1)


def _peak(circular: _Floats, advance: int) -> _Floats:
    """(...,) interpolated lag of the greatest sample of circular correlations (..., lag). Lags down to -`advance` count
    as negative."""
    turned = np.roll(circular, advance, axis=-1)
    peak = np.argmax(turned, axis=-1)
    around = np.clip(peak[..., None] + np.array([-1, 0, 1]), 0, turned.shape[-1] - 1)
    before, at, after = np.moveaxis(np.take_along_axis(turned, around, axis=-1), -1, 0)
    # The vertex of a parabola through three points. A signal below 1.5 kHz is smooth between samples.
    curvature = np.minimum(before - 2 * at + after, -1e-30)
    return np.asarray(peak - advance + np.clip(0.5 * (before - after) / curvature, -0.5, 0.5))


def band_cepstra(sample_rate: float, taps: int) -> _Floats:
    """(band, tap) folded cepstrum of a gain of one decibel in each of FILTER_BANDS_HZ. The gain is linear over log
    frequency between band centres and flat beyond the first and the last.

    A short cepstrum smooths the corners of this shape. The shapes are mixed so that the gains are exact at the centres.
    """
    centres = np.array(FILTER_BANDS_HZ)
    n_fft = 2 ** int(np.ceil(np.log2(64 * taps)))
    frequency = np.maximum(np.fft.rfftfreq(n_fft, 1 / sample_rate), 1.0)
    octave = np.clip(np.log2(frequency / centres[0]), 0, len(centres) - 1)
    decibels = np.maximum(0.0, 1 - np.abs(octave - np.arange(len(centres))[:, None]))
    nepers = np.log(10) / 20
    shapes = folded_cepstrum(nepers * decibels)[:, :taps]
    # guard: bands above Nyquist's frequency are left out
    audible = centres < sample_rate / 2
    at_centres = shapes @ np.cos(2 * np.pi / sample_rate * np.outer(np.arange(taps), centres)) / nepers
    shapes[audible] = np.linalg.solve(at_centres[np.ix_(audible, audible)], shapes[audible])
    shapes[~audible] -= at_centres[np.ix_(~audible, audible)] @ shapes[audible]
    return shapes
