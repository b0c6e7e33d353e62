import numpy as np
import pytest

from server.acoustics.decibels import power_to_db
from server.scene.manifest import Air
from training.data.scene_file import HISTOGRAM_BIN_S
from training.simulation.rays import sphere_directions
from training.simulation.tracing import RoomTracer, free_field_amplitude


def trace(geometry, shoebox, *, rays=2000, seed=0, image_order=1, duration_s=0.4):
    tracer = RoomTracer(
        geometry,
        Air(),
        shoebox.receivers,
        duration_s=duration_s,
        image_order=image_order,
        arrival_directions=sphere_directions(12),
    )
    return tracer.trace(shoebox.emitter, rays=rays, rng=np.random.default_rng(seed))


def total(arrivals, band):
    return sum(np.sum(a.image_amplitudes[:, band] ** 2) + a.energy[:, band].sum() for a in arrivals)


@pytest.mark.parametrize("image_order", [0, 1, 3])
def test_the_direct_sound_is_left_out(shoebox, image_order):
    """All that comes from an absorber is the direct sound: in a room of nothing else there is nothing."""
    for arrivals in trace(shoebox.geometry(absorption=1.0), shoebox, image_order=image_order):
        assert not (np.linalg.norm(arrivals.image_positions - shoebox.emitter, axis=1) < 1e-3).any()
        np.testing.assert_array_equal(arrivals.image_amplitudes, 0)
        np.testing.assert_array_equal(arrivals.energy, 0)


def test_a_free_wave_falls_with_distance():
    distance = np.array([0.5, 1.0, 7.0])
    amplitude = free_field_amplitude(distance, Air())
    # Below 1 kHz the air takes less than 0.1 dB over these few metres.
    np.testing.assert_allclose(amplitude[:, :4] * distance[:, None], 1, rtol=0.01)
    # ISO 9613-1, table 1: 105 dB/km at 8 kHz, 20 degrees and 50 % humidity.
    treble_db = 20 * np.log10(amplitude[:, 6] * distance)
    np.testing.assert_allclose(treble_db, -0.105 * distance, rtol=0.01)


def test_the_air_takes_from_rays_what_it_takes_from_waves(shoebox):
    """The decay of a band is faster by the air's decibels per metre times the metres per second."""
    (arrivals, *_) = trace(shoebox.geometry(scattering=0.8), shoebox, rays=20_000)
    level_db = power_to_db(arrivals.energy.sum(axis=0))
    late = slice(20, 90)
    times_s = np.arange(level_db.shape[-1])[late] * HISTOGRAM_BIN_S
    difference, _ = np.polyfit(times_s, level_db[6, late] - level_db[0, late], 1)
    per_m = Air().absorption_db_per_m
    assert difference == pytest.approx(-(per_m[6] - per_m[0]) * 343, rel=0.01)


def test_scattering_takes_from_the_mirror_and_gives_to_the_rays(shoebox):
    plain, rough = (trace(shoebox.geometry(scattering=s), shoebox)[0] for s in (0.0, 0.5))
    np.testing.assert_allclose(rough.image_amplitudes / plain.image_amplitudes, np.sqrt(0.5))
    assert rough.energy.sum() > plain.energy.sum()


@pytest.mark.parametrize("image_order", [0, 1, 3])
@pytest.mark.parametrize("scattering", [0.0, 0.5, 0.9])
def test_reflected_energy_is_that_of_a_diffuse_field(shoebox, scattering, image_order):
    """16 pi / R with the room constant R (Kuttruff, Room Acoustics, ch. 5), beside a direct sound of 1 / r**2."""
    absorption = 0.15
    expected = 16 * np.pi * (1 - absorption) / (shoebox.surface_m2 * absorption)
    geometry = shoebox.geometry(absorption=absorption, scattering=scattering)
    found = total(trace(geometry, shoebox, rays=4000, image_order=image_order, duration_s=0.8), band=2)
    assert power_to_db(found / len(shoebox.receivers) / expected) == pytest.approx(0, abs=0.5)


@pytest.mark.parametrize("image_order", [0, 1, 2])
def test_reflections_are_images_or_rays_and_never_both(shoebox, image_order):
    """Whatever the order at which images end and rays begin, the energy is the same."""
    geometry = shoebox.geometry(scattering=0.2)
    totals = [total(trace(geometry, shoebox, rays=20_000, image_order=image_order + k), band=2) for k in (0, 1)]
    assert power_to_db(totals[1] / totals[0]) == pytest.approx(0, abs=0.1)


def test_the_seed_decides_the_arrivals(shoebox):
    first, again, other = (trace(shoebox.geometry(), shoebox, rays=500, seed=seed) for seed in (7, 7, 8))
    for one, same, different in zip(first, again, other, strict=True):
        np.testing.assert_array_equal(one.energy, same.energy)
        np.testing.assert_array_equal(one.image_amplitudes, same.image_amplitudes)
        assert not np.array_equal(one.energy, different.energy)
