"""Decoding of what arrives at a point, by direction, to ambisonic channels.

The channels are frozen noises (`server.field.ambisonic_noise`) in octave bands, one noise for each channel, mixed so
that the channels have the covariance of the arriving sound: gains of each band and column of a prediction, interpolated
in between. Bands overlap, and there their amplitudes add up: gains make up for the power that this lacks. A first order
follows exactly from harmonics of the second (`server.field.ambisonic_kernel`). For higher orders, sound is spread over
virtual directions, with powers that are never negative and whose harmonics are those predicted, as nearly as such
powers can have them. The first channel is the same at all orders.

Where nothing but a level changes, the same noise sounds: equal poses have equal responses, and neighbours nearly so. A
root of a covariance is taken that is continuous, and that turns with the sound.

Channels are ACN and SN3D (`server.acoustics.spherical_harmonics`), in world axes. Axes: B poses; k channels; d
directions; bands; columns of a prediction; responses (B, k, sample).
"""

from functools import cache, lru_cache

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ, band_weights
from server.acoustics.codec import Codec
from server.acoustics.spherical_harmonics import harmonic_count, mean_squares, real_harmonics
from server.field.ambisonic_kernel import find_first_order, mix_bands
from server.field.ambisonic_noise import even_noises
from server.field.directional_graph import Arrivals
from server.kernels.cache_lines import zeros_on_lines
from server.kernels.simd import LANES
from server.scene.manifest import CodecParameters

Float32 = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]

_STEPS, _BEYOND = 40, 1.8
_SNUB_CUBE = (0.866246818107821, 0.422518653761111, 0.266635401516705)
"""Coordinates by which the corners of a snub cube are a spherical 7-design (Hardin and Sloane, Discrete Comput. Geom.
15, 429, 1996): sums over them are means over the sphere for products of harmonics up to the third order."""


@cache
def virtual_directions() -> Floats:
    """(24, 3) unit vectors, a spherical design of strength 7."""
    a, b, c = _SNUB_CUBE
    turned = np.array([[a, b, c], [b, c, a], [c, a, b]])
    signs = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])  # an even number of minuses
    mirrored = turned[:, ::-1] * np.array([-1, 1, 1])
    directions = np.concatenate([(signs[:, None] * corners).reshape(-1, 3) for corners in (turned, mirrored)])
    return np.asarray(directions / np.linalg.norm(directions, axis=-1, keepdims=True))


def powers_by_direction(moments: npt.NDArray[np.floating]) -> Floats:
    """(..., d) powers of the virtual directions, never negative, that sum to 1 and have these harmonics (..., k)
    relative to the first, which is 1.

    Harmonics that no such powers have, like those of a single wave between the directions, are approached: by
    alternating projections onto what has the harmonics, a little beyond, and onto what is not negative (relaxed
    projections after Agmon and Motzkin, 1954).
    """
    wanted = np.asarray(moments, dtype=np.float64)
    order = round(wanted.shape[-1] ** 0.5) - 1
    harmonics = real_harmonics(virtual_directions(), order)
    # On a design, what turns harmonics into powers is the transpose.
    inverse = (harmonics / (mean_squares(order) * len(harmonics))).T
    powers = wanted @ inverse
    for _ in range(_STEPS):
        if not (powers < 0).any():
            break
        np.maximum(powers, 0, out=powers)
        powers += _BEYOND * ((wanted - powers @ harmonics) @ inverse)
    np.maximum(powers, 0, out=powers)
    return np.asarray(powers / powers.sum(axis=-1, keepdims=True))


