"""Statistical acoustics against formulae worked out by hand and against traced rays."""

import numpy as np
import pytest

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.scene.manifest import Air
from training.simulation.diffuse_room import DiffuseRoom
from training.simulation.rays import RayTracer, sphere_directions

NONE_GEOMETRIC = 0


def room_of(shoebox, *, air=None, **shares):
    return DiffuseRoom(shoebox.geometry(**shares), air, 343.0)


def test_a_box_has_its_volume_surface_and_free_path(shoebox):
    room = room_of(shoebox)
    assert room.volume_m3 == pytest.approx(shoebox.volume_m3)
    assert room.surface_m2 == pytest.approx(shoebox.surface_m2)
    assert room.mean_free_path_m == pytest.approx(4 * shoebox.volume_m3 / shoebox.surface_m2)


def test_reverberation_is_eyrings_and_air_shortens_it(shoebox):
    dry, aired = room_of(shoebox, absorption=0.2), room_of(shoebox, absorption=0.2, air=Air())
    by_hand = 0.161 * shoebox.volume_m3 / (-shoebox.surface_m2 * np.log(0.8))
    np.testing.assert_allclose(dry.reverberation_time_s, by_hand, rtol=2e-3)
    # A ray loses by walls and air independently: decay rates add.
    rate = 60 / dry.reverberation_time_s + 343.0 * Air().absorption_db_per_m
    np.testing.assert_allclose(aired.reverberation_time_s, 60 / rate, rtol=1e-9)


def test_a_room_without_loss_or_without_reflections_is_finite(shoebox):
    for absorption in (0.0, 1.0):
        room = room_of(shoebox, absorption=absorption)
        assert np.isfinite(room.reverberation_time_s).all()
        assert np.isfinite(room.reflected_power(1)).all()
        assert np.isfinite(room.clarity_spread_db(0.05))
    np.testing.assert_allclose(room.reflected_power(1), 0.0, atol=1e-6)


@pytest.mark.parametrize("order", [1, 2, 4])
def test_reflected_power_is_that_of_rays_where_sound_is_diffuse(shoebox, order):
    """All of it scattered, so that no image takes any; over receivers and bands."""
    geometry = shoebox.geometry(absorption=0.2, scattering=1.0)
    tracer = RayTracer(
        geometry, shoebox.receivers, duration_s=1.5, image_order=NONE_GEOMETRIC, arrival_directions=sphere_directions(6)
    )
    energy = tracer.trace(shoebox.emitter, rays=4000, rng=np.random.default_rng(1)).sum(axis=(1, 3))
    room = DiffuseRoom(geometry, None, 343.0)
    series = sum(room.reflected_power(1) * 0.8**extra * 0.2 for extra in range(order - 1))
    expected = room.reflected_power(order)
    np.testing.assert_allclose(energy.mean(axis=0) - series, expected, rtol=0.15)


def test_scattering_is_the_mean_of_what_is_reflected(shoebox):
    per_band = np.linspace(0.1, 0.7, len(OCTAVE_BANDS_HZ))
    np.testing.assert_allclose(room_of(shoebox, scattering=per_band).scattering, per_band)


def test_clarity_spreads_as_that_of_decaying_noise_does(shoebox):
    """Of white noise in the octaves, which the formula takes to be as wide as they are, with one decay for all."""
    room = DiffuseRoom(shoebox.geometry(absorption=0.25), None, 343.0)
    rate, early_s = 6 * np.log(10) / room.reverberation_time_s[0], 0.05
    sample_rate = 2 * sum(band / np.sqrt(2) for band in OCTAVE_BANDS_HZ)  # white up to the width of all octaves
    times_s = np.arange(round(1.0 * sample_rate)) / sample_rate
    noise = np.random.default_rng(0).standard_normal((600, len(times_s))) ** 2 * np.exp(-rate * times_s)
    early = times_s < early_s
    clarity_db = 10 * np.log10(noise[:, early].sum(axis=1) / noise[:, ~early].sum(axis=1))
    assert room.clarity_spread_db(early_s) == pytest.approx(clarity_db.std(), rel=0.15)
