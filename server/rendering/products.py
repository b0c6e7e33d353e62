"""The innermost loops of the compiled convolver: products of spectra and filters, summed over partitions.

`stage` is a STAGE record, and layouts are as in `server.rendering.convolver_kernel`. Sums stay in registers: one pass
over the partitions per tile of eight bins, in the order in which filter and spectra lie in memory.
"""

import numpy as np

from server.acoustics.simd import broadcast, load, load_int, multiply, multiply_add, multiply_subtract, store
from server.compiled import compiled


@compiled
def accumulate(stage, channels, filters, spectra, mix, begin, end, first, last, sign, is_first) -> None:
    """Add partitions `begin` to `end`, times `sign`, to a mix; `is_first` starts from zero, not from what is there."""
    address = load_int(filters, 3 * stage.number) if filters != 0 else 0
    stride = load_int(filters, 3 * stage.number + 1) if filters != 0 else 0
    if channels == 2:
        _accumulate_two(stage, address, stride, spectra, mix, begin, end, first, last, sign, is_first)
    else:
        _accumulate_one(stage, address, stride, spectra, mix, begin, end, first, last, sign, is_first)


@compiled
def _accumulate_two(stage, filters, stride, spectra, mix, begin, end, first, last, sign, is_first) -> None:
    size, slots = stage.size, stage.partitions
    zero, factor = broadcast(np.float32(0)), broadcast(sign)
    start = stage.newest + begin
    if start >= slots:
        start -= slots
    for tile in range(first, last):
        at = 8 * tile
        lr, li, rr, ri = zero, zero, zero, zero
        if not is_first:
            lr, li = load(mix, at), load(mix, size + at)
            rr, ri = load(mix, 2 * size + at), load(mix, 3 * size + at)
        slot = start
        h = 32 * (tile * stride + begin)
        for _ in range(begin, end):
            x = 16 * (tile * slots + slot)
            xr, xi = multiply(load(spectra, x), factor), multiply(load(spectra, x + 8), factor)
            hr, hi = load(filters, h), load(filters, h + 8)
            gr, gi = load(filters, h + 16), load(filters, h + 24)
            lr, li = multiply_add(xr, hr, lr), multiply_add(xr, hi, li)
            rr, ri = multiply_add(xr, gr, rr), multiply_add(xr, gi, ri)
            lr, li = multiply_subtract(xi, hi, lr), multiply_add(xi, hr, li)
            rr, ri = multiply_subtract(xi, gi, rr), multiply_add(xi, gr, ri)
            h += 32
            slot += 1
            if slot == slots:
                slot = 0
        store(mix, at, lr)
        store(mix, size + at, li)
        store(mix, 2 * size + at, rr)
        store(mix, 3 * size + at, ri)


@compiled
def _accumulate_one(stage, filters, stride, spectra, mix, begin, end, first, last, sign, is_first) -> None:
    size, slots = stage.size, stage.partitions
    zero, factor = broadcast(np.float32(0)), broadcast(sign)
    start = stage.newest + begin
    if start >= slots:
        start -= slots
    for tile in range(first, last):
        at = 8 * tile
        re, im = zero, zero
        if not is_first:
            re, im = load(mix, at), load(mix, size + at)
        slot = start
        h = 16 * (tile * stride + begin)
        for _ in range(begin, end):
            x = 16 * (tile * slots + slot)
            xr, xi = multiply(load(spectra, x), factor), multiply(load(spectra, x + 8), factor)
            hr, hi = load(filters, h), load(filters, h + 8)
            re, im = multiply_add(xr, hr, re), multiply_add(xr, hi, im)
            re, im = multiply_subtract(xi, hi, re), multiply_add(xi, hr, im)
            h += 16
            slot += 1
            if slot == slots:
                slot = 0
        store(mix, at, re)
        store(mix, size + at, im)


@compiled
def accumulate_pair(stage, channels, filters, stride, spectra, first, last, is_first, is_first_pair) -> None:
    """All partitions into `mix`, and from the second on, with input one window older, into `next_mix`."""
    if channels == 2:
        _accumulate_pair_two(stage, filters, stride, spectra, first, last, is_first, is_first_pair)
    else:
        _accumulate_pair_one(stage, filters, stride, spectra, first, last, is_first, is_first_pair)


