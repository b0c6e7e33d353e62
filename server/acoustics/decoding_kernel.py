"""Predicted spectrograms to responses in one go: the compiled counterpart of `server.acoustics.decoding`'s NumPy path.

Bins are worked on one after the other and frames eight at a time. Of each bin, magnitudes and coherence become rows
that are read shifted by the delay, so that frozen noise meets them at its own time; what has been composed for eight
frames is transformed while it is at hand. Letters: t frames from emission on, j frames of the aligned prediction.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from server.acoustics.phase import MOST_COHERENT, UNDECIDED
from server.acoustics.simd import (
    LANES,
    at_least,
    broadcast,
    cosine_sine,
    divide,
    exponential,
    load,
    multiply,
    multiply_add,
    multiply_subtract,
    square_root,
    store,
    subtract,
)
from server.acoustics.stft_kernel import Windows, analyse, impose_magnitudes, place_bin, synthesise
from server.compiled import compiled

Float32 = npt.NDArray[np.float32]

WHOLE, START, TARGETS = 0, 1, 2
"""What `decode` is for: a response; what iterations can start from, and their targets; targets alone."""
_PADDING = 2 * LANES
"""Zeros before a row and after it: what a delayed vector may reach."""


class Shape(NamedTuple):
    """Of a prediction of `frames` the first `used` count, and of `known` of these the phase is known."""

    bins: int
    frames: int
    used: int
    known: int
    samples: int
    frame_lead: int
    log_floor: float
    all_is_certain: bool


class Workspace(NamedTuple):
    """`rows` magnitudes left and right, coherence real and imaginary, targets left and right, with zeros around them;
    `known_rows` phases and certainties of both ears. Spectra are (bin, left and right real and imaginary, frame)."""

    rows: Float32
    known_rows: Float32
    spectra: Float32
    known_spectra: Float32
    targets: Float32
    frames: Float32
    more_frames: Float32
    total: Float32
    other_total: Float32
    known_total: Float32

    @classmethod
    def of(cls, shape: Shape, n_fft: int, *, iterates: bool) -> "Workspace":
        hop, width, known_width = n_fft // 4, _whole_vectors(shape.frames), _whole_vectors(shape.known)
        length = (width + 3) * hop

        def zeros(*lengths: int) -> Float32:
            return np.zeros(lengths, dtype=np.float32)

        return cls(
            rows=zeros(6, _PADDING + width + _PADDING),
            known_rows=zeros(4, width),
            spectra=zeros(shape.bins, 4, width),
            known_spectra=zeros(shape.bins, 4, known_width),
            targets=zeros(shape.bins, 2, width if iterates else 0),
            frames=zeros(2 * n_fft * LANES),
            more_frames=zeros(2 * n_fft * LANES if iterates else 0),
            total=zeros(2, length),
            other_total=zeros(2, length if iterates else 0),
            known_total=zeros(2, (known_width + 3) * hop),
        )


@compiled
def _whole_vectors(frames: int) -> int:
    return (frames + LANES - 1) // LANES * LANES


@compiled
def decode(
    log_magnitude: Float32,
    frequency: Float32,
    certainty: Float32,
    interaural: Float32,
    aligned: npt.NDArray[np.float64],
    shape: Shape,
    windows: Windows,
    noise: Float32,
    gate: Float32,
    purpose: int,
    work: Workspace,
    output: Float32,
) -> None:
    """Predictions as of `server.field.graph.Spectrograms`, `aligned` (B,) the sample, not necessarily whole, at which
    each of them starts; to `output` (B, 2, sample). Targets are left in `work`, those of the last row."""
    for row in range(output.shape[0]):
        whole, share, first, stop = _delay(aligned[row], shape, windows.n_fft // 4)
        start = math.floor(aligned[row])
        for bin_ in range(shape.bins):
            _read_known(frequency[row], certainty[row], bin_, shape, work)
            _separate(log_magnitude[row], interaural[row], bin_, aligned[row] - start, shape, windows.n_fft, work)
            if purpose != WHOLE:
                _delay_targets(bin_, whole, share, first, stop, shape, work)
            if purpose != TARGETS:
                _compose(bin_, whole, share, first, stop, noise, work)
        if purpose == TARGETS:
            continue
        response = output[row]
        _synthesise_all(work.spectra, first, stop, windows, work.frames, work.total)
        _take(work.total, shape, response)
        if shape.known > 0:
            _synthesise_all(work.known_spectra, 0, shape.known, windows, work.frames, work.known_total)
            _add(work.known_total, start, shape, response)
        if purpose == WHOLE:
            _open(gate, start, response)


@compiled
def iterate(
    iterations: int,
    from_zero_phase: bool,
    aligned: float,
    shape: Shape,
    windows: Windows,
    gate: Float32,
    work: Workspace,
    response: Float32,
) -> None:
    """As `server.acoustics.phase.griffin_lim`, in place: the phases of the response's transform, or none, the
    magnitudes of the targets in `work`, and a response again."""
    _, _, first, stop = _delay(aligned, shape, windows.n_fft // 4)
    if from_zero_phase:
        _synthesise_targets(first, stop, windows, work)
        _take(work.total, shape, response)
    _griffin_lim(iterations, first, stop, shape, windows, work, response)
    _open(gate, math.floor(aligned), response)


@compiled
def _delay(aligned, shape, hop):
    """Whole frames and a share of one; the first frame that can sound, in whole vectors, and the one after the last."""
    limit = float((shape.frames + 1) * hop)
    delay = min(limit, max(-limit, aligned)) / hop
    whole = math.floor(delay)
    first = max(0, whole) // LANES * LANES
    return whole, np.float32(delay - whole), first, min(shape.frames, shape.used + whole + 1)


@compiled
def _read_known(frequency, certainty, bin_, shape, work) -> None:
    """Phases, summed up from their advances, and certainties of one bin."""
    for ear in range(2):
        phase = 0.0
        for j in range(shape.known):
            phase += frequency[ear, bin_, j]
            phase -= 2 * math.pi * math.floor(phase / (2 * math.pi) + 0.5)
            # Four hops are one window: a bin's centre advances by whole quarters of a turn.
            work.known_rows[ear, j] = phase + 0.5 * math.pi * (bin_ * j % 4)
            work.known_rows[2 + ear, j] = 1.0 if shape.all_is_certain else certainty[ear, bin_, j]


@compiled
def _separate(log_magnitude, interaural, bin_, fraction, shape, n_fft, work) -> None:
    """As `server.acoustics.phase.separate`: the noise's part to rows, the known part, later by `fraction` of a sample,
    to its spectra."""
    zero, one = broadcast(np.float32(0.0)), broadcast(np.float32(1.0))
    undecided, most = broadcast(np.float32(UNDECIDED)), broadcast(np.float32(MOST_COHERENT))
    floor = broadcast(np.float32(shape.log_floor))
    turn = -2.0 * math.pi * bin_ / n_fft * fraction
    cos, sin = broadcast(np.float32(math.cos(turn))), broadcast(np.float32(math.sin(turn)))
    left, right = log_magnitude[0, bin_].ctypes.data, log_magnitude[1, bin_].ctypes.data
    real, imaginary = interaural[0, bin_].ctypes.data, interaural[1, bin_].ctypes.data
    rows, row = work.rows.ctypes.data, work.rows.shape[1]
    known_rows, known_row = work.known_rows.ctypes.data, work.known_rows.shape[1]
    known = work.known_spectra[bin_].ctypes.data
    known_width = work.known_spectra.shape[2]
    for vector in range(0, shape.used, LANES):
        j = min(vector, shape.frames - LANES)
        ml = at_least(subtract(exponential(load(left, j)), floor), zero)
        mr = at_least(subtract(exponential(load(right, j)), floor), zero)
        cr, ci = load(real, j), load(imaginary, j)
        at = _PADDING + j
        store(rows, 4 * row + at, ml)
        store(rows, 5 * row + at, mr)
        if vector < shape.known:
            cl, cr_ = load(known_rows, 2 * known_row + j), load(known_rows, 3 * known_row + j)
            cos_l, sin_l = cosine_sine(load(known_rows, j))
            cos_r, sin_r = cosine_sine(load(known_rows, known_row + j))
            al, bl = multiply(cos_l, cl), multiply(sin_l, cl)
            ar, br = multiply(cos_r, cr_), multiply(sin_r, cr_)
            store(known, j, multiply(ml, multiply_subtract(bl, sin, multiply(al, cos))))
            store(known, known_width + j, multiply(ml, multiply_add(bl, cos, multiply(al, sin))))
            store(known, 2 * known_width + j, multiply(mr, multiply_subtract(br, sin, multiply(ar, cos))))
            store(known, 3 * known_width + j, multiply(mr, multiply_add(br, cos, multiply(ar, sin))))
            ul = square_root(at_least(multiply_subtract(cl, cl, one), zero))
            ur = square_root(at_least(multiply_subtract(cr_, cr_, one), zero))
            share = at_least(multiply(ul, ur), undecided)
            cr = divide(multiply_subtract(bl, br, multiply_subtract(al, ar, cr)), share)
            ci = divide(multiply_add(al, br, multiply_subtract(bl, ar, ci)), share)
            ml, mr = multiply(ml, ul), multiply(mr, ur)
        scale = divide(most, square_root(at_least(multiply_add(cr, cr, multiply(ci, ci)), one)))
        store(rows, at, ml)
        store(rows, row + at, mr)
        store(rows, 2 * row + at, multiply(cr, scale))
        store(rows, 3 * row + at, multiply(ci, scale))
    for at in range(_PADDING + shape.used, _PADDING + _whole_vectors(shape.used)):
        for number in range(6):
            work.rows[number, at] = 0


@compiled
def _delayed(rows, at, share):
    """Between a row's values from `at` on and those one frame before."""
    now, before = load(rows, at), load(rows, at - 1)
    return multiply_add(subtract(before, now), share, now)


