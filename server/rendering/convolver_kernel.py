"""The compiled convolver: all the work of a block, without allocation, locks or Python objects.

A convolver is a record of numbers and addresses (`CONVOLVER`), with one record per stage (`STAGE`).
`server.rendering.compiled_convolver` allocates every array once and keeps it. Bins are laid out in tiles of eight,
complex numbers as eight real parts followed by eight imaginary parts. Data that is read together is stored together:

    filter of a stage   near: (partition, tile, channel, part, 8), the first NEAR partitions;
                        far: (tile, partition, channel, part, 8), the other partitions
    ring of a stage     (source, slot, tile, part, 8)          spectra of windows, the newest first,
                                                               `multiply_accumulate.spectrum_stride` apart
    mix of a stage      (tile, channel, column, part, 8)       columns as in `server.rendering.multiply_accumulate`

Memory bandwidth limits the speed. Therefore each source has its turn in one window out of TURNS, and is then multiplied
for TURNS windows at once, so that its filter is read only once. The current window gets all partitions; the next window
gets all but the first, whose input is not known yet; and so on. In the windows between two turns only the newest
spectrum is left to multiply: by the first partition for the current window, and by the following partitions for the
windows up to the source's next turn.

The first stage exchanges an IR at once, and subtracts the products that were computed in advance with the old IR. Later
stages exchange it on the source's turn, when there are no such products.

A stage other than the first works on one window while the next one fills. The transforms of its sources, their products
and the inverse transforms form a list of jobs with estimated costs; every block does its share of them.
"""

import numpy as np
import numpy.typing as npt
from numba import carray

from server.kernels import odd_fft
from server.kernels.compiled import compiled
from server.kernels.copying import copy
from server.kernels.simd import add, broadcast, load, load_int, multiply_add, pointer, store
from server.rendering.convolver_records import CONVOLVER, STAGE
from server.rendering.multiply_accumulate import (
    GROUP,
    SURPLUS,
    add_newest,
    add_range,
    add_turn,
    enter_member,
    mix_offset,
    spectrum_stride,
)
from server.rendering.partitions import TURNS

_CHUNK_NS = 2500
"""About how long one job of products takes, in ns of estimated cost; a longer list of products is cut into several
jobs."""


@compiled
def _ints(address: int, count: int):
    return carray(pointer(address), (count,), np.int64)


@compiled
def _floats(address: int, count: int):
    return carray(pointer(address), (count,), np.float32)


@compiled
def process_convolver(address: int) -> None:
    """Convolve the block at `input` and write the mix to `output`; `address` is the address of a CONVOLVER record."""
    convolver = carray(pointer(address), (1,), CONVOLVER)[0]
    stages = carray(pointer(convolver.stage), (convolver.stages,), STAGE)
    _write_input(convolver)
    for number in range(1, convolver.stages):
        if stages[number].gain != 0:
            _take_in(convolver, stages[number])
    _head(convolver, stages[0])
    for number in range(1, convolver.stages):
        _tick(convolver, stages[number])
    convolver.blocks += 1


@compiled
def has_exchanged(address: int) -> bool:
    """Whether the head exchanged an IR in the last block."""
    convolver = carray(pointer(address), (1,), CONVOLVER)[0]
    exchanged = _ints(convolver.exchanged, convolver.sources)
    some = np.int64(0)
    for source in range(convolver.sources):
        some |= exchanged[source]
    return some != 0


@compiled
def process_block(address: int, blocks: npt.NDArray[np.float32], output: npt.NDArray[np.float32]) -> bool:
    """Call `process_convolver` for one block (source, block_size) and write its mix to `output` (channel, block_size).
    Returns False, and does nothing, for other shapes."""
    convolver = carray(pointer(address), (1,), CONVOLVER)[0]
    taken = (convolver.sources, convolver.block_size)
    made = (convolver.channels, convolver.block_size)
    if blocks.shape != taken or output.shape != made:
        return False
    samples = carray(pointer(convolver.input), taken, np.float32)
    for source in range(convolver.sources):
        copy(blocks[source], samples[source])
    process_convolver(address)
    mix = carray(pointer(convolver.output), made, np.float32)
    for channel in range(convolver.channels):
        copy(mix[channel], output[channel])
    return True


