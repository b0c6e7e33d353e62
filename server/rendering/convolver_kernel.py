"""The compiled convolver: everything that happens in a block, without allocation, locks or Python objects.

A convolver is a record of numbers and addresses (`CONVOLVER`), with one record per stage (`STAGE`). Every array it
needs is sized once, in `server.rendering.compiled_convolver`, which owns them. Bins are laid out in tiles of eight,
complex numbers as eight real parts then eight imaginary ones:

    filter of a stage   (tile, partition, channel, part, 8)   one per IR, partitions in order
    spectra of a stage  (source, tile, slot, part, 8)          a ring of windows: slot `newest` + p is p windows old
    mix of a stage      (channel, part, bin)                   and `surplus`: what the IRs that are faded from add to it

so that a product runs through memory once, in order, with its sums in registers; memory is what limits it. So a later
stage multiplies two windows at a time: reading a filter once, it adds to the mix of the window at work all partitions,
and to that of the next one (`next_mix`) all but the first, whose input is not there yet. Sources take turns, even ones
in one window and odd ones in the other, and exchange their IRs on theirs.

A stage other than the first works on a window while the next one fills: its sources' transforms, their products, and
the inverse transforms are a list of jobs with estimated costs, of which every block does its share.
"""

import numpy as np
import numpy.typing as npt
from numba import carray

from server.acoustics.simd import add, broadcast, load, load_int, multiply_add, pointer, store
from server.compiled import compiled
from server.rendering import products, right_angle
from server.rendering.convolver_records import CONVOLVER, STAGE

_CHUNK_NS = 2500
"""A list of products is cut into jobs of about this length."""


@compiled
def _ints(address: int, count: int):
    return carray(pointer(address), (count,), np.int64)


@compiled
def _floats(address: int, count: int):
    return carray(pointer(address), (count,), np.float32)


@compiled
def process_convolver(address: int) -> None:
    """Take in the block at `input` and leave the mix at `output`; `address` is that of a CONVOLVER record."""
    convolver = carray(pointer(address), (1,), CONVOLVER)[0]
    stages = carray(pointer(convolver.stage), (convolver.stages,), STAGE)
    _take_in(convolver)
    _head(convolver, stages[0])
    for number in range(1, convolver.stages):
        _tick(convolver, stages[number])
    convolver.blocks += 1


@compiled
def process_block(address: int, blocks: npt.NDArray[np.float32], output: npt.NDArray[np.float32]) -> bool:
    """`process_convolver` of one block (source, block_size), its mix left in `output` (channel, block_size). False, and
    nothing done, for other shapes."""
    convolver = carray(pointer(address), (1,), CONVOLVER)[0]
    taken = (convolver.sources, convolver.block_size)
    made = (convolver.channels, convolver.block_size)
    if blocks.shape != taken or output.shape != made:
        return False
    samples = carray(pointer(convolver.input), taken, np.float32)
    samples[:] = blocks
    process_convolver(address)
    output[:] = carray(pointer(convolver.output), made, np.float32)
    return True


@compiled
def _take_in(convolver) -> None:
    """Write what sounds into the histories."""
    size = convolver.block_size
    place = (convolver.blocks % convolver.history_blocks) * size
    silent = _ints(convolver.silent, convolver.sources)
    wanted = _ints(convolver.wanted, convolver.sources)
    any_sounds = False
    for source in range(convolver.sources):
        samples = _floats(convolver.input + 4 * source * size, size)
        is_fed = False
        for n in range(size):
            is_fed |= samples[n] != 0
        silent[source] = 0 if is_fed else silent[source] + 1
        if wanted[source] == 0 or silent[source] >= convolver.quiet_blocks:
            continue
        any_sounds = True
        history = convolver.history + 4 * (source * convolver.history_blocks * size + place)
        for n in range(0, size, 8):
            store(history, n, load(convolver.input, source * size + n))
    if convolver.has_shared_tail:
        _take_in_tail(convolver, place, any_sounds)


@compiled
def _take_in_tail(convolver, place, any_sounds) -> None:
    size = convolver.block_size
    tail_silent = _ints(convolver.tail_silent, 1)
    tail_silent[0] = 0 if any_sounds else tail_silent[0] + 1
    if tail_silent[0] >= convolver.quiet_blocks:
        return
    silent = _ints(convolver.silent, convolver.sources)
    wanted = _ints(convolver.wanted, convolver.sources)
    gains = _floats(convolver.tail_gain, 2 * convolver.sources)
    history = convolver.tail_history + 4 * place
    for n in range(0, size, 8):
        store(history, n, broadcast(np.float32(0)))
    for source in range(convolver.sources):
        if wanted[source] == 0 or silent[source] >= convolver.quiet_blocks:
            continue
        start = broadcast(gains[source])
        change = broadcast(gains[convolver.sources + source] - gains[source])
        for n in range(0, size, 8):
            gain = multiply_add(change, load(convolver.fade_in, n), start)
            store(history, n, multiply_add(gain, load(convolver.input, source * size + n), load(history, n)))
        gains[source] = gains[convolver.sources + source]


