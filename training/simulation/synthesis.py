"""Binaural impulse responses: of the direct sound from geometry, and from traced arrivals of what follows it.

Specular paths are exact: each is its own delayed, filtered head-related impulse response. What rays bring is noise
shaped in time, frequency and direction by their energy, heard through the head from each direction of arrival
(Schroeder, "Physically based real-time auralization of interactive virtual environments", 2011, ch. 5). One noise
serves all head orientations of a pair, so turning the head changes the ears and not the room.

The head is the one that direct paths are rendered through: minimum phase and a delay per ear. What a measurement has
beside these is mostly the phase of its loudspeaker.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.signal import ShortTimeFFT
from scipy.signal.windows import hann

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.minimum_phase import folded_cepstrum
from server.rendering.hrtf import HeadFilters
from server.scene.manifest import Air
from training.dataset import SPEED_OF_SOUND
from training.simulation.rays import HISTOGRAM_BIN_S
from training.simulation.tracing import Arrivals, free_field_amplitude

_WINDOW_S = 0.010
_DIFFUSE_RISE_S = 0.002
# Ears may hear before a wave passes the head's centre, and a delay by a fraction of a sample rings on either side.
_LEAD_S = 0.001


def rotate_into_head(directions: npt.NDArray[np.float64], yaws: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """(direction, yaw, xyz) world directions as seen by a level head turned counter-clockwise by each yaw (radians)."""
    x, y, z = (directions[:, None, axis] for axis in range(3))
    cos, sin = np.cos(yaws), np.sin(yaws)
    return np.stack([x * cos + y * sin, y * cos - x * sin, np.broadcast_to(z, (len(directions), len(yaws)))], axis=-1)


@dataclass(frozen=True)
class BinauralSynthesis:
    """Renders arrivals to `samples` samples at the rate of `head`; `arrival_directions` are those of the traced
    energy."""

    head: HeadFilters
    arrival_directions: npt.NDArray[np.float64]
    yaws: npt.NDArray[np.float64]
    samples: int

    @property
    def _sample_rate(self) -> int:
        return self.head.sample_rate

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

    def _heard_from(self, directions: npt.NDArray[np.float64]) -> npt.NDArray[np.complex128]:
        """(..., ear, bin) spectra of the head; time zero is when a wave passes its centre."""
        head, mesh = self.head, self.head.triangulation
        flat = directions.reshape(-1, 3)
        shares = (flat @ mesh.inverses.reshape(-1, 3).T).reshape(len(flat), len(mesh.inverses), 3)
        around = np.argmax(np.minimum(np.minimum(shares[..., 0], shares[..., 1]), shares[..., 2]), axis=-1)
        share = np.maximum(shares[np.arange(len(flat)), around], 0)
        share /= np.sum(share, axis=-1, keepdims=True)
        corners = mesh.triangles[around]
        cepstra = np.einsum("dc,dcet->det", share, head.cepstra[corners])
        delays = np.einsum("dc,dce->de", share, head.delays_s[corners]) * head.sample_rate
        turn = -2j * np.pi * np.fft.rfftfreq(self._n_fft) * delays[..., None]
        spectra = np.exp(np.fft.rfft(cepstra, self._n_fft) + turn)
        return np.asarray(spectra).reshape(*directions.shape[:-1], *spectra.shape[1:])

    @cached_property
    def _transform(self) -> ShortTimeFFT:
        return ShortTimeFFT(hann(self._n_fft, sym=False), self._n_fft // 4, self._sample_rate)

    @cached_property
    def _arrival_spectra(self) -> npt.NDArray[np.complex128]:
        """(bin, yaw and ear, direction)"""
        heard = rotate_into_head(self.arrival_directions, self.yaws)
        spectra = self._heard_from(heard)
        return np.ascontiguousarray(np.moveaxis(spectra, (0, 3), (3, 0)).reshape(spectra.shape[-1], -1, len(heard)))

    def render(
        self, arrivals: Arrivals, receiver: npt.NDArray[np.float64], onset_s: float, rng: np.random.Generator
    ) -> npt.NDArray[np.float64]:
        """(yaw, ear, sample) reflected sound; sample 0 is emission. Nothing diffuse is heard before `onset_s`."""
        response = self._late(arrivals.energy, onset_s, rng)
        self._add_specular(arrivals.image_positions, arrivals.image_amplitudes, receiver, response)
        return response

    def direct(
        self, emitter: npt.NDArray[np.float64], receiver: npt.NDArray[np.float64], air: Air
    ) -> npt.NDArray[np.float64]:
        """(yaw, ear, sample) direct sound of an emitter in sight; sample 0 is emission."""
        response = np.zeros((len(self.yaws), 2, self.samples))
        amplitude = free_field_amplitude(np.linalg.norm(emitter - receiver, keepdims=True), air)
        self._add_specular(emitter[None], amplitude, receiver, response)
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
        self,
        positions: npt.NDArray[np.float64],
        amplitudes: npt.NDArray[np.float64],
        receiver: npt.NDArray[np.float64],
        response: npt.NDArray[np.float64],
    ) -> None:
        """Adds what comes from (image, xyz) with (image, band) pressure at the receiver."""
        offset = positions - receiver
        distance = np.linalg.norm(offset, axis=-1)
        heard = rotate_into_head(offset / np.maximum(distance, 1e-6)[:, None], self.yaws)
        gain = _minimum_phase(amplitudes @ self._band_weights)
        delay = distance / SPEED_OF_SOUND * self._sample_rate
        start = np.floor(delay).astype(int)
        lead = round(_LEAD_S * self._sample_rate)
        shift = np.exp(-2j * np.pi * np.fft.rfftfreq(self._n_fft) * (lead + delay - start)[:, None])
        spectra = self._heard_from(heard) * (gain * shift)[:, None, None]
        taps = np.fft.irfft(spectra, self._n_fft)
        for tap, at in zip(taps, start - lead, strict=True):
            first, last = max(0, -at), min(self._n_fft, self.samples - at)
            if last > first:
                response[..., at + first : at + last] += tap[..., first:last]


def _minimum_phase(magnitude: npt.NDArray[np.float64]) -> npt.NDArray[np.complex128]:
    """(..., bin) spectra of the given magnitude whose energy comes as early as it can."""
    n_fft = 2 * (magnitude.shape[-1] - 1)
    return np.asarray(np.exp(np.fft.rfft(folded_cepstrum(np.log(np.maximum(magnitude, 1e-12))), n_fft)))
