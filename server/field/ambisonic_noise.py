"""The frozen noises behind ambisonic channels: white, of level spectrogram, and hardly alike.

The power of plain white noise within an octave and a few tens of milliseconds is uncertain by decibels, and so is the
covariance of two such noises. All responses would have these errors. So the noises are sums of wave packets that are
orthogonal, cover time and frequency evenly, and have equal energy: local cosines over frequency (Coifman and Meyer, C.
R. Acad. Sci. Paris 312, 259, 1991), in subbands of 44 Hz at low frequencies to 175 Hz at high ones. Their signs are
drawn at random, and are the same for all noises up to a row of a Walsh-Hadamard matrix: so the noises are orthogonal in
blocks of neighbouring packets, the first four in blocks of four.

At low frequencies too few packets fall into an octave and a few tens of milliseconds for that to be enough. There the
first second's amplitudes are optimised (`training.models.ambisonic_noise`) and come from a file.

A packet lies at the same time whatever the length and the sample rate. So a longer response begins as a shorter one
does, and low frequencies are the same at all rates.
"""

import math
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

from server.acoustics.spherical_harmonics import HIGHEST_ORDER, harmonic_count

Floats = npt.NDArray[np.float64]

NOISES = harmonic_count(HIGHEST_ORDER)
LOW_HZ = tuple(np.repeat([43.75, 87.5, 175.0], [8, 4, 4]).cumsum().tolist())
"""Upper edges of the subbands whose amplitudes are optimised."""
UNIT_S = 0.08
"""In so many seconds there is a whole number of packets in each of these subbands."""
AMPLITUDES_FILE = Path(__file__).parent / "noise_data" / "amplitudes.npy"
"""(unit of time, noise, packet) optimised amplitudes as 8-bit integers, subband after subband."""
AMPLITUDE_STEP = 1 / 32
_WIDTH_HZ = 175.0
"""Of all higher subbands. Their packets are 2.9 ms apart."""
_SEED = 24_05_2011
_BITS = 64


def even_noises(sample_rate: int, samples: int, count: int) -> Floats:
    """(noise, sample) the first `count` noises, at most NOISES, of unit variance."""
    size = whole_units(sample_rate, samples)
    edges = subband_edges(sample_rate, size)
    amplitudes = signs(edges, count)
    for drawn, optimised in zip(amplitudes, _optimised(), strict=False):
        used = min(drawn.shape[1], optimised.shape[1])
        drawn[:, :used] = optimised[:count, :used]
    return sum_of_packets(amplitudes, edges)[:, :samples]


def whole_units(sample_rate: int, samples: int) -> int:
    """The length of the shortest signal that has so many samples and lasts a multiple of UNIT_S."""
    unit = UNIT_S * sample_rate
    return round(math.ceil(samples / unit) * unit)


def subband_edges(sample_rate: int, size: int) -> list[int]:
    """Edges of the subbands, as indices of the DCT of a signal of `size` samples. The last subband ends with the
    spectrum and is the widest."""
    highest_hz = sample_rate / 2
    wide = np.arange(LOW_HZ[-1] + _WIDTH_HZ, highest_hz - _WIDTH_HZ + 1e-6, _WIDTH_HZ)
    return [*np.round(np.array([0, *LOW_HZ, *wide]) / highest_hz * size).astype(int).tolist(), size]


def signs(edges: list[int], count: int) -> list[Floats]:
    """(noise, packet) the signs of each subband: random ones, times rows of a Walsh-Hadamard matrix."""
    row = np.arange(count, dtype=np.int64)[:, None]
    found = []
    for subband, (start, end) in enumerate(pairwise(edges)):
        packet = np.arange(end - start)
        # Raw bits, since these are the same in every version of NumPy.
        raw = np.random.PCG64([_SEED, subband]).random_raw(-(-len(packet) // _BITS))
        random = np.unpackbits(raw.astype("<u8").view(np.uint8), bitorder="little")[: len(packet)]
        # Blocks are of two packets by two subbands and, for more than four noises, of four by four.
        column = packet % 2 + 2 * (subband % 2) + 4 * (packet // 2 % 2) + 8 * (subband // 2 % 2)
        found.append(1.0 - 2.0 * ((random + np.bitwise_count(row & column)) % 2))
    return found


def sum_of_packets(amplitudes: list[Floats], edges: list[int]) -> Floats:
    """(noise, sample) signals of wave packets with these amplitudes (noise, packet) in each subband."""
    spectrum = np.zeros((len(amplitudes[0]), edges[-1]))
    widths = np.diff(edges)
    overlaps = [0, *(np.minimum(widths[:-1], widths[1:]) // 2).tolist(), 0]
    for of_subband, (start, end), below, above in zip(
        amplitudes, pairwise(edges), overlaps[:-1], overlaps[1:], strict=True
    ):
        # Beyond its ends a cosine transform of the fourth kind goes on as its mirror image, at the upper end negative.
        inside = _cosine_transform(of_subband)
        lower, upper = inside[:, :below][:, ::-1], -inside[:, len(inside[0]) - above :][:, ::-1]
        packets = np.concatenate([lower, inside, upper], axis=1)
        packets[:, : 2 * below] *= _rise(below)
        packets[:, packets.shape[1] - 2 * above :] *= _rise(above)[::-1]
        spectrum[:, start - below : end + above] += packets
    return _cosine_transform(spectrum)


def _rise(half: int) -> Floats:
    """The slope of Meyer's windows over twice so many coefficients: with its mirror image, squares add up to one."""
    position = (np.arange(2 * half) + 0.5) / max(1, 2 * half)
    return np.asarray(np.sin(np.pi / 2 * np.sin(np.pi / 2 * position) ** 2))


def _cosine_transform(values: Floats) -> Floats:
    """The orthonormal discrete cosine transform of the fourth kind, along the last axis. It is its own inverse."""
    size = values.shape[-1]
    turn = np.exp(-0.5j * np.pi / size * np.arange(size))
    spectra = np.fft.fft(values * turn, 2 * size)[..., :size]
    return np.asarray(np.sqrt(2 / size) * (spectra * turn * np.exp(-0.25j * np.pi / size)).real)


@cache
def _optimised() -> list[Floats]:
    """(noise, packet) optimised amplitudes of each of the lowest subbands."""
    stored = np.load(AMPLITUDES_FILE) * AMPLITUDE_STEP
    per_unit = np.round(2 * np.diff(LOW_HZ, prepend=0) * UNIT_S).astype(int)
    parts = np.split(stored, np.cumsum(per_unit)[:-1], axis=-1)
    return [np.swapaxes(part, 0, 1).reshape(NOISES, -1) for part in parts]