@compiled
def _head(convolver, stage) -> None:
    """The first stage: all at once, for the newest block."""
    size, channels = stage.size, convolver.channels
    _begin(convolver, stage, convolver.blocks)
    exchanged = _ints(convolver.exchanged, convolver.sources)
    exchanged[:] = 0
    job_source, job_old = _ints(stage.job_source, stage.sources), _ints(stage.job_old, stage.sources)
    for job in range(stage.jobs):
        exchanged[job_source[job]] = job_old[job] != 0
        _transform(convolver, stage, job)
        _multiply(convolver, stage, job, np.int64(0), size // 8)
    for channel in range(channels):
        if stage.jobs == 0:
            for n in range(0, size, 8):
                store(convolver.output, channel * size + n, broadcast(np.float32(0)))
        else:
            _synthesise(convolver, stage, channel, convolver.output + 4 * channel * size)


@compiled
def _tick(convolver, stage) -> None:
    """A later stage: hear the window made before, do a share of the work, and begin anew where a window is full."""
    tick = convolver.blocks % stage.ticks
    size = convolver.block_size
    if stage.is_heard:
        heard = stage.output + 4 * (stage.heard * convolver.channels * stage.size + tick * size)
        for channel in range(convolver.channels):
            for n in range(0, size, 8):
                part = load(heard, channel * stage.size + n)
                store(convolver.output, channel * size + n, add(load(convolver.output, channel * size + n), part))
    _work(convolver, stage, stage.cost * (tick + 1) // stage.ticks)
    if tick == stage.ticks - 1:
        stage.heard = 1 - stage.heard
        stage.is_heard = stage.is_made
        _begin(convolver, stage, convolver.blocks // stage.ticks)
        stage.is_made = stage.jobs > 0


@compiled
def _begin(convolver, stage, window) -> None:
    """List the jobs of a window that is full, and put into effect the filters wanted by now."""
    is_mix_begun = stage.number > 0 and stage.first_pair < stage.jobs
    stage.mix, stage.next_mix = stage.next_mix, stage.mix
    stage.window = window
    stage.newest = (stage.newest if stage.newest > 0 else stage.partitions) - 1
    wanted, silent = _ints(stage.wanted, stage.sources), _ints(stage.silent, stage.sources)
    current = _ints(stage.current, stage.sources)
    job_source = _ints(stage.job_source, stage.sources)
    job_old, job_new = _ints(stage.job_old, stage.sources), _ints(stage.job_new, stage.sources)
    stage.first_pair = stage.sources
    stage.fades, stage.cost = 0, 0
    jobs = 0
    for source in range(stage.sources):
        old, new = current[source], wanted[source]
        if old != 0 and new != 0 and not _has_turn(stage, source):
            new = old
        current[source] = new
        if new == 0 or silent[source] >= convolver.quiet_blocks:
            continue
        is_fading = old != 0 and old != new
        job_source[jobs], job_new[jobs] = source, new
        job_old[jobs] = old if is_fading else 0
        stage.fades += is_fading
        if stage.number > 0 and _has_turn(stage, source):
            stage.first_pair = min(stage.first_pair, jobs)
        stage.cost += _transform_ns(stage.size) + _product_ns(stage, source, is_fading) * (stage.size // 8)
        jobs += 1
    if stage.fades > 0:
        for n in range(0, 2 * convolver.channels * stage.size, 8):
            store(stage.surplus, n, broadcast(np.float32(0)))
    stage.jobs, stage.is_mix_begun = jobs, is_mix_begun
    stage.cursor, stage.step, stage.cost_done = 0, 0, 0
    if jobs > 0:
        stage.cost += convolver.channels * (2 if stage.fades > 0 else 1) * _transform_ns(stage.size)


@compiled
def _has_turn(stage, source) -> bool:
    """Whether this is the window in which a source is multiplied for two, and may exchange its IR."""
    return stage.number == 0 or (stage.window + source) % 2 == 0


@compiled
def _transform_ns(size) -> int:
    """About what a transform takes; only proportions matter."""
    return size + size // 4


@compiled
def _product_ns(stage, source, is_fading) -> int:
    """About what the products of one tile take."""
    partitions = stage.partitions if _has_turn(stage, source) else 1
    return 6 * (3 * partitions if is_fading else partitions)


@compiled
def _work(convolver, stage, until) -> None:
    """Do jobs in order until the cost of those done reaches `until`, or all are: a source cleared meanwhile costs less
    than was counted on."""
    jobs_and_inverses = stage.jobs + convolver.channels
    tiles = stage.size // 8
    job_source, job_old = _ints(stage.job_source, stage.sources), _ints(stage.job_old, stage.sources)
    while stage.cost_done < until and stage.cursor < jobs_and_inverses:
        if stage.cursor < stage.jobs:
            job = stage.cursor
            if stage.step == 0:
                _transform(convolver, stage, job)
                stage.step = 1
                stage.cost_done += _transform_ns(stage.size)
                continue
            weight = _product_ns(stage, job_source[job], job_old[job] != 0)
            first = stage.step - 1
            last = min(tiles, first + max(1, _CHUNK_NS // weight))
            _multiply(convolver, stage, job, first, last)
            stage.cost_done += (last - first) * weight
            if last == tiles:
                stage.cursor += 1
                stage.step = 0
            else:
                stage.step = last + 1
        else:
            channel = stage.cursor - stage.jobs
            made = stage.output + 4 * ((1 - stage.heard) * convolver.channels + channel) * stage.size
            _synthesise(convolver, stage, channel, made)
            stage.cursor += 1
            stage.cost_done += (2 if stage.fades > 0 else 1) * _transform_ns(stage.size)


@compiled
def _transform(convolver, stage, job) -> None:
    """The spectrum of a source's window, into its newest slot."""
    source = _ints(stage.job_source, stage.sources)[job]
    size, span = stage.size, convolver.history_blocks * convolver.block_size
    history = stage.history + 4 * source * span
    second = (stage.window * size) % span
    first = (second - size) % span
    scratch = convolver.scratch
    right_angle.forward(
        history + 4 * first, history + 4 * second, scratch, size, stage.twist, stage.passes, stage.lanes
    )
    spectra = stage.spectra + 4 * (source * 2 * size * stage.partitions + 16 * stage.newest)
    for tile in range(size // 8):
        store(spectra, tile * stage.partitions * 16, load(scratch, 8 * tile))
        store(spectra, tile * stage.partitions * 16 + 8, load(scratch, size + 8 * tile))


@compiled
def _multiply(convolver, stage, job, first, last) -> None:
    """Add the products of a source's spectra and filter, tiles `first` to `last`, to the mix."""
    source = _ints(stage.job_source, stage.sources)[job]
    old, new = _ints(stage.job_old, stage.sources)[job], _ints(stage.job_new, stage.sources)[job]
    spectra = stage.spectra + 4 * source * 2 * stage.size * stage.partitions
    header = 3 * stage.number
    count = load_int(new, header + 1) if new != 0 else 0
    is_first = job == 0 and not stage.is_mix_begun
    if stage.number > 0 and _has_turn(stage, source):
        filters = load_int(new, header) if new != 0 else 0
        products.accumulate_pair(
            stage, convolver.channels, filters, count, spectra, first, last, is_first, job == stage.first_pair
        )
    else:
        end = count if stage.number == 0 else min(1, count)
        products.accumulate(
            stage, convolver.channels, new, spectra, stage.mix, 0, end, first, last, np.float32(1), is_first
        )
    if old == 0 or new == 0:
        return
    begin, end = _changed(old, new, header)
    if begin < end:
        until = min(end, load_int(old, header + 1))
        products.accumulate(
            stage, convolver.channels, old, spectra, stage.surplus, begin, until, first, last, np.float32(1), False
        )
        until = min(end, count)
        products.accumulate(
            stage, convolver.channels, new, spectra, stage.surplus, begin, until, first, last, np.float32(-1), False
        )


@compiled
def _changed(old: int, new: int, header: int):
    """The first partition in which two filters differ, and the one after the last."""
    old_count, new_count = load_int(old, header + 1), load_int(new, header + 1)
    old_digests, new_digests = load_int(old, header + 2), load_int(new, header + 2)
    both, most = min(old_count, new_count), max(old_count, new_count)
    begin, end = most, most if old_count != new_count else 0
    for p in range(both):
        if load_int(old_digests, p) != load_int(new_digests, p):
            begin = min(begin, p)
            end = max(end, p + 1)
    return min(begin, both) if old_count != new_count else begin, end


@compiled
def _synthesise(convolver, stage, channel, out) -> None:
    """The samples of a channel at `out` (size,), faded from the filters before where any were exchanged."""
    size = stage.size
    bins = stage.mix + 4 * channel * 2 * size
    right_angle.inverse(bins, out, size, stage.twist, stage.passes, stage.lanes)
    if stage.fades > 0:
        surplus = stage.surplus + 4 * channel * 2 * size
        right_angle.inverse(surplus, convolver.scratch, size, stage.twist, stage.passes, stage.lanes)
        for n in range(0, size, 8):
            faded = multiply_add(load(convolver.scratch, n), load(stage.fade_out, n), load(out, n))
            store(out, n, faded)
