"""Conversion of single to half precision with IEEE 754 rounding (to nearest, ties to even).

NumPy's own conversion takes tens of nanoseconds for each subnormal number. The ends of decays consist of such numbers,
and their conversion would take longer than their simulation.
"""

from typing import Any

import numba
import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

_EXPONENT_SHIFT = np.uint32((127 - 15) << 23)
_SMALLEST_NORMAL = np.uint32((127 - 14) << 23)
_BEYOND_LARGEST = np.uint32((127 + 16) << 23)
_INFINITE = np.uint32(0x7F800000)
# Adding this aligns the last bit of a single with that of a subnormal half.
_ALIGNING = np.float32(0.5)
_ALIGNING_BITS = _ALIGNING.view(np.uint32)


def to_half(values: npt.NDArray[np.float32]) -> npt.NDArray[np.float16]:
    """Return the same numbers as `values.astype(np.float16)`, but numbers that are too large become infinite without a
    warning."""
    single = np.ascontiguousarray(values, dtype=np.float32)
    half = np.empty(single.shape, dtype=np.float16)
    _round(single.reshape(-1), half.reshape(-1).view(np.uint16))
    return half


@intrinsic
def _bits(_context: Any, _value: Any) -> Any:
    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], ir.IntType(32))

    return types.uint32(types.float32), generate


@numba.njit(cache=True, nogil=True)
def _round(values, half):
    for index in range(len(values)):
        magnitude = abs(values[index])
        size, sign = _bits(magnitude), (_bits(values[index]) >> np.uint32(16)) & np.uint32(0x8000)
        # Rounds up beyond the middle, or at the middle if the last remaining bit is odd.
        rounded = (size - _EXPONENT_SHIFT + np.uint32(0xFFF) + ((size >> np.uint32(13)) & np.uint32(1))) >> np.uint32(
            13
        )
        if size < _SMALLEST_NORMAL:
            rounded = _bits(magnitude + _ALIGNING) - _ALIGNING_BITS
        if size >= _BEYOND_LARGEST:
            rounded = np.uint32(0x7C00)
        if size > _INFINITE:
            rounded = np.uint32(0x7E00)
        half[index] = np.uint16(sign | rounded)
