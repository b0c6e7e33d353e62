"""Interpolates sound fields by kernel ridge regression with a kernel that solves the Helmholtz equation (Ueno, Koyama
and Saruwatari, "Kernel ridge regression with constraint of Helmholtz equation for sound field interpolation", IWAENC
2018): at wave number k, sin(k d) / (k d) of the distance d between two listeners.

It interpolates between the listeners of one emitter. At a fixed orientation, a head hears a sum of plane waves, each
with a factor of its own, which solves the same equation. So every ear at every yaw is interpolated separately.

Axes: responses (yaw, channel, sample); spectra (listener, yaw, channel, frequency). Metres, hertz.
"""

import numpy as np
import numpy.typing as npt
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq

from training.baselines.baselines import ALL_YAWS, TrainingPairs, YawIndices
from training.data.dataset import SPEED_OF_SOUND

_Floats = npt.NDArray[np.float64]
_Responses = npt.NDArray[np.float32]

REGULARISATIONS = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)
# The kernel's filter extends to both sides by the travel time between the most distant listeners.
_PADDING_S = 0.1
_CHUNK = 512  # frequencies
_CHOOSING_EMITTERS = 3
_CHOOSING_STEP = 16  # every so many frequencies


class HelmholtzInterpolation:
    """Interpolates below `cutoff_hz` and is silent above, if a cut-off is given. Interpolation fails where the distance
    between listeners exceeds half a wavelength."""

    def __init__(self, pairs: TrainingPairs, sample_rate: int, cutoff_hz: float | None = None) -> None:
        """Chooses `regularisations` (octave,): those with the least leave-one-out error over the training listeners of
        the first emitters that have enough of them."""
        self._pairs = pairs
        self._sample_rate = sample_rate
        self._cutoff_hz = cutoff_hz
        self.regularisations = self._choose()

    def response(self, pair: int, yaw_indices: YawIndices = ALL_YAWS) -> _Responses | None:
        """None if training has no pair of this emitter."""
        pairs = self._pairs
        known = self._known(int(pairs.pair_emitter[pair]))
        if not len(known):
            return None
        responses = np.stack([pairs.response(int(number))[yaw_indices] for number in known])
        samples = responses.shape[-1]
        size = self._size(samples)
        frequency = rfftfreq(size, 1 / self._sample_rate)
        passed = self._passed(frequency)
        used = np.flatnonzero(passed)
        listeners = pairs.listener_positions[pairs.pair_listener[known]]
        target = pairs.listener_positions[pairs.pair_listener[pair]]
        spectra = rfft(responses, size, axis=-1)
        between = np.linalg.norm(listeners[:, None] - listeners, axis=-1)
        towards = np.linalg.norm(listeners - target, axis=-1)
        estimate = np.zeros(spectra.shape[1:], dtype=np.complex64)
        for start in range(0, len(used), _CHUNK):
            part = used[start : start + _CHUNK]
            ridge = self.regularisations[octaves(frequency[part])][:, None, None]
            matrix = kernel(frequency[part], between) + ridge * np.eye(len(known))
            weights = np.linalg.solve(matrix, kernel(frequency[part], towards)[..., None])[..., 0]
            estimate[..., part] = np.einsum("nycf,fn->ycf", spectra[..., part], weights * passed[part, None])
        return irfft(estimate, size, axis=-1)[..., :samples].astype(np.float32)

    def _known(self, emitter: int) -> npt.NDArray[np.integer]:
        return np.flatnonzero(self._pairs.training & (self._pairs.pair_emitter == emitter))

    def _size(self, samples: int) -> int:
        return next_fast_len(samples + round(_PADDING_S * self._sample_rate), real=True)

    def _passed(self, frequency: _Floats) -> _Floats:
        """Gain of the low-pass filter: one up to the cut-off, then a raised cosine over half an octave, then zero."""
        if self._cutoff_hz is None:
            return np.ones(len(frequency))
        octaves = np.log2(np.maximum(frequency, 1e-3) / self._cutoff_hz)
        return np.asarray(0.5 + 0.5 * np.cos(np.pi * np.clip(2 * octaves, 0, 1)))

    def _choose(self) -> _Floats:
        count = int(octaves(np.array([self._sample_rate / 2]))[0]) + 1
        errors = np.zeros((count, len(REGULARISATIONS)))
        emitters = [number for number in np.unique(self._pairs.pair_emitter) if len(self._known(int(number))) > 2]
        for emitter in emitters[:_CHOOSING_EMITTERS]:
            known = self._known(int(emitter))
            responses = np.stack([self._pairs.response(int(number))[0] for number in known])
            size = self._size(responses.shape[-1])
            frequency = rfftfreq(size, 1 / self._sample_rate)
            used = np.flatnonzero(self._passed(frequency))[::_CHOOSING_STEP]
            spectra = np.moveaxis(rfft(responses, size, axis=-1)[..., used], -1, 0).astype(np.complex128)
            listeners = self._pairs.listener_positions[self._pairs.pair_listener[known]]
            matrix = kernel(frequency[used], np.linalg.norm(listeners[:, None] - listeners, axis=-1))
            for number, regularisation in enumerate(REGULARISATIONS):
                left_out = np.abs(left_out_errors(matrix, spectra, regularisation)) ** 2
                errors[:, number] += np.bincount(octaves(frequency[used]), left_out.sum(axis=(1, 2)), count)
        return np.asarray(np.array(REGULARISATIONS)[np.argmin(errors, axis=1)])


def octaves(frequency: _Floats) -> npt.NDArray[np.int64]:
    """(frequency,) the number of the octave of each frequency; the lowest octave is everything below 125 Hz."""
    return np.maximum(np.floor(np.log2(np.maximum(frequency, 1.0) / 62.5)), 0).astype(np.int64)


def kernel(frequency: _Floats, distance_m: _Floats) -> _Floats:
    """(frequency, ...) kernel values for distances (...)."""
    wavelengths = frequency.reshape(-1, *(1,) * np.ndim(distance_m)) * distance_m / SPEED_OF_SOUND
    return np.asarray(np.sinc(2 * wavelengths))


def left_out_errors(
    matrix: _Floats, values: npt.NDArray[np.complexfloating], regularisation: float
) -> npt.NDArray[np.complexfloating]:
    """(frequency, listener, ...) differences of `values` from their estimates by all other listeners, for kernels
    (frequency, listener, listener). The closed form leaves no listener out explicitly (Rasmussen and Williams, Gaussian
    Processes for Machine Learning, 2006, 5.4.2)."""
    inverse = np.linalg.inv(matrix + regularisation * np.eye(matrix.shape[-1]))
    flat = values.reshape(*values.shape[:2], -1)
    errors = (inverse @ flat) / np.diagonal(inverse, axis1=-2, axis2=-1)[..., None]
    return np.asarray(errors.reshape(values.shape))
