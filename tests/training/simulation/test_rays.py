import numpy as np
import pytest

from server.acoustics.decibels import power_to_db
from server.scene.geometry import Material, Materials
from training.data.scene_file import HISTOGRAM_BIN_S
from training.simulation.rays import RayTracer, sphere_directions

RAMP = np.linspace(0, 1, 7)
# A corner of each room of the apartment that the other cannot see, not even in one mirror.
OUT_OF_SIGHT = np.array([4.6, 4.6, 1.4]), np.array([3.5, 0.5, 1.5])


def traced(geometry, emitter, receivers, *, rays=3000, seed=0, image_order=0, duration_s=0.4, directions=12):
    """(receiver, direction, band, bin)"""
    tracer = RayTracer(
        geometry,
        np.asarray(receivers),
        duration_s=duration_s,
        image_order=image_order,
        arrival_directions=sphere_directions(directions),
    )
    return tracer.trace(emitter, rays=rays, rng=np.random.default_rng(seed))


def decay_db(energy):
    """Schroeder's backward integral over the last axis, from 0 dB."""
    remaining = np.cumsum(energy[..., ::-1], axis=-1)[..., ::-1]
    return power_to_db(remaining / remaining[..., :1])


def reverberation_time_s(decay, upper_db=-5, lower_db=-35):
    fitted = (decay < upper_db) & (decay > lower_db)
    slope, _ = np.polyfit(np.flatnonzero(fitted) * HISTOGRAM_BIN_S, decay[fitted], 1)
    return -60 / slope


@pytest.mark.parametrize("count", [12, 24, 500])
def test_directions_are_spread_evenly(count):
    directions = sphere_directions(count)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    np.testing.assert_allclose(directions.mean(axis=0), 0, atol=1 / count)
    # Second moments of the uniform sphere.
    np.testing.assert_allclose(directions.T @ directions / count, np.eye(3) / 3, atol=2 / count)
    cosines = directions @ directions.T - 2 * np.eye(count)
    nearest = np.arccos(cosines.max(axis=1))
    # The mean spacing of `count` caps that tile the sphere.
    assert nearest.min() > 0.75 * np.sqrt(4 * np.pi / count)


@pytest.mark.parametrize("scattering", [0.0, 0.5, RAMP])
def test_walls_that_absorb_nothing_keep_all_energy(shoebox, scattering):
    """What is radiated within a bin stays, and fills the room evenly: 4 pi c dt / V, in every band, however it
    scatters."""
    geometry = shoebox.geometry(absorption=0.0, scattering=scattering)
    energy = traced(geometry, shoebox.emitter, shoebox.receivers, rays=20_000).sum(axis=1).mean(axis=0)
    expected = 4 * np.pi * 343 * HISTOGRAM_BIN_S / shoebox.volume_m3
    for half in (energy[:, 10:55], energy[:, 55:]):
        np.testing.assert_allclose(power_to_db(half.mean(axis=-1) / expected), 0, atol=0.15)


@pytest.mark.parametrize("scattering", [0.3, 0.9, RAMP * 0.7 + 0.3])
def test_energy_is_that_of_a_diffuse_field(shoebox, scattering):
    """16 pi / R with the room constant R (Kuttruff, Room Acoustics, ch. 5)."""
    absorption = 0.15
    geometry = shoebox.geometry(absorption=absorption, scattering=scattering)
    energy = traced(geometry, shoebox.emitter, shoebox.receivers, duration_s=0.8).sum(axis=(1, 3)).mean(axis=0)
    expected = 16 * np.pi * (1 - absorption) / (shoebox.surface_m2 * absorption)
    np.testing.assert_allclose(power_to_db(energy / expected), 0, atol=0.4)


@pytest.mark.parametrize("absorption", [0.1, 0.2])
def test_decay_is_eyrings_where_the_field_is_diffuse(shoebox, absorption):
    eyring_s = 24 * np.log(10) / 343 * shoebox.volume_m3 / (-shoebox.surface_m2 * np.log(1 - absorption))
    geometry = shoebox.geometry(absorption=absorption, scattering=1.0)
    energy = traced(geometry, shoebox.emitter, shoebox.receivers, duration_s=1.2)
    found_s = reverberation_time_s(decay_db(energy.sum(axis=(0, 1, 2))))
    # Paths in a box differ in length, which makes it 4 % longer (Kuttruff, sec. 5.3: gamma**2 of about 0.4).
    path_spread = 1 + 0.4 / 2 * np.log(1 - absorption)
    assert found_s == pytest.approx(eyring_s / path_spread, rel=0.03)


def test_the_first_mirrored_reflection_has_the_level_of_a_free_wave(shoebox):
    """Rays alone, through the floor's mirror, all else absorbing: (1 - a) / d**2."""
    mute, mirror = (Material(absorption=(a,) * 7, scattering=(0.0,) * 7) for a in (1.0, 0.36))
    geometry = shoebox.geometry().model_copy(update={"materials": Materials(walls=mute, floor=mirror, ceiling=mute)})
    energy = traced(geometry, shoebox.emitter, shoebox.receivers, rays=200_000).sum(axis=(1, 3))
    image = shoebox.emitter * (1, 1, -1)
    expected = 0.64 / np.sum((shoebox.receivers - image) ** 2, axis=1)
    np.testing.assert_allclose(power_to_db(energy[:, 3] / expected), 0, atol=0.15)


