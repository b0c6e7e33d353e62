import numpy as np
import pyroomacoustics as pra
import pytest

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.decibels import power_to_db
from server.scene.geometry import Geometry, Material, Materials
from server.scene.manifest import Air
from training.dataset import SPEED_OF_SOUND
from training.simulation.tracing import (
    HISTOGRAM_BIN_S,
    RoomTracer,
    counted_twice,
    free_field_amplitude,
    sphere_directions,
)

SIZE_M = np.array([4.0, 3.0, 2.5])
CORNERS = ((0, 0), (4, 0), (4, 3), (0, 3))
EMITTER = np.array([2.5, 1.0, 1.6])
RECEIVERS = np.array([[1.0, 1.0, 1.5], [3.0, 2.0, 1.2], [0.8, 2.2, 1.4]])
# A corner of each room of the apartment that the other cannot see, not even in one mirror.
OUT_OF_SIGHT = np.array([4.6, 4.6, 1.4]), np.array([3.5, 0.5, 1.5])


def shoebox(*, absorption=0.3, scattering=0.3):
    material = Material(absorption=(absorption,) * 7, scattering=(scattering,) * 7)
    return Geometry(
        height_m=2.5, corners=CORNERS, materials=Materials(walls=material, floor=material, ceiling=material)
    )


def trace(geometry, emitter=EMITTER, receivers=RECEIVERS, *, rays=2000, seed=0, image_order=1, duration_s=0.4):
    tracer = RoomTracer(
        geometry,
        Air(),
        receivers,
        duration_s=duration_s,
        image_order=image_order,
        arrival_directions=sphere_directions(12),
    )
    return tracer.trace(emitter, rays=rays, seed=seed)