@compiled
def _accumulate_pair_two(stage, filters, stride, spectra, first, last, is_first, is_first_pair) -> None:
    size, slots, mix, next_mix = stage.size, stage.partitions, stage.mix, stage.next_mix
    zero = broadcast(np.float32(0))
    for tile in range(first, last):
        at = 8 * tile
        lr, li, rr, ri = zero, zero, zero, zero
        next_lr, next_li, next_rr, next_ri = zero, zero, zero, zero
        if not is_first:
            lr, li = load(mix, at), load(mix, size + at)
            rr, ri = load(mix, 2 * size + at), load(mix, 3 * size + at)
        if not is_first_pair:
            next_lr, next_li = load(next_mix, at), load(next_mix, size + at)
            next_rr, next_ri = load(next_mix, 2 * size + at), load(next_mix, 3 * size + at)
        slot = stage.newest
        h = 32 * tile * stride
        newer_r, newer_i = zero, zero
        for _ in range(stride):
            x = 16 * (tile * slots + slot)
            xr, xi = load(spectra, x), load(spectra, x + 8)
            hr, hi = load(filters, h), load(filters, h + 8)
            lr, li = multiply_add(xr, hr, lr), multiply_add(xr, hi, li)
            next_lr, next_li = multiply_add(newer_r, hr, next_lr), multiply_add(newer_r, hi, next_li)
            lr, li = multiply_subtract(xi, hi, lr), multiply_add(xi, hr, li)
            next_lr, next_li = multiply_subtract(newer_i, hi, next_lr), multiply_add(newer_i, hr, next_li)
            hr, hi = load(filters, h + 16), load(filters, h + 24)
            rr, ri = multiply_add(xr, hr, rr), multiply_add(xr, hi, ri)
            next_rr, next_ri = multiply_add(newer_r, hr, next_rr), multiply_add(newer_r, hi, next_ri)
            rr, ri = multiply_subtract(xi, hi, rr), multiply_add(xi, hr, ri)
            next_rr, next_ri = multiply_subtract(newer_i, hi, next_rr), multiply_add(newer_i, hr, next_ri)
            newer_r, newer_i = xr, xi
            h += 32
            slot += 1
            if slot == slots:
                slot = 0
        store(mix, at, lr)
        store(mix, size + at, li)
        store(mix, 2 * size + at, rr)
        store(mix, 3 * size + at, ri)
        store(next_mix, at, next_lr)
        store(next_mix, size + at, next_li)
        store(next_mix, 2 * size + at, next_rr)
        store(next_mix, 3 * size + at, next_ri)


@compiled
def _accumulate_pair_one(stage, filters, stride, spectra, first, last, is_first, is_first_pair) -> None:
    size, slots, mix, next_mix = stage.size, stage.partitions, stage.mix, stage.next_mix
    zero = broadcast(np.float32(0))
    for tile in range(first, last):
        at = 8 * tile
        re, im, next_re, next_im = zero, zero, zero, zero
        if not is_first:
            re, im = load(mix, at), load(mix, size + at)
        if not is_first_pair:
            next_re, next_im = load(next_mix, at), load(next_mix, size + at)
        slot = stage.newest
        h = 16 * tile * stride
        newer_r, newer_i = zero, zero
        for _ in range(stride):
            x = 16 * (tile * slots + slot)
            xr, xi = load(spectra, x), load(spectra, x + 8)
            hr, hi = load(filters, h), load(filters, h + 8)
            re, im = multiply_add(xr, hr, re), multiply_add(xr, hi, im)
            next_re, next_im = multiply_add(newer_r, hr, next_re), multiply_add(newer_r, hi, next_im)
            re, im = multiply_subtract(xi, hi, re), multiply_add(xi, hr, im)
            next_re, next_im = multiply_subtract(newer_i, hi, next_re), multiply_add(newer_i, hr, next_im)
            newer_r, newer_i = xr, xi
            h += 16
            slot += 1
            if slot == slots:
                slot = 0
        store(mix, at, re)
        store(mix, size + at, im)
        store(next_mix, at, next_re)
        store(next_mix, size + at, next_im)
