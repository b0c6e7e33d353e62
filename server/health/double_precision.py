"""Full impulse responses in double precision, the reference for the server's responses.

The network's outputs and the tables of heads and of the windowed sinc are float32, as they are. Everything after them
is computed independently in float64, with other algorithms if possible: NumPy's transforms instead of compiled ones,
the recursion of a power series instead of an unrolled kernel, a search over all triangles of a head instead of a walk
across them. Responses are rounded to float32 twice, after decoding and after the gate, which is 150 dB below them.

Axes: B poses; spectrograms (B, ear, frequency, frame); responses (B, ear, sample).
"""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from scipy.fft import irfft, next_fast_len, rfft

from server.acoustics.geometry import axes_of, orientations_of
from server.acoustics.phase import MOST_COHERENT, NO_PHASE, UNDECIDED
from server.acoustics.sound_path import DescribedPaths
from server.acoustics.spherical_harmonics import harmonic_count, rotation
from server.field.band_tail import BandTail
from server.field.band_tail_kernel import MOST_IN_A_BAND
from server.field.decoder import Decoder
from server.field.directional_graph import LEAST_POWER, Arrivals, DirectionalGraph
from server.field.field import AcousticField, Silence
from server.field.gate import MOST_GIVEN, Gate, Indices
from server.field.graph import Spectrograms
from server.rendering.fractional_delay import BEFORE, PHASES, TAPS
from server.rendering.hrtf import HeadFilters
from server.rendering.still_paths import StillPaths
from server.responses.early_reflections import EarlyReflections
from server.responses.full_response import FullResponse

_Float32 = npt.NDArray[np.float32]
_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]
_Number = TypeVar("_Number", np.float64, np.complex128)