def computed_by_pyroomacoustics(geometry, emitter, receivers, *, rays=2000, sample_rate=24_000):
    room = pra.Room.from_corners(
        np.array(geometry.corners).T,
        fs=sample_rate,
        max_order=1,
        materials=material(geometry.materials.walls),
        ray_tracing=True,
        air_absorption=True,
    )
    caps = {name: material(getattr(geometry.materials, name)) for name in ("floor", "ceiling")}
    room.extrude(geometry.height_m, materials=caps)
    room.set_ray_tracing(n_rays=rays, receiver_radius=0.4, energy_thres=1e-12, time_thres=0.4)
    room.add_source(emitter)
    room.add_microphone_array(receivers.T)
    pra.random.seed(1)
    room.compute_rir()
    # Its responses begin with half the length of its fractional delay filters.
    return room, [response[0][pra.constants.get("frac_delay_length") // 2 :] for response in room.rir]


def material(of):
    coefficients = ({"coeffs": list(c), "center_freqs": list(OCTAVE_BANDS_HZ)} for c in (of.absorption, of.scattering))
    return pra.Material(*coefficients)


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


@pytest.mark.parametrize("image_order", [0, 1, 3])
def test_the_direct_sound_is_left_out(image_order):
    """All that comes from an absorber is the direct sound: in a room of nothing else there is nothing."""
    for arrivals in trace(shoebox(absorption=1.0), image_order=image_order):
        assert not (np.linalg.norm(arrivals.image_positions - EMITTER, axis=1) < 1e-3).any()
        np.testing.assert_allclose(arrivals.image_amplitudes, 0, atol=1e-6)
        np.testing.assert_allclose(arrivals.energy, 0, atol=1e-9)


def test_a_free_wave_falls_with_distance():
    distance = np.array([0.5, 1.0, 7.0])
    amplitude = free_field_amplitude(distance, Air())
    # Below 1 kHz the air takes less than 0.1 dB over these few metres.
    np.testing.assert_allclose(amplitude[:, :4] * distance[:, None], 1, rtol=0.01)
    # ISO 9613-1, table 1: 105 dB/km at 8 kHz, 20 degrees and 50 % humidity.
    treble_db = 20 * np.log10(amplitude[:, 6] * distance)
    np.testing.assert_allclose(treble_db, -0.105 * distance, rtol=0.01)


def test_images_of_first_order_are_mirrors_in_the_six_walls():
    mirrored = []
    for axis in range(3):
        for wall in (0.0, SIZE_M[axis]):
            image = EMITTER.copy()
            image[axis] = 2 * wall - image[axis]
            mirrored.append(image)
    for arrivals, receiver in zip(trace(shoebox(absorption=0.36, scattering=0.0)), RECEIVERS, strict=True):
        found = arrivals.image_positions[np.lexsort(arrivals.image_positions.round(3).T)]
        np.testing.assert_allclose(found, np.array(mirrored)[np.lexsort(np.round(mirrored, 3).T)], atol=1e-5)
        # One reflection leaves sqrt(1 - 0.36) of the pressure.
        distance = np.linalg.norm(arrivals.image_positions - receiver, axis=1)
        np.testing.assert_allclose(arrivals.image_amplitudes[:, 2] * distance, 0.8, rtol=0.01)


def test_scattering_takes_from_the_mirror_and_gives_to_the_rays():
    plain, rough = (trace(shoebox(scattering=scattering))[0] for scattering in (0.0, 0.5))
    np.testing.assert_allclose(rough.image_amplitudes / plain.image_amplitudes, np.sqrt(0.5), rtol=1e-4)
    assert rough.energy.sum() > plain.energy.sum()


def test_energy_is_that_of_pyroomacoustics_own_responses():
    # At a high rate, for in its noise two impulses may meet in one sample and count as one (0.9 dB at 24 kHz).
    rate, rays = 96_000, 4000
    room, responses = computed_by_pyroomacoustics(shoebox(), EMITTER, RECEIVERS, rays=rays, sample_rate=rate)
    # Asked for first-order images, it lets its rays bring them once more: as ours do without such images.
    imaged, traced = trace(shoebox(), rays=rays), trace(shoebox(), rays=rays, image_order=0)
    too_much = counted_twice(shoebox(), image_order=0, bins=100)
    impulse = np.zeros(8192)
    impulse[4096] = 1
    for start_s, end_s in ((0.0, 0.02), (0.02, 0.06), (0.06, 0.12), (0.12, 0.2)):
        window = slice(round(start_s * rate), round(end_s * rate))
        bins = slice(round(start_s / HISTOGRAM_BIN_S), round(end_s / HISTOGRAM_BIN_S))
        expected = found = 0.0
        for band in range(2, 6):
            passes = np.sum(room.octave_bands.analysis(impulse, band=band) ** 2)
            for images, arrivals, receiver, response in zip(imaged, traced, RECEIVERS, responses, strict=True):
                expected += np.sum(room.octave_bands.analysis(response, band=band)[window] ** 2) / passes
                direct_m = np.linalg.norm(EMITTER - receiver, keepdims=True)
                distance_m = np.append(np.linalg.norm(images.image_positions - receiver, axis=1), direct_m)
                amplitudes = np.append(images.image_amplitudes, free_field_amplitude(direct_m, Air()), axis=0)
                heard = (distance_m >= start_s * 343) & (distance_m < end_s * 343)
                found += np.sum(amplitudes[heard, band] ** 2) + (arrivals.energy * too_much)[:, band, bins].sum()
        assert power_to_db(found / expected) == pytest.approx(0, abs=1.5)


@pytest.mark.parametrize("image_order", [0, 1, 3])
@pytest.mark.parametrize("scattering", [0.0, 0.5, 0.9])
def test_reflected_energy_is_that_of_a_diffuse_field(scattering, image_order):
    """16 pi / R with the room constant R (Kuttruff, Room Acoustics, ch. 5), beside a direct sound of 1 / r**2."""
    absorption = 0.15
    geometry = shoebox(absorption=absorption, scattering=scattering)
    surface = 2 * (SIZE_M * np.roll(SIZE_M, 1)).sum()
    expected = 16 * np.pi * (1 - absorption) / (surface * absorption)
    found = 0.0
    for arrivals in trace(geometry, rays=4000, image_order=image_order, duration_s=0.8):
        found += np.sum(arrivals.image_amplitudes[:, 2] ** 2) + arrivals.energy[:, 2].sum()
    assert power_to_db(found / len(RECEIVERS) / expected) == pytest.approx(0, abs=0.8)


def test_rays_are_sorted_by_where_they_come_from():
    # Without images, rays bring first what the nearest mirror reflects.
    plain = shoebox(scattering=0.0)
    for rays, mirrors, receiver in zip(trace(plain, image_order=0), trace(plain), RECEIVERS, strict=True):
        offsets = mirrors.image_positions - receiver
        distance = np.linalg.norm(offsets, axis=1)
        order = np.argsort(distance)
        bins = (distance[order] / 343 / HISTOGRAM_BIN_S).astype(int)
        alone = [index for index in range(6) if np.sum(bins == bins[index]) == 1]
        for index in alone[:2]:
            towards = offsets[order[index]] / distance[order[index]]
            strongest = np.argmax(rays.energy[:, 0, bins[index]])
            assert sphere_directions(12)[strongest] @ towards > 0.7


@pytest.mark.parametrize("image_order", [0, 1, 2])
def test_reflections_are_images_or_rays_and_never_both(image_order):
    """Whatever the order at which images end and rays begin, without scattering the energy is the same."""
    plain = shoebox(scattering=0.0)
    totals = [
        sum(
            np.sum(a.image_amplitudes[:, 2] ** 2) + a.energy[:, 2].sum() for a in trace(plain, rays=8000, image_order=k)
        )
        for k in (image_order, image_order + 1)
    ]
    assert power_to_db(totals[1] / totals[0]) == pytest.approx(0, abs=0.15)


def test_no_sound_goes_through_a_wall(apartment):
    emitter, receiver = OUT_OF_SIGHT
    (arrivals,) = trace(apartment.geometry, emitter, receiver[None], rays=8000)
    assert len(arrivals.image_positions) == 0
    path_m = apartment.geometry.floor_plan.path_length_m(emitter, receiver)
    begins = np.flatnonzero(arrivals.energy.sum(axis=(0, 1)))[0]
    assert begins >= int(path_m / 343 / HISTOGRAM_BIN_S)
    assert arrivals.energy.sum() > 0


def test_pyroomacoustics_own_responses_go_through_the_wall(apartment):
    """Why `compute_rir` is not used: where nothing is visible, 0.10.1 draws the direct path all the same (earlier
    versions raise)."""
    emitter, receiver = OUT_OF_SIGHT
    _, (response,) = computed_by_pyroomacoustics(apartment.geometry, emitter, receiver[None], rays=500)
    distance = np.linalg.norm(emitter - receiver)
    assert np.argmax(np.abs(response)) == pytest.approx(distance / 343 * 24_000, abs=1)
    assert np.abs(response).max() > 0.5 / distance


def test_decay_is_eyrings_where_the_field_is_diffuse():
    absorption = 0.2
    volume, surface = np.prod(SIZE_M), 2 * (SIZE_M * np.roll(SIZE_M, 1)).sum()
    eyring_s = 0.161 * volume / (-surface * np.log(1 - absorption))
    geometry = shoebox(absorption=absorption, scattering=0.9)
    traced = trace(geometry, rays=4000, duration_s=0.6)
    energy = sum(arrivals.energy[:, 2].sum(axis=0) for arrivals in traced)
    decay_db = power_to_db(np.cumsum(energy[::-1])[::-1] / energy.sum())
    fitted = (decay_db < -5) & (decay_db > -35)
    slope, _ = np.polyfit(np.flatnonzero(fitted) * HISTOGRAM_BIN_S, decay_db[fitted], 1)
    assert -60 / slope == pytest.approx(eyring_s, rel=0.1)


def test_the_seed_decides_the_arrivals():
    first, again, other = (trace(shoebox(), rays=500, seed=seed) for seed in (7, 7, 8))
    for one, same, different in zip(first, again, other, strict=True):
        np.testing.assert_array_equal(one.energy, same.energy)
        np.testing.assert_array_equal(one.image_amplitudes, same.image_amplitudes)
        assert not np.array_equal(one.energy, different.energy)


def test_a_tracer_keeps_nothing_of_the_emitter_before():
    tracer = RoomTracer(
        shoebox(), Air(), RECEIVERS, duration_s=0.2, image_order=1, arrival_directions=sphere_directions(6)
    )
    first = tracer.trace(EMITTER, rays=500, seed=1)
    tracer.trace(EMITTER + 0.3, rays=500, seed=2)
    for one, same in zip(first, tracer.trace(EMITTER, rays=500, seed=1), strict=True):
        np.testing.assert_array_equal(one.energy, same.energy)


def test_the_engine_takes_sound_to_be_as_fast_as_everything_else_does():
    assert pra.constants.get("c") == SPEED_OF_SOUND
