"""One late tail for all receivers of a room, where late reverberation is the same at every place.

Energies have the axes (direction, band, bin), with bins of HISTOGRAM_BIN_S, as in `training.simulation.tracing`.
Receivers share the energies and their directions. The noise that the tail is drawn with is long, and each response uses
another part of it. `training.simulation.tail_noise` draws the noise.
"""

from dataclasses import dataclass

import numba
import numpy as np
import numpy.typing as npt

from training.data.scene_file import HISTOGRAM_BIN_S

_Floats = npt.NDArray[np.float64]
_Singles = npt.NDArray[np.float32]

# Crossfade from a receiver's own sound to the shared tail, at constant power.
FADE_S = 0.010
BAND_GROUP = 4
"""The number of bands of the noise is a multiple of this. Bands are added in groups of this size, which saves trips to
memory."""
# The amplitudes of this many samples, in all bands, fit into a core's L1 cache while the channels are computed.
_STRETCH = 1024


def shared_power(times_s: _Floats, start_s: float) -> _Floats:
    """(...,) the share of the power that comes from the shared tail at each time."""
    return np.asarray(np.sin(np.pi / 2 * np.clip((times_s - start_s) / FADE_S, 0, 1)) ** 2)


@dataclass(frozen=True)
class SharedTail:
    """`energies` (take, direction, band, bin) are the same for each receiver, have the same directions at all times,
    and are zero before `start_s`. `noise` (band, yaw and ear, sample) is read in a circle. From sample `first` of a
    response on, it is multiplied by `amplitudes` (take, band, sample)."""

    start_s: float
    first: int
    energies: _Singles
    noise: npt.NDArray[np.int16]
    amplitudes: _Singles

    def begin(self, rng: np.random.Generator) -> int:
        """A random sample of the noise for a response's tail to begin with."""
        return int(rng.integers(self.noise.shape[-1]))

    def extend(self, take: int, own: npt.NDArray[np.floating], begin: int) -> _Singles:
        """(yaw, ear, sample) the whole response: a receiver's `own` part, and the tail from sample `begin` of the noise
        on."""
        response = np.zeros((*own.shape[:-1], self.first + self.amplitudes.shape[-1]), np.float32)
        response[..., : own.shape[-1]] = own
        ears = response.reshape(-1, response.shape[-1])
        _add_modulated(self.noise, begin, self.amplitudes[take], ears, self.first)
        return response

    def join(self, take: int, own: _Singles) -> _Singles:
        """(direction, band, bin) energy of the whole response, from the `own` energy of its first bins."""
        tail = self.energies[take]
        share = shared_power((np.arange(tail.shape[-1]) + 0.5) * HISTOGRAM_BIN_S, self.start_s).astype(np.float32)
        energy = tail * share
        known = own.shape[-1]
        energy[..., :known] += own * (1 - share[:known])
        return energy


@numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc"})
def _add_modulated(noise, begin, amplitude, response, first):
    """Adds (band, channel, sample) noise, times (band, sample) amplitude, to the (channel, sample) response from sample
    `first` on. The noise is read in a circle, from `begin` on."""
    bands, channels, length = noise.shape
    samples, done = amplitude.shape[1], 0
    while done < samples:
        count = min(samples - done, length - begin, _STRETCH)
        heard, played = slice(begin, begin + count), slice(done, done + count)
        for channel in range(channels):
            target = response[channel, first + done : first + done + count]
            for band in range(0, bands, BAND_GROUP):
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
