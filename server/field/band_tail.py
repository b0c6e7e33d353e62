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
from server.acoustics.decoding_kernel import NO_MARGIN
from server.field.band_tail_kernel import add_band_tail, find_band_gains
from server.field.decoder import Decoder
from server.field.directional_graph import LEAST_POWER, Arrivals, DirectionalGraph
from server.field.directional_response_kernel import Buffers, Early, Hearing, Room, Tail, respond
from server.field.directions_kernel import turned_shape
from server.field.graph import Spectrograms
from server.kernels.by_reference import Reference
from server.kernels.cache_lines import zeros_on_lines
from server.kernels.simd import WIDE_LANES
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
        first = max(0, int(np.searchsorted(edges, self.early_frames)) - 2)
        self._early_columns = _columns_of(parameters, self.early_frames)
        is_simple = _have_columns(parameters, self.early_frames) and parameters.known_frames == 0
        self._margin = WIDE_LANES if is_simple else NO_MARGIN
        places = centres[first:] * codec.hop - codec.frame_lead_samples + codec.n_fft / 2
        missing = _missing(codec.window * codec.dual_window, codec.hop)
        noises, diffuse = _band_noises(graph, frozen_noise)
        steps = np.max(np.abs(noises), axis=-1, keepdims=True) / np.iinfo(np.int16).max
        # A scene without noise has a step too.
        steps = np.maximum(steps, _SMALLEST)
        # As 16-bit integers, half as much has to be read, which is most of the work.
        rounded = np.round(noises / steps).astype(np.int16)
        self.parts = Tail(first, diffuse, np.ascontiguousarray(steps[..., 0], np.float32), rounded, places, missing)
        self._hearings: dict[Decoder, Reference] = {}
        self._rooms: list[Reference] = []

    @property
    def nbytes(self) -> int:
        """The size of the noises, which is nearly all that a tail holds."""
        return self.parts.noises.nbytes

    def responses(
        self,
        decoder: Decoder,
        arrivals: Arrivals,
        orientations: Floats,
        aligned: Floats,
        samples: int | None = None,
    ) -> Float32:
        """Responses (B, 2, sample) of heads with these orientations (B, 4): the first frames by `decoder`, which uses
        `early_frames` of them, then the tail. The first coded sample lies at sample `aligned` (B,), which may be a
        fraction. With `samples`, only so many of each are computed."""
        constants = decoder.constants
        if constants is None:
            responses = decoder.decode(self._early(arrivals, orientations), aligned)
            self._add(arrivals, orientations, aligned, responses)
            return np.ascontiguousarray(responses[..., :samples])
        hearing = self._hearings.get(decoder)
        if hearing is None:
            band, share = self._graph.between_bands
            early = Early(band, share, self._early_columns, self._margin, *constants)
            hearing = self._hearings[decoder] = Reference(Hearing(self._graph.turning, early, self.parts, LEAST_POWER))
        try:
            room = self._rooms.pop()
        except IndexError:
            room = Reference(Room(self._new_buffers(), decoder.new_workspace()))
        responses = decoder.room(len(aligned), samples)
        respond(arrivals.log_magnitude, arrivals.directions, orientations, aligned, hearing, room, responses)
        self._rooms.append(room)
        return responses

    def _early(self, arrivals: Arrivals, orientations: Floats) -> Spectrograms:
        """The spectrograms at the ears, as far as the first frames need them."""
        return self._graph.at_ears(arrivals, orientations, columns=self._early_columns)

    def _new_buffers(self) -> Buffers:
        codec, bands = self._codec, len(self.parts.diffuse)
        columns = self._graph.parameters.columns
        row = -(-self._early_columns // WIDE_LANES) * WIDE_LANES
        ears = zeros_on_lines(2, 1, 2, codec.bins, columns if self._margin == NO_MARGIN else row + 2 * self._margin)
        harmonics = self._graph.turning.level.shape[1]
        turned = turned_shape(harmonics, bands, columns)
        return Buffers(
            turned=zeros_on_lines(*turned),
            levels=ears[0],
            coherence=ears[1],
            no_phase=zeros_on_lines(1, 2, codec.bins, 0),
            work=zeros_on_lines(harmonics + 1, bands, row),
            gains=zeros_on_lines(3, *turned[1:]),
            scratch=zeros_on_lines(2, codec.n_fft + codec.hop),
        )

    def _add(self, arrivals: Arrivals, orientations: Floats, aligned: Floats, responses: Float32) -> None:
        """Add tails to responses whose first frames are decoded by NumPy."""
        codec, parts = self._codec, self.parts
        bands, columns = arrivals.log_magnitude.shape[1:]
        gains = np.empty((3, *turned_shape(0, bands, columns)[1:]), np.float32)
        scratch = np.empty((2, codec.n_fft + codec.hop), np.float32)
        for row, (orientation, start) in enumerate(zip(orientations, aligned, strict=True)):
            turned = self._graph.turned(arrivals, row, orientation)
            products = self._graph.band_products
            find_band_gains(turned, products, parts.diffuse, parts.steps, parts.first, LEAST_POWER, gains)
            delay = float(start) / codec.hop
            whole = math.floor(delay)
            fade_at = (whole + self.early_frames) * codec.hop - codec.frame_lead_samples
            add_band_tail(
                gains[:, :, parts.first :],
                parts.places + start,
                parts.noises,
                fade_at,
                delay - whole,
                parts.missing,
                scratch,
                responses[row],
            )


def _columns_of(parameters: CodecParameters, frames: int) -> int:
    """The number of columns of a prediction from which its first `frames` are made."""
    if parameters.frame_axis is None:
        return frames
    weights = parameters.frame_axis.spread()[:, :frames]
    return int(np.flatnonzero(weights.any(axis=1))[-1]) + 1


def _have_columns(parameters: CodecParameters, frames: int) -> bool:
    """Whether each of the first `frames` has a column of a prediction of its own."""
    axis = parameters.frame_axis
    return axis is None or np.array_equal(axis.edges[: frames + 1], np.arange(frames + 1))


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


def _band_noises(graph: DirectionalGraph, frozen_noise: Float32) -> tuple[Floats, Float32]:
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
    of_bands = graph.band_products[..., 0]
    coherent = of_bands[:, 2] / np.sqrt(of_bands[:, 0] * of_bands[:, 1])
    diffuse = np.stack([of_bands[:, 0], of_bands[:, 1], np.clip(coherent, -0.999, 0.999)], axis=-1)
    return noises, np.ascontiguousarray(diffuse, np.float32)
