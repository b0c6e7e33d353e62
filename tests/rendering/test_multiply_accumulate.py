"""A source's turn on wide registers and on narrow ones."""

import numpy as np
import pytest

from server.kernels.cache_lines import zeros_on_lines
from server.kernels.compiled import compiled
from server.rendering.convolver_records import STAGE
from server.rendering.multiply_accumulate import (
    COLUMNS,
    GROUP,
    _add_turn_of_channel,
    _add_turn_of_pair,
    enter_member,
    spectrum_stride,
)
from server.rendering.packed_filter import address

TILES, SLOTS = 8, 6


@compiled
def turn(stages, channels, filters, counts, rings, newest, is_wide):
    stage = stages[0]
    for member in range(filters.size):
        enter_member(stage, member, filters[member], counts[member], rings[member])
    if is_wide:
        for channel in range(0, channels, 2):
            _add_turn_of_pair(stage, channels, channel, filters.size, newest, 0, TILES)
    else:
        for channel in range(channels):
            _add_turn_of_channel(stage, channels, channel, filters.size, newest, 0, TILES)


@pytest.mark.parametrize("channels", [1, 2, 4, 9])
@pytest.mark.parametrize("counts", [(6,), (1, 6), (2, 3), (3, 0)], ids=str)
def test_both_ways_give_the_same_bits(channels, counts):
    rng = np.random.default_rng(1)
    size = 8 * TILES
    filters = [rng.standard_normal(max(1, 16 * TILES * count * channels)).astype(np.float32) for count in counts]
    rings = [rng.standard_normal((SLOTS, int(spectrum_stride(size)))).astype(np.float32) for _ in counts]
    start = rng.standard_normal(16 * TILES * channels * COLUMNS).astype(np.float32)
    made = []
    for is_wide in (True, False):
        mix, group = zeros_on_lines(start.size), np.zeros((GROUP, 3), np.int64)
        mix[:] = start
        stage = np.zeros(1, STAGE)
        for name, value in {
            "size": size,
            "slots": SLOTS,
            "window": 7,
            "mix": address(mix),
            "group": address(group),
        }.items():
            stage[name] = value
        addresses = [np.array([address(each) for each in arrays], np.int64) for arrays in (filters, rings)]
        turn(stage, channels, addresses[0], np.array(counts, np.int64), addresses[1], 4, is_wide)
        made.append(mix)
    np.testing.assert_array_equal(*made)
    assert not np.array_equal(made[0], start)
