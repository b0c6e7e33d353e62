"""The innermost loops of the compiled convolver: products of spectra and filters, summed over partitions.

Channels are computed in pairs, whose sums fit in registers; the last of an odd number is computed alone.

`stage` is a STAGE record; layouts are as in `server.rendering.convolver_kernel`. Memory bandwidth limits the speed.
Therefore memory is read in order and prefetched, in few streams at a time; a mix is read once for a group of sources,
and sums stay in registers.

Eight complex numbers are one vector of sixteen lanes, the real parts in its first half and the imaginary parts in the
second. A product then takes two steps: multiply by the real parts of one factor, repeated in both halves, and by its
imaginary parts, crosswise and with opposed signs. Such a vector is one register with AVX-512 and two elsewhere, where
registers are also fewer. There it is used only in loops that load more than they keep in registers. `add_turn`, which
keeps the most, works there on one channel at a time, with real and imaginary parts in vectors of their own. The results
are the same to the last bit.
"""

import numpy as np
from numba import carray

from server.kernels.cache_lines import LINE_BYTES
from server.kernels.compiled import compiled
from server.kernels.simd import (
    HAS_WIDE_REGISTERS,
    add,
    lanes,
    load_int,
    multiply,
    multiply_add,
    multiply_subtract,
    pointer,
    prefetch,
    store,
    swap_halves,
)
from server.rendering.partitions import NEAR, TURNS

_wide, _narrow = lanes(16), lanes(8)
_load_narrow, _broadcast_narrow = _narrow.load, _narrow.broadcast
load, broadcast, load_twice, load_opposed = _wide.load, _wide.broadcast, _wide.load_twice, _wide.load_opposed

COLUMNS = TURNS + 1
"""Columns of a mix: one for each window, by its number modulo TURNS, and one (SURPLUS) for what the old IRs of a
crossfade add to the current window."""
SURPLUS = TURNS
GROUP = 2
"""The most sources that are multiplied together. The mix is read once for all of them, while each reads a few streams
of its own; with four at a time the streams become too many, and it takes longer."""
_SPECTRUM_AHEAD, _FILTER_AHEAD = 6 * LINE_BYTES, 16 * LINE_BYTES


@compiled
def mix_offset(channels, tile, channel, column) -> int:
    """The index in a mix of a tile (eight bins) of one channel and column: of its real parts, which the imaginary parts
    follow."""
    return 16 * (COLUMNS * (channels * tile + channel) + column)


@compiled
def spectrum_stride(size) -> int:
    """Distance from one spectrum of a ring to the next: its length plus one cache line, because spectra a power of two
    apart would evict each other from a cache."""
    return 2 * size + 16


@compiled
def filter_offset(channels, tiles, count, tile, partition) -> int:
    """Index of a tile in a filter of `count` partitions: the real and imaginary parts of the first channel, followed by
    those of the others."""
    near = min(NEAR, count)
    if partition < near:
        return 16 * channels * (tiles * partition + tile)
    return 16 * channels * (tiles * near + tile * (count - near) + partition - near)


@compiled
def enter_member(stage, member, filters, count, ring) -> None:
    """Enter one source of the group that is multiplied next: the address of its filter, the number of the filter's
    partitions, and the address of its ring."""
    group = carray(pointer(stage.group), (GROUP, 3), np.int64)
    group[member, 0], group[member, 1], group[member, 2] = filters, count, ring


@compiled
def member_of(stage, member):
    """The values that `enter_member` stored: filter, number of partitions, ring."""
    at = 3 * member
    return load_int(stage.group, at), load_int(stage.group, at + 1), load_int(stage.group, at + 2)


@compiled
def _multiply_add(total, real, opposed, filters, h):
    """Return `total` plus the complex product of eight bins with the filter's values at index `h`."""
    taps = load(filters, h)
    return multiply_add(opposed, swap_halves(taps), multiply_add(real, taps, total))


@compiled
def _add_to(mix, at, sums) -> None:
    """Add a finished sum to the mix. Adding each product to a mix that is already large would lose more precision."""
    store(mix, at, add(load(mix, at), sums))


@compiled
def _fetch_filter(filters, h) -> None:
    """Prefetch the filter values for a few tiles ahead. A processor cannot follow this many streams by itself, and with
    many listeners all filters lie in main memory."""
    prefetch(filters + 4 * h + _FILTER_AHEAD)
    prefetch(filters + 4 * h + _FILTER_AHEAD + LINE_BYTES)


@compiled
def _step(near, tiles, channels, count, tile, partition) -> int:
    """Distance in a filter from a tile of a partition to the next tile of that partition."""
    if partition + 1 == near:
        return filter_offset(channels, tiles, count, tile, near) - filter_offset(channels, tiles, count, tile, near - 1)
    return 16 * channels * (tiles if partition + 1 < near else 1)


