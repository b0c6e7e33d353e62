import numpy as np
from numpy.testing import assert_array_equal

from server.kernels.copying import copy


def test_copy_writes_the_beginning_and_leaves_the_rest():
    to = np.full(9, -1.0, np.float32)
    copy(np.arange(5, dtype=np.float32), to)
    assert_array_equal(to, [0, 1, 2, 3, 4, -1, -1, -1, -1])


def test_copy_of_nothing_changes_nothing():
    to = np.ones(3, np.float32)
    copy(to[:0], to)
    assert_array_equal(to, 1)