class DoubleDecoder(Decoder):
    """A field's decoder in float64."""

    def __init__(self, field: AcousticField, frames: int | None = None) -> None:
        """`frames` are those before a tail of bands, if the field has one."""
        parameters = field.graph.parameters
        self.ir_samples = field.ir_samples
        self._codec = parameters.codec
        self._frame_axis = parameters.frame_axis
        self._phase = field.level.phase
        self._used = frames or field.level.frames or self._codec.frames
        self._known = min(parameters.known_frames, self._used)
        signal = _fitted(field.bundle.frozen_noise, self._codec.samples)
        self._white = self._codec.transform(signal) / np.sqrt(self._codec.window_energy)

    @property
    def constants(self) -> None:
        """None, so that NumPy decodes spectrograms, and not compiled code."""
        return None

    def decode(
        self, predicted: Spectrograms, aligned: _Floats, near: Sequence[_Float32 | None] | None = None
    ) -> _Float32:
        near = near or [None] * len(aligned)
        predicted = predicted.spread(self._frame_axis)
        rows = [
            self._decode(predicted[row : row + 1], float(start), response)
            for row, (start, response) in enumerate(zip(aligned, near, strict=True))
        ]
        return np.stack(rows).astype(np.float32)

    def _decode(self, predicted: Spectrograms, aligned: float, near: _Float32 | None) -> _Floats:
        codec, used = self._codec, self._used
        start, delay = int(np.floor(aligned)), aligned / codec.hop
        magnitude = _double(codec.magnitude(_double(predicted.log_magnitude[0])))
        magnitude[..., used:] = 0
        known, unknown, coherence = self._separate(predicted, magnitude)
        turn = np.exp(-2j * np.pi * np.arange(codec.bins) / codec.n_fft * (aligned - start))
        early = _double(codec.synthesise(known * turn[:, None]))
        unknown, coherence = _later(unknown, delay), _later(coherence, delay)
        independent = np.sqrt(np.maximum(1 - np.abs(coherence) ** 2, 0))
        noise = np.stack([self._white[0], np.conj(coherence) * self._white[0] + independent * self._white[1]])
        response = _fitted(codec.synthesise(unknown * noise), self.ir_samples)
        first, last = max(0, start), min(self.ir_samples, start + early.shape[-1])
        if last > first:
            response[:, first:last] += early[:, first - start : last - start]
        if self._phase.iterations:
            response = self._griffin_lim(_later(magnitude, delay), response if near is None else _double(near), near)
        return response

    def _separate(self, predicted: Spectrograms, magnitude: _Floats) -> tuple[_Complex, _Floats, _Complex]:
        """The known part, and the magnitude and coherence of the noise, as in `server.acoustics.phase.separate`, for
        one response."""
        known = self._known
        phase = self._codec.integrate(_double(predicted.instantaneous_frequency[0, ..., :known]))
        certainty = _double(predicted.certainty[0, ..., :known])
        if self._phase.kind == "integrated":
            certainty = np.ones_like(certainty)
        phasors = certainty * np.exp(1j * phase)
        left_over = np.sqrt(np.maximum(1 - certainty**2, 0))
        coherence = _double(predicted.interaural[0, 0]) + 1j * _double(predicted.interaural[0, 1])
        coherence[..., :known] -= phasors[0] * np.conj(phasors[1])
        coherence[..., :known] /= np.maximum(left_over[0] * left_over[1], UNDECIDED)
        coherence *= MOST_COHERENT / np.maximum(np.abs(coherence), 1)
        coherence[..., self._used :] = 0
        unknown = magnitude.copy()
        unknown[..., :known] *= left_over
        return magnitude[..., :known] * phasors, unknown, coherence

    def _griffin_lim(self, magnitude: _Floats, response: _Floats, near: _Float32 | None) -> _Floats:
        """The Griffin-Lim algorithm, from a response or from zero phase."""
        codec = self._codec
        if self._phase.warm or near is not None:
            signal = _fitted(response, codec.samples)
        else:
            zero_phase = np.zeros(magnitude.shape, dtype=np.complex128)
            zero_phase.real = magnitude * (-1.0) ** np.arange(codec.bins)[:, None]
            signal = _double(codec.synthesise(zero_phase))
        for _ in range(self._phase.iterations):
            spectrogram = codec.transform(signal)
            size = np.abs(spectrogram)
            phasors: _Complex = np.where(size**2 >= NO_PHASE, spectrogram / np.maximum(size, NO_PHASE), 1)
            signal = _double(codec.synthesise(np.asarray(magnitude * phasors, dtype=np.complex128)))
        return _fitted(signal, self.ir_samples)


class DoubleGate(Gate):
    """The gate in NumPy: gains and energies in float64, samples in float32."""

    def __init__(self, gate: Gate) -> None:
        self._rise, self._answer, self._given = gate._rise, gate._answer, gate._given

    def _open(self, responses: _Float32, onsets: Indices, echoes: Indices) -> None:
        samples = np.arange(responses.shape[-1])
        for response, onset, echo in zip(responses, onsets.tolist(), echoes.tolist(), strict=True):
            begin = echo - len(self._answer)
            opens = max(0, onset, begin)
            gain = np.where(
                samples < opens, 0.0, _at(self._rise, samples - onset, 1) * _at(self._answer, samples - begin, 1)
            )
            given = _at(self._given, samples - opens, 0)
            squares = response.astype(np.float64) ** 2
            taken, kept = (squares * (1 - gain**2)).sum(axis=-1), (squares * gain**2 * given).sum(axis=-1)
            share = np.divide(taken, kept, out=np.full_like(kept, MOST_GIVEN), where=taken < MOST_GIVEN * kept)
            response *= gain * np.sqrt(1 + share[:, None] * given)


