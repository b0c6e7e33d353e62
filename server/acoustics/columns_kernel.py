"""Conversion of a prediction from cells to frames, eight frames at a time as `decode` needs them. A cell is a group of
frames with one column of the prediction."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from server.acoustics.cells import Axis
from server.kernels.cache_lines import on_lines, zeros_on_lines
from server.kernels.compiled import compiled
from server.kernels.simd import LANES, broadcast, load, load_broadcast, multiply_add, store

Float32 = npt.NDArray[np.float32]

FEWEST = 3
"""The least number of columns that are read for eight frames, some with weight 0. Most cells are eight frames long, and
then three columns suffice."""
NOTHING = -1e30
"""Log magnitude where nothing is predicted."""


class Columns(NamedTuple):
    """The columns from which eight frames in a row are made, for each first frame from -8 on: `number` columns from
    `first` on, with `weights` (frame, most, 8). `nothing` (frame, 8) is the initial value of log magnitudes. All arrays
    are empty if every frame has its own column."""

    first: npt.NDArray[np.int64]
    number: npt.NDArray[np.int64]
    weights: Float32
    nothing: Float32

    @classmethod
    def of(cls, axis: Axis | None, used: int) -> "Columns":
        """The columns for the cells of an axis (at least FEWEST), of whose frames only the first `used` are used."""
        if axis is None:
            none = np.zeros(0, np.int64)
            return cls(none, none, zeros_on_lines(0, FEWEST, LANES), zeros_on_lines(0, LANES))
        spread = axis.spread()
        cells, frames = spread.shape
        of_frame = np.pad(spread[:, :used], ((0, 0), (LANES, LANES + frames - used)))
        windows = np.lib.stride_tricks.sliding_window_view(of_frame, LANES, axis=1).transpose(1, 0, 2)
        has_part = np.any(windows, axis=2)
        first = np.minimum(np.argmax(has_part, axis=1), cells - FEWEST)
        count = np.maximum(cells - np.argmax(has_part[:, ::-1], axis=1) - first, FEWEST)
        count[~np.any(has_part, axis=1)] = FEWEST
        weights = np.zeros((len(windows), int(count.max()), LANES))
        for window, weight, begin, columns in zip(windows, weights, first, count, strict=True):
            weight[:columns] = window[begin : begin + columns]
        nothing = np.where(np.any(windows, axis=1), 0.0, NOTHING)
        return cls(first.astype(np.int64), count.astype(np.int64), on_lines(weights), on_lines(nothing))


@compiled
def spread_columns(columns, j, log_magnitude, interaural, eight) -> None:
    """Write eight frames from frame `j` on to `eight` (4, bin, 8), from log magnitudes and coherences (2, bin,
    column)."""
    row = min(max(j + LANES, 0), columns.first.size - 1)
    nothing = load(columns.nothing[row].ctypes.data, 0)
    first, count, weights = columns.first[row], columns.number[row], columns.weights[row].ctypes.data
    _spread(log_magnitude, first, count, weights, nothing, eight[:2])
    _spread(interaural, first, count, weights, broadcast(np.float32(0.0)), eight[2:])


@compiled
def _spread(values, first, count, weights, begin, eight) -> None:
    bins, step = values.shape[1], values.strides[1] // values.itemsize
    w0, w1, w2 = load(weights, 0), load(weights, LANES), load(weights, 2 * LANES)
    for part in range(2):
        row, to = values[part].ctypes.data + values.itemsize * first, eight[part].ctypes.data
        for bin_ in range(bins):
            total = multiply_add(load_broadcast(row, 0), w0, begin)
            total = multiply_add(load_broadcast(row, 1), w1, total)
            total = multiply_add(load_broadcast(row, 2), w2, total)
            for number in range(FEWEST, count):
                total = multiply_add(load_broadcast(row, number), load(weights, number * LANES), total)
            store(to, bin_ * LANES, total)
            row += step * values.itemsize
