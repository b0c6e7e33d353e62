"""Differences in time and level between the two ears for sound from the side; the head is a sphere."""

import numpy as np

LATERAL_ILD_DB = 6.0
"""Interaural level difference of sound from straight to the side, over all frequencies; it is larger at high ones."""
_HEAD_RADIUS_M = 0.0875


def delay_s(aside: float, speed_of_sound: float) -> float:
    """Return the interaural time difference of Woodworth's sphere; `aside` is the sine of the angle from the median
    plane."""
    return _HEAD_RADIUS_M / speed_of_sound * (float(np.arcsin(min(aside, 1.0))) + aside)
