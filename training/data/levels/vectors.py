"""Products of vectors of three, in compiled code. `np.dot` would call a library whose last bit depends on the
processor."""

import numba


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
