"""Training targets without randomness: the expected value of each head's output over all draws of a simulated response.

A cell of a simulated spectrogram is a complex Gaussian of known mean and variance (`training.simulation.expected`). So
its expected power, the coherence between the ears and the expected phasor are known, and the network need not average
over random draws.
"""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.special import i0e, i1e

from training.data.dataset import Dataset
from training.models.cells import Cells
from training.models.targets import LEAD_SAMPLES, align
from training.simulation.expected import ExpectedSpectrograms

_Complex = npt.NDArray[np.complexfloating]


def expected_phasor(mean: _Complex, variance: npt.NDArray[np.floating]) -> npt.NDArray[np.complex128]:
    """E[S / |S|] of complex Gaussians S: the phasor of their mean m times sqrt(pi k) / 2 * exp(-k / 2) * (I0(k / 2) +
    I1(k / 2)) with k = |m|**2 / v (the first moment of the phase's density; Middleton, An Introduction to Statistical
    Communication Theory, 1960, ch. 9)."""
    magnitude = np.abs(mean).astype(np.float64)
    least = np.finfo(np.float64).tiny
    half = np.minimum(magnitude**2 / np.maximum(variance, least), 1e12) / 2
    certainty = np.sqrt(np.pi * half / 2) * (i0e(half) + i1e(half))
    return np.asarray(mean / np.maximum(magnitude, least) * certainty)


def _by_yaw(products: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Reorders (frequency, product, yaw, cell) to (yaw, product, frequency, cell)."""
    return products.transpose(2, 1, 0, 3)


class ExpectedTargets:
    """Computes expected targets for the pairs of a simulated dataset."""

    def __init__(self, dataset: Dataset, cells: Cells) -> None:
        self._dataset, self._cells = dataset, cells
        self._spectrograms = ExpectedSpectrograms(dataset, cells.codec)
        self._pool = cells.all_frames.pool()
        self._bands = cells.bands.pool().T

    def of_pair(self, emitter: int, listener: int) -> npt.NDArray[np.float16]:
        """(yaw, heads.size) flat targets."""
        cells, fine = self._cells, self._cells.fine_frames
        advance = self._dataset.onset_s[emitter, listener] * self._dataset.sample_rate - LEAD_SAMPLES
        diffuse = self._spectrograms.diffuse_products(emitter, listener, self._pool, advance)
        mean = self._mean(emitter, listener, advance)
        left, right = (np.moveaxis(mean[:, ear], 1, 0) for ear in (0, 1))
        cross = left * np.conj(right)
        specular = np.stack([np.abs(left) ** 2, np.abs(right) ** 2, cross.real, cross.imag], axis=1)
        products = diffuse + np.tensordot(specular.astype(np.float32), self._pool[: mean.shape[-1]], 1)
        pooled = np.tensordot(self._bands, products, 1)
        loudness = np.sqrt(pooled[:, 0] * pooled[:, 1])
        known = np.s_[..., : cells.known_frames]
        # Below the codec's floor there is no phase worth learning.
        variance = _by_yaw(diffuse[:, :2])[known] + cells.codec.log_floor**2
        phasor = expected_phasor(mean[known], variance)
        parts = (
            cells.codec.log_magnitude(_by_yaw(np.sqrt(products[:, :2, :, :fine]))),
            cells.codec.log_magnitude(_by_yaw(np.sqrt(pooled[:, :2, :, fine:]))),
            np.stack([phasor.real, phasor.imag], axis=1),
            _by_yaw(pooled[:, 2:] / np.maximum(loudness, 1e-20)[:, None]),
        )
        return np.concatenate([part.reshape(len(mean), -1) for part in parts], axis=-1).astype(np.float16)

    def points_of_pair(self, emitter: int, listener: int) -> npt.NDArray[np.float16]:
        """(yaw, ear, frequency, frame, 2) expected log-magnitude and instantaneous frequency of every point, for cells
        that are fine throughout. The log-magnitude is that of the expected power. The frequency is the angle of the
        expected product of a frame with the conjugate of the frame before; of noise alone it is zero."""
        codec, frames = self._cells.codec, self._cells.fine_frames
        advance = self._dataset.onset_s[emitter, listener] * self._dataset.sample_rate - LEAD_SAMPLES
        diffuse = self._spectrograms.diffuse_products(emitter, listener, self._pool, advance)
        variance = np.maximum(_by_yaw(diffuse[:, :2]), 0)  # rounding may leave it below zero
        specular = self._mean(emitter, listener, advance)
        mean = np.zeros(variance.shape, np.complex128)
        mean[..., : specular.shape[-1]] = specular[..., :frames]
        # Windows of consecutive frames overlap, so noise has a product, too. Below the codec's floor there is no phase
        # worth learning.
        overlap = np.sum(codec.window[codec.hop :] * codec.window[: -codec.hop]) / codec.window_energy
        spread = np.sqrt(variance + codec.log_floor**2)
        noise = spread[..., 1:] * spread[..., :-1] * overlap
        product = mean[..., 1:] * np.conj(mean[..., :-1]) * np.exp(-1j * codec.nominal_advance) + noise
        frequency = np.concatenate([np.angle(mean[..., :1]), np.angle(product)], axis=-1)
        log_magnitude = codec.log_magnitude(np.sqrt(np.abs(mean) ** 2 + variance))
        return np.stack([log_magnitude, frequency], axis=-1).astype(np.float16)

    def _mean(self, emitter: int, listener: int, advance: float) -> _Complex:
        """(yaw, ear, frequency, frame) spectrogram of the aligned specular part, up to its end."""
        codec = self._cells.codec
        response = self._spectrograms.specular(emitter, listener)
        sounding = np.flatnonzero(response.any(axis=(0, 1)))
        # An advance by a fraction of a sample rings on for less than a window.
        ends = int(sounding[-1] + 1 if len(sounding) else 0) - int(np.floor(advance)) + codec.n_fft
        samples = min(max(ends, (self._cells.fine_frames + codec.n_fft // codec.hop) * codec.hop), codec.samples)
        aligned = align(response[..., : samples + max(0, int(np.ceil(advance)))], advance)[..., :samples]
        return replace(codec, samples=samples).transform(aligned)
