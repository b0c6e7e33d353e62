"""Arrays that begin on a cache line: vectors that cross the boundary of two lines take twice as long."""

import numpy as np
import numpy.typing as npt

Float32 = npt.NDArray[np.float32]

LINE_BYTES = 64


def zeros_on_lines(*lengths: int) -> Float32:
    """As `numpy.zeros`, but on a cache line; NumPy aligns to 16 bytes only. Memory pages are mapped when first written,
    so unused parts cost nothing."""
    size = int(np.prod(lengths))
    line = LINE_BYTES // np.float32().itemsize
    whole = np.zeros(size + line, dtype=np.float32)
    skipped = -whole.ctypes.data % LINE_BYTES // whole.itemsize
    return whole[skipped : skipped + size].reshape(lengths)


def on_lines(values: npt.NDArray[np.floating]) -> Float32:
    """A copy of an array that begins on a cache line."""
    copy = zeros_on_lines(*values.shape)
    copy[...] = values
    return copy
