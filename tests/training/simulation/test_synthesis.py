from dataclasses import replace

import numpy as np
import pytest

from server.acoustics.decibels import power_to_db
from server.rendering.hrtf import kemar as kemar_at
from training.data.scene_file import HISTOGRAM_BIN_S
from training.simulation.rays import sphere_directions
from training.simulation.synthesis import BinauralSynthesis, rotate_into_head
from training.simulation.tracing import Arrivals

RATE = 24_000
SAMPLES = 6000
BINS = round(SAMPLES / RATE / HISTOGRAM_BIN_S)
DIRECTIONS = sphere_directions(24)
HERE = np.array([1.0, 2.0, 1.5])
YAWS = 2 * np.pi * np.arange(4) / 4


def rendering(hrtf, *, samples=SAMPLES, yaws=YAWS):
    return BinauralSynthesis(hrtf, DIRECTIONS, np.asarray(yaws), samples)


def specular(offset, *, bins=BINS):
    """One specular arrival, apparently from `offset` from the receiver, falling as one over the distance."""
    offset = np.asarray(offset, dtype=float)
    amplitude = np.full((1, 7), 1 / np.linalg.norm(offset))
    return Arrivals(HERE + offset[None], amplitude, np.zeros((len(DIRECTIONS), 7, bins)))


def diffuse(energy):
    """Only what rays bring: (direction, bin) energies, the same in every band."""
    return Arrivals(np.zeros((0, 3)), np.zeros((0, 7)), np.repeat(energy[:, None], 7, axis=1))


def energy_db(response):
    return power_to_db(np.sum(response**2, axis=-1))


@pytest.mark.parametrize("sample_rate", [16_000, 22_050, 24_000, 48_000])
@pytest.mark.parametrize("distance_m", [1.0, 2.345, 7.0])
def test_a_specular_arrival_comes_after_its_way(sample_rate, distance_m):
    synthesis = rendering(kemar_at(sample_rate), samples=sample_rate // 4)
    response = synthesis.render(specular((distance_m, 0, 0)), HERE, distance_m / 343, np.random.default_rng(0))
    ahead = np.abs(response[0])  # yaw 0 looks along +x
    onset = np.argmax(ahead > 0.1 * ahead.max(axis=-1, keepdims=True), axis=-1)
    np.testing.assert_allclose(onset, distance_m / 343 * sample_rate, atol=1e-4 * sample_rate)


def test_arrivals_keep_the_level_they_were_traced_with(kemar):
    near, far = (
        rendering(kemar).render(specular((r, 0, 0)), HERE, r / 343, np.random.default_rng(0))
        for r in (343 / 120, 686 / 120)
    )
    # Whole samples apart, so that the two are copies.
    np.testing.assert_allclose(far[..., 200:], near[..., :-200] / 2, atol=1e-7)


def test_the_ear_towards_the_emitter_is_louder(kemar):
    response = rendering(kemar).render(specular((0, 3, 0)), HERE, 3 / 343, np.random.default_rng(0))
    left, right = energy_db(response).T
    # The emitter is north; yaws look east, north, west and south.
    assert left[0] > right[0] + 6
    assert right[2] > left[2] + 6
    assert left[1] == pytest.approx(right[1], abs=1)


def test_turning_round_swaps_the_ears(kemar):
    """Emitters north and south of the head, alike: what one ear hears looking east, the other hears looking west.
    KEMAR is symmetric by construction of its measurements."""
    response = rendering(kemar).render(specular((0, 3, 0)), HERE, 3 / 343, np.random.default_rng(0))
    peak = np.abs(response).max()
    np.testing.assert_allclose(response[2, ::-1], response[0], atol=0.02 * peak)


def test_a_wall_that_takes_the_treble_delays_nothing(kemar):
    plain = specular((3, 0, 0))
    dull = replace(plain, image_amplitudes=plain.image_amplitudes * np.linspace(1, 0.1, 7))
    bright, muffled = (rendering(kemar).render(a, HERE, 3 / 343, np.random.default_rng(0))[0, 0] for a in (plain, dull))
    gain = np.abs(np.fft.rfft(muffled) / np.fft.rfft(bright))
    frequency = np.fft.rfftfreq(SAMPLES, 1 / RATE)
    for band, expected in zip((250, 1000, 4000, 8000), np.linspace(1, 0.1, 7)[[1, 3, 5, 6]], strict=True):
        assert gain[np.argmin(np.abs(frequency - band))] == pytest.approx(expected, rel=0.1)
    assert np.argmax(np.abs(muffled) > 0.1 * np.abs(muffled).max()) == pytest.approx(3 / 343 * RATE, abs=2)


def test_diffuse_energy_is_that_of_the_histogram(kemar):
    decay = np.exp(-np.arange(BINS) / 12)
    response = rendering(kemar).render(
        diffuse(np.full((len(DIRECTIONS), BINS), 1 / len(DIRECTIONS)) * decay), HERE, 0, np.random.default_rng(1)
    )
    # Heard from everywhere, each ear of the head has unit gain; four orientations share one noise.
    in_time = np.sum(response**2, axis=(0, 1)) / response[..., 0].size
    for start, end in ((2, 8), (8, 20), (20, 40), (40, BINS - 2)):
        window = slice(*(round(b * HISTOGRAM_BIN_S * RATE) for b in (start, end)))
        found, expected = in_time[window].sum(), decay[start:end].sum()
        assert power_to_db(found / expected) == pytest.approx(0, abs=0.7)


def test_diffuse_sound_is_heard_from_where_it_comes(kemar):
    energy = np.where(DIRECTIONS[:, 1:2] > 0.7, np.exp(-np.arange(BINS) / 12), 0)  # north
    response = rendering(kemar).render(diffuse(energy), HERE, 0, np.random.default_rng(1))
    left, right = energy_db(response).T
    assert left[0] > right[0] + 3
    assert right[2] > left[2] + 3


def test_nothing_sounds_before_it_can_arrive(kemar):
    onset_s = 0.02
    arrivals = replace(specular((onset_s * 343, 0, 0)), energy=np.ones((len(DIRECTIONS), 7, BINS)))
    response = rendering(kemar).render(arrivals, HERE, onset_s, np.random.default_rng(0))
    # The nearer ear is a quarter of a millisecond early, and delays by fractions of samples ring.
    first = round((onset_s - 0.001) * RATE)
    assert np.abs(response[..., first:]).max() > 0.01
    np.testing.assert_array_equal(response[..., :first], 0)


def test_what_arrives_after_the_end_is_left_out(kemar):
    response = rendering(kemar).render(specular((343.0, 0, 0)), HERE, 1.0, np.random.default_rng(0))
    np.testing.assert_array_equal(response, 0)


def test_rotation_into_the_head_is_undone_by_turning_back():
    rng = np.random.default_rng(0)
    directions = rng.standard_normal((50, 3))
    yaws = rng.uniform(-7, 7, 5)
    heard = rotate_into_head(directions, yaws)
    for index, yaw in enumerate(yaws):
        back = rotate_into_head(heard[:, index], np.array([-yaw]))[:, 0]
        np.testing.assert_allclose(back, directions, atol=1e-12)


def test_north_is_left_of_a_head_that_looks_east():
    north = np.array([[0.0, 1.0, 0.0]])
    np.testing.assert_allclose(rotate_into_head(north, np.array([0.0]))[0, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(rotate_into_head(north, np.array([np.pi / 2]))[0, 0], [1, 0, 0], atol=1e-12)
