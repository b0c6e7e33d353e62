"""When sound arrives at poses, in samples of a response, in compiled code."""

import math

import numpy as np
import numpy.typing as npt

from server.kernels.compiled import compiled

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

_NEVER = 2.0**31
"""Samples: larger than any index of a response."""
_EAR_AHEAD_S = 0.00026
"""Seconds: the nearer ear is 87.5 mm from the middle of the head, so sound reaches it at most this much earlier."""


@compiled
def find_times(
    length_m: Floats,
    echo_m: Floats,
    speed_of_sound: float,
    sample_rate: float,
    coded_lead: int,
    lead: int,
    aligned: Floats,
    onsets: Indices,
    echoes: Indices,
) -> bool:
    """Fill `aligned` (B,), the sample on which the first coded one lies, `coded_lead` samples before the sound that
    takes a way of `length_m` (B,); `onsets` (B,), from which sound is let through, `lead` samples after that; and, if
    `echo_m` (B,) are lengths of reflected ways and not empty, `echoes` (B,), by which one can have arrived. Returns
    whether all ways come to an end."""
    for row in range(length_m.size):
        aligned[row] = length_m[row] / speed_of_sound * sample_rate - coded_lead
        if not aligned[row] < _NEVER:
            return False
        onsets[row] = math.floor(aligned[row]) + lead
        if echo_m.size > 0:
            echoes[row] = math.floor((echo_m[row] / speed_of_sound - _EAR_AHEAD_S) * sample_rate)
    return True
