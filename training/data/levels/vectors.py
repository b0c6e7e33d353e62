"""Products of vectors of three, in compiled code. `np.dot` would call a library whose last bit depends on the
processor."""

from server.kernels.compiled import compiled_inline


@compiled_inline
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
