import numpy as np
import pytest

from server.acoustics.codec import Codec
from training.models.cells import Cells

CELLS = Cells(Codec(24_000, 256, 64, 16_800, 1e-5))
AXES = [CELLS.bands, CELLS.late_frames, CELLS.all_frames]


@pytest.mark.parametrize("axis", AXES)
def test_cells_tile_their_steps(axis):
    assert (axis.widths > 0).all()
    assert axis.widths.sum() == axis.edges[-1] - axis.edges[0]
    member = axis.pool() > 0
    np.testing.assert_array_equal(member.sum(axis=1), 1)
    np.testing.assert_array_equal(member.sum(axis=0), axis.widths)


def test_axes_cover_the_spectrogram():
    assert CELLS.bands.edges[[0, -1]].tolist() == [0, CELLS.codec.bins]
    assert CELLS.late_frames.edges[[0, -1]].tolist() == [CELLS.fine_frames, CELLS.codec.frames]
    assert CELLS.all_frames.edges[[0, -1]].tolist() == [0, CELLS.codec.frames]


def test_cells_widen_and_never_narrow():
    for axis in AXES:
        assert (np.diff(axis.widths[:-1]) >= 0).all()  # the last may be cut off by the end


@pytest.mark.parametrize("axis", AXES)
def test_pooling_averages_and_spreading_interpolates(axis):
    np.testing.assert_allclose(axis.pool().sum(axis=0), 1, rtol=1e-6)
    np.testing.assert_allclose(axis.spread().sum(axis=0), 1, rtol=1e-6)
    assert (axis.spread() >= 0).all()


@pytest.mark.parametrize("axis", AXES)
def test_straight_lines_come_back_between_the_outer_centres(axis):
    steps = np.arange(axis.edges[0], axis.edges[-1])
    line = 3.0 - 0.25 * steps
    again = line @ axis.pool() @ axis.spread()
    between = (steps >= (axis.edges[0] + axis.edges[1] - 1) / 2) & (steps <= (axis.edges[-2] + axis.edges[-1] - 1) / 2)
    np.testing.assert_allclose(again[between], line[between], atol=2e-5)
    # Beyond, the outermost cell's own level.
    np.testing.assert_allclose(again, line, atol=0.25 * axis.widths.max() / 2)


@pytest.mark.parametrize("axis", AXES)
def test_pooling_of_what_was_spread_from_a_constant_is_exact(axis):
    np.testing.assert_allclose(np.full(axis.cells, 0.7) @ axis.spread() @ axis.pool(), 0.7, rtol=1e-6)


@pytest.mark.parametrize("samples", [2_000, 4_000, 24_000, 96_000])
def test_any_length_has_cells(samples):
    cells = Cells(Codec(8_000, 256, 64, samples, 1e-5))
    assert cells.all_frames.edges[-1] == cells.codec.frames
    assert cells.late_frames.cells >= 1