@compiled
def _compose(bin_, whole, share, first, stop, noise, work) -> None:
    """Frozen noise of the rows' magnitudes and coherence, delayed by `whole` frames and a share of one, to spectra."""
    zero, one = broadcast(np.float32(0.0)), broadcast(np.float32(1.0))
    rows, row, width = work.rows.ctypes.data, work.rows.shape[1], work.spectra.shape[2]
    spectra, white = work.spectra[bin_].ctypes.data, noise[bin_].ctypes.data
    later = broadcast(share)
    for t in range(first, stop, LANES):
        at = _PADDING + t - whole
        ml, mr = _delayed(rows, at, later), _delayed(rows, row + at, later)
        cr, ci = _delayed(rows, 2 * row + at, later), _delayed(rows, 3 * row + at, later)
        own = square_root(at_least(subtract(one, multiply_add(cr, cr, multiply(ci, ci))), zero))
        lr, li = load(white, t), load(white, width + t)
        rr = multiply_add(cr, lr, multiply_add(ci, li, multiply(own, load(white, 2 * width + t))))
        ri = multiply_subtract(ci, lr, multiply_add(cr, li, multiply(own, load(white, 3 * width + t))))
        store(spectra, t, multiply(ml, lr))
        store(spectra, width + t, multiply(ml, li))
        store(spectra, 2 * width + t, multiply(mr, rr))
        store(spectra, 3 * width + t, multiply(mr, ri))


