"""One block of the direct path of many emitters, in compiled code.

An emitter's block is written to its delay line. Each ear reads the line with its own delay, the path's plus the head's,
and applies one minimum-phase filter that combines the magnitudes of head, air and path as a sum of cepstra. Without a
head there is one ear, which has no delay of its own, and needs a filter only if something on the path has a gain.
Ambisonic channels are this one ear with a filter for each channel: the common one times the harmonic of the direction.

A muted emitter still writes its delay line but costs nothing else, so it can be heard again at once.

Requested values jump from block to block; the rendered values follow smoothly. Path lengths and the head's delays
follow like critically damped springs whose anchor moves steadily through a block. Within the block the delay is the
cubic that meets position and speed at both ends. A filter is computed anew when direction or bands have changed, long
before the change is audible, and crossfaded over the block. In steady motion the crossfade is a straight line, so that
blocks join without a ripple at the block rate; for a leap it is a raised cosine. A length that jumps further than any
motion could is crossfaded too, from the old delay to the new.

Filters work on the spectra of `server.kernels.odd_fft`, and all slots are summed before the single inverse transform:
there is one spectrum of the delayed input per ear, and one per filter whenever the filter changes.

Letters: s slots, e ears (2, or 1 without a head), c channels of the output, n taps, f bins, b block size, w block size
rounded up to whole tiles of the loops (values beyond b mean nothing), r length of the delay line's ring. Lengths are in
metres, delays in samples unless their name says seconds.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

import server.rendering.path_loops as loops
from server.kernels.compiled import compiled_in_place
from server.rendering.direct_path_records import (
    BANDS,
    FILTER_BANDS,
    FILTERED,
    MUTED,
    NOT_STARTED,
    UNFILTERED,
    DirectPathState,
    DoubleArray,
    FloatArray,
)
from server.rendering.fractional_delay import BEFORE
from server.rendering.harmonics_kernel import write_harmonics
from server.rendering.sphere import find_triangle

_LENGTH_TIME_S = 0.015
_HEAD_TIME_S = 0.008
_GREATEST_SPEED_RATIO = 0.5
"""Fraction of the speed of sound; a change that implies a higher speed is a jump, not a motion."""
_POSE_INTERVAL_S = 0.020
"""Seconds; a length that was requested longer ago than this says nothing about speed."""
_ANGLE_STEP = np.radians(0.3)
_BAND_STEP_DB = 0.02
_ANGLE_LEAP = np.radians(10.0)
_BAND_LEAP_DB = 3.0
_NONE, _STEP, _LEAP, _PLAIN = 0, 1, 2, 3
_REST_M = 1e-6
_REST_S = 3e-9
TILE = loops.TILE
transform_tables = loops.transform_tables
_ANCHOR, _AT, _SPEED = 0, 1, 2


@compiled_in_place
def ask(
    slots: Any,
    rows: npt.NDArray[np.int64],
    lengths_m: DoubleArray,
    arrivals: DoubleArray,
    band_gains_db: DoubleArray,
) -> None:
    """Set the targets of the slots in `rows` (n,): lengths (n,), arrivals (n, 3), gains (n, band)."""
    for number in range(rows.size):
        slot = slots[rows[number]]
        slot.present = True
        slot.asked = True
        slot.goal_m = lengths_m[number]
        for axis in range(3):
            slot.arrival[axis] = arrivals[number, axis]
        for band in range(BANDS):
            slot.band_gain_db[band] = band_gains_db[number, band]


@compiled_in_place
def render_direct_paths(state: DirectPathState, blocks: FloatArray, out: FloatArray) -> None:
    """Render the blocks (s, b) of all slots and add the result to the channels (c, b) in `out`."""
    position = state.position[0]
    size = out.shape[1]
    state.is_mixed[:] = 0
    for index in range(blocks.shape[0]):
        slot = state.slots[index]
        if index + 1 < blocks.shape[0]:
            _fetch(state, index + 1, position, size)
        if slot.present and _write_input(slot, state.line[index], position, state.ring, state.quiet, blocks[index]):
            _render_slot(state, slot, index, size)
    state.position[0] = (position + size) % state.ring
    for kind in range(_PLAIN):
        if state.is_mixed[kind] != 0:
            _synthesise(state, kind, out)
    if state.is_mixed[_PLAIN] != 0:
        loops.add_block(state.plain, out[0])


@compiled_in_place
def _fetch(state: DirectPathState, index: int, position: int, size: int) -> None:
    """Prefetch the data of a slot while the slot before it is processed. With many listeners on a core, all of it lies
    in main memory."""
    slot = state.slots[index]
    if not slot.present:
        return
    line = state.line[index]
    begin = (position - int(slot.delay[0]) - BEFORE) % state.ring
    loops.fetch(line, position, position + size)
    loops.fetch(line, begin, min(begin + size + 2 * BEFORE, line.size))
    for ear in range(state.heard.shape[1]):
        loops.fetch(state.heard[index, ear], 0, state.heard.shape[2])
    for channel in range(state.spectra.shape[1]):
        loops.fetch(state.spectra[index, channel, 0], 0, 2 * state.spectra.shape[3])  # the imaginary parts follow


@compiled_in_place
def _open(state: DirectPathState, kind: int) -> None:
    """Zero a mix before its first use in a block."""
    if state.is_mixed[kind] == 0:
        state.mix[kind] = 0
        state.is_mixed[kind] = 1


@compiled_in_place
def _synthesise(state: DirectPathState, kind: int, out: FloatArray) -> None:
    """Transform one of the mixes back and add it to `out`: the mix of the filters in effect, or a mix that fades out
    from the previous filters."""
    block = state.filtered
    for channel in range(out.shape[0]):
        loops.synthesise(state.mix[kind, channel], state.twist, state.passes, state.lanes, block)
        newest = block[block.size - out.shape[1] :]
        if kind == 0:
            loops.add_block(newest, out[channel])
        elif kind == _STEP:
            loops.add_fading(newest, state.ramp, out[channel])
        else:
            loops.add_fading(newest, state.fade, out[channel])


@compiled_in_place
def _write_input(slot: Any, line: FloatArray, position: int, ring: int, quiet: int, block: FloatArray) -> bool:
    """Write a block to the slot's delay line. Returns False if the slot has rung out: the line is silent then and need
    not be written."""
    size = block.size
    if not loops.is_silent(block):
        slot.silent = 0
    else:
        slot.silent = min(slot.silent + size, quiet)
        if slot.silent == quiet:
            slot.mode = NOT_STARTED
            return False
    loops.copy(block, line[position : position + size])
    again = ring + position
    if again + size <= line.size:
        loops.copy(block, line[again : again + size])
    return True


@compiled_in_place
def _render_slot(state: DirectPathState, slot: Any, index: int, size: int) -> None:
    """Add a slot to the mixes. The last mode and the current mode (see NOT_STARTED) decide what is done: nothing if
    both are inaudible, otherwise a block that fades from the one to the other, including the start and the end."""
    before, ears = slot.mode, state.cepstra.shape[1]
    if slot.muted and before <= MUTED:
        slot.mode = MUTED
        slot.is_elsewhere = before == NOT_STARTED or slot.is_elsewhere or slot.asked
        slot.jump = slot.asked = False
        return
    # A slot that did not move while it was muted continues from its old position.
    at_once = before == NOT_STARTED or (before == MUTED and slot.is_elsewhere)
    slot.is_elsewhere = False
    jumps = not at_once and _jumps(slot, size, state.sample_rate, state.speed_of_sound)
    if slot.asked:
        slot.since_asked = 0
    slot.jump = slot.asked = False
    slot.was_unattenuated = slot.unattenuated
    period_s = size / state.sample_rate
    _follow(slot.length, slot.goal_m, period_s, _LENGTH_TIME_S, _REST_M, at_once or jumps)
    gain = 1.0 if slot.unattenuated else 1.0 / max(slot.length[_AT], state.nearest_m)
    gain_before = gain if at_once else slot.gain
    slot.gain = gain
    change = _change(slot, state.to_head, state.air_db_per_m)
    is_filtered = ears == 2 or state.harmonics.size > 0 or _colours(slot)
    now = MUTED if slot.muted else FILTERED if is_filtered else UNFILTERED
    slot.mode = now
    if jumps or (now == FILTERED) != (before == FILTERED):
        change = _LEAP
    if now == FILTERED and change != _NONE:
        _find_filters(state, slot)

    window = 2 * state.bins.shape[1]
    for ear in range(ears):
        _follow(slot.head[ear], slot.head_goal_s[ear], period_s, _HEAD_TIME_S, _REST_S, at_once or jumps)
        samples = state.heard[index, ear]
        newest = samples[window - size : window - size + state.first.size]
        if before == FILTERED:
            loops.shift(samples, size, window - size)
        elif before == NOT_STARTED:
            samples[:] = 0
        elif now == FILTERED:
            _read_past(state, slot, index, ear, window - size, at_once, gain_before)
        _read(state, slot, state.line[index], ear, size, at_once, jumps, gain_before, newest)
        if before == FILTERED or now == FILTERED:
            _add_filtered(state, index, ear, before, now, change)
        if before == UNFILTERED or now == UNFILTERED:
            # A slot that has just started has nothing to fade in from.
            _add_plain(state, newest[:size], before in (UNFILTERED, NOT_STARTED), now == UNFILTERED)


@compiled_in_place
def _read_past(state: DirectPathState, slot: Any, index: int, ear: int, back: int, at_once: bool, gain: float) -> None:
    """Compute what an ear would have received from `back` samples before this block on; a filter that starts needs
    these samples."""
    past = _delay(state, slot, ear) if at_once else slot.delay[ear]
    samples = state.heard[index, ear, : 2 * state.bins.shape[1]]
    _read_still(state, state.line[index], past, back, samples)
    loops.multiply_by(samples, gain)


@compiled_in_place
def _add_filtered(state: DirectPathState, index: int, ear: int, before: int, now: int, change: int) -> None:
    """Filter what an ear receives and add it to the mix of its channels, with a crossfade from the previous filter if
    the two differ."""
    loops.transform(state.heard[index, ear], state.twist, state.passes, state.lanes, state.bins)
    channels = state.spectra.shape[1] // state.heard.shape[1]
    if before != NOT_STARTED and change != _NONE:
        _open(state, change)
    if now == FILTERED:
        _open(state, 0)
    for channel in range(ear * channels, (ear + 1) * channels):
        in_effect, after = state.spectra[index, channel], state.next_spectra[channel]
        if before != FILTERED:
            in_effect[:] = 0
        if now != FILTERED:
            after[:] = 0
        if before == NOT_STARTED:
            loops.copy_spectrum(after, in_effect)
        elif change != _NONE:
            loops.accumulate_change(state.bins, in_effect, after, state.mix[change, channel])
            loops.copy_spectrum(after, in_effect)
        if now == FILTERED:
            loops.accumulate(state.bins, in_effect, state.mix[0, channel])


@compiled_in_place
def _add_plain(state: DirectPathState, block: FloatArray, before: bool, after: bool) -> None:
    """Add what an ear receives without a filter, faded in or out if it was not heard before or is not heard after."""
    if state.is_mixed[_PLAIN] == 0:
        state.plain[:] = 0
        state.is_mixed[_PLAIN] = 1
    plain = state.plain[: block.size]
    if before and after:
        loops.add_block(block, plain)
    elif before:
        loops.add_fading(block, state.fade, plain)
    else:
        loops.add_block(block, plain)
        loops.multiply_by(block, -1.0)
        loops.add_fading(block, state.fade, plain)


@compiled_in_place
def _colours(slot: Any) -> bool:
    """Whether anything on the path has a gain in some band."""
    most = 0.0
    for band in range(FILTER_BANDS):
        most = max(most, abs(slot.bands_db[band]))
    return most > 0.0


@compiled_in_place
def _jumps(slot: Any, size: int, sample_rate: float, speed_of_sound: float) -> bool:
    slot.since_asked += size
    longest = max(_POSE_INTERVAL_S * sample_rate, float(size))
    elapsed_s = min(float(slot.since_asked), longest) / sample_rate
    way = abs(slot.goal_m - slot.length[_ANCHOR])
    too_far = way > _GREATEST_SPEED_RATIO * speed_of_sound * elapsed_s
    return bool(slot.unattenuated != slot.was_unattenuated or (slot.asked and (slot.jump or too_far)))


@compiled_in_place
def _follow(spring: DoubleArray, goal: float, period_s: float, time_s: float, rest: float, at_once: bool) -> None:
    """Move a critically damped spring of time constant `time_s` exactly by one block, while its anchor moves steadily
    to `goal`. The spring trails its anchor by twice the time constant, and stops within `rest` of it."""
    anchor, at, speed = spring[_ANCHOR], spring[_AT], spring[_SPEED]
    if not at_once and (at != goal or speed != 0.0 or anchor != goal):
        drift = (goal - anchor) / period_s
        trail = 2.0 * time_s * drift
        off = at - anchor + trail
        rate = speed - drift + off / time_s
        decay = np.exp(-period_s / time_s)
        left = (off + rate * period_s) * decay
        at = goal - trail + left
        speed = drift + rate * decay - left / time_s
        at_once = abs(at - goal) < rest and abs(speed) * time_s < rest
    if at_once:
        at, speed = goal, 0.0
    spring[_ANCHOR] = goal
    spring[_AT] = at
    spring[_SPEED] = speed


@compiled_in_place
def _change(slot: Any, to_head: DoubleArray, air_db_per_m: DoubleArray) -> int:
    """Classify how far direction and bands are from those for which the filters were computed: too little for new
    filters, a step of steady motion, or a leap."""
    turned = 0.0
    for axis in range(3):
        along = 0.0
        for world in range(3):
            along += to_head[axis, world] * slot.arrival[world]
        slot.direction[axis] = along
        turned += (along - slot.filtered_direction[axis]) ** 2
    difference_db = 0.0
    for band in range(FILTER_BANDS):
        level = slot.band_gain_db[min(band, BANDS - 1)]
        if not slot.airless:
            level -= air_db_per_m[band] * slot.length[_AT]
        slot.bands_db[band] = level
        difference_db = max(difference_db, abs(level - slot.filtered_db[band]))
    if turned > _ANGLE_LEAP**2 or difference_db > _BAND_LEAP_DB:
        return _LEAP
    return _STEP if turned > _ANGLE_STEP**2 or difference_db > _BAND_STEP_DB else _NONE


@compiled_in_place
def _find_filters(state: DirectPathState, slot: Any) -> None:
    """Compute the filters and the head's delays for the direction and bands of a slot."""
    for axis in range(3):
        slot.filtered_direction[axis] = slot.direction[axis]
    for band in range(FILTER_BANDS):
        slot.filtered_db[band] = slot.bands_db[band]
    count, ears = state.next_taps.shape[1], state.cepstra.shape[1]
    triangle = 0
    if ears == 2:
        triangle = find_triangle(state.across, state.inverses, slot.direction, slot.triangle, state.weights)
        slot.triangle = triangle
    for ear in range(ears):
        delay = 0.0
        cepstrum = state.cepstrum[ear, :count]
        cepstrum[:] = 0
        if ears == 2:
            for corner in range(3):
                direction = state.triangles[triangle, corner]
                delay += state.weights[corner] * state.head_delays_s[direction, ear]
                loops.add_scaled(state.cepstra[direction, ear], state.weights[corner], cepstrum)
        for band in range(FILTER_BANDS):
            loops.add_scaled(state.band_cepstra[band], slot.bands_db[band], cepstrum)
        loops.weight(cepstrum, state.orders)
        slot.head_goal_s[ear] = delay
    loops.series_exponential(state.cepstrum, state.reciprocals, state.sums, state.next_taps)
    for ear in range(ears):
        loops.copy(state.next_taps[ear], state.padded[:count])
        loops.transform(state.padded, state.twist, state.passes, state.lanes, state.next_spectra[ear])
    if state.harmonics.size > 0:
        write_harmonics(slot.direction, state.harmonics)
        for channel in range(1, state.harmonics.size):
            loops.copy_spectrum(state.next_spectra[0], state.next_spectra[channel])
            for part in range(2):
                loops.multiply_by(state.next_spectra[channel, part], state.harmonics[channel])


