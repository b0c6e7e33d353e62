"""The late sound of a room in which every place hears the same: one tail for all receivers of an emitter.

Energies are axes (direction, band, bin) of HISTOGRAM_BIN_S, as those of `training.simulation.tracing`. What is shared
are the energies and where they come from; the noise that they are drawn with is long, and every response takes another
part of it. `training.simulation.tail_noise` draws it.
"""

from dataclasses import dataclass

import numba
import numpy as np
import numpy.typing as npt

from training.data.scene_file import HISTOGRAM_BIN_S

_Floats = npt.NDArray[np.float64]
_Singles = npt.NDArray[np.float32]

# From own sound to shared, at constant power.
FADE_S = 0.010
BANDS_AT_ONCE = 4
"""Of the noise, whose bands are a multiple of it: that spares their sum trips to memory."""
# Samples of all bands' amplitudes that a core's nearest cache holds while every channel goes by.
_STRETCH = 1024


def shared_power(times_s: _Floats, start_s: float) -> _Floats:
    """(...,) the share of the power that is shared at each time."""
    return np.asarray(np.sin(np.pi / 2 * np.clip((times_s - start_s) / FADE_S, 0, 1)) ** 2)


@dataclass(frozen=True)
class SharedTail:
    """`energies` (take, direction, band, bin) are what each receiver gets: from the same directions at all times, and
    of those before `start_s` nothing. `noise` (band, yaw and ear, sample) has no end, and is heard with (take, band,
    sample) `amplitudes` from sample `first` of a response on."""

    start_s: float
    first: int
    energies: _Singles
    noise: npt.NDArray[np.int16]
    amplitudes: _Singles

    def begin(self, rng: np.random.Generator) -> int:
        """The sample of the noise that a response begins with."""
        return int(rng.integers(self.noise.shape[-1]))

    def extend(self, take: int, own: npt.NDArray[np.floating], begin: int) -> _Singles:
        """(yaw, ear, sample) response that is, at first, a receiver's own, which ends after the fade."""
        response = np.zeros((*own.shape[:-1], self.first + self.amplitudes.shape[-1]), np.float32)
        response[..., : own.shape[-1]] = own
        ears = response.reshape(-1, response.shape[-1])
        _add_modulated(self.noise, begin, self.amplitudes[take], ears, self.first)
        return response

    def join(self, take: int, own: _Singles) -> _Singles:
        """(direction, band, bin) energy of a receiver whose own is known for the first bins."""
        tail = self.energies[take]
        share = shared_power((np.arange(tail.shape[-1]) + 0.5) * HISTOGRAM_BIN_S, self.start_s).astype(np.float32)
        energy = tail * share
        known = own.shape[-1]
        energy[..., :known] += own * (1 - share[:known])
        return energy


@numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc"})
def _add_modulated(noise, begin, amplitude, response, first):
    """Adds (band, channel, sample) noise times (band, sample) amplitude to (channel, sample) from `first` on, going
    round from `begin` at the end of the noise."""
    bands, channels, length = noise.shape
    samples, done = amplitude.shape[1], 0
    while done < samples:
        count = min(samples - done, length - begin, _STRETCH)
        heard, played = slice(begin, begin + count), slice(done, done + count)
        for channel in range(channels):
            target = response[channel, first + done : first + done + count]
            for band in range(0, bands, BANDS_AT_ONCE):
                one, gain_one = noise[band, channel, heard], amplitude[band, played]
                two, gain_two = noise[band + 1, channel, heard], amplitude[band + 1, played]
                three, gain_three = noise[band + 2, channel, heard], amplitude[band + 2, played]
                four, gain_four = noise[band + 3, channel, heard], amplitude[band + 3, played]
                for index in range(count):
                    target[index] += (
                        np.float32(one[index]) * gain_one[index]
                        + np.float32(two[index]) * gain_two[index]
                        + np.float32(three[index]) * gain_three[index]
                        + np.float32(four[index]) * gain_four[index]
                    )
        done, begin = done + count, (begin + count) % length