def test_a_scattering_floor_is_lamberts(shoebox):
    """All else absorbing: the integral over the floor of what it gets from the emitter, and sends on."""
    mute, rough = (Material(absorption=(a,) * 7, scattering=(1.0,) * 7) for a in (1.0, 0.2))
    geometry = shoebox.geometry().model_copy(update={"materials": Materials(walls=mute, floor=rough, ceiling=mute)})
    energy = traced(geometry, shoebox.emitter, shoebox.receivers, rays=100_000).sum(axis=(1, 3))
    x, y = np.meshgrid(*((np.arange(400) + 0.5) / 400 * size for size in shoebox.size_m[:2]), indexing="ij")
    area = np.prod(shoebox.size_m[:2]) / 400**2

    def square(point):
        return (x - point[0]) ** 2 + (y - point[1]) ** 2 + point[2] ** 2

    falls = shoebox.emitter[2] / square(shoebox.emitter) ** 1.5
    for found, receiver in zip(energy, shoebox.receivers, strict=True):
        sent = 0.8 * falls * receiver[2] / np.pi / square(receiver) ** 1.5
        np.testing.assert_allclose(power_to_db(found / (sent.sum() * area)), 0, atol=0.15)


def test_rays_are_sorted_by_where_they_come_from(shoebox):
    """Of two low down, one above the other, first the floor is heard; of two high up, the ceiling."""
    directions = sphere_directions(24)
    for height_m, side in ((0.5, -1), (2.0, 1)):
        ends = np.array([[2.0, 1.5, height_m], [2.0, 1.5, height_m + 0.1]])
        energy = traced(shoebox.geometry(scattering=0.0), ends[0], ends[1:], rays=20_000, directions=24)[0, :, 0]
        first = np.flatnonzero(energy.sum(axis=0))[0]
        assert directions[np.argmax(energy[:, first])][2] * side > 0.8


@pytest.mark.parametrize("image_order", [0, 1, 2])
def test_reflections_are_left_to_images_order_by_order(shoebox, image_order):
    """What rays leave out when images bring one order more is the energy of those images."""
    geometry = shoebox.geometry(absorption=0.3, scattering=0.2)
    fewer, more = (
        traced(geometry, shoebox.emitter, shoebox.receivers, rays=20_000, image_order=k)[:, :, 3].sum()
        for k in (image_order, image_order + 1)
    )
    lattice = np.mgrid[-3:4, -3:4, -3:4].reshape(3, -1).T
    cells = lattice[np.abs(lattice).sum(axis=1) == image_order + 1]
    odd = cells % 2 == 1
    images = np.where(odd, (cells + 1) * shoebox.size_m - shoebox.emitter, cells * shoebox.size_m + shoebox.emitter)
    square = np.sum((images - shoebox.receivers[:, None]) ** 2, axis=-1)
    expected = np.sum((0.7 * 0.8) ** (image_order + 1) / square)
    assert fewer - more == pytest.approx(expected, rel=0.08)


def test_decays_are_those_of_pyroomacoustics(apartment, reference):
    """Mirrors only, in two rooms with a doorway. Where walls scatter its rays are mirrored all the same, with all of
    their energy, so there is nothing to compare."""
    shares = {
        name: Material(absorption=getattr(apartment.geometry.materials, name).absorption, scattering=(0.0,) * 7)
        for name in ("walls", "floor", "ceiling")
    }
    geometry = apartment.geometry.model_copy(update={"materials": Materials(**shares)})
    emitter, *receivers = apartment.probe_positions(1)[3:40:3]
    oracle = reference(geometry, np.array(receivers), image_order=0, duration_s=0.6)
    expected = oracle.energy(emitter, 20_000, np.random.default_rng(1)).sum(axis=0)
    found = traced(geometry, emitter, receivers, rays=40_000, duration_s=0.6).sum(axis=(0, 1))
    np.testing.assert_allclose(power_to_db(found.sum(axis=-1) / expected.sum(axis=-1)), 0, atol=0.3)
    ours, theirs = decay_db(found), decay_db(expected)
    for mine, other in zip(ours, theirs, strict=True):
        assert np.abs(mine - other)[other > -40].max() < 1
        assert reverberation_time_s(mine) == pytest.approx(reverberation_time_s(other), rel=0.05)


def test_emitter_and_receiver_may_change_places(apartment):
    """Between rooms, with different bands and surfaces."""
    pairs = apartment.probe_positions(2)[[[2, 38], [10, 30], [17, 22]]]
    for one, other in pairs:
        there, back = (
            traced(apartment.geometry, a, b[None], rays=20_000, image_order=1).sum(axis=(0, 1))
            for a, b in ((one, other), (other, one))
        )
        np.testing.assert_allclose(power_to_db(there.sum(axis=-1) / back.sum(axis=-1)), 0, atol=0.5)


def test_no_sound_goes_through_a_wall(apartment):
    emitter, receiver = OUT_OF_SIGHT
    energy = traced(apartment.geometry, emitter, receiver[None], rays=8000)
    path_m = apartment.geometry.floor_plan.path_length_m(emitter, receiver)
    begins = np.flatnonzero(energy.sum(axis=(0, 1, 2)))[0]
    assert begins >= int(path_m / 343 / HISTOGRAM_BIN_S)
    assert energy.sum() > 0


def test_the_same_random_numbers_give_the_same_energy(shoebox):
    first, again, other = (
        traced(shoebox.geometry(), shoebox.emitter, shoebox.receivers, rays=500, seed=seed) for seed in (7, 7, 8)
    )
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
