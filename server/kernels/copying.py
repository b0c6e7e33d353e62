"""Copies between arrays in compiled code.

An assignment of one slice to another makes numba compile the text of an error for lengths that differ, with all that
formats numbers: two seconds in each function with such an assignment.
"""

from typing import Any

from server.kernels.compiled import compiled_in_place


@compiled_in_place
def copy(samples: Any, to: Any) -> None:
    """Copy an array to the beginning of another, which is at least as long."""
    for i in range(samples.size):
        to[i] = samples[i]
