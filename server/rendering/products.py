"""The innermost loops of the compiled convolver: products of spectra and filters, summed over partitions.

`stage` is a STAGE record, and layouts are as in `server.rendering.convolver_kernel`. Memory is what limits them: it is
read in order and asked for ahead, by few streams at a time; a mix is read once for a group of sources, and sums stay in
registers.
"""

import numpy as np
from numba import carray

from server.acoustics.cache_lines import LINE_BYTES
from server.acoustics.simd import (
    broadcast,
    load,
    load_int,
    multiply,
    multiply_add,
    multiply_subtract,
    pointer,
    prefetch,
    store,
)
from server.compiled import compiled
from server.rendering.partitions import NEAR, TURNS

COLUMNS = TURNS + 1
"""Of a mix: windows, by their number modulo TURNS, and what the IRs that are faded from add to the one at work."""
SURPLUS = TURNS
GROUP = 2
"""Sources that are multiplied together at the most: the mix is read once for all of them, while each of them reads a
few streams of its own. Four at a time take longer: those are too many streams."""
_SPECTRUM_AHEAD, _FILTER_AHEAD = 6 * LINE_BYTES, 16 * LINE_BYTES


@compiled
def mixed(channels, tile, channel, column) -> int:
    """Where the real parts of a tile are in a mix; the imaginary ones follow."""
    return 16 * (COLUMNS * (channels * tile + channel) + column)


@compiled
def apart(size) -> int:
    """From a spectrum of a ring to the next: one line further than it is long, since lines a power of two apart would
    drive each other out of a cache."""
    return 2 * size + 16


@compiled
def packed(channels, tiles, count, tile, partition) -> int:
    """Where a tile is in a filter of `count` partitions: real and imaginary parts of the first channel, then of the
    second."""
    near = min(NEAR, count)
    if partition < near:
        return 16 * channels * (tiles * partition + tile)
    return 16 * channels * (tiles * near + tile * (count - near) + partition - near)


@compiled
def enter_member(stage, member, filters, count, ring) -> None:
    """Have a source be in the group that is multiplied next: the address of its filter, of how many partitions, and of
    its ring."""
    group = carray(pointer(stage.group), (GROUP, 3), np.int64)
    group[member, 0], group[member, 1], group[member, 2] = filters, count, ring


@compiled
def member_of(stage, member):
    """What was entered."""
    at = 3 * member
    return load_int(stage.group, at), load_int(stage.group, at + 1), load_int(stage.group, at + 2)


@compiled
def _multiply_add(re, im, xr, xi, filters, h):
    """The complex sum of `re` and `im`, and of the product of x and what is in a filter."""
    hr, hi = load(filters, h), load(filters, h + 8)
    re, im = multiply_add(xr, hr, re), multiply_add(xr, hi, im)
    return multiply_subtract(xi, hi, re), multiply_add(xi, hr, im)


@compiled
def _fetch_filter(filters, h) -> None:
    """Have what a few tiles on are multiplied by come near. There are more streams than a processor follows by
    itself, and with many listeners all of it lies in main memory."""
    prefetch(filters + 4 * h + _FILTER_AHEAD)
    prefetch(filters + 4 * h + _FILTER_AHEAD + LINE_BYTES)


@compiled
def _keep(mix, at, re, im) -> None:
    store(mix, at, re)
    store(mix, at + 8, im)


@compiled
def _step(near, tiles, channels, count, tile, partition) -> int:
    """From a tile of a partition to that of the next one."""
    if partition + 1 == near:
        return packed(channels, tiles, count, tile, near) - packed(channels, tiles, count, tile, near - 1)
    return 16 * channels * (tiles if partition + 1 < near else 1)


@compiled
def add_newest(stage, channels, members, newest, ahead, first, last) -> None:
    """Add the products of the newest spectra of a group, in slot `newest` of their rings, to the mix of the window at
    work, and of the `ahead` - 1 that follow it: with the first partition of their filters, the second and so on."""
    mix, tiles, start = stage.mix, stage.size // 8, apart(stage.size) * newest
    for tile in range(first, last):
        x = start + 16 * tile
        for partition in range(ahead):
            h = 16 * channels * (tiles * partition + tile)
            left = mixed(channels, tile, 0, (stage.window + partition) % TURNS)
            right = left + 16 * COLUMNS * (channels - 1)
            lr, li, rr, ri = load(mix, left), load(mix, left + 8), load(mix, right), load(mix, right + 8)
            for member in range(members):
                filters, count, ring = member_of(stage, member)
                if partition < count:
                    xr, xi = load(ring, x), load(ring, x + 8)
                    _fetch_filter(filters, h)
                    lr, li = _multiply_add(lr, li, xr, xi, filters, h)
                    rr, ri = _multiply_add(rr, ri, xr, xi, filters, h + 16 * (channels - 1))
            _keep(mix, right, rr, ri)
            _keep(mix, left, lr, li)


