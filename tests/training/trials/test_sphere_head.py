"""A spherical head against what is known of spheres."""

import numpy as np
import pytest

from server.rendering.hrtf import HeadFilters, Hrtf
from training.data.dataset import SPEED_OF_SOUND
from training.trials.sphere_head import SAMPLE_RATE, sphere_response, sphere_responses, write_sphere_head


def test_low_frequencies_pass_as_if_nothing_were_there():
    np.testing.assert_allclose(np.abs(sphere_response(np.array([0.01]), np.linspace(-1, 1, 9))), 1.0, atol=0.02)


def test_high_frequencies_double_where_the_wave_meets_the_sphere():
    assert np.abs(sphere_response(np.array([60.0]), np.array([1.0])))[0, 0] == pytest.approx(2.0, rel=0.03)
    assert np.abs(sphere_response(np.array([60.0]), np.array([-0.8])))[0, 0] < 0.3


@pytest.mark.parametrize("radius_m", [0.07, 0.1])
def test_the_delay_between_ears_is_three_radii_over_c_at_low_frequencies(radius_m):
    """3 a / c sin(azimuth) (Kuhn, J. Acoust. Soc. Am. 62, 157, 1977), for ears at opposite sides."""
    frequency = np.array([100.0])
    ka = 2 * np.pi * frequency * radius_m / SPEED_OF_SOUND
    near, far = np.angle(sphere_response(ka, np.array([1.0, -1.0])))[:, 0]
    delay_s = (near - far) / (2 * np.pi * frequency[0])
    assert delay_s == pytest.approx(3 * radius_m / SPEED_OF_SOUND, rel=0.02)


def test_sound_arrives_earlier_at_the_nearer_ear():
    left, right = sphere_responses(np.array([[0.0, 1.0, 0.0]]), 0.0875)[0]
    onsets = [int(np.argmax(np.abs(ear) > 0.2 * np.abs(ear).max())) for ear in (left, right)]
    assert onsets[0] < onsets[1]
    assert (onsets[1] - onsets[0]) / SAMPLE_RATE == pytest.approx(0.0875 * (1 + np.pi / 2) / SPEED_OF_SOUND, abs=1e-4)


def test_the_file_is_a_head_that_the_server_takes(tmp_path):
    path = tmp_path / "sphere.sofa"
    write_sphere_head(path, 0.08)
    filters = HeadFilters.from_hrtf(Hrtf.read(path, 24_000))
    assert filters.longest_delay_s < 4e-4
    at_left = int(np.argmax(filters.directions[:, 1]))
    assert filters.cepstra[at_left, 0, 0] > filters.cepstra[at_left, 1, 0]
