"""Binaural impulse responses from traced arrivals.

Specular paths are exact: each is its own delayed, filtered head-related impulse response. What rays bring is noise
shaped in time, frequency and direction by their energy, heard through the head from each direction of arrival
(Schroeder, "Physically based real-time auralization of interactive virtual environments", 2011, ch. 5). One noise
serves all head orientations of a pair, so turning the head changes the ears and not the room.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.signal import ShortTimeFFT
from scipy.signal.windows import hann

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.rendering.hrtf import Hrtf
from training.dataset import SPEED_OF_SOUND
from training.tracing import HISTOGRAM_BIN_S, Arrivals

_WINDOW_S = 0.010
_DIFFUSE_RISE_S = 0.002


def rotate_into_head(directions: npt.NDArray[np.float64], yaws: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """(direction, yaw, xyz) world directions as seen by a level head turned counter-clockwise by each yaw (radians)."""
    x, y, z = (directions[:, None, axis] for axis in range(3))
    cos, sin = np.cos(yaws), np.sin(yaws)
    return np.stack([x * cos + y * sin, y * cos - x * sin, np.broadcast_to(z, (len(directions), len(yaws)))], axis=-1)


@dataclass(frozen=True)
class BinauralSynthesis:
    """Renders arrivals to `samples` samples at the rate of `hrtf`; `arrival_directions` are those of the traced
    energy."""

    hrtf: Hrtf
    arrival_directions: npt.NDArray[np.float64]
    yaws: npt.NDArray[np.float64]
    samples: int

    @property
    def _sample_rate(self) -> int:
        return self.hrtf.sample_rate

    @property
    def _n_fft(self) -> int:
        """Long enough for a head-related impulse response behind the filter of a wall."""
        return 2 ** int(np.ceil(np.log2(_WINDOW_S * self._sample_rate)))

    @cached_property
    def _band_weights(self) -> npt.NDArray[np.float64]:
        """(band, bin) interpolation of band energies, linear over log frequency; columns sum to one."""
        frequency = np.maximum(np.fft.rfftfreq(self._n_fft, 1 / self._sample_rate), 1.0)
        octave = np.clip(np.log2(frequency / OCTAVE_BANDS_HZ[0]), 0, len(OCTAVE_BANDS_HZ) - 1)
        return np.maximum(0.0, 1 - np.abs(octave - np.arange(len(OCTAVE_BANDS_HZ))[:, None]))

    @cached_property
    def _transform(self) -> ShortTimeFFT:
        return ShortTimeFFT(hann(self._n_fft, sym=False), self._n_fft // 4, self._sample_rate)

    @cached_property
    def _arrival_spectra(self) -> npt.NDArray[np.complex128]:
        """(bin, yaw and ear, direction)"""
        heard = rotate_into_head(self.arrival_directions, self.yaws)
        spectra = self.hrtf.spectra(heard, self._n_fft)
        return np.ascontiguousarray(np.moveaxis(spectra, (0, 3), (3, 0)).reshape(spectra.shape[-1], -1, len(heard)))

    def render(
        self, arrivals: Arrivals, receiver: npt.NDArray[np.float64], onset_s: float, rng: np.random.Generator
    ) -> npt.NDArray[np.float64]:
        """(yaw, ear, sample) impulse responses; sample 0 is emission. Nothing diffuse is heard before `onset_s`."""
        response = self._late(arrivals.energy, onset_s, rng)
        self._add_specular(arrivals, receiver, response)
        return response

    def _late(
        self, energy: npt.NDArray[np.float64], onset_s: float, rng: np.random.Generator
    ) -> npt.NDArray[np.float64]:
        transform = self._transform
        noise = transform.stft(rng.standard_normal((len(energy), self.samples)))
        frames = np.arange(transform.p_min, transform.p_max(self.samples)) * transform.hop / self._sample_rate
        bins = (np.arange(energy.shape[-1]) + 0.5) * HISTOGRAM_BIN_S
        position = np.clip(np.interp(frames, bins, np.arange(len(bins))), 0, len(bins) - 1)
        before = np.minimum(position.astype(int), len(bins) - 2)
        share = position - before
        per_sample = energy / (HISTOGRAM_BIN_S * self._sample_rate)
        at_frames = per_sample[..., before] * (1 - share) + per_sample[..., before + 1] * share
        shaped = noise * np.sqrt(np.einsum("dbt,bf->dft", at_frames, self._band_weights, optimize=True))
        heard = np.matmul(self._arrival_spectra, np.moveaxis(shaped, 1, 0))
        late = transform.istft(np.moveaxis(heard, 0, 1), k1=self.samples)
        # Windows smear energy to before the direct sound, where nothing scattered can be.
        since_onset = np.arange(self.samples) / self._sample_rate - onset_s
        late *= np.sin(np.pi / 2 * np.clip(since_onset / _DIFFUSE_RISE_S, 0, 1)) ** 2
        return np.asarray(late.reshape(len(self.yaws), 2, self.samples))

    def _add_specular(
        self, arrivals: Arrivals, receiver: npt.NDArray[np.float64], response: npt.NDArray[np.float64]
    ) -> None:
        offset = arrivals.image_positions - receiver
        distance = np.linalg.norm(offset, axis=-1)
        heard = rotate_into_head(offset / np.maximum(distance, 1e-6)[:, None], self.yaws)
        gain = _minimum_phase(arrivals.image_amplitudes @ self._band_weights)
        delay = distance / SPEED_OF_SOUND * self._sample_rate
        start = np.floor(delay).astype(int)
        lead = self.hrtf.lead_samples
        shift = np.exp(-2j * np.pi * np.fft.rfftfreq(self._n_fft) * (lead + delay - start)[:, None])
        spectra = self.hrtf.spectra(heard, self._n_fft) * (gain * shift)[:, None, None]
        taps = np.fft.irfft(spectra, self._n_fft)
        for tap, at in zip(taps, start - lead, strict=True):
            first, last = max(0, -at), min(self._n_fft, self.samples - at)
            if last > first:
                response[..., at + first : at + last] += tap[..., first:last]


def _minimum_phase(magnitude: npt.NDArray[np.float64]) -> npt.NDArray[np.complex128]:
    """(..., bin) spectra of the given magnitude whose energy comes as early as it can (real cepstrum, folded)."""
    cepstrum = np.fft.irfft(np.log(np.maximum(magnitude, 1e-12)))
    n = cepstrum.shape[-1]
    cepstrum[..., 1 : n // 2] *= 2
    cepstrum[..., n // 2 + 1 :] = 0
    return np.asarray(np.exp(np.fft.rfft(cepstrum)))