@compiled
def _write_input(convolver) -> None:
    """Write the block of every source that is not silent into its history."""
    size = convolver.block_size
    place = (convolver.blocks % convolver.history_blocks) * size
    silent = _ints(convolver.silent, convolver.sources)
    wanted = _ints(convolver.wanted, convolver.sources)
    for source in range(convolver.sources):
        samples = _floats(convolver.input + 4 * source * size, size)
        is_fed = False
        for n in range(size):
            is_fed |= samples[n] != 0
        silent[source] = 0 if is_fed else silent[source] + 1
        if wanted[source] == 0 or silent[source] >= convolver.quiet_blocks:
            continue
        history = convolver.history + 4 * (source * convolver.history_blocks * size + place)
        for n in range(0, size, 8):
            store(history, n, load(convolver.input, source * size + n))


@compiled
def _take_in(convolver, stage) -> None:
    """Write the inputs of a stage with a history of its own, at their gains. What a stage no longer takes in rings out
    in it; then it costs nothing."""
    size, span = convolver.block_size, convolver.history_blocks * convolver.block_size
    place = (convolver.blocks % convolver.history_blocks) * size
    heard, wanted = _ints(convolver.silent, convolver.sources), _ints(convolver.wanted, convolver.sources)
    silent = _ints(stage.silent, stage.sources)
    gains = _floats(stage.gain, 2 * convolver.sources)
    is_fed = False
    for source in range(convolver.sources):
        before, after = gains[source], gains[convolver.sources + source]
        is_heard = wanted[source] != 0 and heard[source] < convolver.quiet_blocks and (before != 0 or after != 0)
        history = stage.history + 4 * place
        if stage.is_mix:
            if is_heard and not is_fed:
                _clear_block(history, size)
            is_fed |= is_heard
        else:
            history += 4 * source * span
            silent[source] = 0 if is_heard and heard[source] == 0 else silent[source] + 1
            if silent[source] < convolver.quiet_blocks:
                _clear_block(history, size)
        if is_heard:
            start, change = broadcast(before), broadcast(after - before)
            for n in range(0, size, 8):
                gain = multiply_add(change, load(convolver.fade_in, n), start)
                store(history, n, multiply_add(gain, load(convolver.input, source * size + n), load(history, n)))
            gains[source] = after
    if stage.is_mix:
        silent[0] = 0 if is_fed else silent[0] + 1
        if not is_fed and silent[0] < convolver.quiet_blocks:
            _clear_block(stage.history + 4 * place, size)


@compiled
def _clear_block(address, size) -> None:
    for n in range(0, size, 8):
        store(address, n, broadcast(np.float32(0)))