class DoubleDirectionalGraph(DirectionalGraph):
    """A field's graph whose predictions are heard by two ears in float64."""

    def __init__(self, graph: DirectionalGraph) -> None:
        vars(self).update(vars(graph))
        self._single = graph

    def run(
        self,
        listeners: npt.ArrayLike,
        emitters: npt.ArrayLike,
        heads: npt.ArrayLike,
        paths: DescribedPaths | None = None,
    ) -> list[_Float32]:
        return self._single.run(listeners, emitters, heads, paths)

    def at_ears(self, arrivals: Arrivals, heads: npt.ArrayLike, *, columns: int | None = None) -> Spectrograms:  # noqa: ARG002  all are computed
        rows = [
            self._at_ears(_double(log_magnitude), _double(directions), orientation)
            for log_magnitude, directions, orientation in zip(
                arrivals.log_magnitude, arrivals.directions, orientations_of(heads), strict=True
            )
        ]
        levels, coherence = (np.stack(parts) for parts in zip(*rows, strict=True))
        no_phase = np.zeros((*levels.shape[:3], self.parameters.known_frames))
        return Spectrograms(levels, no_phase, no_phase, coherence)

    def _at_ears(self, log_magnitude: _Floats, directions: _Floats, orientation: _Floats) -> tuple[_Floats, _Floats]:
        floor = self.parameters.log_floor
        products = self._products.matrix @ rotation(orientation, self.heard_order)
        by_band = np.square(np.maximum(np.exp(log_magnitude) - floor, 0)) * self.relative(directions)
        band, share = self.between_bands
        upper = _double(share)[:, None]
        power = (1 - upper) * by_band[:, band] + upper * by_band[:, band + 1]
        heard = np.einsum("bpk,kbc->pbc", products, power)
        least = LEAST_POWER * products[:, :2, 0].T[..., None] * power[0]
        amplitude = np.sqrt(np.maximum(heard[:2], least))
        both = amplitude[0] * amplitude[1]
        coherence = np.divide(heard[2:], both, out=np.zeros_like(heard[2:]), where=both > 0)
        coherence /= np.maximum(1, np.hypot(*coherence))
        return np.log(amplitude + floor), coherence

    def relative(self, directions: _Floats) -> _Floats:
        """(k, band, column) the harmonics of the power that are heard, relative to the first."""
        one = np.ones((1, *directions.shape[1:]))
        return np.concatenate([one, directions])[: harmonic_count(self.heard_order)]


class DoubleBandTail(BandTail):
    """A tail of band noises in NumPy: gains and sums in float64, of the noises as they are kept."""

    def __init__(self, tail: BandTail, graph: DoubleDirectionalGraph) -> None:
        vars(self).update(vars(tail))
        self._graph: DoubleDirectionalGraph = graph

    def _add(self, arrivals: Arrivals, orientations: _Floats, aligned: _Floats, responses: _Float32) -> None:
        codec, parts = self._codec, self.parts
        noises = parts.noises.astype(np.float64) * _double(parts.steps)[..., None]
        for row, (orientation, start) in enumerate(zip(orientations, aligned.tolist(), strict=True)):
            gains = self._gains(
                _double(arrivals.log_magnitude[row, :, parts.first :]),
                _double(arrivals.directions[row, ..., parts.first :]),
                orientation,
            )
            whole = int(np.floor(start / codec.hop))
            share = start / codec.hop - whole
            fade_at = (whole + self.early_frames) * codec.hop - codec.frame_lead_samples
            amount = _at(
                share * parts.missing[0] + (1 - share) * parts.missing[1], np.arange(self._length) - fade_at, 1
            )
            amount[: max(0, fade_at)] = 0
            places = parts.places + start
            at = np.arange(self._length)
            left, other, own = ([np.interp(at, places, band) for band in ear] for ear in gains)
            tail = np.stack(
                [np.sum(left * noises[:, 0], axis=0), np.sum(other * noises[:, 0] + own * noises[:, 1], axis=0)]
            )
            count = min(self._length, responses.shape[-1])
            responses[row, :, :count] += (amount * tail)[:, :count]

    @property
    def _length(self) -> int:
        return int(self.parts.noises.shape[-1])

    def _gains(self, log_magnitude: _Floats, directions: _Floats, orientation: _Floats) -> _Floats:
        """(3, band, column) gains as `server.field.band_tail_kernel.find_band_gains` describes them."""
        graph, diffuse = self._graph, _double(self.parts.diffuse)
        mean = _double(graph._mean_over_band)
        of_bins = graph._products.matrix @ rotation(orientation, graph.heard_order)
        products = np.einsum("bf,fpk->bpk", mean, of_bins)
        left, right, real, _ = np.einsum("bpk,kbc->pbc", products, graph.relative(directions))
        left, right = (np.maximum(power, LEAST_POWER * diffuse[:, ear, None]) for ear, power in ((0, left), (1, right)))
        coherence = np.clip(real / np.sqrt(left * right), -MOST_IN_A_BAND, MOST_IN_A_BAND)
        magnitude = np.maximum(np.exp(log_magnitude) - self._codec.log_floor, 0)
        amplitudes = [
            _balanced(magnitude * np.sqrt(power / diffuse[:, ear, None])) for ear, power in ((0, left), (1, right))
        ]
        of_diffuse = diffuse[:, 2, None]
        own = np.sqrt((1 - coherence**2) / (1 - of_diffuse**2))
        return np.stack([amplitudes[0], amplitudes[1] * (coherence - own * of_diffuse), amplitudes[1] * own])


