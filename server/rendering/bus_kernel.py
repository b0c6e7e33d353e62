"""One block of a listener's bus in compiled code: ambisonic channels are turned and decoded to two ears.

`server.rendering.bus` explains. All fields of the record are int64: numbers, and addresses of arrays that are kept
elsewhere. Letters: k channels, f bins of the filters, a power of two, b block size.
"""

import numpy as np
from numba import carray

from server.kernels import odd_fft
from server.kernels.compiled import compiled
from server.kernels.simd import (
    add,
    broadcast,
    load,
    multiply_add,
    multiply_subtract,
    pointer,
    store,
)

BUS = np.dtype(
    [
        (name, np.int64)
        for name in (
            "channels",
            "block_size",
            "bins",
            "rotation",  # (2, k, k) float32: in effect, and wanted
            "ramp",  # (b,) float32, rises in a straight line
            "window",  # (k, 2 f) float32: the newest samples of the turned channels
            "filters",  # (2, k, part, f) float32
            "spectrum",  # (part, f) float32
            "mix",  # (2, part, f) float32
            "scratch",  # (part, f) float32
            "heard",  # (f,) float32
            "twist",
            "passes",
            "lanes",
            "silent",  # samples in a row that were silent
            "quiet",  # samples of silence after which the bus has rung out
        )
    ]
)


@compiled
def decode_bus(bus, given: int, output: int) -> None:
    """Turn and decode the channels (k, b) at address `given`, 0 for silence, and add them to the ears (2, b) at
    `output`."""
    size, channels = bus.block_size, bus.channels
    if given == 0 or _is_silent(given, channels * size):
        bus.silent = min(bus.silent + size, bus.quiet)
    else:
        bus.silent = 0
    if bus.silent == bus.quiet:
        _settle(bus)
        return
    _turn(bus, given)
    _filter(bus)
    for ear in range(2):
        odd_fft.inverse(
            bus.mix + 8 * bus.bins * ear,
            8,
            bus.bins,
            bus.scratch,
            bus.heard,
            bus.bins,
            bus.twist,
            bus.passes,
            bus.lanes,
        )
        newest = bus.heard + 4 * (bus.bins - size)
        to = output + 4 * size * ear
        for n in range(0, size, 8):
            store(to, n, add(load(to, n), load(newest, n)))


@compiled
def _is_silent(address: int, count: int) -> bool:
    samples = carray(pointer(address), (count,), np.float32)
    some = False
    for n in range(count):
        some |= samples[n] != 0
    return not some


@compiled
def _settle(bus) -> None:
    """Forget the rest of a signal that has rung out, and take the wanted rotation at once."""
    window = carray(pointer(bus.window), (bus.channels * 2 * bus.bins,), np.float32)
    window[:] = 0
    rotation = carray(pointer(bus.rotation), (2, bus.channels * bus.channels), np.float32)
    rotation[0] = rotation[1]


@compiled
def _turn(bus, given) -> None:
    """Write the turned channels to the window. The matrix goes from that in effect to the wanted one in a straight
    line, so that blocks of a steady turn join without a ripple."""
    size, channels, span = bus.block_size, bus.channels, 2 * bus.bins
    rotation = carray(pointer(bus.rotation), (2, channels, channels), np.float32)
    zero = broadcast(np.float32(0))
    for channel in range(channels):
        row = bus.window + 4 * span * channel
        for n in range(0, span - size, 8):
            store(row, n, load(row, n + size))
        newest = row + 4 * (span - size)
        for n in range(0, size, 8):
            store(newest, n, zero)
        if given == 0:
            continue
        for other in range(channels):
            before, after = rotation[0, channel, other], rotation[1, channel, other]
            if before == 0 and after == 0:
                continue
            start, change = broadcast(before), broadcast(after - before)
            come = given + 4 * size * other
            for n in range(0, size, 8):
                gain = multiply_add(change, load(bus.ramp, n), start)
                store(newest, n, multiply_add(gain, load(come, n), load(newest, n)))
    rotation[0] = rotation[1]


@compiled
def _filter(bus) -> None:
    """Sum the spectra of all channels times the filters of each ear."""
    bins, channels, span = bus.bins, bus.channels, 2 * bus.bins
    zero = broadcast(np.float32(0))
    for n in range(0, 4 * bins, 8):
        store(bus.mix, n, zero)
    for channel in range(channels):
        row = bus.window + 4 * span * channel
        odd_fft.forward(row, row + 4 * bins, bus.scratch, bus.spectrum, 8, bins, bins, bus.twist, bus.passes, bus.lanes)
        for ear in range(2):
            x, y = bus.spectrum, bus.mix + 8 * bins * ear
            h = bus.filters + 8 * bins * (ear * channels + channel)
            for n in range(0, bins, 8):
                xr, xi, hr, hi = load(x, n), load(x, bins + n), load(h, n), load(h, bins + n)
                store(y, n, multiply_subtract(xi, hi, multiply_add(xr, hr, load(y, n))))
                store(y, bins + n, multiply_add(xi, hr, multiply_add(xr, hi, load(y, bins + n))))