@compiled
def _head(convolver, stage) -> None:
    """Do all the work of the first stage for the newest block."""
    size, channels = stage.size, convolver.channels
    _begin(convolver, stage, convolver.blocks)
    exchanged = _ints(convolver.exchanged, convolver.sources)
    exchanged[:] = 0
    job_source, job_old = _ints(stage.job_source, stage.sources), _ints(stage.job_old, stage.sources)
    job = 0
    while job < stage.jobs:
        end = _group_end(stage, job)
        for member in range(job, end):
            exchanged[job_source[member]] = job_old[member] != 0
            _transform(convolver, stage, member)
        _multiply(convolver, stage, job, end, np.int64(0), size // 8)
        job = end
    for channel in range(channels):
        if stage.jobs == 0:
            for n in range(0, size, 8):
                store(convolver.output, channel * size + n, broadcast(np.float32(0)))
        else:
            _synthesise(convolver, stage, channel, convolver.output + 4 * channel * size)


@compiled
def _tick(convolver, stage) -> None:
    """Run a later stage for one block: output a part of the previous window's result, do a share of the work on the
    current window, and start the next window when it is full."""
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
    """List the jobs of a full window, and switch to the filters that are wanted by now."""
    stage.window = window
    wanted, silent = _ints(stage.wanted, stage.sources), _ints(stage.silent, stage.sources)
    current = _ints(stage.current, stage.sources)
    job_source = _ints(stage.job_source, stage.sources)
    job_old, job_new = _ints(stage.job_old, stage.sources), _ints(stage.job_new, stage.sources)
    stage.fades, stage.cost = 0, 0
    jobs = 0
    for turn in range(TURNS):
        for source in range(turn, stage.sources, TURNS):
            old, new = current[source], wanted[source]
            if old != 0 and new != 0 and stage.number > 0 and _since_turn(stage, source) > 0:
                new = old
            current[source] = new
            if new == 0 or silent[source] >= convolver.quiet_blocks:
                continue
            is_fading = old != 0 and old != new
            job_source[jobs], job_new[jobs] = source, new
            job_old[jobs] = old if is_fading else 0
            stage.fades += is_fading
            stage.cost += _transform_ns(stage.size)
            stage.cost += _product_ns(convolver, stage, source, is_fading) * (stage.size // 8)
            jobs += 1
    stage.jobs = jobs
    stage.cursor, stage.step, stage.cost_done = 0, 0, 0
    if jobs > 0:
        stage.cost += convolver.channels * (2 if stage.fades > 0 else 1) * _transform_ns(stage.size)
    else:
        for channel in range(convolver.channels):
            _clear_column(convolver, stage, channel, window % TURNS)


@compiled
def _since_turn(stage, source) -> int:
    """How many windows ago the source had its turn, when it was multiplied for this window too; 0 if its turn is
    now."""
    return (stage.window + source) % TURNS


@compiled
def _transform_ns(size) -> int:
    """Estimated cost of one transform; only the proportions between costs matter."""
    return 2 * size


@compiled
def _product_ns(convolver, stage, source, is_fading) -> int:
    """Estimated cost of the products of one tile."""
    since = _since_turn(stage, source)
    pairs = (convolver.channels + 1) // 2
    ns = 10 * pairs * (stage.partitions if since == 0 else TURNS - since)
    return ns + 20 * pairs * stage.partitions if is_fading else ns


@compiled
def _work(convolver, stage, until) -> None:
    """Do jobs in order until their total cost reaches `until`, or until no job is left: a source that was cleared
    meanwhile costs less than estimated."""
    jobs_and_inverses = stage.jobs + convolver.channels
    tiles = stage.size // 8
    job_source, job_old = _ints(stage.job_source, stage.sources), _ints(stage.job_old, stage.sources)
    while stage.cost_done < until and stage.cursor < jobs_and_inverses:
        if stage.cursor < stage.jobs:
            job = stage.cursor
            end = _group_end(stage, job)
            if stage.step < end - job:
                _transform(convolver, stage, job + stage.step)
                stage.step += 1
                stage.cost_done += _transform_ns(stage.size)
                continue
            weight = 0
            for member in range(job, end):
                weight += _product_ns(convolver, stage, job_source[member], job_old[member] != 0)
            first = stage.step - (end - job)
            last = min(tiles, first + max(1, _CHUNK_NS // weight))
            _multiply(convolver, stage, job, end, first, last)
            stage.cost_done += (last - first) * weight
            if last == tiles:
                stage.cursor = end
                stage.step = 0
            else:
                stage.step = last + end - job
        else:
            channel = stage.cursor - stage.jobs
            made = stage.output + 4 * ((1 - stage.heard) * convolver.channels + channel) * stage.size
            _synthesise(convolver, stage, channel, made)
            stage.cursor += 1
            stage.cost_done += (2 if stage.fades > 0 else 1) * _transform_ns(stage.size)


@compiled
def _transform(convolver, stage, job) -> None:
    """Compute the spectrum of a source's window and store it as the newest in the source's ring."""
    source = _ints(stage.job_source, stage.sources)[job]
    size, span = stage.size, convolver.history_blocks * convolver.block_size
    history = stage.history + 4 * source * span
    second = (stage.window * size) % span
    first = (second - size) % span
    odd_fft.forward(
        history + 4 * first,
        history + 4 * second,
        convolver.scratch,
        _ring(stage, source) + 4 * spectrum_stride(size) * _newest(stage),
        16,
        8,
        size,
        stage.twist,
        stage.passes,
        stage.lanes,
    )


@compiled
def _group_end(stage, job) -> int:
    """Index after the last job of the group that begins at `job`. A group is at most GROUP jobs in a row whose sources
    have their turn in the same window; they are multiplied together."""
    job_source = _ints(stage.job_source, stage.sources)
    end = job + 1
    while end < min(stage.jobs, job + GROUP) and (job_source[end] - job_source[job]) % TURNS == 0:
        end += 1
    return end


@compiled
def _multiply(convolver, stage, job, end, first, last) -> None:
    """Multiply the spectra of a group by its filters, tiles `first` to `last`, and add the products to the mix."""
    channels = convolver.channels
    job_source = _ints(stage.job_source, stage.sources)
    job_old, job_new = _ints(stage.job_old, stage.sources), _ints(stage.job_new, stage.sources)
    since, newest = _since_turn(stage, job_source[job]), _newest(stage)
    for member in range(job, end):
        filters, count = _partitions(stage, job_new[member])
        enter_member(stage, member - job, filters, count, _ring(stage, job_source[member]))
    if since == 0:
        add_turn(stage, channels, end - job, newest, first, last)
    else:
        add_newest(stage, channels, end - job, newest, TURNS - since, first, last)
    for member in range(job, end):
        if job_old[member] != 0 and job_new[member] != 0:
            _exchange(stage, channels, job_source[member], job_old[member], job_new[member], first, last)


@compiled
def _exchange(stage, channels, source, old, new, first, last) -> None:
    """Add the difference between the old and the new filter's output to the SURPLUS column, and replace the old
    filter's products by the new one's in windows that were multiplied in advance."""
    since, ring, newest = _since_turn(stage, source), _ring(stage, source), _newest(stage)
    begin, end = _changed(old, new, 3 * stage.number)
    for sign, header in ((np.float32(1), old), (np.float32(-1), new)):
        filters, count = _partitions(stage, header)
        until, column = min(end, count), SURPLUS
        add_range(stage, channels, filters, count, ring, newest, begin, until, 0, column, first, last, sign)
        for ahead in range(TURNS - since if since > 0 else 0):
            known, column = max(begin, ahead + 1), (stage.window + ahead) % TURNS
            add_range(stage, channels, filters, count, ring, newest, known, until, ahead, column, first, last, -sign)


@compiled
def _ring(stage, source) -> int:
    """The address of a source's ring of spectra (slot, tile, part, 8)."""
    return stage.ring + 4 * spectrum_stride(stage.size) * stage.slots * source


@compiled
def _newest(stage) -> int:
    """The slot, the same in every ring, that holds the spectrum of the current window."""
    return -stage.window % stage.slots


@compiled
def _partitions(stage, header):
    """The address of a filter's spectra for a stage, and the number of its partitions; (0, 0) if `header` is 0."""
    if header == 0:
        return 0, 0
    return load_int(header, 3 * stage.number), load_int(header, 3 * stage.number + 1)


@compiled
def _changed(old: int, new: int, header: int):
    """The range of partitions in which two filters differ: its first index, and the index after its last."""
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
    """Write the samples of a channel to `out` (size,), crossfaded from the old filters if any were exchanged."""
    _invert_column(convolver, stage, channel, stage.window % TURNS, out)
    if stage.fades > 0:
        faded_from = convolver.scratch + 8 * stage.size
        _invert_column(convolver, stage, channel, SURPLUS, faded_from)
        for n in range(0, stage.size, 8):
            store(out, n, multiply_add(load(faded_from, n), load(stage.fade_out, n), load(out, n)))


@compiled
def _invert_column(convolver, stage, channel, column, out) -> None:
    """Transform one column of a channel's mix back into samples at `out` (size,), then zero the column for a later
    window."""
    mix = stage.mix + 4 * mix_offset(convolver.channels, 0, channel, column)
    step = mix_offset(convolver.channels, 1, 0, 0)
    odd_fft.inverse(mix, step, 8, convolver.scratch, out, stage.size, stage.twist, stage.passes, stage.lanes)
    _clear_column(convolver, stage, channel, column)


@compiled
def _clear_column(convolver, stage, channel, column) -> None:
    zero = broadcast(np.float32(0))
    for tile in range(stage.size // 8):
        at = mix_offset(convolver.channels, tile, channel, column)
        store(stage.mix, at, zero)
        store(stage.mix, at + 8, zero)
