"""Conversion of impulse responses to log-magnitude and instantaneous frequency, and back.

Axes: (..., frequency, frame) for spectrograms, (..., sample) for signals. The transform equals that of
`scipy.signal.ShortTimeFFT` with a periodic Hann window, to the bit, but without that module's import time of half a
second. Frame 0 is the first whose window touches the signal.

Instantaneous frequency is the phase advance from one frame to the next *minus* that of the bin's centre frequency,
wrapped to [-pi, pi). Without the subtraction every fourth bin would lie on the branch cut (hop = n_fft / 4). Frame 0
holds the absolute phase.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from numpy.fft import irfft, rfft

Array = npt.NDArray[np.floating]


@dataclass(frozen=True)
class Codec:
    """Parameters of the transform. `samples` is the length of the signals. Magnitudes are stored as
    log(|S| + log_floor), so that silence is finite."""

    sample_rate: int
    n_fft: int
    hop: int
    samples: int
    log_floor: float

    @property
    def bins(self) -> int:
        return self.n_fft // 2 + 1

    @property
    def frames(self) -> int:
        # The last window begins before the signal's last sample, since a window's first sample is zero.
        reached = -(-(self.samples - 1 + self.n_fft // 2) // self.hop)
        return max(reached, self.samples // self.hop + 1) - self._first_frame

    @property
    def _first_frame(self) -> int:
        """Number of the first frame whose window reaches into the signal; frame n is centred at sample n * hop."""
        return 1 - -(-(self.n_fft - self.n_fft // 2) // self.hop)

    @cached_property
    def frame_times_s(self) -> npt.NDArray[np.float64]:
        """(frame,) centre of each window; the first is negative."""
        first = self._first_frame
        return np.arange(first, first + self.frames, dtype=np.float64) * self.hop / self.sample_rate

    @cached_property
    def nominal_advance(self) -> npt.NDArray[np.float64]:
        """(frequency, 1) radians by which a bin-centred tone advances per frame."""
        return np.asarray(2 * np.pi * self.hop / self.n_fft * np.arange(self.bins, dtype=np.float64)[:, None])

    @cached_property
    def window(self) -> npt.NDArray[np.float64]:
        """(n_fft,) periodic Hann window."""
        return (0.5 + 0.5 * np.cos(np.linspace(-np.pi, np.pi, self.n_fft + 1)))[:-1]

    @cached_property
    def dual_window(self) -> npt.NDArray[np.float64]:
        """(n_fft,) synthesis window: the canonical dual (Groechenig, Foundations of Time-Frequency Analysis, 2001,
        7.6)."""
        power = self.window**2
        overlapped = power.copy()
        for shift in range(self.hop, self.n_fft, self.hop):
            overlapped[shift:] += power[:-shift]
            overlapped[:-shift] += power[shift:]
        return np.asarray(self.window / overlapped)

    @property
    def frame_lead_samples(self) -> int:
        """Samples of the first frame that lie before the signal."""
        return self.n_fft // 2 - self._first_frame * self.hop

    @cached_property
    def window_energy(self) -> float:
        """Mean of |S|**2 for white noise of unit variance."""
        return float(np.sum(self.window**2))

    def transform(self, signal: Array) -> npt.NDArray[np.complex128]:
        """(..., sample) to complex (..., frequency, frame)."""
        signal = np.asarray(signal)
        lead, frames = self.frame_lead_samples, self.frames
        padded = np.zeros((*signal.shape[:-1], (frames - 1) * self.hop + self.n_fft), signal.dtype)
        used = min(signal.shape[-1], padded.shape[-1] - lead)
        padded[..., lead : lead + used] = signal[..., :used]
        spectrogram = np.empty((*signal.shape[:-1], self.bins, frames), np.complex128)
        for frame in range(frames):
            start = frame * self.hop
            spectrogram[..., frame] = rfft(padded[..., start : start + self.n_fft] * self.window, axis=-1)
        return spectrogram

    def log_magnitude(self, spectrogram: npt.NDArray[np.inexact]) -> npt.NDArray[np.float64]:
        # guard: silence has a logarithm
        return np.asarray(np.log(np.abs(spectrogram).astype(np.float64) + self.log_floor))

    def magnitude(self, log_magnitude: Array) -> Array:
        # guard: beneath the floor is silence
        return np.maximum(np.exp(log_magnitude) - self.log_floor, 0)

    def encode(self, signal: Array) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """(..., sample) to log-magnitude and instantaneous frequency, each (..., frequency, frame)."""
        spectrogram = self.transform(signal)
        return self.log_magnitude(spectrogram), self.instantaneous_frequency(np.angle(spectrogram))

    def decode(self, log_magnitude: Array, instantaneous_frequency: Array) -> npt.NDArray[np.floating]:
        """Inverse of `encode`; (..., frequency, frame) to (..., sample)."""
        phase = self.integrate(instantaneous_frequency)
        return self.synthesise(self.magnitude(log_magnitude) * np.exp(1j * phase))

    def instantaneous_frequency(self, phase: Array) -> npt.NDArray[np.float64]:
        """Phase advance per frame of phases (..., frequency, frame), demodulated and wrapped."""
        # guard: advances are demodulated
        advance = np.diff(phase, axis=-1) - self.nominal_advance
        # guard: advances are wrapped to one turn
        wrapped = (advance + np.pi) % (2 * np.pi) - np.pi
        return np.concatenate([phase[..., :1], wrapped], axis=-1)

    def integrate(self, instantaneous_frequency: Array) -> Array:
        """Phase from its advances: the inverse of `instantaneous_frequency`, up to whole turns."""
        frames = np.arange(instantaneous_frequency.shape[-1])
        # guard: phase is summed in double precision
        phase = np.cumsum(instantaneous_frequency, axis=-1, dtype=np.float64) + self.nominal_advance * frames
        # Whole turns are dropped before they can eat the mantissa of a float32.
        # guard: whole turns come off before single precision
        return (phase % (2 * np.pi)).astype(instantaneous_frequency.dtype)

    def synthesise(self, spectrogram: npt.NDArray[np.complexfloating]) -> npt.NDArray[np.floating]:
        """Complex (..., frequency, frame) to (..., sample). Fewer frames than `frames` give a shorter signal.

        Equals `ShortTimeFFT.istft`, but transforms all frames at once. The precision is that of the input.
        """
        slices = irfft(np.swapaxes(spectrogram, -1, -2), self.n_fft, axis=-1)
        slices *= self.dual_window.astype(slices.dtype)
        frames, shifts = spectrogram.shape[-1], self.n_fft // self.hop
        parts = slices.reshape(*slices.shape[:-1], shifts, self.hop)
        total = np.zeros((*slices.shape[:-2], frames + shifts - 1, self.hop), dtype=slices.dtype)
        for shift in range(shifts):
            total[..., shift : shift + frames, :] += parts[..., shift, :]
        start = self.frame_lead_samples
        return np.asarray(total.reshape(*total.shape[:-2], -1)[..., start : start + self.samples])
