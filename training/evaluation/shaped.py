"""The nearest measured response, shaped: for places in between measurements that stand close together.

How sound dies away in detail is different every few centimetres, and a few hundred measurements do not teach it. How
strong it is in a band and a stretch of time, and when it arrives, changes smoothly. So the detail is the nearest
response's, while its arrival, and its energy in every octave and stretch, are changed to what a regression over all
measurements expects (`training.evaluation.regression`).

Axes: one pair's responses are `(yaw, channel, sample)`.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq
from scipy.signal import resample

from server.acoustics.decay import onset_sample
from training.dataset import SPEED_OF_SOUND
from training.evaluation.baselines import TrainingPairs, Turns, nearest_pair
from training.evaluation.regression import PairRegression

_Floats = npt.NDArray[np.float64]

_LEAD_S = 0.0015
"""What is kept in front of the arrival."""
_CROSSOVERS_HZ = (700.0, 1400.0, 2800.0, 5600.0, 11200.0)
_HIGHEST = 0.4  # crossover, as a share of the rate
# After the arrival. The first stretch is the direct sound, as the direct-to-reverberant ratio has it.
_EDGES_S = (0.0025, 0.006, 0.012, 0.025, 0.050, 0.1, 0.2, 0.4, 0.8)
_FADE = 0.12  # of an edge's time, on either side
_LARGEST_GAIN = np.log(4.5)  # 13 dB: more is a fault of the measurement or of the regression
_SILENCE = 1e-12  # of the energy of a response
_ARRIVAL_S = 0.005
_UPSAMPLING = 8
_NEAREST_M = 0.1
_MOST_PAIRS = 2000


@dataclass(frozen=True)
class Parts:
    """Octave bands times stretches of time that add up to the whole, for responses that arrive after `lead` samples."""

    sample_rate: float
    samples: int
    lead: int

    @cached_property
    def stretches(self) -> _Floats:
        """(stretch, sample) weights that sum to one."""
        time_s = (np.arange(self.samples) - self.lead) / self.sample_rate
        edges = [edge for edge in _EDGES_S if edge * (1 + _FADE) < time_s[-1]]
        later = [_rise((time_s / edge - 1 + _FADE) / (2 * _FADE)) for edge in edges]
        bounds = [np.ones(self.samples), *later, np.zeros(self.samples)]
        return np.stack([bounds[index] - bounds[index + 1] for index in range(len(bounds) - 1)])

    def split(self, responses: npt.NDArray[np.floating]) -> _Floats:
        """(..., band, stretch, sample)"""
        size = next_fast_len(2 * self.samples, real=True)  # what a band's filter smears wraps into nothing
        octave = np.log2(np.maximum(rfftfreq(size, 1 / self.sample_rate), 1e-3))
        crossovers = [hertz for hertz in _CROSSOVERS_HZ if hertz < _HIGHEST * self.sample_rate]
        above = [np.ones_like(octave), *(_rise(octave - np.log2(hertz) + 0.5) for hertz in crossovers)]
        passes = [low - high for low, high in zip(above, [*above[1:], np.zeros_like(octave)], strict=True)]
        spectra = rfft(np.asarray(responses, dtype=np.float64), size)[..., np.newaxis, :] * np.stack(passes)
        return irfft(spectra, size)[..., np.newaxis, : self.samples] * self.stretches


def _rise(x: _Floats) -> _Floats:
    """Raised cosine from 0 to 1 over the unit interval."""
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * np.clip(x, 0.0, 1.0)))


def moved(responses: npt.NDArray[np.floating], later: npt.ArrayLike) -> _Floats:
    """(..., sample) later by fractions of samples (...), silence at the open end."""
    samples = responses.shape[-1]
    later = np.asarray(later, dtype=np.float64)
    size = next_fast_len(samples + 2 * int(np.ceil(np.abs(later).max(initial=0.0))) + 64, real=True)
    shift = np.exp(-2j * np.pi * np.fft.rfftfreq(size) * later[..., np.newaxis])
    return np.asarray(irfft(rfft(np.asarray(responses, dtype=np.float64), size) * shift, size)[..., :samples])


class ShapedNearest:
    """All targets of one regression: arrivals (yaw, channel), and energies (yaw, channel, band, stretch)."""

    def __init__(self, pairs: TrainingPairs, delays_s: npt.NDArray[np.floating], sample_rate: float) -> None:
        self._pairs, self._delays_s, self._rate = pairs, delays_s, sample_rate
        training = np.flatnonzero(pairs.training)
        training = np.sort(np.random.default_rng(12).permutation(training)[:_MOST_PAIRS])
        samples = pairs.response(int(training[0])).shape[-1]
        lead = round(_LEAD_S * sample_rate)
        # Whatever an alignment moves to the front must not push the end out.
        self._parts = Parts(sample_rate, samples, lead)
        described = [self._described(int(pair)) for pair in training]
        self._shape = described[0][1].shape
        values = np.stack([np.concatenate([late.ravel(), energy.ravel()]) for late, energy, _ in described])
        self._scale = np.concatenate(
            [np.full(part.size, max(float(spread), 1e-9)) for part, spread in self._spreads(described)]
        )
        self._expected = PairRegression(*self._ends(training), values / self._scale)

    def response(self, pair: int, turns: Turns) -> npt.NDArray[np.float32]:
        """(yaw, channel, sample)"""
        emitter, listener = self._ends(np.array([pair]))
        values = self._expected(emitter, listener)[0] * self._scale
        size = int(np.prod(self._shape[:2]))
        arrival = values[:size].reshape(self._shape[:2])
        energy = values[size:].reshape(self._shape) + self._spherical(pair)
        late, known, aligned = self._described(nearest_pair(self._pairs, pair), turns)
        known = known + self._spherical(nearest_pair(self._pairs, pair))
        gain = np.exp(0.5 * np.clip(energy[turns] - known, -2 * _LARGEST_GAIN, 2 * _LARGEST_GAIN))
        shaped = np.sum(self._parts.split(aligned) * gain[..., np.newaxis], axis=(-3, -2))
        starts = self._start(pair) + arrival[turns] * self._rate
        return moved(shaped, starts).astype(np.float32)

    def _described(self, pair: int, turns: Turns = slice(None)) -> tuple[_Floats, _Floats, _Floats]:
        """(yaw, channel) seconds by which sound arrives later than geometry says, (yaw, channel, band, stretch)
        logarithm of energy less that of spherical spreading, and the response aligned to its arrival."""
        response = self._pairs.response(pair)[turns]
        roughly = moved(response, np.full(response.shape[:-1], -self._start(pair)))
        head = roughly[..., : self._parts.lead + round(_ARRIVAL_S * self._rate)]
        onset = onset_sample(resample(head, head.shape[-1] * _UPSAMPLING, axis=-1)) / _UPSAMPLING
        late = np.where(onset >= 0, onset - self._parts.lead, 0.0)
        aligned = moved(roughly, -late)
        power = np.square(self._parts.split(aligned)).sum(axis=-1)
        floor = _SILENCE * max(float(power.sum(axis=(-2, -1)).max()), np.finfo(np.float64).tiny)
        return late / self._rate, np.log(power + floor) - self._spherical(pair), aligned

    def _start(self, pair: int) -> float:
        """Samples, of a response that is aligned by geometry."""
        return float(self._delays_s[pair]) * self._rate - self._parts.lead

    def _spherical(self, pair: int) -> _Floats:
        """(stretch,): the direct sound spreads, what follows fills the room."""
        distance = max(float(self._delays_s[pair]) * SPEED_OF_SOUND, _NEAREST_M)
        return np.where(np.arange(len(self._parts.stretches)) == 0, -2.0 * np.log(distance), 0.0)

    def _ends(self, pairs: npt.NDArray[np.integer]) -> tuple[_Floats, _Floats]:
        known = self._pairs
        return known.emitter_positions[known.pair_emitter[pairs]], known.listener_positions[known.pair_listener[pairs]]

    @staticmethod
    def _spreads(described: list[tuple[_Floats, _Floats, _Floats]]) -> list[tuple[_Floats, float]]:
        """Arrivals and energies have different units: each counts in its own spread."""
        return [
            (described[0][part], float(np.mean(np.std([each[part] for each in described], axis=0)))) for part in (0, 1)
        ]
