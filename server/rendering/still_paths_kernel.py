"""Impulse responses of static paths, in compiled code.

The steps are those of one block of a direct path: delays and minimum-phase filters of head, air and surfaces, and the
windowed sinc. Letters: n taps, e ears.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

import server.rendering.path_loops as loops
from server.acoustics.geometry import axis_coordinates
from server.kernels.by_reference import Reference, value_of
from server.kernels.compiled import compiled
from server.kernels.copying import copy
from server.rendering.fractional_delay import BEFORE, PHASES, TAPS
from server.rendering.harmonics_kernel import write_harmonics
from server.rendering.sphere import cube_cell, find_triangle

FloatArray = npt.NDArray[np.float32]
DoubleArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

_axis_coordinates = compiled(axis_coordinates)


class StillPathTables(NamedTuple):
    """The tables that `add_still_paths` reads."""

    cepstra: FloatArray  # (direction, e, n)
    head_delays_s: DoubleArray  # (direction, e)
    triangles: IntArray
    across: IntArray
    inverses: DoubleArray
    by_cell: IntArray  # as `server.rendering.sphere.triangles_by_cell`
    band_cepstra: FloatArray  # (filter band, n) for a gain of one decibel
    orders: FloatArray  # (n,) 1, 1, 2, 3 ...
    reciprocals: FloatArray  # (n,) of `orders`
    sinc: FloatArray
    air_db_per_m: DoubleArray  # (filter band,) >= 0
    sample_rate: float
    speed_of_sound: float
    nearest_m: float


@compiled
def add_still_paths(
    reference: Reference,
    orientation: DoubleArray,
    lengths_m: DoubleArray,
    arrivals: DoubleArray,
    gains_db: DoubleArray,
    out: FloatArray,
) -> None:
    """Add to `out` (channel, sample) the responses of paths to a unit impulse at sample 0: lengths (path,), arrivals
    (path, 3), gains (path, octave band), at a head with this `orientation` (4,). Channels are the ears or, for one ear,
    also 4, 9 or 16 ambisonic ones. `reference` refers to StillPathTables."""
    tables = value_of(reference)
    to_head = np.array(_axis_coordinates(orientation[0], orientation[1], orientation[2], orientation[3])).reshape(3, 3)
    ears, count, bands = tables.cepstra.shape[1], tables.cepstra.shape[2], tables.band_cepstra.shape[0]
    wide = -(-(count + TAPS - 1) // loops.TILE) * loops.TILE
    cepstrum, sums = np.zeros((2, count + 8), np.float32), np.zeros((2, count + 8), np.float32)
    taps, padded = np.zeros((2, count), np.float32), np.zeros(wide + TAPS - 1, np.float32)
    still_taps, heard = np.zeros(TAPS, np.float32), np.zeros(wide, np.float32)
    directions, weights = np.zeros((lengths_m.size, 3)), np.zeros((lengths_m.size, 3))
    nearest = np.zeros((lengths_m.size, 3), np.int64)
    of_each = out.shape[0] // ears
    harmonics = np.ones(of_each)
    for path in range(lengths_m.size):
        for axis in range(3):
            for world in range(3):
                directions[path, axis] += to_head[axis, world] * arrivals[path, world]
        if ears == 2:
            _find_corners(tables, directions[path], weights[path], nearest[path])
    for path in range(lengths_m.size):
        length = lengths_m[path]
        shared = cepstrum[0, :count]
        shared[:] = 0
        for band in range(bands):
            level_db = gains_db[path, min(band, gains_db.shape[1] - 1)] - tables.air_db_per_m[band] * length
            loops.add_scaled(tables.band_cepstra[band], level_db, shared)
        copy(shared, cepstrum[1])
        for ear in range(ears):
            of_ear = cepstrum[ear, :count]
            if ears == 2:
                for corner in range(3):
                    loops.add_scaled(tables.cepstra[nearest[path, corner], ear], weights[path, corner], of_ear)
            for n in range(count):
                of_ear[n] *= tables.orders[n]
        loops.series_exponential(cepstrum, tables.reciprocals, sums, taps)
        if ears == 1:
            write_harmonics(directions[path], harmonics)
        gain = 1.0 / max(length, tables.nearest_m)
        for ear in range(ears):
            delay_s = length / tables.speed_of_sound
            if ears == 2:
                for corner in range(3):
                    delay_s += weights[path, corner] * tables.head_delays_s[nearest[path, corner], ear]
            delay = delay_s * tables.sample_rate
            whole = int(np.ceil(delay))
            phase = (whole - delay) * PHASES
            row = min(PHASES - 1, int(phase))
            loops.interpolate_reversed(tables.sinc[row], phase - row, still_taps)
            copy(taps[ear], padded[TAPS - 1 :])
            loops.filter_block(padded, still_taps, heard)
            begin = whole + BEFORE - (TAPS - 1)
            # Outside the reach of filter and sinc there are only zeros.
            for number in range(of_each):
                scale = np.float32(gain * harmonics[number])
                for i in range(max(0, -begin), min(count + TAPS - 1, out.shape[1] - begin)):
                    out[ear * of_each + number, begin + i] += scale * heard[i]


@compiled
def _find_corners(tables: StillPathTables, direction: DoubleArray, weights: DoubleArray, corners: IntArray) -> None:
    """Find the measured directions `corners` (3,) around a direction, and their `weights` (3,). What is measured there
    is fetched from memory while others are sought: a turned head hears from where it did not before."""
    start = tables.by_cell[cube_cell(direction)]
    triangle = find_triangle(tables.across, tables.inverses, direction, start, weights)
    for corner in range(3):
        measured = tables.triangles[triangle, corner]
        corners[corner] = measured
        for ear in range(2):
            loops.fetch(tables.cepstra[measured, ear], 0, tables.cepstra.shape[2])
