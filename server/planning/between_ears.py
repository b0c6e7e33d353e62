"""How far apart in time and level sound from aside is at the two ears of a head: a sphere."""

import numpy as np

LATERAL_ILD_DB = 6.0
"""Between the ears for sound from straight aside, over all frequencies; a head's shadow is deeper at high ones."""
_HEAD_RADIUS_M = 0.0875


def delay_s(aside: float, speed_of_sound: float) -> float:
    """Woodworth's sphere: `aside` is the sine of the angle off the median plane."""
    return _HEAD_RADIUS_M / speed_of_sound * (float(np.arcsin(min(aside, 1.0))) + aside)
