"""Decoding of what arrives at a point, by direction, to ambisonic channels.

The sound of each band and column of frames is spread over virtual directions, with powers that are never negative and
whose harmonics are those predicted, as nearly as such powers can have them. Each direction plays a frozen noise of its
own as a plane wave. So the covariance of the channels is that of the powers, and rotating the channels is the same as
turning the listener.

Channels are ACN and SN3D (`server.acoustics.spherical_harmonics`), in world axes. Axes: B poses; k channels; d
directions; bands; columns of frames; responses (B, k, sample).
"""

from functools import cache, lru_cache

import numpy as np
import numpy.typing as npt

from server.acoustics.codec import Codec
from server.acoustics.phase import delayed
from server.acoustics.spherical_harmonics import harmonic_count, mean_squares, real_harmonics
from server.field.any_size_decoder import resized
from server.field.directional_graph import Arrivals
from server.scene.manifest import CodecParameters

Float32 = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]

_SEED = 24_05_2011
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
        self._axis = parameters.frame_axis
        self._ir_samples = ir_samples
        self._used = codec.frames if frames is None else min(frames, codec.frames)

    def decode(
        self,
        arrivals: Arrivals,
        between_bands: tuple[npt.NDArray[np.int64], Float32],
        aligned: Floats,
        order: int,
    ) -> Float32:
        """Decode to channels of `order`. The first sample of each prediction lies at sample `aligned` (B,) of its
        response. `between_bands` says for each bin the band below it, and its share of the way to the next."""
        encode = real_harmonics(virtual_directions(), order).T.astype(np.float32)
        responses = np.empty((len(aligned), harmonic_count(order), self._ir_samples), np.float32)
        for row, response in enumerate(responses):
            magnitude, powers = self._frames_of(
                arrivals.log_magnitude[row], arrivals.directions[row], between_bands, aligned[row] / self._codec.hop
            )
            waves = np.sqrt(powers) * magnitude * _noises(self._codec)
            spectra = np.tensordot(encode, waves, axes=1)
            response[:] = resized(self._codec.synthesise(spectra), self._ir_samples)
        return responses

    def _frames_of(
        self,
        log_magnitude: Float32,
        directions: Float32,
        between_bands: tuple[npt.NDArray[np.int64], Float32],
        delay: float,
    ) -> tuple[Float32, Float32]:
        """The omnidirectional magnitude (bin, frame), and the powers (d, bin, frame) relative to it, delayed by so many
        frames."""
        codec = self._codec
        power = np.square(codec.magnitude(log_magnitude.astype(np.float64)))
        moments = np.concatenate([np.ones_like(log_magnitude)[None], directions])
        shared = np.moveaxis(powers_by_direction(np.moveaxis(moments, 0, -1)), -1, 0)
        band, share = between_bands
        upper = share[:, None].astype(np.float64)

        def at_bins(by_band: Floats) -> Floats:
            return (1 - upper) * by_band[..., band, :] + upper * by_band[..., band + 1, :]

        whole = at_bins(power)
        parts = at_bins(shared * power)
        # guard: where nothing arrives, nothing is divided
        shares = np.where(whole > 0, parts / np.where(whole > 0, whole, 1), 1 / len(parts))
        level = np.log(np.sqrt(whole) + codec.log_floor)
        if self._axis is not None:
            to_frames = self._axis.spread().astype(np.float64)
            level, shares = level @ to_frames, shares @ to_frames
        magnitude = codec.magnitude(level)
        magnitude[..., self._used :] = 0
        delay_of_one = np.array([delay])
        magnitude = delayed(magnitude[None].astype(np.float32), delay_of_one)[0]
        shares = delayed(shares[None].astype(np.float32), delay_of_one)[0]
        total = shares.sum(axis=0)
        shares /= np.where(total > 0, total, 1)
        return magnitude, shares


@lru_cache(maxsize=4)
def _noises(codec: Codec) -> npt.NDArray[np.complex64]:
    """(d, frequency, frame) independent noises of unit expected power, the same in every process."""
    white = np.random.default_rng(_SEED).standard_normal((len(virtual_directions()), codec.samples))
    return np.asarray(codec.transform(white) / np.sqrt(codec.window_energy), dtype=np.complex64)
