"""The nearest measured response, shaped: for places in between measurements that stand close together.

How sound dies away in detail is different every few centimetres, and a few hundred measurements do not teach it. How
strong it is in a band and a stretch of time, and when it arrives, changes smoothly. So the detail is the nearest
response's, while its arrival, and its energy in every octave and stretch, are changed to what a regression over all
measurements expects (`training.evaluation.regression`).

Axes: one pair's responses are `(yaw, channel, sample)`.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq
from scipy.signal import oaconvolve, resample

from server.acoustics.decay import onset_sample
from training.dataset import SPEED_OF_SOUND
from training.evaluation.baselines import ALL_TURNS, TrainingPairs, Turns, nearest_pair
from training.evaluation.regression import PairRegression

_Floats = npt.NDArray[np.float64]

_CROSSOVERS_HZ = (700.0, 1400.0, 2800.0, 5600.0, 11200.0)
_HIGHEST = 0.4  # crossover, as a share of the rate
# After the arrival. The first stretch is the direct sound, as the direct-to-reverberant ratio has it.
_EDGES_S = (0.0025, 0.006, 0.012, 0.025, 0.050, 0.1, 0.2, 0.4, 0.8)
_FADE = 0.12  # of an edge's time, on either side
_LARGEST_GAIN = 4.5  # more is a fault of the measurement or of the regression
_SILENCE = 1e-12  # of the energy of a response
_SEARCH_S = (0.0015, 0.005)  # for the arrival, before and after what geometry says
_UPSAMPLING = 8
_KERNEL_REACH = 32  # samples on either side
_KERNEL_BETA = 8.0
_NEAREST_M = 0.1
_MOST_PAIRS = 2000


def bands(responses: npt.NDArray[np.floating], sample_rate: float) -> _Floats:
    """(..., band, sample) octaves, the lowest and highest open, that add up to the responses `(..., sample)`."""
    samples = responses.shape[-1]
    size = next_fast_len(2 * samples, real=True)  # what a band's filter smears wraps into nothing
    octave = np.log2(np.maximum(rfftfreq(size, 1 / sample_rate), 1e-3))
    crossovers = [hertz for hertz in _CROSSOVERS_HZ if hertz < _HIGHEST * sample_rate]
    above = [np.ones_like(octave), *(_rise(octave - np.log2(hertz) + 0.5) for hertz in crossovers)]
    passes = [low - high for low, high in zip(above, [*above[1:], np.zeros_like(octave)], strict=True)]
    spectra = rfft(np.asarray(responses, dtype=np.float64), size)[..., np.newaxis, :] * np.stack(passes)
    return np.asarray(irfft(spectra, size)[..., :samples])


def stretches(arrival_s: npt.NDArray[np.floating], samples: int, sample_rate: float, count: int) -> _Floats:
    """(..., stretch, sample) weights that add up to one, for responses whose sound arrives at `arrival_s` (...)."""
    after_s = np.arange(samples) / sample_rate - arrival_s[..., np.newaxis]
    later = [_rise((after_s / edge - 1 + _FADE) / (2 * _FADE)) for edge in _EDGES_S[: count - 1]]
    bounds = [np.ones_like(after_s), *later, np.zeros_like(after_s)]
    return np.stack([bounds[index] - bounds[index + 1] for index in range(count)], axis=-2)


def moved(responses: npt.NDArray[np.floating], later: npt.NDArray[np.floating]) -> _Floats:
    """(..., sample) later by fractions of samples (...). At the open end the outermost sample goes on: a measurement's
    offset would else end in a step, and the step ring."""
    whole = np.round(later).astype(int)
    taps = np.arange(-_KERNEL_REACH, _KERNEL_REACH + 1)
    kernel = np.sinc(taps - (later - whole)[..., np.newaxis]) * np.kaiser(len(taps), _KERNEL_BETA)
    reach = _KERNEL_REACH + int(np.abs(whole).max(initial=0))
    padded = np.pad(responses, [(0, 0)] * (responses.ndim - 1) + [(reach, reach)], mode="edge")
    filtered = oaconvolve(padded, kernel, mode="same", axes=-1)
    index = np.arange(responses.shape[-1]) + reach - whole[..., np.newaxis]
    return np.asarray(np.take_along_axis(filtered, index, axis=-1))


def _rise(x: _Floats) -> _Floats:
    """Raised cosine from 0 to 1 over the unit interval."""
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * np.clip(x, 0.0, 1.0)))


@dataclass(frozen=True)
class _Described:
    """arrival_s: (yaw, channel), later than geometry says; parts: (yaw, channel, band, stretch, sample), which add up
    to the response; energy: (yaw, channel, band, stretch), logarithm, less what spherical spreading makes of it."""

    arrival_s: _Floats
    parts: _Floats
    energy: _Floats


class ShapedNearest:
    """One regression says all: arrivals and energies, each in its own spread."""

    def __init__(self, pairs: TrainingPairs, delays_s: npt.NDArray[np.floating], sample_rate: float) -> None:
        self._pairs, self._delays_s, self._rate = pairs, delays_s, sample_rate
        training = np.flatnonzero(pairs.training)
        training = np.sort(np.random.default_rng(12).permutation(training)[:_MOST_PAIRS])
        remaining_s = pairs.response(int(training[0])).shape[-1] / sample_rate - float(delays_s.max())
        self._stretches = 1 + sum(edge * (1 + 2 * _FADE) < remaining_s for edge in _EDGES_S)
        arrivals, energies = [], []
        for pair in training:
            described = self._described(int(pair))
            arrivals.append(described.arrival_s)
            energies.append(described.energy)
        self._shapes = arrivals[0].shape, energies[0].shape
        self._scales = [max(float(np.std(part, axis=0).mean()), 1e-9) for part in (arrivals, energies)]
        values = [np.stack(part) / scale for part, scale in zip((arrivals, energies), self._scales, strict=True)]
        flat = np.concatenate([part.reshape(len(training), -1) for part in values], axis=1)
        self._expected = PairRegression(*self._ends(training), flat)

    def response(self, pair: int, turns: Turns = ALL_TURNS) -> npt.NDArray[np.float32]:
        """(yaw, channel, sample)"""
        values = self._expected(*self._ends(np.array([pair])))[0]
        split = np.split(values, [int(np.prod(self._shapes[0]))])
        arrival_s, energy = (
            part.reshape(shape)[turns] * scale
            for part, shape, scale in zip(split, self._shapes, self._scales, strict=True)
        )
        near = nearest_pair(self._pairs, pair)
        described = self._described(near, turns)
        # Towards spherical spreading, which descriptions leave out, and away from that of the nearest.
        change = energy + self._spreading(pair) - described.energy - self._spreading(near)
        gain = np.clip(np.exp(0.5 * change), 1 / _LARGEST_GAIN, _LARGEST_GAIN)
        shaped = np.sum(described.parts * gain[..., np.newaxis], axis=(-3, -2))
        later_s = float(self._delays_s[pair] - self._delays_s[near]) + arrival_s - described.arrival_s
        return moved(shaped, later_s * self._rate).astype(np.float32)

    def _described(self, pair: int, turns: Turns = ALL_TURNS) -> _Described:
        response = self._pairs.response(pair)[turns]
        geometric_s = float(self._delays_s[pair])
        arrival_s = geometric_s + self._lateness_s(response, geometric_s)
        weights = stretches(arrival_s, response.shape[-1], self._rate, self._stretches)
        parts = bands(response, self._rate)[..., np.newaxis, :] * weights[..., np.newaxis, :, :]
        power = np.square(parts).sum(axis=-1)
        floor = _SILENCE * max(float(power.sum(axis=(-2, -1)).max()), np.finfo(np.float64).tiny)
        return _Described(arrival_s - geometric_s, parts, np.log(power + floor) - self._spreading(pair))

    def _lateness_s(self, response: npt.NDArray[np.floating], geometric_s: float) -> _Floats:
        """(yaw, channel) seconds from the arrival that geometry gives to the one heard near it."""
        start, stop = (round((geometric_s + offset) * self._rate) for offset in (-_SEARCH_S[0], _SEARCH_S[1]))
        start = max(start, 0)
        head = response[..., start:stop]
        onset = onset_sample(resample(head, head.shape[-1] * _UPSAMPLING, axis=-1))
        heard_s = (start + onset / _UPSAMPLING) / self._rate
        return np.where(onset >= 0, heard_s - geometric_s, 0.0)

    def _spreading(self, pair: int) -> _Floats:
        """(stretch,): the direct sound spreads, what follows fills the room."""
        distance = max(float(self._delays_s[pair]) * SPEED_OF_SOUND, _NEAREST_M)
        return np.where(np.arange(self._stretches) == 0, -2.0 * np.log(distance), 0.0)

    def _ends(self, pairs: npt.NDArray[np.integer]) -> tuple[_Floats, _Floats]:
        known = self._pairs
        return known.emitter_positions[known.pair_emitter[pairs]], known.listener_positions[known.pair_listener[pairs]]
