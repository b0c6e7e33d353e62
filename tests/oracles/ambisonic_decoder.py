"""Ambisonic channels of virtual directions, by an inverse transform of spectrograms: the oracle of
`server.field.ambisonic_decoder`.

Each of 24 directions plays a frozen noise of its own as a plane wave. Axes: B poses; k channels; d directions; bands;
columns of frames; responses (B, k, sample).
"""

from functools import lru_cache

import numpy as np

from server.acoustics.phase import delayed
from server.acoustics.spherical_harmonics import harmonic_count, real_harmonics
from server.field.ambisonic_decoder import powers_by_direction, virtual_directions
from server.field.any_size_decoder import resized

_SEED = 24_05_2011


class SlowAmbisonicDecoder:
    """Decodes a field's arrivals to responses (B, k, `ir_samples`); only the first `frames` frames are used (default:
    all). Thread-safe."""

    def __init__(self, parameters, *, ir_samples, frames=None):
        codec = parameters.codec
        self._codec = codec
        self._axis = parameters.frame_axis
        self._ir_samples = ir_samples
        self._used = codec.frames if frames is None else min(frames, codec.frames)

    def decode(self, arrivals, between_bands, aligned, order):
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

    def _frames_of(self, log_magnitude, directions, between_bands, delay):
        """The omnidirectional magnitude (bin, frame), and the powers (d, bin, frame) relative to it, delayed by so many
        frames."""
        codec = self._codec
        power = np.square(codec.magnitude(log_magnitude.astype(np.float64)))
        moments = np.concatenate([np.ones_like(log_magnitude)[None], directions])
        shared = np.moveaxis(powers_by_direction(np.moveaxis(moments, 0, -1)), -1, 0)
        band, share = between_bands
        upper = share[:, None].astype(np.float64)

        def at_bins(by_band):
            return (1 - upper) * by_band[..., band, :] + upper * by_band[..., band + 1, :]

        whole = at_bins(power)
        parts = at_bins(shared * power)
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
def _noises(codec):
    """(d, frequency, frame) independent noises of unit expected power, the same in every process."""
    white = np.random.default_rng(_SEED).standard_normal((len(virtual_directions()), codec.samples))
    return np.asarray(codec.transform(white) / np.sqrt(codec.window_energy), dtype=np.complex64)
