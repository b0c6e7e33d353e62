"""Ambisonic decoding: channels have the covariance that the predicted powers give them."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.signal import butter, sosfiltfilt, sosfreqz

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.geometry import Quaternion
from server.acoustics.spherical_harmonics import harmonic_count, mean_squares, real_harmonics, rotation
from server.field.ambisonic_decoder import AmbisonicDecoder, _mixing, powers_by_direction, virtual_directions
from server.field.directional_graph import Arrivals
from server.rendering.ear_products import EarProducts
from server.rendering.hrtf import KEMAR, Hrtf
from server.rendering.sphere import solid_angles
from server.scene.manifest import CodecParameters
from tests.oracles.ambisonic_decoder import SlowAmbisonicDecoder

BANDS = len(OCTAVE_BANDS_HZ)
COLUMNS = 12
SAMPLES = 96_000
LONG = CodecParameters(
    sample_rate=24_000,
    n_fft=256,
    hop=64,
    samples=SAMPLES,
    lead_samples=64,
    known_frames=0,
    log_floor=1e-5,
    frame_cells=(1,) * 11 + (SAMPLES // 64 + 2 - 11 + 1,),
)
DECAYING = LONG.model_copy(update={"frame_cells": (1,) * 24 + (8,) * 184 + (SAMPLES // 64 + 3 - 24 - 8 * 184,)})
AXES = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, -0.48, 0.64], [-0.36, 0.48, -0.8]])


def between_bands():
    octave = np.log2(np.maximum(np.linspace(0, 12_000, LONG.codec.bins), 1.0) / OCTAVE_BANDS_HZ[0])
    position = np.clip(octave, 0, BANDS - 1)
    band = np.minimum(position.astype(np.int64), BANDS - 2)
    return band, (position - band).astype(np.float32)


def steady(moments):
    """Arrivals of constant unit power density with these harmonics."""
    level = np.log(np.sqrt(LONG.codec.window_energy) + LONG.log_floor)
    each = np.ones((1, 1, BANDS, COLUMNS), np.float32)
    return Arrivals((level * each[0]).astype(np.float32), np.asarray(moments, np.float32)[None, 1:, None, None] * each)


def decoded(moments, order, aligned=0.0):
    decoder = AmbisonicDecoder(LONG, ir_samples=SAMPLES)
    return decoder.decode(steady(moments), np.array([aligned]), order)[0]


def covariance(channels):
    middle = channels[:, 2_000:-2_000].astype(np.float64)
    return middle @ middle.T / middle.shape[1]


def test_virtual_directions_are_a_design_of_strength_seven():
    x, y, z = virtual_directions().T
    assert len(np.unique(np.round(virtual_directions(), 6), axis=0)) == 24
    for i in range(8):
        for j in range(8 - i):
            for k in range(8 - i - j):
                # The mean of a monomial over the sphere, by double factorials.
                even = all(power % 2 == 0 for power in (i, j, k))
                odd = [np.prod(np.arange(1, power, 2)) for power in (i, j, k, i + j + k + 2)]
                expected = odd[0] * odd[1] * odd[2] / odd[3] if even else 0.0
                assert np.mean(x**i * y**j * z**k) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("order", [0, 1, 2, 3])
@given(seed=st.integers(0, 2**32 - 1))
def test_what_powers_can_have_they_have(order, seed):
    """The harmonics of any powers at the virtual directions, moved a little towards diffuse, are met."""
    rng = np.random.default_rng(seed)
    harmonics = real_harmonics(virtual_directions(), order)
    wanted = rng.dirichlet(np.full(24, 0.5)) @ harmonics
    wanted[1:] *= 0.7
    powers = powers_by_direction(wanted)
    assert (powers >= 0).all()
    assert powers.sum() == pytest.approx(1)
    assert_allclose(powers @ harmonics, wanted, atol=0.03)


@given(seed=st.integers(0, 2**32 - 1))
def test_whatever_harmonics_a_network_gives_powers_are_not_negative(seed):
    rng = np.random.default_rng(seed)
    wanted = np.concatenate([np.ones((50, 1)), rng.uniform(-1, 1, (50, 15))], axis=-1)
    powers = powers_by_direction(wanted)
    assert (powers >= 0).all()
    assert_allclose(powers.sum(axis=-1), 1)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_a_wave_of_one_direction_is_heard_from_there(order):
    """As narrow as 24 directions can have it: its energy vector is long, and points there."""
    rng = np.random.default_rng(order)
    towards = rng.standard_normal((200, 3))
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    vectors = powers_by_direction(real_harmonics(towards, order)) @ virtual_directions()
    lengths = np.linalg.norm(vectors, axis=-1)
    assert lengths.mean() > (0.83, 0.79, 0.70)[order - 1]
    assert np.degrees(np.arccos(np.vecdot(vectors, towards) / lengths)).max() < 3


@pytest.mark.parametrize("order", [1, 2, 3])
def test_a_wave_from_a_virtual_direction_has_the_channels_of_a_plane_wave(order):
    for number in (0, 7, 15):
        towards = virtual_directions()[number]
        channels = decoded(real_harmonics(towards, 3), order)
        expected = real_harmonics(towards, order)
        found = covariance(channels)
        # Of 24 directions one has nearly all: what is left over is a few percent of power.
        assert_allclose(found[0] / found[0, 0], expected, atol=0.12)
        assert found[0, 0] == pytest.approx(1, rel=0.05)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_diffuse_sound_has_independent_channels_of_the_power_that_sn3d_gives_them(order):
    found = covariance(decoded(np.eye(16)[0], order))
    # Some 90 000 samples: a correlation is uncertain by 0.003.
    scale = np.sqrt(mean_squares(order))
    assert_allclose(found / np.outer(scale, scale), np.eye(harmonic_count(order)), atol=0.02)


@pytest.mark.parametrize("towards", AXES)
def test_the_covariance_is_that_of_the_powers(towards):
    moments = 0.5 * real_harmonics(towards, 2)
    moments[0] = 1
    powers = powers_by_direction(moments)
    harmonics = real_harmonics(virtual_directions(), 3)
    expected = np.einsum("d,dk,dl->kl", powers, harmonics, harmonics)
    assert_allclose(covariance(decoded(moments, 3)), expected, atol=0.02)
    # And its first row is what was predicted.
    assert_allclose(expected[0, :9], moments, atol=0.02)


def test_the_first_channel_is_the_same_at_all_orders():
    moments = np.r_[1, 0.3, -0.2, 0.5]
    first = decoded(moments, 0, aligned=100.3)[0]
    for order in (1, 2, 3):
        channels = decoded(moments, order, aligned=100.3)
        assert_array_equal(channels[0], first)
        assert_array_equal(decoded(moments, order, aligned=100.3), channels)


def test_lower_orders_have_the_covariance_of_the_first_channels_of_higher_ones():
    moments = mixed((0.6, -0.48, 0.64), 0.5)
    whole = covariance(decoded(moments, 3))
    for order in (1, 2):
        found = covariance(decoded(moments, order))
        assert_allclose(found, whole[: len(found), : len(found)], atol=0.04)


def mixing(moments, order):
    """(k, noise) of one prediction."""
    directions = np.asarray(moments, np.float32)[1:, None, None] * np.ones((1, BANDS, 13), np.float32)
    found = _mixing(directions, harmonic_count(order)).astype(np.float64)
    assert_array_equal(found, found[..., :1, :1] * np.ones_like(found))
    return found[..., 0, 0]


def second_moments(directions, powers):
    harmonics = real_harmonics(directions, 1)
    return np.einsum("d,dk,dl->kl", powers, harmonics, harmonics)


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 30))
def test_a_first_order_has_exactly_the_covariance_of_the_sound(seed, count):
    """One wave alone, a few, or many; also opposite ones, whose first harmonics cancel."""
    rng = np.random.default_rng(seed)
    directions = rng.standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    if count % 2:
        directions = np.concatenate([directions, -directions])
    powers = rng.dirichlet(np.full(len(directions), 0.5))
    root = mixing(powers @ real_harmonics(directions, 2), 1)
    assert_allclose(root @ root.T, second_moments(directions, powers), atol=2e-4)


@pytest.mark.parametrize("towards", [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, -1), (0.6, 0, 0.8)])
@pytest.mark.parametrize("known", [1, 2, 3])
def test_one_wave_alone_is_a_plane_wave(towards, known):
    root = mixing(real_harmonics(np.array(towards, float), known), 1)
    assert_allclose(root @ root.T, np.outer(*[real_harmonics(np.array(towards, float), 1)] * 2), atol=2e-3)


@given(seed=st.integers(0, 2**32 - 1), known=st.sampled_from([4, 9, 16]))
def test_whatever_harmonics_a_network_gives_a_first_order_is_finite_and_has_its_level(seed, known):
    moments = np.r_[1, np.random.default_rng(seed).uniform(-1, 1, known - 1)]
    root = mixing(moments, 1)
    found = root @ root.T
    assert np.isfinite(root).all()
    assert found[0, 0] == 1
    # The three axes share the power of the sound, as they do of a wave from anywhere; and never have more of it.
    rest = np.linalg.norm(moments[1:4])
    assert np.trace(found[1:, 1:]) == pytest.approx(1, abs=1e-3) or rest > 0.99
    assert np.trace(found[1:, 1:]) < 1 + 1e-3


@given(seed=st.integers(0, 2**32 - 1), known=st.sampled_from([4, 9]))
def test_a_root_turns_with_the_sound(seed, known):
    """So the channels of a turned scene have the covariance of turned channels."""
    rng = np.random.default_rng(seed)
    order = round(known**0.5) - 1
    moments = np.r_[1, rng.uniform(-0.5, 0.5, known - 1)]
    turn = Quaternion(*rng.standard_normal(4))
    one, other = mixing(moments, 1), mixing(rotation(turn, order) @ moments, 1)
    matrix = rotation(turn, 1)
    assert_allclose(other, matrix @ one @ matrix.T, atol=5e-3)


@given(seed=st.integers(0, 2**32 - 1))
def test_a_root_does_not_jump(seed):
    """On the way from any sound to any other, by way of one that has a single direction."""
    rng = np.random.default_rng(seed)
    towards = rng.standard_normal((3, 3))
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    ends = real_harmonics(towards, 2)
    way = [
        before + (after - before) * share
        for before, after in ((ends[0], ends[1]), (ends[1], np.eye(9)[0]), (np.eye(9)[0], -ends[2] + 2 * np.eye(9)[0]))
        for share in np.linspace(0, 1, 40)
    ]
    roots = np.array([mixing(moments, 1) for moments in way])
    # A root changes at most by the root of the change.
    most = np.sqrt(np.abs(np.diff(way, axis=0)).max(axis=-1) * 4)
    assert (np.abs(np.diff(roots, axis=0)).max(axis=(1, 2)) < most + 2e-3).all()


@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_levels_are_those_of_the_slow_way(order):
    """Sound that decays, unlike in each band, from one side: by channel and part of the response, in decibels."""
    edges = DECAYING.frame_axis.edges
    centres_s = (edges[:-1] + edges[1:] - 1) / 2 * 64 / 24_000
    log = (-np.outer(np.linspace(20, 35, BANDS), centres_s) / 20 * np.log(10)).astype(np.float32)[None]
    relative = mixed((0.6, -0.48, 0.64), 0.6).astype(np.float32)
    arrivals = Arrivals(log, np.ones((1, 8, *log.shape[1:]), np.float32) * relative[1:, None, None])
    quick = AmbisonicDecoder(DECAYING, ir_samples=SAMPLES).decode(arrivals, np.array([333.3]), order)[0]
    slow = SlowAmbisonicDecoder(DECAYING, ir_samples=SAMPLES).decode(
        arrivals, between_bands(), np.array([333.3]), order
    )[0]
    parts = slice(600, 12_600), slice(12_600, 36_600), slice(36_600, 84_600)
    for part in parts:
        found, expected = (np.sum(each[:, part].astype(float) ** 2, axis=-1) for each in (quick, slow))
        assert_allclose(10 * np.log10(found / expected)[: 4 if order < 2 else None], 0, atol=0.8)


def expected_energy(log, centres, starts, aligned):
    """(start, octave) energy of what an omnidirectional microphone hears, after a filter of each octave there and back,
    by arithmetic: power is interpolated over the logarithm of frequency, and its root in time."""
    place = centres * 64 - LONG.codec.frame_lead_samples + 128 + aligned
    sample = np.arange(SAMPLES)
    frequency = np.fft.rfftfreq(4096, 1 / 24_000)
    position = np.clip(np.log2(np.maximum(frequency, 1) / 125), 0, BANDS - 1)
    weights = np.maximum(0, 1 - np.abs(position - np.arange(BANDS)[:, None]))
    gains = np.array([np.abs(sosfreqz(octave(band), frequency, fs=24_000)[1]) ** 4 for band in range(BANDS)])
    shares = np.mean(weights * gains[:, None], axis=-1)  # of each octave's filter, from each band
    power = np.array([np.interp(sample, place, np.exp(level)) ** 2 for level in log]) / LONG.codec.window_energy
    return np.array([power[:, start:].sum(axis=1) @ shares.T for start in starts])


def octave(band):
    return butter(2, OCTAVE_BANDS_HZ[band] * np.sqrt([0.5, 1.98]), "bandpass", fs=24_000, output="sos")


@pytest.mark.parametrize("order", [1, 2, 3])
def test_each_octave_has_its_level_and_its_directions_whenever_one_listens(order):
    """A decay unlike in each band, partly from one side: from each of many moments on, what is heard is what is asked.
    White noises would be off by twice as much."""
    edges = DECAYING.frame_axis.edges
    centres = (edges[:-1] + edges[1:] - 1) / 2
    decay_s = np.linspace(0.6, 0.3, BANDS)
    log = (-np.log(1000) * (centres * 64 / 24_000) / decay_s[:, None]).astype(np.float32)
    relative = mixed((0.6, -0.48, 0.64), 0.6).astype(np.float32)
    arrivals = Arrivals(log[None], np.ones((1, 8, *log.shape), np.float32) * relative[1:, None, None])
    channels = AmbisonicDecoder(DECAYING, ir_samples=SAMPLES).decode(arrivals, np.array([333.3]), order)[0]
    starts = np.arange(700, 6000, 330)
    filtered = [sosfiltfilt(octave(band), channels.astype(np.float64), axis=-1) for band in range(BANDS)]
    found = np.array([[part[:, start:] @ part[:, start:].T for part in filtered] for start in starts])
    relative_to_asked = found / expected_energy(log.astype(float), centres, starts, 333.3)[..., None, None]
    level_db = 10 * np.log10(relative_to_asked[..., 0, 0])
    assert (np.sqrt(np.mean(level_db**2, axis=0)) < [1.0, 0.5, 0.4, 0.35, 0.3, 0.2, 0.2]).all()
    assert_allclose(level_db.mean(axis=0), 0, atol=0.3)
    root = _mixing(arrivals.directions[0], harmonic_count(order))[..., 0, 0].astype(np.float64)
    off = relative_to_asked - root @ root.T
    assert (np.sqrt(np.mean(off**2, axis=(0, 2, 3))) < [0.25, 0.13, 0.07, 0.06, 0.05, 0.04, 0.03]).all()


def test_responses_are_the_same_in_any_batch_and_on_any_thread():
    rng = np.random.default_rng(3)
    log = rng.uniform(-3, 0, (4, BANDS, COLUMNS)).astype(np.float32)
    directions = rng.uniform(-0.4, 0.4, (4, 8, BANDS, COLUMNS)).astype(np.float32)
    aligned = np.array([0.0, 10.5, 333.3, 5.0])
    decoder = AmbisonicDecoder(LONG, ir_samples=SAMPLES)
    for order in (1, 2):
        together = decoder.decode(Arrivals(log, directions), aligned, order)

        def one(row, order=order):
            rows = slice(row, row + 1)
            return decoder.decode(Arrivals(log[rows], directions[rows]), aligned[rows], order)[0]

        with ThreadPoolExecutor(4) as pool:
            assert_array_equal(list(pool.map(one, range(4))), together)


def test_sound_begins_with_its_delay():
    late = decoded(np.eye(4)[0], 1, aligned=24_000.0)
    assert not late[:, : 24_000 - 256].any()
    assert covariance(late[:, 24_000:])[0, 0] == pytest.approx(1, rel=0.02)


def test_silence_is_silent():
    moments = np.eye(4)[0]
    quiet = Arrivals(np.full((1, BANDS, COLUMNS), -30.0, np.float32), steady(moments).directions)
    decoder = AmbisonicDecoder(LONG, ir_samples=SAMPLES)
    assert np.abs(decoder.decode(quiet, np.zeros(1), 1)).max() < 1e-12  # what rounding leaves


BINS = LONG.codec.bins
SWEET_HZ = 620.0
"""Up to so many Hz for each order, ears are within the part of the sound field that an order describes."""


@pytest.fixture(scope="module")
def head():
    """Directions (d, 3), weights (d,) and spectra (d, ear, bin) of KEMAR as it was measured."""
    hrtf = Hrtf.read(KEMAR, 24_000)
    spectra = np.fft.rfft(hrtf.impulse_responses, 2 * (BINS - 1))
    return hrtf.directions, solid_angles(hrtf.directions), spectra


def ear_filters(head, order):
    """(k, ear, bin) filters from channels to ears: least squares, above some frequency of the magnitudes alone
    (Schoerkhuber, Zaunschirm and Hoeldrich, DAGA 2018)."""
    directions, weights, spectra = head
    harmonics = real_harmonics(directions, order)
    root = np.sqrt(weights)[:, None]
    solve = np.linalg.pinv(root * harmonics) * root.T
    filters = np.einsum("kd,def->kef", solve, spectra)
    for number in range(round(order * SWEET_HZ / 12_000 * (BINS - 1)), BINS):
        phase = np.angle(np.einsum("dk,ke->de", harmonics, filters[..., number - 1]))
        filters[..., number] = np.einsum("kd,de->ke", solve, np.abs(spectra[..., number]) * np.exp(1j * phase))
    return filters


def in_octaves(power):
    """(..., band) means of a power (..., bin), from 250 Hz on."""
    frequency, centres = np.linspace(0, 12_000, BINS), np.asarray(OCTAVE_BANDS_HZ[1:])
    inside = (frequency > centres[:, None] / np.sqrt(2)) & (frequency < centres[:, None] * np.sqrt(2))
    return power @ inside.T / inside.sum(axis=-1)


def against_ears(moments, order, head, filters):
    """(2, band) differences in dB of level and of interaural level, of what a head hears of the channels to what the
    same field gives its ears directly."""
    to_ears = ear_filters(head, order)
    heard = np.einsum("kef,kl,lef->ef", to_ears, covariance(decoded(moments, order)), to_ears.conj()).real
    direct = EarProducts.of(filters, bins=BINS, order=2).matrix[:, :2] @ moments
    ears, expected = in_octaves(heard), in_octaves(direct.T)
    level = 10 * np.log10(ears.sum(axis=0) / expected.sum(axis=0))
    ild = 10 * np.log10(ears[0] / ears[1]) - 10 * np.log10(expected[0] / expected[1])
    return np.array([level, ild])


def mixed(towards, share):
    moments = share * real_harmonics(np.asarray(towards), 2)
    moments[0] = 1
    return moments


FIELDS = {"diffuse": (AXES[0], 0.0), "ahead": (AXES[0], 0.5), "left": (AXES[1], 0.5), "above": (AXES[3], 0.5)}


@pytest.mark.parametrize(("order", "most_level_db", "most_ild_db"), [(1, 1.5, 1.2), (2, 0.8, 1.0), (3, 1.0, 1.0)])
def test_heard_through_a_head_it_is_the_binaural_response(head, filters, order, most_level_db, most_ild_db):
    worst = np.zeros(2)
    for name, (towards, share) in FIELDS.items():
        found = against_ears(mixed(towards, share), order, head, filters)
        print(order, name, "level", np.round(found[0], 2), "ILD", np.round(found[1], 2))
        worst = np.maximum(worst, np.abs(found).max(axis=-1))
    assert worst[0] < most_level_db
    assert worst[1] < most_ild_db


def test_turned_channels_are_those_of_turned_directions():
    """Over the frozen noise a rotation of the channels is exact: no draw of its own."""
    turn = rotation(Quaternion.from_angles(0.7, -0.3, 1.1), 3)
    moments = mixed(AXES[4], 0.4)
    channels = decoded(moments, 3)
    assert_allclose(covariance(turn @ channels), turn @ covariance(channels) @ turn.T, atol=1e-9)
    assert_allclose((turn @ covariance(channels))[:9, 0], turn[:9, :9] @ moments, atol=0.03)
