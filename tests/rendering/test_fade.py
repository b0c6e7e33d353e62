"""The fade rises from 0 to 1 and, reversed, is its own complement: what both sides share passes unchanged."""

import numpy as np
import pytest

from server.rendering.fade import raised_cosine


@pytest.mark.parametrize("block_size", [1, 2, 128, 255, 256, 1024])
def test_fade_in_and_fade_out_add_up_to_one(block_size):
    fade = raised_cosine(block_size)
    np.testing.assert_allclose(fade + fade[::-1], 1.0, atol=1e-7)


def test_fade_rises_all_the_way():
    fade = raised_cosine(256)
    assert np.all(np.diff(fade) > 0)
    assert fade[0] < 1e-4
    assert fade[-1] > 1 - 1e-4