def _balanced(gain: _Floats) -> _Floats:
    """Gains (band, column) that make up for what is lacking where bands' amplitudes add up."""
    squares = gain[:-1] ** 2 + gain[1:] ** 2
    between = np.divide(1.5 * squares, squares + gain[:-1] * gain[1:], out=np.ones_like(squares), where=squares > 0)
    padded = np.pad(between, ((1, 1), (0, 0)), constant_values=1.0)
    return np.asarray(gain * np.sqrt((padded[:-1] + padded[1:]) / 2))


class _DoubleField(AcousticField):
    def __init__(self, field: AcousticField) -> None:
        graph = field.graph
        if isinstance(graph, DirectionalGraph):
            graph = DoubleDirectionalGraph(graph)
        super().__init__(field.bundle, field.level, graph)
        if self._tail is not None:
            assert isinstance(self.graph, DoubleDirectionalGraph)
            self._tail = DoubleBandTail(self._tail, self.graph)
        if self._decoder is not None:
            self._decoder = DoubleDecoder(field, None if self._tail is None else self._tail.early_frames)
        self._gate = DoubleGate(self._gate)

    def _placed(self, coded: _Float32, aligned: _Floats) -> _Float32:
        start = np.floor(aligned).astype(int)
        size = next_fast_len(coded.shape[-1] + 1, real=True)
        turns = np.exp(-2j * np.pi * np.arange(size // 2 + 1) / size * (aligned - start)[:, None, None])
        shifted = irfft(rfft(_double(coded), size) * turns, size)[..., : coded.shape[-1]]
        responses = np.zeros((len(coded), coded.shape[1], self.ir_samples))
        for response, part, at in zip(responses, shifted, start, strict=True):
            first, last = max(0, at), min(self.ir_samples, at + part.shape[-1])
            if last > first:
                response[:, first:last] += part[:, first - at : last - at]
        return responses.astype(np.float32)


class DoubleStillPaths(StillPaths):
    """Responses of paths at rest. They are summed in float64 before they are added to the output."""

    def add(
        self,
        lengths_m: _Floats,
        arrivals: _Floats,
        band_gains_db: _Floats,
        orientation: Sequence[float],
        out: _Float32,
    ) -> None:
        tables = self._tables
        total = np.zeros(out.shape)
        for length, arrival, gains_db in zip(lengths_m, arrivals, band_gains_db, strict=True):
            corners, weights = self._triangle(axes_of(orientation) @ arrival)
            levels_db = np.append(gains_db, gains_db[-1]) - tables.air_db_per_m * length
            cepstra = np.einsum("c,cen->en", weights, _double(tables.cepstra[corners]))
            cepstra += levels_db @ _double(tables.band_cepstra)
            delays_s = length / tables.speed_of_sound + weights @ tables.head_delays_s[corners]
            for ear, (cepstrum, delay_s) in enumerate(zip(cepstra, delays_s, strict=True)):
                delay = delay_s * tables.sample_rate
                whole = int(np.ceil(delay))
                phase = (whole - delay) * PHASES
                row = min(PHASES - 1, int(phase))
                sinc = _double(tables.sinc[row, :TAPS]) + (phase - row) * _double(tables.sinc[row, TAPS:])
                part = np.convolve(_minimum_phase(cepstrum), sinc[::-1]) / max(length, tables.nearest_m)
                begin = whole + BEFORE - (TAPS - 1)
                first, last = max(0, begin), min(out.shape[1], begin + part.size)
                if last > first:
                    total[ear, first:last] += part[first - begin : last - begin]
        out += total

    def _triangle(self, direction: _Floats) -> tuple[npt.NDArray[np.int64], _Floats]:
        """The three measured directions around a direction, and their weights. It is the triangle whose least weight is
        greatest."""
        weights = self._tables.inverses @ direction
        best = int(np.argmax(weights.min(axis=-1)))
        of_best = np.maximum(weights[best], 0)
        return self._tables.triangles[best], of_best / of_best.sum()


class _DoubleEarlyReflections(EarlyReflections):
    def __init__(self, early: EarlyReflections, paths: DoubleStillPaths) -> None:
        self._finder, self._air_db_per_m, self._paths = early._finder, early._air_db_per_m, paths


class DoubleFullResponse(FullResponse):
    """`FullResponse` computed in float64."""

    def __init__(self, field: AcousticField, filters: HeadFilters) -> None:
        super().__init__(field if isinstance(field, Silence) else _DoubleField(field.through(filters)), filters)
        paths = DoubleStillPaths(
            filters,
            speed_of_sound=field.bundle.manifest.speed_of_sound,
            air_db_per_m=field.bundle.manifest.air.filter_db_per_m,
        )
        self._direct = paths
        if self._early is not None:
            self._early = _DoubleEarlyReflections(self._early, paths)


def _at(curve: _Float32, index: Indices, after: float) -> _Floats:
    """Values of the curve at indices. Before its beginning it has its first value, and `after` after its end."""
    values = np.append(_double(curve), after)
    return np.asarray(values[np.clip(index, 0, len(curve))])


def _double(values: npt.NDArray[np.floating]) -> _Floats:
    return np.asarray(values, dtype=np.float64)


def _fitted(signal: npt.NDArray[np.floating], samples: int) -> _Floats:
    """The signal (..., sample) cut or padded with zeros to `samples`."""
    fitted = np.zeros((*signal.shape[:-1], samples))
    count = min(samples, signal.shape[-1])
    fitted[..., :count] = signal[..., :count]
    return fitted


def _later(values: npt.NDArray[_Number], frames: float) -> npt.NDArray[_Number]:
    """Values (..., frame) delayed by `frames`, which may be fractional: linear interpolation, zero outside."""
    at = np.arange(values.shape[-1]) - frames
    before = np.floor(at).astype(int)

    def of_frame(number: npt.NDArray[np.int64]) -> npt.NDArray[_Number]:
        inside = (number >= 0) & (number < values.shape[-1])
        return np.where(inside, values[..., np.where(inside, number, 0)], 0)

    share = (at - before).astype(values.dtype)
    return np.asarray(of_frame(before) + share * (of_frame(before + 1) - of_frame(before)))


def _minimum_phase(cepstrum: _Floats) -> _Floats:
    """(n,) taps of the filter with this folded cepstrum: h[n] = sum k / n c[k] h[n - k] (Oppenheim and Schafer,
    "Discrete-Time Signal Processing", ch. 13)."""
    taps = np.empty_like(cepstrum)
    taps[0] = np.exp(cepstrum[0])
    ordered = np.arange(cepstrum.size) * cepstrum
    for n in range(1, cepstrum.size):
        taps[n] = ordered[1 : n + 1] @ taps[n - 1 :: -1][:n] / n
    return taps
