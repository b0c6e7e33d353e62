"""Late reverberation as frozen band noises with gains that change with the pose, in place of an inverse transform.

Late sound is noise in octave bands that decay. So a noise is filtered once, into the bands and through a head that
hears diffuse sound, and each response multiplies it by gains: two ears, seven bands, a value per column of a
prediction. The first part of a response, which changes faster and has more colour, is still decoded from spectrograms
(`server.field.decoder`). Where that ends, the tail fades in. Both have the same noise, so that nothing is heard of the
change.

Axes: B poses; bands (7); noises (band, ear, sample); responses (B, ear, sample).
"""

import math

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import band_weights
from server.acoustics.geometry import LEVEL, orientations_of
from server.field.band_tail_kernel import add_band_tail, find_band_gains
from server.field.decoder import Decoder
from server.field.directional_graph import LEAST_POWER, Arrivals, DirectionalGraph
from server.kernels.cache_lines import on_lines
from server.scene.manifest import CodecParameters

Float32 = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]

EARLY_S = 0.06
"""Seconds after the first sound that are decoded from spectrograms."""
_SMALLEST = 1e-12


def early_frames(parameters: CodecParameters) -> int:
    """The number of frames before the tail: those of the first EARLY_S, up to the end of a cell."""
    codec = parameters.codec
    wanted = int(np.ceil((EARLY_S * codec.sample_rate + parameters.lead_samples) / codec.hop))
    ends = np.arange(1, codec.frames + 1) if parameters.frame_axis is None else parameters.frame_axis.edges[1:]
    later = ends[ends >= wanted]
    return int(later[0]) if len(later) else codec.frames


class BandTail:
    """The tail of a directional field's responses through one head. Thread-safe."""

    def __init__(self, graph: DirectionalGraph, frozen_noise: Float32) -> None:
        """`frozen_noise` (2, sample) is the scene's white noise."""
        parameters = graph.parameters
        self._graph = graph
        self._codec = parameters.codec
        codec = self._codec
        self.early_frames = early_frames(parameters)
        """The number of frames that are decoded from spectrograms."""
        edges = np.arange(codec.frames + 1) if parameters.frame_axis is None else parameters.frame_axis.edges
        centres = (edges[:-1] + edges[1:] - 1) / 2
        # The fade lies before the first late column, so begin with the column before it.
        self._first = max(0, int(np.searchsorted(edges, self.early_frames)) - 2)
        self._early_columns = min(len(centres), int(np.searchsorted(edges, self.early_frames)) + 1)
        self._places = centres[self._first :] * codec.hop - codec.frame_lead_samples + codec.n_fft / 2
        self._missing = _missing(codec.window * codec.dual_window, codec.hop)
        self._noises, self._diffuse = _band_noises(graph, frozen_noise)

    @property
    def nbytes(self) -> int:
        """The size of the noises, which is nearly all that a tail holds."""
        return self._noises.nbytes

    def responses(
        self, decoder: Decoder, listeners: Floats, emitters: Floats, heads: npt.ArrayLike, aligned: Floats
    ) -> Float32:
        """Responses (B, 2, sample): the first frames by `decoder`, which uses `early_frames` of them, then the tail.
        The first coded sample lies at sample `aligned` (B,), which may be a fraction. Heads are orientations (B, 4) or
        yaws (B,) of level heads."""
        orientations = orientations_of(heads)
        arrivals = self._graph.arrivals(listeners, emitters)
        early = self._graph.at_ears(arrivals, orientations, columns=self._early_columns)
        responses = decoder.decode(early, aligned)
        self._add(arrivals, orientations, aligned, responses)
        return responses

    def _add(self, arrivals: Arrivals, orientations: Floats, aligned: Floats, responses: Float32) -> None:
        codec = self._codec
        bands, columns = arrivals.log_magnitude.shape[1:]
        gains = np.empty((3, bands, columns - self._first), np.float32)
        scratch = np.empty((2, codec.n_fft + codec.hop), np.float32)
        for row, (orientation, start) in enumerate(zip(orientations, aligned, strict=True)):
            find_band_gains(
                arrivals.log_magnitude[row],
                arrivals.directions[row],
                self._graph.band_products(orientation),
                self._diffuse,
                self._first,
                codec.log_floor,
                LEAST_POWER,
                gains,
            )
            delay = float(start) / codec.hop
            whole = math.floor(delay)
            fade_at = (whole + self.early_frames) * codec.hop - codec.frame_lead_samples
            places = self._places + start
            add_band_tail(gains, places, self._noises, fade_at, delay - whole, self._missing, scratch, responses[row])


def _missing(product: Floats, hop: int) -> Float32:
    """(2, sample) the amplitude that is missing from the first sample of the first missing frame on: if only the frames
    after it are missing, and if it is missing too. `product` is that of both windows."""
    size = len(product) + hop
    with_it = np.zeros(size)
    for start in range(0, size, hop):
        part = product[: size - start]
        with_it[start : start + len(part)] += part
    after_it = np.concatenate([np.zeros(hop), with_it[: size - hop]])
    return np.stack([after_it, with_it]).astype(np.float32)


def _band_noises(graph: DirectionalGraph, frozen_noise: Float32) -> tuple[Float32, Float32]:
    """The noises (band, ear, sample) of diffuse sound of unit power at a head's ears, by octave band; and (band, 3)
    what `find_band_gains` needs to know of them.

    Bands overlap. All are made of one noise, with amplitudes that add up to one: then equal gains give back that noise,
    whose spectrogram is even.
    """
    codec = graph.parameters.codec
    samples = codec.samples
    noise = np.zeros((2, samples))
    count = min(samples, frozen_noise.shape[1])
    noise[:, :count] = frozen_noise[:, :count]
    one, other = np.fft.rfft(noise) / np.sqrt(codec.window_energy)
    frequency = np.fft.rfftfreq(samples)
    at_bins = np.linspace(0, 0.5, codec.bins)
    products = np.stack([np.interp(frequency, at_bins, values) for values in graph.diffuse_products.T])
    left, right = np.sqrt(np.maximum(products[:2], _SMALLEST))
    coherence = (products[2] + 1j * products[3]) / (left * right)
    coherence /= np.maximum(1, np.abs(coherence))
    at_right = np.conj(coherence) * one + np.sqrt(1 - np.abs(coherence) ** 2) * other
    weights = band_weights(frequency * codec.sample_rate)
    noises = np.stack([np.fft.irfft(weights * ear, samples) for ear in (left * one, right * at_right)], axis=1)
    of_bands = graph.band_products(np.array(LEVEL))[..., 0]
    coherent = of_bands[:, 2] / np.sqrt(of_bands[:, 0] * of_bands[:, 1])
    diffuse = np.stack([of_bands[:, 0], of_bands[:, 1], np.clip(coherent, -0.999, 0.999)], axis=-1)
    return on_lines(noises), np.ascontiguousarray(diffuse, np.float32)