@compiled
def add_newest(stage, channels, members, newest, ahead, first, last) -> None:
    """Multiply the newest spectra of a group, in slot `newest` of their rings, by the first `ahead` partitions of their
    filters. The product with partition p is added to the mix of the window p after the current one."""
    mix, tiles, start = stage.mix, stage.size // 8, spectrum_stride(stage.size) * newest
    zero = broadcast(np.float32(0))
    for channel in range(0, channels, 2):
        is_pair = channel + 1 < channels
        for tile in range(first, last):
            x = start + 16 * tile
            for partition in range(ahead):
                h = 16 * (channels * (tiles * partition + tile) + channel)
                left = mix_offset(channels, tile, channel, (stage.window + partition) % TURNS)
                left_sum, right_sum = zero, zero
                for member in range(members):
                    filters, count, ring = member_of(stage, member)
                    if partition < count:
                        real, opposed = load_twice(ring, x), load_opposed(ring, x + 8)
                        _fetch_filter(filters, h)
                        left_sum = _multiply_add(left_sum, real, opposed, filters, h)
                        right_sum = _multiply_add(right_sum, real, opposed, filters, h + 16 * is_pair)
                if is_pair:
                    _add_to(mix, left + 16 * COLUMNS, right_sum)
                _add_to(mix, left, left_sum)


@compiled
def add_range(stage, channels, filters, count, ring, newest, begin, end, ahead, column, first, last, sign) -> None:
    """Multiply partitions `begin` to `end` of a filter by the spectra of the ring, and add the products, times `sign`,
    to a column of the mix. The column belongs to the window `ahead` of the one whose spectrum is in slot `newest`."""
    mix, tiles, slots, factor = stage.mix, stage.size // 8, stage.slots, broadcast(sign)
    spectrum = spectrum_stride(stage.size)
    zero = broadcast(np.float32(0))
    near = min(NEAR, count)
    start = (newest + begin - ahead) % slots
    for channel in range(0, channels, 2):
        is_pair = channel + 1 < channels
        for tile in range(first, last):
            left = mix_offset(channels, tile, channel, column)
            left_sum, right_sum = zero, zero
            slot = start
            h = filter_offset(channels, tiles, count, tile, begin) + 16 * channel
            for partition in range(begin, end):
                x = spectrum * slot + 16 * tile
                real, opposed = multiply(load_twice(ring, x), factor), multiply(load_opposed(ring, x + 8), factor)
                left_sum = _multiply_add(left_sum, real, opposed, filters, h)
                right_sum = _multiply_add(right_sum, real, opposed, filters, h + 16 * is_pair)
                h += _step(near, tiles, channels, count, tile, partition)
                slot = slot + 1 if slot + 1 < slots else 0
            _add_to(mix, left, left_sum)
            if is_pair:
                _add_to(mix, left + 16 * COLUMNS, right_sum)


@compiled
def add_turn(stage, channels, members, newest, first, last) -> None:
    """Multiply all partitions of a group's filters by the spectra in their rings, from slot `newest` on, and add the
    products to the mix of the current window. Also add the products that are known by now to the mixes of the next
    three windows: from the first, second and third partition on."""
    if HAS_WIDE_REGISTERS:
        for channel in range(0, channels, 2):
            _add_turn_of_pair(stage, channels, channel, members, newest, first, last)
    else:
        for channel in range(channels):
            _add_turn_of_channel(stage, channels, channel, members, newest, first, last)


@compiled
def _add_turn_of_channel(stage, channels, channel, members, newest, first, last) -> None:
    """Do the work of `add_turn` for one channel, in registers of eight lanes."""
    mix, tiles, slots = stage.mix, stage.size // 8, stage.slots
    spectrum = spectrum_stride(stage.size)
    zero = _broadcast_narrow(np.float32(0))
    for tile in range(first, last):
        a, b, c, d = zero, zero, zero, zero
        a_i, b_i, c_i, d_i = zero, zero, zero, zero
        for member in range(members):
            filters, count, ring = member_of(stage, member)
            near = min(NEAR, count)
            slot = newest
            h = 16 * (channels * tile + channel)
            # Where the spectra of the partition's own window are, and of the one, two and three windows after it.
            x, x_b, x_c, x_d = 0, 0, 0, 0
            for partition in range(count):
                x, x_b, x_c, x_d = spectrum * slot + 16 * tile, x, x_b, x_c
                prefetch(ring + 4 * x + _SPECTRUM_AHEAD)
                _fetch_filter(filters, h)
                real, imaginary = _load_narrow(filters, h), _load_narrow(filters, h + 8)
                a, a_i = _plus_product(a, a_i, ring, x, real, imaginary)
                if partition >= 1:
                    b, b_i = _plus_product(b, b_i, ring, x_b, real, imaginary)
                if partition >= 2:
                    c, c_i = _plus_product(c, c_i, ring, x_c, real, imaginary)
                if partition >= 3:
                    d, d_i = _plus_product(d, d_i, ring, x_d, real, imaginary)
                h += _step(near, tiles, channels, count, tile, partition)
                slot = slot + 1 if slot + 1 < slots else 0
        _add_parts(mix, mix_offset(channels, tile, channel, stage.window % TURNS), a, a_i)
        _add_parts(mix, mix_offset(channels, tile, channel, (stage.window + 1) % TURNS), b, b_i)
        _add_parts(mix, mix_offset(channels, tile, channel, (stage.window + 2) % TURNS), c, c_i)
        _add_parts(mix, mix_offset(channels, tile, channel, (stage.window + 3) % TURNS), d, d_i)


