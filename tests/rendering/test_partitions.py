"""Laws of the cut: no gap, no overlap, and time enough for every stage."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.rendering.partitions import Partitioning


@given(block_size=st.sampled_from([64, 128, 256, 512, 1024]), ir_samples=st.integers(1, 400_000))
def test_stages_cover_the_response_without_gap_or_overlap(block_size, ir_samples):
    stages = Partitioning(block_size, ir_samples).stages
    assert stages[0].start == 0
    assert stages[0].size == block_size
    for before, after in itertools.pairwise(stages):
        assert after.start == before.end
    last = stages[-1]
    assert last.end - last.size < ir_samples <= last.end


@given(block_size=st.sampled_from([64, 256]), ir_samples=st.integers(1, 400_000))
def test_a_later_stage_has_a_window_of_time_to_work(block_size, ir_samples):
    """Its first sample is due when its window was full one window ago."""
    for stage in Partitioning(block_size, ir_samples).stages[1:]:
        assert stage.start == 2 * stage.size
        assert stage.size == stage.ticks * block_size


def test_a_second_at_48_khz_is_cut_as_the_design_says():
    stages = Partitioning(256, 48_000).stages
    assert [(stage.size, stage.partitions) for stage in stages] == [(256, 8), (1024, 6), (4096, 10)]


@given(block_size=st.sampled_from([64, 256]), ir_samples=st.integers(1, 100_000))
def test_quiet_is_longer_than_the_response(block_size, ir_samples):
    partitioning = Partitioning(block_size, ir_samples)
    assert partitioning.quiet_blocks * block_size >= ir_samples + block_size
    assert partitioning.history_blocks % partitioning.stages[-1].ticks == 0


@pytest.mark.parametrize(("block_size", "ir_samples"), [(0, 1), (32, 1), (96, 1), (64, 0), (64, -5)])
def test_impossible_sizes_are_refused(block_size, ir_samples):
    with pytest.raises(ValueError, match=r"block_size|ir_samples"):
        Partitioning(block_size, ir_samples)
