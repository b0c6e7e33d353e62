"""Copies between arrays in compiled code.

An assignment of one slice to another makes numba compile the text of an error for lengths that differ, with all that
formats numbers: two seconds in each function with such an assignment.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from server.kernels.compiled import compiled_in_place


@compiled_in_place
def copy(samples: Any, to: Any) -> None:
    """Copy an array to the beginning of another, which is at least as long."""
    for i in range(samples.size):
        to[i] = samples[i]


def doubles(values: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """A copy in the one layout that compiled code is asked for. What is read-only or lies otherwise, it would be
    compiled for once more: seconds, in the midst of a stream if a pose came so."""
    return np.array(values, dtype=np.float64, order="C")