@compiled
def _delay_targets(bin_, whole, share, first, stop, shape, work) -> None:
    """Whole magnitudes, delayed as the noise's are; none after the last frame."""
    rows, row, width = work.rows.ctypes.data, work.rows.shape[1], work.targets.shape[2]
    targets = work.targets[bin_].ctypes.data
    later = broadcast(share)
    for t in range(first, stop, LANES):
        at = _PADDING + t - whole
        store(targets, t, _delayed(rows, 4 * row + at, later))
        store(targets, width + t, _delayed(rows, 5 * row + at, later))
    for ear in range(2):
        for t in range(shape.frames, width):
            work.targets[bin_, ear, t] = 0


@compiled
def _silence(signals, begin, end) -> None:
    # A slice set to zero would do the same, and take seconds to compile.
    for ear in range(2):
        for n in range(begin, end):
            signals[ear, n] = 0


@compiled
def _synthesise_all(spectra, first, stop, windows, frames, total) -> None:
    _silence(total, 0, total.shape[1])
    width = spectra.shape[2]
    at = frames.ctypes.data
    for t in range(first, stop, LANES):
        for bin_ in range(spectra.shape[0]):
            parts = spectra[bin_].ctypes.data
            place_bin(
                at,
                windows.n_fft,
                bin_,
                load(parts, t),
                load(parts, width + t),
                load(parts, 2 * width + t),
                load(parts, 3 * width + t),
            )
        synthesise(at, windows, total, t)


@compiled
def _synthesise_targets(first, stop, windows, work) -> None:
    """With zero phase."""
    _silence(work.total, 0, work.total.shape[1])
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
    _silence(total, 0, length)
    for ear in range(2):
        for n in range(count):
            total[ear, lead + n] = response[ear, n]
    for _ in range(iterations):
        _silence(other, 0, length)
        for t in range(first, stop, LANES):
            analyse(analysed, windows, total, t)
            impose_magnitudes(analysed, placed, windows, work.targets, t)
            synthesise(placed, windows, other, t)
        _silence(other, 0, lead)
        _silence(other, end, length)
        total, other = other, total
    _take(total, shape, response)


@compiled
def _take(total, shape, response) -> None:
    count = min(shape.samples, response.shape[1])
    for ear in range(2):
        for n in range(count):
            response[ear, n] = total[ear, shape.frame_lead + n]
    _silence(response, count, response.shape[1])


@compiled
def _add(known_total, start, shape, response) -> None:
    """The known part from sample `start` of the response on, as far as both reach."""
    lead = shape.frame_lead
    begin = max(0, start)
    end = min(response.shape[1], start + min(shape.samples, known_total.shape[1] - lead))
    for ear in range(2):
        for n in range(begin, end):
            response[ear, n] += known_total[ear, lead + n - start]


@compiled
def _open(gate, start, response) -> None:
    """Silence before sample `start`, and the gate's rise from there on."""
    _silence(response, 0, min(max(0, start), response.shape[1]))
    for ear in range(2):
        for n in range(max(0, start), min(response.shape[1], start + gate.size)):
            response[ear, n] *= gate[n - start]