@compiled
def add_range(stage, channels, filters, count, ring, newest, begin, end, ahead, column, first, last, sign) -> None:
    """Add partitions `begin` to `end` of a filter, times `sign` and the spectra in the ring, to a column of the mix,
    which is that of a window `ahead` of the one whose spectrum is in slot `newest`."""
    mix, tiles, slots, factor = stage.mix, stage.size // 8, stage.slots, broadcast(sign)
    spectrum = apart(stage.size)
    near = min(NEAR, count)
    start = (newest + begin - ahead) % slots
    for tile in range(first, last):
        left, right = mixed(channels, tile, 0, column), mixed(channels, tile, channels - 1, column)
        lr, li, rr, ri = load(mix, left), load(mix, left + 8), load(mix, right), load(mix, right + 8)
        slot = start
        h = packed(channels, tiles, count, tile, begin)
        for partition in range(begin, end):
            x = spectrum * slot + 16 * tile
            xr, xi = multiply(load(ring, x), factor), multiply(load(ring, x + 8), factor)
            lr, li = _multiply_add(lr, li, xr, xi, filters, h)
            rr, ri = _multiply_add(rr, ri, xr, xi, filters, h + 16 * (channels - 1))
            h += _step(near, tiles, channels, count, tile, partition)
            slot = slot + 1 if slot + 1 < slots else 0
        _keep(mix, left, lr, li)
        _keep(mix, right, rr, ri)


@compiled
def add_turn(stage, channels, members, newest, first, last) -> None:
    """Add all partitions of a group's filters, times the spectra in their rings from slot `newest` on, to the mix of
    the window at work, and to those of the three that follow it what is known of them by now: from the first, second
    and third partition on."""
    mix, tiles, slots = stage.mix, stage.size // 8, stage.slots
    spectrum = apart(stage.size)
    other = 16 * COLUMNS * (channels - 1)  # from one channel to the other, which is the same if there is only one
    zero = broadcast(np.float32(0))
    for tile in range(first, last):
        a = mixed(channels, tile, 0, stage.window % TURNS)
        b = mixed(channels, tile, 0, (stage.window + 1) % TURNS)
        c = mixed(channels, tile, 0, (stage.window + 2) % TURNS)
        d = mixed(channels, tile, 0, (stage.window + 3) % TURNS)
        lr_a, li_a, lr_b, li_b = load(mix, a), load(mix, a + 8), load(mix, b), load(mix, b + 8)
        lr_c, li_c, lr_d, li_d = load(mix, c), load(mix, c + 8), load(mix, d), load(mix, d + 8)
        a, b, c, d = a + other, b + other, c + other, d + other
        rr_a, ri_a, rr_b, ri_b = load(mix, a), load(mix, a + 8), load(mix, b), load(mix, b + 8)
        rr_c, ri_c, rr_d, ri_d = load(mix, c), load(mix, c + 8), load(mix, d), load(mix, d + 8)
        for member in range(members):
            filters, count, ring = member_of(stage, member)
            near = min(NEAR, count)
            xr_b, xi_b, xr_c, xi_c, xr_d, xi_d = zero, zero, zero, zero, zero, zero
            slot = newest
            h = 16 * channels * tile
            for partition in range(count):
                x = spectrum * slot + 16 * tile
                xr_a, xi_a = load(ring, x), load(ring, x + 8)
                prefetch(ring + 4 * x + _SPECTRUM_AHEAD)
                _fetch_filter(filters, h)
                lr_a, li_a = _multiply_add(lr_a, li_a, xr_a, xi_a, filters, h)
                lr_b, li_b = _multiply_add(lr_b, li_b, xr_b, xi_b, filters, h)
                lr_c, li_c = _multiply_add(lr_c, li_c, xr_c, xi_c, filters, h)
                lr_d, li_d = _multiply_add(lr_d, li_d, xr_d, xi_d, filters, h)
                if channels == 2:
                    rr_a, ri_a = _multiply_add(rr_a, ri_a, xr_a, xi_a, filters, h + 16)
                    rr_b, ri_b = _multiply_add(rr_b, ri_b, xr_b, xi_b, filters, h + 16)
                    rr_c, ri_c = _multiply_add(rr_c, ri_c, xr_c, xi_c, filters, h + 16)
                    rr_d, ri_d = _multiply_add(rr_d, ri_d, xr_d, xi_d, filters, h + 16)
                xr_b, xi_b, xr_c, xi_c, xr_d, xi_d = xr_a, xi_a, xr_b, xi_b, xr_c, xi_c
                h += _step(near, tiles, channels, count, tile, partition)
                slot = slot + 1 if slot + 1 < slots else 0
        if channels == 2:
            _keep(mix, a, rr_a, ri_a)
            _keep(mix, b, rr_b, ri_b)
            _keep(mix, c, rr_c, ri_c)
            _keep(mix, d, rr_d, ri_d)
        a, b, c, d = a - other, b - other, c - other, d - other
        _keep(mix, a, lr_a, li_a)
        _keep(mix, b, lr_b, li_b)
        _keep(mix, c, lr_c, li_c)
        _keep(mix, d, lr_d, li_d)