@compiled
def _plus_product(total, total_i, ring, x, real, imaginary):
    """Return the sums `total` and `total_i`, real and imaginary parts of eight bins, with a product added: the eight
    bins at index `x` of a ring times a filter's values `real` and `imaginary`."""
    x_r, x_i = _load_narrow(ring, x), _load_narrow(ring, x + 8)
    total = multiply_subtract(x_i, imaginary, multiply_add(x_r, real, total))
    total_i = multiply_add(x_i, real, multiply_add(x_r, imaginary, total_i))
    return total, total_i


@compiled
def _add_parts(mix, at, real, imaginary) -> None:
    store(mix, at, add(_load_narrow(mix, at), real))
    store(mix, at + 8, add(_load_narrow(mix, at + 8), imaginary))


@compiled
def _add_turn_of_pair(stage, channels, channel, members, newest, first, last) -> None:
    """Do the work of `add_turn` for a channel and the next, if there is one."""
    mix, tiles, slots = stage.mix, stage.size // 8, stage.slots
    spectrum = spectrum_stride(stage.size)
    is_pair = channel + 1 < channels
    other = 16 * COLUMNS  # distance from one channel of the mix to the other
    zero = broadcast(np.float32(0))
    for tile in range(first, last):
        a = mix_offset(channels, tile, channel, stage.window % TURNS)
        b = mix_offset(channels, tile, channel, (stage.window + 1) % TURNS)
        c = mix_offset(channels, tile, channel, (stage.window + 2) % TURNS)
        d = mix_offset(channels, tile, channel, (stage.window + 3) % TURNS)
        l_a, l_b, l_c, l_d = zero, zero, zero, zero
        r_a, r_b, r_c, r_d = zero, zero, zero, zero
        for member in range(members):
            filters, count, ring = member_of(stage, member)
            near = min(NEAR, count)
            real_b, real_c, real_d = zero, zero, zero
            opposed_b, opposed_c, opposed_d = zero, zero, zero
            slot = newest
            h = 16 * (channels * tile + channel)
            for partition in range(count):
                x = spectrum * slot + 16 * tile
                real_a, opposed_a = load_twice(ring, x), load_opposed(ring, x + 8)
                prefetch(ring + 4 * x + _SPECTRUM_AHEAD)
                _fetch_filter(filters, h)
                l_a = _multiply_add(l_a, real_a, opposed_a, filters, h)
                l_b = _multiply_add(l_b, real_b, opposed_b, filters, h)
                l_c = _multiply_add(l_c, real_c, opposed_c, filters, h)
                l_d = _multiply_add(l_d, real_d, opposed_d, filters, h)
                if is_pair:
                    r_a = _multiply_add(r_a, real_a, opposed_a, filters, h + 16)
                    r_b = _multiply_add(r_b, real_b, opposed_b, filters, h + 16)
                    r_c = _multiply_add(r_c, real_c, opposed_c, filters, h + 16)
                    r_d = _multiply_add(r_d, real_d, opposed_d, filters, h + 16)
                real_b, real_c, real_d = real_a, real_b, real_c
                opposed_b, opposed_c, opposed_d = opposed_a, opposed_b, opposed_c
                h += _step(near, tiles, channels, count, tile, partition)
                slot = slot + 1 if slot + 1 < slots else 0
        if is_pair:
            _add_to(mix, a + other, r_a)
            _add_to(mix, b + other, r_b)
            _add_to(mix, c + other, r_c)
            _add_to(mix, d + other, r_d)
        _add_to(mix, a, l_a)
        _add_to(mix, b, l_b)
        _add_to(mix, c, l_c)
        _add_to(mix, d, l_d)