@compiled_in_place
def _read(
    state: DirectPathState,
    slot: Any,
    line: FloatArray,
    ear: int,
    size: int,
    at_once: bool,
    jumps: bool,
    gain_before: float,
    heard: FloatArray,
) -> None:
    """Read the delay line for one ear with the ear's moving delay, apply the gain of the distance, and write the result
    to `heard`."""
    end = _delay(state, slot, ear)
    is_within = state.shortest_m <= slot.length[_AT] <= state.longest_m
    speed = slot.length[_SPEED] if is_within else 0.0
    end_slope = speed / state.speed_of_sound + slot.head[ear, _SPEED]
    start, slope = slot.delay[ear], slot.slope[ear]
    slot.delay[ear] = end
    slot.slope[ear] = end_slope

    gain = slot.gain
    if at_once or (start == end and slope == 0.0 and end_slope == 0.0 and gain_before == gain):
        _read_still(state, line, end, 0, heard)
        loops.scale(heard, gain, gain, state.ramp)
    elif jumps:
        before, after = state.read[0], state.read[1]
        _read_moving(state, line, start, slope, 0.0, 0.0, before)
        _read_still(state, line, end, 0, after)
        loops.scale(before, gain_before, gain_before, state.ramp)
        loops.scale(after, gain, gain, state.ramp)
        heard[:] = 0
        loops.add_faded(before, after, state.fade, heard[:size])
    else:
        mean_slope = (end - start) / size
        curve = (3.0 * mean_slope - 2.0 * slope - end_slope) / size
        twist = (slope + end_slope - 2.0 * mean_slope) / size**2
        _read_moving(state, line, start, slope, curve, twist, heard)
        loops.scale(heard, gain_before, gain, state.ramp)


