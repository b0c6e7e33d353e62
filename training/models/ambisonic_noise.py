"""Optimises the low frequencies of the noises behind ambisonic channels (`server.field.ambisonic_noise`):
`python -m training.models.ambisonic_noise`.

What is asked of the noises: in each octave band, whenever a sound begins and however fast it decays, equal power of
all noises and no correlation between them, nor between one and the Hilbert transform of another, since ears hear
channels with phases of all kinds. These powers and correlations, weighted by a decay from some sample on, are quadratic
in the packets' amplitudes. The squares of their errors are made small by the L-BFGS method, from random signs on. The
first four noises, of which ambisonics of the first order is made, weigh more, and the first of all weighs most. So does
power: all correlations would be smaller if there were less of it.

The signals have a low sample rate, since only low frequencies are optimised, and a tail beyond what is kept.
"""

import logging
from pathlib import Path
from typing import Annotated

import numpy as np
import numpy.typing as npt
import torch
import typer
from scipy.signal import butter, sosfreqz

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.field.ambisonic_noise import (
    AMPLITUDE_STEP,
    AMPLITUDES_FILE,
    LOW_HZ,
    NOISES,
    UNIT_S,
    signs,
    subband_edges,
    sum_of_packets,
    whole_units,
)

_logger = logging.getLogger(__name__)

_RATE_HZ = 4000
_KEPT_UNITS, _UNITS = 16, 20
_STEPS = (8, 4, 2, 1)
"""By which the analytic signals of the lowest octave bands are decimated."""
_FILTER_ORDER, _FILTERED_AT_HZ = 2, 48_000
_DECAYS_S = (0.2, 0.4, 0.8)
"""Times of a decay by 60 dB."""
_APART_S = 0.010
_LAST_START_S = 0.12
"""Before the signals end."""
_PAIR_WEIGHTS = ((4, 1.0), (9, 0.5), (NOISES, 0.25))
_POWER_WEIGHT = 10.0
_FIRST_WEIGHT = 3.0
_LARGEST = 3.5
_RESTRAINT = 0.02
"""Weight of amplitudes beyond _LARGEST, which would not fit into the file."""


def optimise(*, iterations: int) -> npt.NDArray[np.int8]:
    """(unit of time, noise, packet) amplitudes in steps of AMPLITUDE_STEP."""
    size = whole_units(_RATE_HZ, round(_UNITS * UNIT_S * _RATE_HZ))
    edges = subband_edges(_RATE_HZ, size)
    drawn = signs(edges, NOISES)
    subbands = len(LOW_HZ)
    filtered, fixed = _filtered_packets(drawn, edges, subbands)
    decays = [_decays(size, step) for step in _STEPS]
    one, other = np.triu_indices(NOISES)
    weights = np.select([other < most for most, _ in _PAIR_WEIGHTS], [weight for _, weight in _PAIR_WEIGHTS])
    weights[one == other] *= _POWER_WEIGHT
    weights[0] *= _FIRST_WEIGHT
    of_pairs = torch.tensor(weights, dtype=torch.float32)[:, None]
    expected = torch.tensor(one == other, dtype=torch.float32)[:, None]
    start = np.ascontiguousarray(np.concatenate(drawn[:subbands], axis=1), np.float32)
    amplitudes = torch.tensor(start, requires_grad=True)
    optimiser = torch.optim.LBFGS([amplitudes], max_iter=iterations, history_size=20, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        optimiser.zero_grad()
        total = _RESTRAINT * torch.relu(amplitudes.abs() - _LARGEST).square().sum()
        for packets, rest, windows in zip(filtered, fixed, decays, strict=True):
            heard = amplitudes @ packets + rest
            real, imaginary = heard.chunk(2, dim=1)
            in_phase = real[one] * real[other] + imaginary[one] * imaginary[other]
            across = imaginary[one] * real[other] - real[one] * imaginary[other]
            errors = (in_phase @ windows - expected).square() + (across @ windows).square()
            total = total + (of_pairs * errors).mean()
        total.backward()
        _logger.info("%g", float(total.detach()))
        return total

    optimiser.step(loss)
    return _stored(amplitudes.detach().numpy(), [len(part[0]) for part in drawn[:subbands]])


def _filtered_packets(
    drawn: list[npt.NDArray[np.float64]], edges: list[int], subbands: int
) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """For each octave band, (packet, sample) the filtered packets of the first subbands, and (noise, sample) what the
    other subbands give. They are the real and then the imaginary parts of analytic signals, of unit power for white
    noise, and only every so many samples."""
    counts = [part.shape[1] for part in drawn]
    low = sum(counts[:subbands])
    rows = np.eye(low)
    alone = [rows[:, sum(counts[:number]) :][:, :count] for number, count in enumerate(counts[:subbands])]
    packets = sum_of_packets([*alone, *(np.zeros((low, count)) for count in counts[subbands:])], edges)
    others = [np.zeros_like(part) for part in drawn[:subbands]] + drawn[subbands:]
    rest = sum_of_packets(others, edges)
    size = edges[-1]
    frequencies_hz = np.fft.rfftfreq(2 * size, 1 / _RATE_HZ)
    filtered: list[torch.Tensor] = []
    fixed: list[torch.Tensor] = []
    for centre_hz, step in zip(OCTAVE_BANDS_HZ, _STEPS, strict=False):
        octave = butter(_FILTER_ORDER, centre_hz * np.sqrt([0.5, 2.0]), "bandpass", fs=_FILTERED_AT_HZ, output="sos")
        gains = np.abs(sosfreqz(octave, frequencies_hz, fs=_FILTERED_AT_HZ)[1]) ** 2  # there and back
        gains /= np.sqrt(np.mean(gains**2))
        for signals, found in ((packets, filtered), (rest, fixed)):
            heard = np.fft.ifft(np.fft.rfft(signals, 2 * size) * gains, 2 * size)[:, :size:step] * np.sqrt(2)
            found.append(torch.tensor(np.concatenate([heard.real, heard.imag], axis=1).astype(np.float32)))
    return filtered, fixed


def _decays(size: int, step: int) -> torch.Tensor:
    """(sample, decay) decays of power from many samples on, each with the sum one; only every so many samples."""
    time_s = np.arange(0, size, step) / _RATE_HZ
    starts_s = np.arange(0, time_s[-1] - _LAST_START_S, _APART_S)
    after_s = time_s[:, None] - starts_s
    decays = [np.where(after_s >= 0, 10 ** (-6 * np.maximum(after_s, 0) / decay_s), 0) for decay_s in _DECAYS_S]
    found = np.concatenate(decays, axis=1)
    return torch.tensor((found / found.sum(axis=0)).astype(np.float32))


def _stored(amplitudes: npt.NDArray[np.float32], counts: list[int]) -> npt.NDArray[np.int8]:
    parts = np.split(amplitudes, np.cumsum(counts)[:-1], axis=1)
    by_unit = [np.swapaxes(part.reshape(NOISES, _UNITS, -1), 0, 1)[:_KEPT_UNITS] for part in parts]
    steps = np.round(np.concatenate(by_unit, axis=-1) / AMPLITUDE_STEP)
    return np.clip(steps, -127, 127).astype(np.int8)


def main(
    out: Annotated[Path, typer.Option(help="The file to write.", dir_okay=False)] = AMPLITUDES_FILE,
    iterations: Annotated[int, typer.Option(min=1)] = 300,
) -> None:
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    out.parent.mkdir(parents=True, exist_ok=True)
    np.save(out, optimise(iterations=iterations))


if __name__ == "__main__":
    typer.run(main)
