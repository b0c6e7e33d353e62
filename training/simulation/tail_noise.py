"""The noise of a shared tail. It is drawn once, for all receivers of all emitters."""

import numpy as np
import numpy.typing as npt

from training.data.scene_file import HISTOGRAM_BIN_S
from training.data.shared_tail import BAND_GROUP, SharedTail, shared_power
from training.simulation.synthesis import BinauralSynthesis, power_at

_NOISE_S = 2.0
# Quantisation steps of the noise in the root mean square of a band's loudest channel. Sixteen bits halve the memory
# traffic, which limits the speed, and are finer than the half precision of stored responses.
_STEPS = 4096


def draw_tail(
    synthesis: BinauralSynthesis, energies: npt.NDArray[np.float64], *, start_s: float, rng: np.random.Generator
) -> SharedTail:
    """Draw the shared tail for `energies` (take, direction, band, bin), of which the part before `start_s` is not used.
    The noise is quantised band by band."""
    sample_rate = synthesis.head.sample_rate
    late = energies[..., int(start_s / HISTOGRAM_BIN_S) :].sum(axis=(0, -1))
    total = late.sum(axis=0)
    directional = np.divide(late, total, out=np.full_like(late, 1 / len(late)), where=total > 0)
    of_all = energies.sum(axis=1)
    first = round(start_s * sample_rate)
    times_s = np.arange(first, synthesis.samples) / sample_rate
    per_sample = power_at(times_s, of_all.astype(np.float32)) / np.float32(sample_rate)
    amplitudes = np.sqrt(per_sample * shared_power(times_s, start_s))
    noise = synthesis.diffuse_noise(directional, round(_NOISE_S * sample_rate), rng)
    noise = noise.reshape(len(noise), -1, noise.shape[-1])
    loudest = np.sqrt(np.einsum("bcs,bcs->bc", noise, noise).max(axis=-1) / noise.shape[-1])
    step = np.maximum(loudest, np.finfo(np.float32).tiny)[:, None] / _STEPS
    noise /= step[..., None]
    limits = np.iinfo(np.int16)
    np.clip(np.rint(noise, out=noise), limits.min, limits.max, out=noise)
    silent = -len(noise) % BAND_GROUP
    quantised = np.zeros((len(noise) + silent, *noise.shape[1:]), np.int16)
    quantised[: len(noise)] = noise
    return SharedTail(
        start_s=start_s,
        first=first,
        energies=(directional[..., None] * of_all[:, None]).astype(np.float32),
        noise=quantised,
        amplitudes=np.pad((amplitudes * step).astype(np.float32), ((0, 0), (0, silent), (0, 0))),
    )