@compiled_in_place
def _delay(state: DirectPathState, slot: Any, ear: int) -> float:
    """The current delay of one ear in samples, from the path's length and the head's delay."""
    within = min(max(slot.length[_AT], state.shortest_m), state.longest_m)
    return float((within / state.speed_of_sound + slot.head[ear, _AT]) * state.sample_rate)


@compiled_in_place
def _read_still(state: DirectPathState, line: FloatArray, delay: float, back: int, out: FloatArray) -> None:
    """Read the line from `back` samples before this block on, as if the delay had always been `delay`."""
    first, row, share = state.first[:1], state.row[:1], state.share[:1]
    loops.locate(float(state.position[0] - back), state.ring, delay, 0.0, 0.0, 0.0, first, row, share)
    loops.interpolate_reversed(state.sinc[row[0]], share[0], state.still_taps)
    begin = first[0] - BEFORE
    begin = begin if begin >= 0 else begin + state.ring
    loops.filter_block(line[begin:], state.still_taps, out)


@compiled_in_place
def _read_moving(
    state: DirectPathState, line: FloatArray, a0: float, a1: float, a2: float, a3: float, out: FloatArray
) -> None:
    loops.locate(state.position[0] - float(BEFORE), state.ring, a0, a1, a2, a3, state.first, state.row, state.share)
    loops.read_at(line, state.first, state.row, state.share, state.sinc, out)
