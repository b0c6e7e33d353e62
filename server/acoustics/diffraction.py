"""Loss of the direct sound by diffraction at an edge: the knife-edge law of Kurze and Anderson ("Sound attenuation by
barriers", Applied Acoustics 4, 1971), which follows Maekawa's measured chart.

Its argument is the Fresnel number N, the detour over the edge in half wavelengths, positive if the edge hides the
emitter. With x = sqrt(2 pi |N|) the loss is 5 + 20 log10(x / tanh x) dB in the shadow and 5 + 20 log10(x / tan x) dB in
sight. This is one smooth function of N: 5 dB where the sight line grazes the edge, and nothing below N = -0.19.

The loss comes on top of 1 / length over the bent path. Keller's ray round a half-plane, relative to that, is a function
of N to within 3 dB at all angles; relative to the straight line it is not.
"""

import math

from server.kernels.compiled import compiled

GRAZING_LOSS_DB = 5.0
# Below this Fresnel number an edge causes no loss: x / tan(x) = 10^(-5 / 20) at x = 1.0972.
CLEAR_FRESNEL_NUMBER = -0.1915871349
# Below this argument x / tanh(x) is 1 to double precision; computing it would divide 0 by 0.
SMALL_ARGUMENT = 1e-4


@compiled
def diffraction_gain_db(fresnel_number: float) -> float:
    """Gain in dB, 0 or less."""
    # guard: beyond its clearance an edge screens nothing
    if fresnel_number <= CLEAR_FRESNEL_NUMBER:
        return 0.0
    x = math.sqrt(2 * math.pi * abs(fresnel_number))
    # guard: a screen's formula has no nought by nought
    if x < SMALL_ARGUMENT:
        return -GRAZING_LOSS_DB
    bent = x / math.tanh(x) if fresnel_number > 0 else x / math.tan(x)
    return min(0.0, -(GRAZING_LOSS_DB + 20 * math.log10(bent)))
