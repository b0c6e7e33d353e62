"""Decoding of predicted spectrograms to responses in one pass, in compiled code.

It works on eight frames at a time, from prediction to response, so that intermediate results stay in the nearest cache.
The frozen noise is not delayed; therefore predictions are read earlier by the delay. For the fractional part of the
delay, each bin keeps its values of the last eight frames. Letters: t frames counted from emission, j frames of the
aligned prediction.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from server.acoustics.columns_kernel import NOTHING, Columns, spread_columns
from server.acoustics.phase import MOST_COHERENT, UNDECIDED
from server.acoustics.stft_kernel import Windows, add_up, one_before, place_bin, synthesise_next
from server.kernels.cache_lines import zeros_on_lines
from server.kernels.compiled import compiled
from server.kernels.simd import (
    LANES,
    any_above,
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

Float32 = npt.NDArray[np.float32]

WHOLE, START, TARGETS = 0, 1, 2
"""The purposes of `decode`: a response; the start and the targets of an iteration; targets only."""
NO_MARGIN = -1


class Shape(NamedTuple):
    """The sizes of a prediction: only the first `used` of its `frames` are used, and for the first `known` of these the
    phase is known."""

    bins: int
    frames: int
    used: int
    known: int
    samples: int
    frame_lead: int
    log_floor: float
    all_is_certain: bool


class Workspace(NamedTuple):
    """Buffers of `decode`, reused between calls.

    `eight` (4, bin, 8) are frames at the beginning or end of a prediction, or made from cells: log magnitudes left and
    right, coherence real and imaginary. `magnitudes` are (bin, 2, 8). `last` (bin, 6, 8) are the last values that the
    next eight frames need: the noise's magnitudes left and right, its coherence real and imaginary, targets left and
    right. `known` (bin, 6, frame) are phasors left and right, real and imaginary, and certainties, with eight zeros
    before and after them; `known_row` holds the phases and certainties of both ears for one bin. `synthesise_next` uses
    `frames`, `carried` and `rows`; `sounded` (2, sample) is its output where only a part of it is needed. `targets` are
    (bin, ear, frame); `total` is (2, sample).
    """

    eight: Float32
    magnitudes: Float32
    last: Float32
    known_row: Float32
    known: Float32
    frames: Float32
    carried: Float32
    rows: Float32
    sounded: Float32
    targets: Float32
    more_frames: Float32
    total: Float32
    other_total: Float32

    @classmethod
    def of(cls, shape: Shape, n_fft: int, *, iterates: bool) -> "Workspace":
        hop, width, known_width = n_fft // 4, whole_vectors(shape.frames), whole_vectors(shape.known)
        length = (width + 3) * hop if iterates else 0

        return cls(
            eight=zeros_on_lines(4, shape.bins, LANES),
            magnitudes=zeros_on_lines(shape.bins, 2, LANES),
            last=zeros_on_lines(shape.bins, 6, LANES),
            known_row=zeros_on_lines(4, known_width),
            known=zeros_on_lines(shape.bins, 6, LANES + known_width + LANES),
            frames=zeros_on_lines(2 * n_fft * LANES),
            carried=zeros_on_lines(hop, 2, 3, LANES),
            rows=zeros_on_lines(2, LANES, LANES),
            sounded=zeros_on_lines(2, LANES * hop),
            targets=zeros_on_lines(shape.bins, 2, width if iterates else 0),
            more_frames=zeros_on_lines(2 * n_fft * LANES if iterates else 0),
            total=zeros_on_lines(2, length),
            other_total=zeros_on_lines(2, length),
        )


@compiled
def whole_vectors(frames: int) -> int:
    return (frames + LANES - 1) // LANES * LANES


@compiled
def decode(
    log_magnitude: Float32,
    frequency: Float32,
    certainty: Float32,
    interaural: Float32,
    aligned: npt.NDArray[np.float64],
    columns: Columns,
    shape: Shape,
    windows: Windows,
    noise: Float32,
    purpose: int,
    work: Workspace,
    output: Float32,
) -> None:
    """Decode predictions, as in `server.field.graph.Spectrograms`, per frame or per cell (`columns`), and write the
    responses to `output` (B, 2, sample). Each prediction starts at sample `aligned` (B,), which may be a fraction. The
    targets of the last row remain in `work`."""
    for row in range(output.shape[0]):
        start = math.floor(aligned[row])
        turn = -2.0 * math.pi / windows.n_fft * (aligned[row] - start)
        _know(frequency[row], certainty[row], turn, shape, work)
        _add_noise(
            log_magnitude[row],
            interaural[row],
            aligned[row],
            columns,
            shape,
            windows,
            noise,
            purpose,
            NO_MARGIN,
            work,
            output[row],
        )
        if purpose != TARGETS:
            _add_known(log_magnitude[row], interaural[row], start, columns, shape, windows, work, output[row])


@compiled
def decode_magnitudes(
    magnitude: Float32,
    interaural: Float32,
    margin: int,
    aligned: float,
    columns: Columns,
    shape: Shape,
    windows: Windows,
    noise: Float32,
    work: Workspace,
    response: Float32,
) -> None:
    """Decode one prediction as `decode` does, from magnitudes (ear, bin, frame) in place of their logarithms, where no
    phase is known. A `margin` of frames, at least LANES, lies before the first frame and after the last of those that
    are used; it is silent, and so is its `interaural` coherence (2, bin, frame)."""
    _add_noise(magnitude, interaural, aligned, columns, shape, windows, noise, WHOLE, margin, work, response)


@compiled
def delay_of(aligned, shape, hop):
    """Split a delay into whole frames and a fraction of one. Returns both, the first frame that can sound (rounded down
    to whole vectors), and the frame after the last."""
    limit = float((shape.frames + 1) * hop)
    delay = min(limit, max(-limit, aligned)) / hop
    whole = math.floor(delay)
    first = max(0, whole) // LANES * LANES
    return whole, np.float32(delay - whole), first, min(shape.frames, shape.used + whole + 1)


@compiled
def _know(frequency, certainty, turn, shape, work) -> None:
    """Write the phasors and certainties of the frames whose phase is known to `work`. Phases are sums of the predicted
    advances, and bin k is turned by k times `turn`."""
    rows, row = work.known_row.ctypes.data, work.known_row.shape[1]
    width = work.known.shape[2]
    for bin_ in range(shape.bins):
        for ear in range(2):
            phase = 0.0
            for j in range(shape.known):
                phase += frequency[ear, bin_, j]
                phase -= 2 * math.pi * math.floor(phase * (0.5 / math.pi) + 0.5)
                # Four hops are one window, so a bin's centre advances by whole quarters of a turn.
                work.known_row[ear, j] = phase + 0.5 * math.pi * (bin_ * j % 4) + bin_ * turn
                work.known_row[2 + ear, j] = 1.0 if shape.all_is_certain else certainty[ear, bin_, j]
        known = work.known[bin_].ctypes.data
        for j in range(0, shape.known, LANES):
            for ear in range(2):
                cosine, sine = cosine_sine(load(rows, ear * row + j))
                size = load(rows, (2 + ear) * row + j)
                store(known, 2 * ear * width + LANES + j, multiply(cosine, size))
                store(known, (2 * ear + 1) * width + LANES + j, multiply(sine, size))
                store(known, (4 + ear) * width + LANES + j, size)


@compiled
def _predicted(log_magnitude, interaural, j, columns, shape, work):
    """Find eight frames from frame `j` on. Returns the addresses of the left ear's log magnitudes and of the
    coherence's real part, the distance from these to the right ear and the imaginary part, and the distance from one
    bin to the next."""
    if columns.first.size > 0:
        spread_columns(columns, j, log_magnitude, interaural, work.eight)
    elif j >= 0 and j + LANES <= shape.used:
        levels, coherences = log_magnitude.ctypes.data + 4 * j, interaural.ctypes.data + 4 * j
        return levels, coherences, log_magnitude.strides[0] // 4, log_magnitude.strides[1] // 4
    else:
        _copy_what_is_there(log_magnitude, interaural, j, shape.used, work.eight)
    return work.eight.ctypes.data, work.eight[2].ctypes.data, LANES * shape.bins, LANES


@compiled
def _copy_what_is_there(log_magnitude, interaural, j, used, eight) -> None:
    for bin_ in range(eight.shape[1]):
        for lane in range(LANES):
            is_there = 0 <= j + lane < used
            for part in range(2):
                eight[part, bin_, lane] = log_magnitude[part, bin_, j + lane] if is_there else NOTHING
                eight[2 + part, bin_, lane] = interaural[part, bin_, j + lane] if is_there else 0.0


@compiled
def _find_magnitudes(levels, other, step, shape, work) -> None:
    """Compute the magnitudes of eight frames from log magnitudes at address `levels`. This is a loop of its own,
    because its constants occupy most registers."""
    zero, floor = broadcast(np.float32(0.0)), broadcast(np.float32(shape.log_floor))
    magnitudes = work.magnitudes.ctypes.data
    for bin_ in range(shape.bins):
        at, to = bin_ * step, 2 * LANES * bin_
        store(magnitudes, to, at_least(subtract(exponential(load(levels, at)), floor), zero))
        store(magnitudes, to + LANES, at_least(subtract(exponential(load(levels, other + at)), floor), zero))


@compiled
def _later(last, at, now, share):
    """Interpolate between a bin's eight values and the values one frame before each. The values are then stored as the
    last eight."""
    before = one_before(last, at, now)
    return multiply_add(subtract(before, now), share, now)


@compiled
def _add_noise(
    log_magnitude, interaural, aligned, columns, shape, windows, noise, purpose, margin, work, response
) -> None:
    """Write the noise part to a response, whose old content is overwritten."""
    hop = windows.n_fft // 4
    whole, share, first, stop = delay_of(aligned, shape, hop)
    end = min(shape.samples, response.shape[1])
    at = min(end, max(0, first * hop - shape.frame_lead))
    _clear(work.last)
    _clear(work.carried)
    if purpose != TARGETS:
        silence(response, 0, at)
    if whole < 0:  # the first frames are interpolated with frames before emission
        _compose(
            -LANES, whole, share, log_magnitude, interaural, columns, shape, windows.n_fft, noise, purpose, margin, work
        )
    for t in range(first, stop, LANES):
        _compose(
            t, whole, share, log_magnitude, interaural, columns, shape, windows.n_fft, noise, purpose, margin, work
        )
        if purpose != TARGETS:
            at = _sound(t * hop - shape.frame_lead, 0, end, False, True, windows, work, response)
    if purpose != TARGETS:
        if first < stop and at < end:
            at = _sound(at, 0, end, False, False, windows, work, response)
        silence(response, min(end, at), response.shape[1])
    if purpose != WHOLE:
        for bin_ in range(shape.bins):
            for ear in range(2):
                for t in range(shape.frames, work.targets.shape[2]):
                    work.targets[bin_, ear, t] = 0


@compiled
def _compose(t, whole, share, log_magnitude, interaural, columns, shape, n_fft, noise, purpose, margin, work) -> None:
    """Compute eight frames, from frame `t` on, of the frozen noise that fills the unknown part, as
    `server.acoustics.phase.separate` and `correlated_noise` do. The prediction is delayed by `whole` frames and a
    `share` of one. Targets are computed too, depending on `purpose`. `margin` is as in `decode_magnitudes`, or
    NO_MARGIN for logarithms."""
    zero, one = broadcast(np.float32(0.0)), broadcast(np.float32(1.0))
    undecided, most = broadcast(np.float32(UNDECIDED)), broadcast(np.float32(MOST_COHERENT))
    later = broadcast(share)
    j = t - whole
    if margin >= 0:
        magnitudes, coherences = log_magnitude.ctypes.data + 4 * (margin + j), interaural.ctypes.data + 4 * (margin + j)
        step, other = log_magnitude.shape[2], log_magnitude.shape[1] * log_magnitude.shape[2]
        by_bin, by_ear = step, other
    else:
        levels, coherences, other, step = _predicted(log_magnitude, interaural, j, columns, shape, work)
        _find_magnitudes(levels, other, step, shape, work)
        magnitudes, by_bin, by_ear = work.magnitudes.ctypes.data, 2 * LANES, LANES
    is_known = -LANES < j < shape.known
    known_width, width = work.known.shape[2], work.targets.shape[2]
    heard = max(0, t)  # frames before 0 are stored at 0 and overwritten later
    frames, white = work.frames.ctypes.data, noise[heard // LANES].ctypes.data
    for bin_ in range(shape.bins):
        at = bin_ * step
        last = work.last[bin_].ctypes.data
        ml, mr = load(magnitudes, by_bin * bin_), load(magnitudes, by_bin * bin_ + by_ear)
        if purpose != WHOLE:
            targets = work.targets[bin_].ctypes.data
            store(targets, heard, _later(last, 4 * LANES, ml, later))
            store(targets, width + heard, _later(last, 5 * LANES, mr, later))
            if purpose == TARGETS:
                continue
        cr, ci = load(coherences, at), load(coherences, other + at)
        if is_known:
            known, to = work.known[bin_].ctypes.data, LANES + j
            al, bl = load(known, to), load(known, known_width + to)
            ar, br = load(known, 2 * known_width + to), load(known, 3 * known_width + to)
            cl, cr_ = load(known, 4 * known_width + to), load(known, 5 * known_width + to)
            ul = square_root(at_least(multiply_subtract(cl, cl, one), zero))
            ur = square_root(at_least(multiply_subtract(cr_, cr_, one), zero))
            both = at_least(multiply(ul, ur), undecided)
            cr = divide(multiply_subtract(bl, br, multiply_subtract(al, ar, cr)), both)
            ci = divide(multiply_add(al, br, multiply_subtract(bl, ar, ci)), both)
            ml, mr = multiply(ml, ul), multiply(mr, ur)
        scale, square = most, multiply_add(cr, cr, multiply(ci, ci))
        if any_above(square, one):  # rarely true
            scale = divide(most, square_root(at_least(square, one)))
        ml, mr = _later(last, 0, ml, later), _later(last, LANES, mr, later)
        cr = _later(last, 2 * LANES, multiply(cr, scale), later)
        ci = _later(last, 3 * LANES, multiply(ci, scale), later)
        own = square_root(at_least(multiply_subtract(cr, cr, multiply_subtract(ci, ci, one)), zero))
        of_bin = 4 * LANES * bin_
        lr, li = load(white, of_bin), load(white, of_bin + LANES)
        own_re, own_im = multiply(own, load(white, of_bin + 2 * LANES)), multiply(own, load(white, of_bin + 3 * LANES))
        rr = multiply_add(cr, lr, multiply_add(ci, li, own_re))
        ri = multiply_subtract(ci, lr, multiply_add(cr, li, own_im))
        place_bin(frames, n_fft, bin_, multiply(ml, lr), multiply(ml, li), multiply(mr, rr), multiply(mr, ri))


@compiled
def _add_known(log_magnitude, interaural, start, columns, shape, windows, work, response) -> None:
    """Add the known part to the response from sample `start` on; samples outside the response are dropped."""
    frames = work.frames.ctypes.data
    magnitudes = work.magnitudes.ctypes.data
    width = work.known.shape[2]
    begin, end = max(0, start), min(response.shape[1], start + shape.samples)
    at = start - shape.frame_lead
    _clear(work.carried)
    for j in range(0, shape.known, LANES):
        levels, _, other, step = _predicted(log_magnitude, interaural, j, columns, shape, work)
        _find_magnitudes(levels, other, step, shape, work)
        for bin_ in range(shape.bins):
            known = work.known[bin_].ctypes.data
            ml, mr = load(magnitudes, 2 * LANES * bin_), load(magnitudes, 2 * LANES * bin_ + LANES)
            place_bin(
                frames,
                windows.n_fft,
                bin_,
                multiply(ml, load(known, LANES + j)),
                multiply(ml, load(known, width + LANES + j)),
                multiply(mr, load(known, 2 * width + LANES + j)),
                multiply(mr, load(known, 3 * width + LANES + j)),
            )
        at = _sound(at, begin, end, True, True, windows, work, response)
    if shape.known > 0 and shape.known + 3 > whole_vectors(shape.known):
        _sound(at, begin, end, True, False, windows, work, response)


@compiled
def _sound(at, begin, end, is_added, has_frames, windows, work, response):
    """Synthesise eight more frames, silent ones unless it `has_frames`, and write the samples that are now complete to
    the response from sample `at` on, within `begin` and `end`. Returns the sample after the last."""
    if not has_frames:
        _clear(work.frames)
    frames, carried, rows = work.frames.ctypes.data, work.carried.ctypes.data, work.rows.ctypes.data
    sounded, stop = work.sounded, at + work.sounded.shape[1]
    if not is_added and at >= begin and stop <= end:
        _synthesise(frames, has_frames, windows, carried, rows, response.ctypes.data + 4 * at, response.strides[0] // 4)
        return stop
    _synthesise(frames, has_frames, windows, carried, rows, sounded.ctypes.data, sounded.shape[1])
    for ear in range(2):
        for n in range(max(begin, at), min(end, stop)):
            response[ear, n] = sounded[ear, n - at] + (response[ear, n] if is_added else np.float32(0.0))
    return stop


@compiled
def _synthesise(frames, has_frames, windows, carried, rows, to, other) -> None:
    if has_frames:
        synthesise_next(frames, windows, carried, rows, to, other)
    else:  # the transform of silence is silence
        add_up(frames, windows, carried, rows, to, other)


@compiled
def _clear(values) -> None:
    """Set all values to zero; their number is a multiple of LANES."""
    for n in range(0, values.size, LANES):
        store(values.ctypes.data, n, broadcast(np.float32(0.0)))


@compiled
def silence(signals, begin, end) -> None:
    # Assigning zero to a slice would do the same, but takes seconds to compile.
    for channel in range(signals.shape[0]):
        for n in range(begin, end):
            signals[channel, n] = 0
