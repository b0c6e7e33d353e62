"""The nearest measured response, reshaped: for places between measurements that are close to each other.

The details of a decay change every few centimetres, and a few hundred measurements are too few to learn them. But the
energy in a band and a stretch of time, and the time of arrival, change smoothly. So the details are those of the
nearest response, while its time of arrival, and its energy in each octave and stretch, are changed to the estimates of
regressions over all measurements (`training.baselines.regression`). Energies of later stretches are estimated relative
to the direct sound. So a factor that all of a response has in common, such as a microphone's gain, is estimated only
once.

Axes: the responses of one pair are `(yaw, channel, sample)`.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq
from scipy.signal import oaconvolve, resample

from server.acoustics.decay import onset_sample
from training.baselines.baselines import ALL_YAWS, TrainingPairs, YawIndices, nearest_pair
from training.baselines.regression import PairRegression
from training.data.dataset import SPEED_OF_SOUND

_Floats = npt.NDArray[np.float64]

_CROSSOVERS_HZ = (700.0, 1400.0, 2800.0, 5600.0, 11200.0)
_HIGHEST = 0.4  # crossover, as a share of the rate
# Seconds after the arrival. The first stretch is the direct sound, as defined for the direct-to-reverberant ratio.
EDGES_S = (0.0025, 0.006, 0.012, 0.025, 0.050, 0.1, 0.2, 0.4, 0.8)
FADE = 0.12  # of an edge's time, on either side
LARGEST_GAIN = 4.5  # more is a fault of the measurement or of the regression
_SILENCE = 1e-12  # of the energy of a response
_SEARCH_S = (0.0015, 0.005)  # for the arrival, before and after the one that geometry predicts
_UPSAMPLING = 8
KERNEL_REACH = 32  # samples on either side
KERNEL_BETA = 8.0
NEAREST_M = 0.1
_MOST_PAIRS = 2000


def bands(responses: npt.NDArray[np.floating], sample_rate: float) -> _Floats:
    """(..., band, sample) octave bands that add up to the responses `(..., sample)`. The lowest and the highest band
    are open."""
    samples = responses.shape[-1]
    size = next_fast_len(2 * samples, real=True)  # zeros, into which the filters of bands may ring
    octave = np.log2(np.maximum(rfftfreq(size, 1 / sample_rate), 1e-3))
    crossovers = [hertz for hertz in _CROSSOVERS_HZ if hertz < _HIGHEST * sample_rate]
    above = [np.ones_like(octave), *(_rise(octave - np.log2(hertz) + 0.5) for hertz in crossovers)]
    passes = [low - high for low, high in zip(above, [*above[1:], np.zeros_like(octave)], strict=True)]
    spectra = rfft(np.asarray(responses, dtype=np.float64), size)[..., np.newaxis, :] * np.stack(passes)
    return np.asarray(irfft(spectra, size)[..., :samples])


def stretches(arrival_s: npt.NDArray[np.floating], samples: int, sample_rate: float, count: int) -> _Floats:
    """(..., stretch, sample) weights that add up to one, for responses whose sound arrives at `arrival_s` (...)."""
    after_s = np.arange(samples) / sample_rate - arrival_s[..., np.newaxis]
    later = [_rise((after_s / edge - 1 + FADE) / (2 * FADE)) for edge in EDGES_S[: count - 1]]
    bounds = [np.ones_like(after_s), *later, np.zeros_like(after_s)]
    return np.stack([bounds[index] - bounds[index + 1] for index in range(count)], axis=-2)


def delay_responses(responses: npt.NDArray[np.floating], later: npt.NDArray[np.floating]) -> _Floats:
    """(..., sample) delayed by fractional numbers of samples (...). At the open end, the outermost sample is repeated,
    because a step from the offset of a measurement to zero would ring."""
    whole = np.round(later).astype(int)
    taps = np.arange(-KERNEL_REACH, KERNEL_REACH + 1)
    kernel = np.sinc(taps - (later - whole)[..., np.newaxis]) * np.kaiser(len(taps), KERNEL_BETA)
    reach = KERNEL_REACH + int(np.abs(whole).max(initial=0))
    padded = np.pad(responses, [(0, 0)] * (responses.ndim - 1) + [(reach, reach)], mode="edge")
    filtered = oaconvolve(padded, kernel, mode="same", axes=-1)
    index = np.arange(responses.shape[-1]) + reach - whole[..., np.newaxis]
    return np.asarray(np.take_along_axis(filtered, index, axis=-1))


def _rise(x: _Floats) -> _Floats:
    """A raised cosine from 0 to 1 over the unit interval."""
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * np.clip(x, 0.0, 1.0)))


@dataclass(frozen=True)
class DescribedResponse:
    """lateness_s: (yaw, channel) seconds by which sound arrives later than geometry predicts. parts: (yaw, channel,
    band, stretch, sample), which add up to the response. energy: (yaw, channel, band, stretch), logarithms."""

    lateness_s: _Floats
    parts: _Floats
    energy: _Floats


@dataclass(frozen=True)
class Expectation:
    """Regressions of a response's properties, each in units of its `scale`: lateness, energy of the direct sound
    without spherical spreading, and the ratio of each later stretch to it, all (yaw, channel); and the shares of bands
    in a stretch, (yaw, channel, band, stretch)."""

    scalars: tuple[PairRegression, ...]
    scalar_scales: tuple[float, ...]
    shares: PairRegression
    share_scale: float
    shape: tuple[int, int, int, int]

    @classmethod
    def of(cls, emitter: _Floats, listener: _Floats, lateness_s: _Floats, energy: _Floats) -> "Expectation":
        """Fits regressions to measurements: emitters (pair, 3), listeners (pair, 3), lateness (pair, yaw, channel) and
        energies (pair, yaw, channel, band, stretch) without spherical spreading."""
        of_stretch = _summed(energy)
        direct = of_stretch[..., 0]
        later = (of_stretch[..., stretch] - direct for stretch in range(1, of_stretch.shape[-1]))

        def fitted(values: _Floats) -> tuple[PairRegression, float]:
            flat = values.reshape(len(values), -1)
            scale = max(float(np.std(flat, axis=0).mean()), 1e-9)
            return PairRegression(emitter, listener, flat / scale), scale

        scalars, scales = zip(*map(fitted, (lateness_s, direct, *later)), strict=True)
        shares, share_scale = fitted(energy - of_stretch[..., np.newaxis, :])
        yaws, channels, bands_, stretches_ = energy.shape[1:]
        return cls(scalars, scales, shares, share_scale, (yaws, channels, bands_, stretches_))

    def __call__(self, emitter: _Floats, listener: _Floats) -> tuple[_Floats, _Floats]:
        """(yaw, channel) lateness and (yaw, channel, band, stretch) energies at a pair (1, 3), (1, 3)."""
        lateness_s, direct, *later = (
            scale * regression(emitter, listener).reshape(self.shape[:2])
            for regression, scale in zip(self.scalars, self.scalar_scales, strict=True)
        )
        of_stretch = np.stack([direct, *(direct + ratio for ratio in later)], axis=-1)
        shares = self.share_scale * self.shares(emitter, listener).reshape(self.shape)
        shares -= _summed(shares)[..., np.newaxis, :]
        return lateness_s, shares + of_stretch[..., np.newaxis, :]


def _summed(energy: _Floats) -> _Floats:
    """Logarithms (..., band, stretch) to the logarithm of their sum over bands (..., stretch)."""
    return np.asarray(np.logaddexp.reduce(energy, axis=-2))


class ShapedNearest:
    """Estimates a response from the nearest one by changing its arrival and its energies. `stretches` counts the
    intervals of time (between EDGES_S) whose energies are changed separately."""

    def __init__(self, pairs: TrainingPairs, delays_s: npt.NDArray[np.floating], sample_rate: float) -> None:
        self.pairs, self.delays_s, self.sample_rate = pairs, delays_s, sample_rate
        training = np.flatnonzero(pairs.training)
        training = np.sort(np.random.default_rng(12).permutation(training)[:_MOST_PAIRS])
        remaining_s = pairs.response(int(training[0])).shape[-1] / sample_rate - float(delays_s.max())
        self.stretches = 1 + sum(edge * (1 + 2 * FADE) < remaining_s for edge in EDGES_S)
        lateness, energies = [], []
        for pair in training:
            described = self.describe(int(pair))
            lateness.append(described.lateness_s)
            energies.append(described.energy - self._spreading(int(pair)))
        self.expected = Expectation.of(*self._ends(training), np.stack(lateness), np.stack(energies))

    def response(self, pair: int, yaw_indices: YawIndices = ALL_YAWS) -> npt.NDArray[np.float32]:
        """(yaw, channel, sample)"""
        lateness_s, energy = (part[yaw_indices] for part in self.expected(*self._ends(np.array([pair]))))
        near = nearest_pair(self.pairs, pair)
        described = self.describe(near, yaw_indices)
        change = energy + self._spreading(pair) - described.energy
        gain = np.clip(np.exp(0.5 * change), 1 / LARGEST_GAIN, LARGEST_GAIN)
        shaped = np.sum(described.parts * gain[..., np.newaxis], axis=(-3, -2))
        later_s = float(self.delays_s[pair] - self.delays_s[near]) + lateness_s - described.lateness_s
        return delay_responses(shaped, later_s * self.sample_rate).astype(np.float32)

    def describe(self, pair: int, yaw_indices: YawIndices = ALL_YAWS) -> DescribedResponse:
        response = self.pairs.response(pair)[yaw_indices]
        geometric_s = float(self.delays_s[pair])
        arrival_s = geometric_s + self._lateness_s(response, geometric_s)
        weights = stretches(arrival_s, response.shape[-1], self.sample_rate, self.stretches)
        parts = bands(response, self.sample_rate)[..., np.newaxis, :] * weights[..., np.newaxis, :, :]
        power = np.square(parts).sum(axis=-1)
        floor = _SILENCE * max(float(power.sum(axis=(-2, -1)).max()), np.finfo(np.float64).tiny)
        return DescribedResponse(arrival_s - geometric_s, parts, np.log(power + floor))

    def _lateness_s(self, response: npt.NDArray[np.floating], geometric_s: float) -> _Floats:
        """(yaw, channel) seconds from the arrival that geometry predicts to the measured onset near it."""
        start, stop = (round((geometric_s + offset) * self.sample_rate) for offset in (-_SEARCH_S[0], _SEARCH_S[1]))
        start = max(start, 0)
        head = response[..., start:stop]
        onset = onset_sample(resample(head, head.shape[-1] * _UPSAMPLING, axis=-1))
        heard_s = (start + onset / _UPSAMPLING) / self.sample_rate
        return np.where(onset >= 0, heard_s - geometric_s, 0.0)

    def _spreading(self, pair: int) -> _Floats:
        """(stretch,) change of log energies with distance: the direct sound spreads, later sound fills the room."""
        distance = max(float(self.delays_s[pair]) * SPEED_OF_SOUND, NEAREST_M)
        return np.where(np.arange(self.stretches) == 0, -2.0 * np.log(distance), 0.0)

    def _ends(self, pairs: npt.NDArray[np.integer]) -> tuple[_Floats, _Floats]:
        known = self.pairs
        return known.emitter_positions[known.pair_emitter[pairs]], known.listener_positions[known.pair_listener[pairs]]
