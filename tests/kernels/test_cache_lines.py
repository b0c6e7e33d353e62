import numpy as np
import pytest
from numpy.testing import assert_array_equal

from server.kernels.cache_lines import LINE_BYTES, on_lines, zeros_on_lines


@pytest.mark.parametrize("shape", [(1,), (7, 3), (129, 6, 8), (40_000,)])
def test_arrays_begin_with_a_line_and_hold_what_they_should(shape):
    values = np.random.default_rng(0).standard_normal(shape).astype(np.float32)
    for array, expected in ((zeros_on_lines(*shape), np.zeros(shape)), (on_lines(values), values)):
        assert array.ctypes.data % LINE_BYTES == 0
        assert array.flags.c_contiguous
        assert array.dtype == np.float32
        assert_array_equal(array, expected)
