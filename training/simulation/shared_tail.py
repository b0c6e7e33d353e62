"""The late sound of a room in which every place hears the same: one tail for all receivers of an emitter.

Energies are axes (direction, band, bin) of HISTOGRAM_BIN_S, as those of `training.simulation.tracing`. What is shared
are the energies and where they come from; the noise that they are drawn with is long, and every response takes another
part of it.
"""

import numba
import numpy as np
import numpy.typing as npt

from training.scene_file import HISTOGRAM_BIN_S
from training.simulation.synthesis import BinauralSynthesis, power_at

_Floats = npt.NDArray[np.float64]
_Singles = npt.NDArray[np.float32]

# From own sound to shared, at constant power.
FADE_S = 0.010
_NOISE_S = 4.0
# Steps of the noise's quantisation in the root mean square of a band's loudest channel: reading it is what adding a
# tail waits for, and responses are stored with fewer digits.
_NOISE_STEPS = 4096
# Samples of all bands' amplitudes that a core's nearest cache holds while every channel goes by.
_STRETCH = 1024


def shared_power(times_s: _Floats, start_s: float) -> _Floats:
    """(...,) the share of the power that is shared at each time."""
    return np.asarray(np.sin(np.pi / 2 * np.clip((times_s - start_s) / FADE_S, 0, 1)) ** 2)


def joined(own: _Singles, tail: _Singles, start_s: float) -> _Singles:
    """(direction, band, bin) energy of a receiver whose own is known for the first bins and ends in a shared tail."""
    share = shared_power((np.arange(tail.shape[-1]) + 0.5) * HISTOGRAM_BIN_S, start_s).astype(np.float32)
    energy = tail * share
    known = own.shape[-1]
    energy[..., :known] += own * (1 - share[:known])
    return energy


class SharedTail:
    """Late sound of (take, direction, band, bin) `energies`, of which the part before `start_s` is not used. Its noise
    is (band, yaw and ear, sample), of unit power per sample over all directions, and has no end. Read only once made.
    """

    def __init__(
        self, synthesis: BinauralSynthesis, energies: _Floats, *, start_s: float, rng: np.random.Generator
    ) -> None:
        sample_rate = synthesis.head.sample_rate
        late = energies[..., int(start_s / HISTOGRAM_BIN_S) :].sum(axis=(0, -1))
        total = late.sum(axis=0)
        directional = np.divide(late, total, out=np.full_like(late, 1 / len(late)), where=total > 0)
        of_all = energies.sum(axis=1)
        self.start_s = start_s
        self.energies: _Singles = (directional[..., None] * of_all[:, None]).astype(np.float32)
        """(take, direction, band, bin) what each receiver gets: from the same directions at all times."""
        self._first = round(start_s * sample_rate)
        times_s = np.arange(self._first, synthesis.samples) / sample_rate
        per_sample = power_at(times_s, of_all.astype(np.float32)) / np.float32(sample_rate)
        amplitudes = np.sqrt(per_sample * shared_power(times_s, start_s))
        noise = synthesis.diffuse_noise(directional, round(_NOISE_S * sample_rate), rng)
        noise = noise.reshape(len(noise), -1, noise.shape[-1])
        loudest = np.sqrt(np.einsum("bcs,bcs->bc", noise, noise).max(axis=-1) / noise.shape[-1])
        step = np.maximum(loudest, np.finfo(np.float32).tiny)[:, None] / _NOISE_STEPS
        self._amplitudes: _Singles = np.ascontiguousarray(amplitudes * step, dtype=np.float32)
        noise /= step[..., None]
        limits = np.iinfo(np.int16)
        self._noise = np.clip(np.rint(noise, out=noise), limits.min, limits.max, out=noise).astype(np.int16)

    def add(self, take: int, response: _Singles, rng: np.random.Generator) -> None:
        """Adds the tail to (yaw, ear, sample) `response`; `rng` chooses the part of the noise."""
        begin = int(rng.integers(self._noise.shape[-1]))
        ears = response.reshape(-1, response.shape[-1])
        _add_modulated(self._noise, begin, self._amplitudes[take], ears, self._first)


@numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc"})
def _add_modulated(noise, begin, amplitude, response, first):
    """Adds (band, channel, sample) noise times (band, sample) amplitude to (channel, sample) from `first` on, going
    round from `begin` at the end of the noise."""
    bands, channels, length = noise.shape
    samples, done = amplitude.shape[1], 0
    while done < samples:
        count = min(samples - done, length - begin, _STRETCH)
        for channel in range(channels):
            target = response[channel, first + done : first + done + count]
            for band in range(bands):
                source, gain = noise[band, channel, begin : begin + count], amplitude[band, done : done + count]
                for index in range(count):
                    target[index] += np.float32(source[index]) * gain[index]
        done, begin = done + count, (begin + count) % length
