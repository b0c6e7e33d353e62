"""The spherical harmonics of one direction in compiled code, as `server.acoustics.spherical_harmonics` defines them."""

import numpy as np
import numpy.typing as npt

from server.kernels.compiled import compiled_in_place

DoubleArray = npt.NDArray[np.float64]

_ROOT_3, _ROOT_15 = np.sqrt(3.0), np.sqrt(15.0)
_ROOT_3_8, _ROOT_5_8 = np.sqrt(3 / 8), np.sqrt(5 / 8)


@compiled_in_place
def write_harmonics(direction: DoubleArray, harmonics: DoubleArray) -> None:
    """Write the harmonics (1, 4, 9 or 16) of a unit vector (3,), in ACN order and SN3D norm."""
    x, y, z = direction[0], direction[1], direction[2]
    harmonics[0] = 1.0
    if harmonics.size >= 4:
        harmonics[1], harmonics[2], harmonics[3] = y, z, x
    if harmonics.size >= 9:
        harmonics[4] = _ROOT_3 * x * y
        harmonics[5] = _ROOT_3 * y * z
        harmonics[6] = 0.5 * (3.0 * z * z - 1.0)
        harmonics[7] = _ROOT_3 * x * z
        harmonics[8] = 0.5 * _ROOT_3 * (x * x - y * y)
    if harmonics.size >= 16:
        harmonics[9] = _ROOT_5_8 * y * (3.0 * x * x - y * y)
        harmonics[10] = _ROOT_15 * x * y * z
        harmonics[11] = _ROOT_3_8 * y * (5.0 * z * z - 1.0)
        harmonics[12] = 0.5 * z * (5.0 * z * z - 3.0)
        harmonics[13] = _ROOT_3_8 * x * (5.0 * z * z - 1.0)
        harmonics[14] = 0.5 * _ROOT_15 * z * (x * x - y * y)
        harmonics[15] = _ROOT_5_8 * x * (x * x - 3.0 * y * y)