class AmbisonicDecoder:
    """Decodes a field's arrivals to responses (B, k, `ir_samples`); only the first `frames` frames are used (default:
    all). Thread-safe."""

    def __init__(self, parameters: CodecParameters, *, ir_samples: int, frames: int | None = None) -> None:
        codec = parameters.codec
        self._codec = codec
        self._ir_samples = ir_samples
        edges = np.arange(codec.frames + 1) if parameters.frame_axis is None else parameters.frame_axis.edges
        centres = (edges[:-1] + edges[1:] - 1) / 2
        self._places = centres * codec.hop - codec.frame_lead_samples + codec.n_fft / 2
        self._end: float | None = None
        if frames is not None and frames < codec.frames:
            self._end = (frames - 1) * codec.hop - codec.frame_lead_samples + codec.n_fft

    def decode(self, arrivals: Arrivals, aligned: Floats, order: int) -> Float32:
        """Decode to channels of `order`. The first sample of each prediction lies at sample `aligned` (B,) of its
        response."""
        channels = harmonic_count(order)
        noises, steps = _noises(self._codec, channels)
        responses = np.empty((len(aligned), channels, self._ir_samples), np.float32)
        for row, (response, start) in enumerate(zip(responses, aligned.tolist(), strict=True)):
            log_magnitude, directions = arrivals.log_magnitude[row], arrivals.directions[row]
            mixing = _mixing(directions, channels)
            places = self._places + start
            begin = int(np.floor(places[0])) - self._codec.hop
            mix_bands(log_magnitude, mixing, self._codec.log_floor, places, noises, steps, begin, response)
            if self._end is not None:
                self._cut(response, int(self._end + start))
        return responses

    def _cut(self, response: Float32, end: int) -> None:
        """Fade a response out before a sample, as the windows of its last frames do."""
        length = self._codec.n_fft - self._codec.hop
        left = (end - np.arange(response.shape[1])) / length
        response *= (np.sin(np.pi / 2 * np.clip(left, 0, 1)) ** 2).astype(np.float32)


def _mixing(directions: Float32, channels: int) -> Float32:
    """(k, noise, band, column) by which noises become channels, relative to the first."""
    bands, columns = directions.shape[1:]
    mixing = np.zeros((channels, channels, bands, columns), np.float32)
    if channels == 1:
        mixing[:] = 1
    elif channels == harmonic_count(1):
        find_first_order(directions, zeros_on_lines(9, -(-columns // LANES) * LANES), mixing)
    else:
        mixing[:] = np.moveaxis(_roots(np.moveaxis(directions, 0, -1), channels), (-2, -1), (0, 1))
    return mixing


def _roots(directions: npt.NDArray[np.floating], channels: int) -> Floats:
    """(..., k, noise) roots of the covariance of the channels: the first has a noise alone, which the others share, and
    the rest is symmetric."""
    moments = np.concatenate([np.ones((*directions.shape[:-1], 1)), directions], axis=-1)
    harmonics = real_harmonics(virtual_directions(), round(channels**0.5) - 1)
    powers = powers_by_direction(moments)
    shared = powers @ harmonics[:, 1:]
    away = harmonics[:, 1:] - shared[..., None, :]  # of each direction
    values, vectors = np.linalg.eigh(np.swapaxes(away, -1, -2) @ (powers[..., None] * away))
    # guard: rounding leaves no negative power
    sizes = np.sqrt(np.maximum(values, 0))
    roots = np.zeros((*directions.shape[:-1], channels, channels))
    roots[..., 0, 0] = 1
    roots[..., 1:, 0] = shared
    roots[..., 1:, 1:] = (vectors * sizes[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return roots


@lru_cache(maxsize=8)
def _noises(codec: Codec, channels: int) -> tuple[npt.NDArray[np.int16], Float32]:
    """(noise, band, sample) noises of unit power density in octave bands, the same in every process, and their units
    (noise, band). Amplitudes of the bands add up to one, so that equal gains give back a noise whose spectrogram is
    level."""
    bands = band_weights(np.fft.rfftfreq(codec.samples, 1 / codec.sample_rate))
    noises = np.empty((channels, len(OCTAVE_BANDS_HZ), codec.samples), np.int16)
    steps = np.empty(noises.shape[:2], np.float32)
    whole = even_noises(codec.sample_rate, codec.samples, channels) / np.sqrt(codec.window_energy)
    for white, noise, step in zip(whole, noises, steps, strict=True):
        filtered = np.fft.irfft(bands * np.fft.rfft(white), codec.samples)
        step[:] = np.maximum(np.abs(filtered).max(axis=-1) / np.iinfo(np.int16).max, 1e-12)
        noise[:] = np.round(filtered / step[:, None])
    return noises, steps
