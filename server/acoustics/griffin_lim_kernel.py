"""The iterations of Griffin and Lim, compiled. They start from the targets that `server.acoustics.decoding_kernel`
leaves in its workspace, and give responses."""

import numpy as np
import numpy.typing as npt

from server.acoustics.decoding_kernel import Shape, Workspace, delay_of, silence
from server.acoustics.stft_kernel import Windows, analyse, impose_magnitudes, place_bin, synthesise
from server.kernels.compiled import compiled
from server.kernels.simd import LANES, broadcast, load, multiply

Float32 = npt.NDArray[np.float32]


@compiled
def iterate(
    iterations: int,
    from_zero_phase: bool,
    aligned: float,
    shape: Shape,
    windows: Windows,
    work: Workspace,
    response: Float32,
) -> None:
    """Do the iterations of `server.acoustics.phase.griffin_lim` in place. Each takes the phases of the response's
    transform (the first may start from zero phase), combines them with the target magnitudes in `work`, and transforms
    back to a response."""
    _, _, first, stop = delay_of(aligned, shape, windows.n_fft // 4)
    if from_zero_phase:
        _synthesise_targets(first, stop, windows, work)
        _take(work.total, shape, response)
    _griffin_lim(iterations, first, stop, shape, windows, work, response)


@compiled
def _synthesise_targets(first, stop, windows, work) -> None:
    """Synthesise the targets with zero phase into the total."""
    silence(work.total, 0, work.total.shape[1])
    zero = broadcast(np.float32(0.0))
    width = work.targets.shape[2]
    at = work.frames.ctypes.data
    for t in range(first, stop, LANES):
        for bin_ in range(work.targets.shape[0]):
            targets = work.targets[bin_].ctypes.data
            sign = broadcast(np.float32(1 - 2 * (bin_ % 2)))
            left, right = multiply(load(targets, t), sign), multiply(load(targets, width + t), sign)
            place_bin(at, windows.n_fft, bin_, left, zero, right, zero)
        synthesise(at, windows, work.total, t)


@compiled
def _griffin_lim(iterations, first, stop, shape, windows, work, response) -> None:
    lead, end, length = shape.frame_lead, shape.frame_lead + shape.samples, work.total.shape[1]
    count = min(shape.samples, response.shape[1])
    analysed, placed = work.frames.ctypes.data, work.more_frames.ctypes.data
    total, other = work.total, work.other_total
    silence(total, 0, length)
    for ear in range(2):
        for n in range(count):
            total[ear, lead + n] = response[ear, n]
    for _ in range(iterations):
        silence(other, 0, length)
        for t in range(first, stop, LANES):
            analyse(analysed, windows, total, t)
            impose_magnitudes(analysed, placed, windows, work.targets, t)
            synthesise(placed, windows, other, t)
        silence(other, 0, lead)
        silence(other, end, length)
        total, other = other, total
    _take(total, shape, response)


@compiled
def _take(total, shape, response) -> None:
    count = min(shape.samples, response.shape[1])
    for ear in range(2):
        for n in range(count):
            response[ear, n] = total[ear, shape.frame_lead + n]
    silence(response, count, response.shape[1])
