"""One block of the direct path of many emitters, in compiled code or, without a compiler, in Python and NumPy.

An emitter's block goes into its delay line. Each ear reads the line at a delay of its own, the way's plus the head's,
and hears it through one minimum-phase filter: what the head, the air and the way do to magnitude, summed as cepstra.

What is asked for jumps from block to block; what is heard follows. Lengths and the head's delays go to where they are
asked to be like critically damped springs whose anchor moves steadily through a block, and within the block the delay
is the cubic that meets position and speed at both of its ends. A filter is computed anew where direction or bands have
moved, long before it could be heard, and crossfaded over the block: along a straight line in steady motion, whose
blocks then join without a ripple at their rate, and along a raised cosine where they leap. A length that jumps further
than anything moves is crossfaded too, from the old delay to the new.

Filters work on the right-angle spectra of `server.rendering.right_angle`, all slots summed before the one way back: a
spectrum per ear of what it hears, one per filter whenever that changes.

Letters: s slots, e ears, n taps, f bins, b block size, w the same in whole tiles of the loops (what is beyond b means
nothing), r ring of the delay line. Lengths in metres, delays in samples unless their name says seconds.
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from server.compiled import HAS_NUMBA, compiled
from server.rendering.fractional_delay import BEFORE
from server.rendering.sphere import find_triangle

if HAS_NUMBA:
    import server.rendering.path_loops as loops
else:
    import server.rendering.path_loops_numpy as loops  # type: ignore[no-redef]

FloatArray = npt.NDArray[np.float32]
DoubleArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

_LENGTH_TIME_S = 0.015
_HEAD_TIME_S = 0.008
_GREATEST_SPEED_RATIO = 0.5
"""Of the speed of sound; what implies more is a jump, not a motion."""
_POSE_INTERVAL_S = 0.020
"""A length asked for longer ago than this says nothing about speed."""
_ANGLE_STEP = np.radians(0.3)
_BAND_STEP_DB = 0.02
_ANGLE_LEAP = np.radians(10.0)
_BAND_LEAP_DB = 3.0
_NONE, _STEP, _LEAP = 0, 1, 2
_REST_M = 1e-6
_REST_S = 3e-9
TILE = loops.TILE
transform_tables = loops.transform_tables
BANDS = 7

SLOT = np.dtype(
    [
        # What is asked for; written between blocks.
        ("present", np.bool_),
        ("asked", np.bool_),  # anew since the last block
        ("jump", np.bool_),
        ("goal_m", np.float64),
        ("arrival", np.float64, 3),  # world
        ("band_gain_db", np.float64, BANDS),
        # Where things are, at the end of the last block. A spring is where its anchor is, where it is, and its speed.
        ("started", np.bool_),
        ("silent", np.int64),  # samples
        ("since_asked", np.int64),  # samples
        ("length", np.float64, 3),  # spring: m, m, m/s
        ("head_goal_s", np.float64, 2),
        ("head", np.float64, (2, 3)),  # springs: s, s, s/s
        ("delay", np.float64, 2),
        ("slope", np.float64, 2),  # samples per sample
        ("gain", np.float64),
        ("direction", np.float64, 3),  # head
        ("bands_db", np.float64, BANDS),
        # What the filters were computed for, and where that was found.
        ("filtered_direction", np.float64, 3),
        ("filtered_db", np.float64, BANDS),
        ("triangle", np.int64),
    ],
    align=True,
)
"""One emitter."""
_ANCHOR, _AT, _SPEED = 0, 1, 2


class DirectPathState(NamedTuple):
    """Everything that `render_direct_paths` reads and writes. Tables may be shared between states; the rest is of one
    thread at a time."""

    slots: npt.NDArray[np.void]  # (s,) of SLOT
    to_head: DoubleArray  # (3, 3) from world to head
    position: IntArray  # (1,) in the line, of the next block
    line: FloatArray  # (s, r and its beginning once more)
    heard: FloatArray  # (s, e, 2 f and room for whole tiles) delayed, the newest 2 f samples
    spectra: FloatArray  # (s, e, part, f) of the filter in effect

    # Tables.
    cepstra: FloatArray  # (direction, e, n)
    head_delays_s: DoubleArray  # (direction, e)
    triangles: IntArray
    across: IntArray
    inverses: DoubleArray
    band_cepstra: FloatArray  # (band, n) of one decibel
    orders: FloatArray  # (n,) 1, 1, 2, 3 ...
    reciprocals: FloatArray  # (n,) of `orders`
    sinc: FloatArray
    twist: FloatArray
    passes: FloatArray
    lanes: FloatArray
    fade: FloatArray  # (b,) from 0 to 1
    ramp: FloatArray  # (b,) likewise, straight, the end of each sample
    air_db_per_m: DoubleArray  # (band,) >= 0

    # Room for intermediate results.
    weights: DoubleArray  # (3,)
    cepstrum: FloatArray  # (e, n + 8)
    sums: FloatArray  # (e, n + 8)
    next_taps: FloatArray  # (e, n)
    padded: FloatArray  # (2 f,)
    next_spectra: FloatArray  # (e, part, f)
    bins: FloatArray  # (part, f)
    mix: FloatArray  # (3, e, part, f) by the filters in effect; what those before add, in a step and in a leap
    first: IntArray  # (w,)
    row: IntArray  # (w,)
    share: FloatArray  # (w,)
    still_taps: FloatArray  # (TAPS,)
    read: FloatArray  # (2, w)
    filtered: FloatArray  # (f,)

    # Constants.
    sample_rate: float
    speed_of_sound: float
    nearest_m: float  # for gain
    shortest_m: float  # for delay: the sinc reads ahead, and an ear may be nearer than the head's centre
    longest_m: float  # for delay
    ring: int
    quiet: int  # samples of silence after which nothing is left to be heard


@compiled
def render_direct_paths(state: DirectPathState, blocks: FloatArray, out: FloatArray) -> None:
    """Add what both ears (2, b) hear of the blocks (s, b) of all slots."""
    position = state.position[0]
    size = out.shape[1]
    sounding, steps, leaps = 0, 0, 0
    for index in range(blocks.shape[0]):
        slot = state.slots[index]
        if slot.present and _take_in(slot, state.line[index], position, state.ring, state.quiet, blocks[index]):
            if sounding == 0:
                state.mix[:] = 0
            sounding += 1
            change = _render_slot(state, slot, index, size)
            steps += change == _STEP
            leaps += change == _LEAP
    state.position[0] = (position + size) % state.ring
    if sounding > 0:
        _synthesise(state, 0, out)
    if steps > 0:
        _synthesise(state, _STEP, out)
    if leaps > 0:
        _synthesise(state, _LEAP, out)


@compiled
def _synthesise(state: DirectPathState, kind: int, out: FloatArray) -> None:
    """Add one of the mixes: what the filters in effect make, or what those before add to it while they fade out."""
    block = state.filtered
    for ear in range(2):
        loops.synthesise(state.mix[kind, ear], state.twist, state.passes, state.lanes, block)
        newest = block[block.size - out.shape[1] :]
        if kind == 0:
            loops.add_block(newest, out[ear])
        elif kind == _STEP:
            loops.add_fading(newest, state.ramp, out[ear])
        else:
            loops.add_fading(newest, state.fade, out[ear])


@compiled
def _take_in(slot: Any, line: FloatArray, position: int, ring: int, quiet: int, block: FloatArray) -> bool:
    """Write a block to its line. False if the slot has rung out: its line is silent then, and need not be written."""
    size = block.size
    if not loops.is_silent(block):
        slot.silent = 0
    else:
        slot.silent = min(slot.silent + size, quiet)
        if slot.silent == quiet:
            slot.started = False
            return False
    line[position : position + size] = block
    again = ring + position
    if again + size <= line.size:
        line[again : again + size] = block
    return True


@compiled
def _render_slot(state: DirectPathState, slot: Any, index: int, size: int) -> int:
    """Add a slot to the mix. How its filters changed: not, or by a fade along a straight line or a raised cosine."""
    period_s = size / state.sample_rate
    starts = not slot.started
    jumps = slot.started and _jumps(slot, size, state.sample_rate, state.speed_of_sound)
    slot.started = True
    if slot.asked:
        slot.since_asked = 0
    slot.asked = False
    slot.jump = False
    _follow(slot.length, slot.goal_m, period_s, _LENGTH_TIME_S, _REST_M, starts or jumps)
    gain = 1.0 / max(slot.length[_AT], state.nearest_m)
    gain_before = gain if starts else slot.gain
    slot.gain = gain
    change = _change(slot, state.to_head, state.air_db_per_m)
    if jumps:
        change = _LEAP
    if change != _NONE or starts:
        _find_filters(state, slot)

    window = 2 * state.bins.shape[1]
    for ear in range(2):
        _follow(slot.head[ear], slot.head_goal_s[ear], period_s, _HEAD_TIME_S, _REST_S, starts or jumps)
        samples = state.heard[index, ear]
        loops.shift(samples, size, window - size)
        newest = samples[window - size : window - size + state.first.size]
        _read(state, slot, state.line[index], ear, size, starts, jumps, gain_before, newest)
        loops.transform(samples, state.twist, state.passes, state.lanes, state.bins)
        in_effect = state.spectra[index, ear]
        if change != _NONE or starts:
            if not starts:
                fading = state.mix[change, ear]
                loops.accumulate_change(state.bins, in_effect, state.next_spectra[ear], fading)
            in_effect[:] = state.next_spectra[ear]
        loops.accumulate(state.bins, in_effect, state.mix[0, ear])
    return _NONE if starts else change


@compiled
def _jumps(slot: Any, size: int, sample_rate: float, speed_of_sound: float) -> bool:
    slot.since_asked += size
    longest = max(_POSE_INTERVAL_S * sample_rate, float(size))
    elapsed_s = min(float(slot.since_asked), longest) / sample_rate
    way = abs(slot.goal_m - slot.length[_ANCHOR])
    return bool(slot.asked and (slot.jump or way > _GREATEST_SPEED_RATIO * speed_of_sound * elapsed_s))


@compiled
def _follow(spring: DoubleArray, goal: float, period_s: float, time_s: float, rest: float, at_once: bool) -> None:
    """Move by one block, exactly, a critically damped spring of time constant `time_s` whose anchor moves steadily to
    `goal`; it trails its anchor by twice the time constant. Within `rest` it stops."""
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


@compiled
def _change(slot: Any, to_head: DoubleArray, air_db_per_m: DoubleArray) -> int:
    """How far direction and bands are from what the filters were computed for: not worth new ones, a step of steady
    motion, or a leap."""
    turned = 0.0
    for axis in range(3):
        along = 0.0
        for world in range(3):
            along += to_head[axis, world] * slot.arrival[world]
        slot.direction[axis] = along
        turned += (along - slot.filtered_direction[axis]) ** 2
    difference_db = 0.0
    for band in range(BANDS):
        level = slot.band_gain_db[band] - air_db_per_m[band] * slot.length[_AT]
        slot.bands_db[band] = level
        difference_db = max(difference_db, abs(level - slot.filtered_db[band]))
    if turned > _ANGLE_LEAP**2 or difference_db > _BAND_LEAP_DB:
        return _LEAP
    return _STEP if turned > _ANGLE_STEP**2 or difference_db > _BAND_STEP_DB else _NONE


@compiled
def _find_filters(state: DirectPathState, slot: Any) -> None:
    """The filters and the head's delays for a slot's direction and bands."""
    for axis in range(3):
        slot.filtered_direction[axis] = slot.direction[axis]
    for band in range(BANDS):
        slot.filtered_db[band] = slot.bands_db[band]
    triangle = find_triangle(state.across, state.inverses, slot.direction, slot.triangle, state.weights)
    slot.triangle = triangle
    count = state.next_taps.shape[1]
    for ear in range(2):
        delay = 0.0
        cepstrum = state.cepstrum[ear, :count]
        cepstrum[:] = 0
        for corner in range(3):
            direction = state.triangles[triangle, corner]
            delay += state.weights[corner] * state.head_delays_s[direction, ear]
            loops.add_scaled(state.cepstra[direction, ear], state.weights[corner], cepstrum)
        for band in range(BANDS):
            loops.add_scaled(state.band_cepstra[band], slot.bands_db[band], cepstrum)
        cepstrum *= state.orders
        slot.head_goal_s[ear] = delay
    loops.series_exponential(state.cepstrum, state.reciprocals, state.sums, state.next_taps)
    for ear in range(2):
        state.padded[:count] = state.next_taps[ear]
        loops.transform(state.padded, state.twist, state.passes, state.lanes, state.next_spectra[ear])


@compiled
def _read(
    state: DirectPathState,
    slot: Any,
    line: FloatArray,
    ear: int,
    size: int,
    starts: bool,
    jumps: bool,
    gain_before: float,
    heard: FloatArray,  # (s, e, 2 f and room for whole tiles) delayed, the newest 2 f samples
) -> None:
    """What one ear's delay makes of the line, at the gain of the distance."""
    within = min(max(slot.length[_AT], state.shortest_m), state.longest_m)
    speed = slot.length[_SPEED] if within == slot.length[_AT] else 0.0
    end = (within / state.speed_of_sound + slot.head[ear, _AT]) * state.sample_rate
    end_slope = speed / state.speed_of_sound + slot.head[ear, _SPEED]
    start, slope = slot.delay[ear], slot.slope[ear]
    slot.delay[ear] = end
    slot.slope[ear] = end_slope

    gain = slot.gain
    if starts or (start == end and slope == 0.0 and end_slope == 0.0 and gain_before == gain):
        _read_still(state, line, end, heard)
        loops.scale(heard, gain, gain, state.ramp)
    elif jumps:
        before, after = state.read[0], state.read[1]
        _read_moving(state, line, start, slope, 0.0, 0.0, before)
        _read_still(state, line, end, after)
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


@compiled
def _read_still(state: DirectPathState, line: FloatArray, delay: float, out: FloatArray) -> None:
    first, row, share = state.first[:1], state.row[:1], state.share[:1]
    loops.locate(float(state.position[0]), state.ring, delay, 0.0, 0.0, 0.0, first, row, share)
    loops.interpolate_reversed(state.sinc[row[0]], share[0], state.still_taps)
    begin = first[0] - BEFORE
    begin = begin if begin >= 0 else begin + state.ring
    loops.filter_block(line[begin:], state.still_taps, out)


@compiled
def _read_moving(
    state: DirectPathState, line: FloatArray, a0: float, a1: float, a2: float, a3: float, out: FloatArray
) -> None:
    loops.locate(state.position[0] - float(BEFORE), state.ring, a0, a1, a2, a3, state.first, state.row, state.share)
    loops.read_at(line, state.first, state.row, state.share, state.sinc, out)
