"""The loudness map against the responses it summarises."""

import io

import numpy as np
import pytest
import sofar
from numpy.testing import assert_allclose
from PIL import Image

from server.acoustics.decibels import power_to_db
from server.rendering.hrtf import KEMAR, kemar
from server.rendering.sphere import solid_angles
from server.responses.full_response import FullResponse, diffuse_energy
from server.responses.loudness import LoudnessMap, loudness_map


@pytest.fixture
def whole(field):
    return FullResponse.through_kemar(field)


@pytest.fixture
def chart(whole):
    return loudness_map(whole, (2.0, 2.5, 1.5), listener_height_m=1.5, spacing_m=0.5)


def test_cells_cover_the_bounds(chart, field):
    bounds = field.bundle.manifest.bounds
    rows, columns = chart.levels_db.shape
    assert (rows, columns) == (8, 14)
    for axis, count in enumerate((columns, rows)):
        margins = (
            chart.origin[axis] - bounds.minimum[axis],
            bounds.maximum[axis] - chart.origin[axis] - (count - 1) * 0.5,
        )
        assert_allclose(margins[0], margins[1])
        assert 0.25 <= margins[0] < 0.5
    assert np.isfinite(chart.levels_db).all()


def test_levels_differ_as_those_of_the_responses_do(chart, whole):
    """Only differences compare: the graph sounds from its first frame on, before the onset the field passes."""
    cells = np.array([(4, 4), (6, 11)])
    x, y = chart.origin[0] + cells[:, 1] * 0.5, chart.origin[1] + cells[:, 0] * 0.5
    listeners = np.repeat(np.stack([x, y, np.full(2, 1.5)], axis=-1), 4, axis=0)
    yaws = np.tile(np.arange(4) * np.pi / 2, 2)
    responses = whole.impulse_responses(listeners, np.broadcast_to((2.0, 2.5, 1.5), listeners.shape), yaws)
    levels = 10 * np.log10(np.mean(np.sum(responses.astype(np.float64) ** 2, axis=-1).reshape(2, 8), axis=-1))
    near, far = (chart.levels_db[row, column] for row, column in cells)
    assert_allclose(near - far, levels[0] - levels[1], atol=0.7)


def test_loudest_cell_is_at_the_emitter(chart):
    row, column = np.unravel_index(np.argmax(chart.levels_db), chart.levels_db.shape)
    assert abs(chart.origin[0] + column * 0.5 - 2.0) < 0.5
    assert abs(chart.origin[1] + row * 0.5 - 2.5) < 0.5


def test_picture_is_north_up_and_brightest_where_loudest(chart):
    image = np.asarray(Image.open(io.BytesIO(chart.to_png())).convert("L"), dtype=float)
    row, column = np.unravel_index(np.argmax(image), image.shape)
    west, south = chart.origin[0] - chart.spacing_m / 2, chart.origin[1] - chart.spacing_m / 2
    assert abs(west + (column + 0.5) / 80 - 2.0) < 0.3
    assert abs(south + (image.shape[0] - row - 0.5) / 80 - 2.5) < 0.3


def test_walls_are_cut_out_sharply_and_do_not_bleed():
    levels = np.full((4, 9), -10.0)
    levels[:, 4] = np.nan
    image = np.asarray(Image.open(io.BytesIO(LoudnessMap(levels, (0.0, 0.0), 0.25, 1.5).to_png())))
    assert image.shape == (80, 180, 4)
    assert not image[:, 80:100, 3].any()
    assert (image[:, :80, 3] == 255).all()
    assert (image[:, 100:, 3] == 255).all()
    assert len(np.unique(image[image[..., 3] > 0], axis=0)) == 1


def test_a_picture_of_a_large_place_has_fewer_pixels_per_metre():
    drawn = LoudnessMap(np.zeros((44, 22)), (0.0, 0.0), 2.24, 1.5).to_png()
    assert Image.open(io.BytesIO(drawn)).size == (1_000, 2_000)


def test_json_has_no_numbers_outside_the_room():
    chart = LoudnessMap(np.array([[np.nan, -3.0]]), (0.0, 0.0), 0.5, 1.5)
    assert chart.to_json()["levels_db"] == [[None, -3.0]]


def test_white_sound_up_to_12_khz_is_as_loud_through_a_head_as_without_one_and_what_is_above_as_the_head_has_it():
    """By the measured responses as they are stored, at 44.1 kHz."""
    stored = sofar.read_sofa(str(KEMAR), verify=False, verbose=False)
    responses, rate_hz = stored.Data_IR, float(stored.Data_SamplingRate)
    azimuth, elevation = np.radians(stored.SourcePosition[:, :2]).T
    directions = np.stack([np.cos(elevation) * part for part in (np.cos(azimuth), np.sin(azimuth))], axis=-1)
    weights = solid_angles(np.column_stack([directions, np.sin(elevation)]))
    spectrum = np.einsum("d,def->f", weights, np.abs(np.fft.rfft(responses)) ** 2)
    is_above = np.fft.rfftfreq(responses.shape[-1], 1 / rate_hz) > 12_000
    above = spectrum[is_above].sum() / spectrum[~is_above].sum()
    in_24_khz, in_48_khz = (power_to_db(diffuse_energy(kemar(rate)).sum()) for rate in (24_000, 48_000))
    assert in_24_khz == pytest.approx(0.0, abs=0.1)
    assert in_48_khz == pytest.approx(power_to_db((1 + above) / 2), abs=0.15)
    assert in_48_khz == pytest.approx(-2.7, abs=0.1)
