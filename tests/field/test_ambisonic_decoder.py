"""Ambisonic decoding: channels have the covariance that the predicted powers give them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.geometry import Quaternion
from server.acoustics.spherical_harmonics import harmonic_count, mean_squares, real_harmonics, rotation
from server.field.ambisonic_decoder import AmbisonicDecoder, powers_by_direction, virtual_directions
from server.field.directional_graph import Arrivals
from server.rendering.ear_products import EarProducts
from server.rendering.hrtf import KEMAR, Hrtf
from server.rendering.sphere import solid_angles
from server.scene.manifest import CodecParameters

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
    return decoder.decode(steady(moments), between_bands(), np.array([aligned]), order)[0]


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


def test_lower_orders_are_the_first_channels_of_higher_ones():
    moments = np.r_[1, 0.3, -0.2, 0.5]
    whole = decoded(moments, 3, aligned=100.3)
    for order in (0, 1, 2):
        assert_allclose(decoded(moments, order, aligned=100.3), whole[: harmonic_count(order)], atol=1e-6)
    assert_array_equal(decoded(moments, 3, aligned=100.3), whole)


def test_sound_begins_with_its_delay():
    late = decoded(np.eye(4)[0], 1, aligned=24_000.0)
    assert not late[:, : 24_000 - 256].any()
    assert covariance(late[:, 24_000:])[0, 0] == pytest.approx(1, rel=0.02)


def test_silence_is_silent():
    moments = np.eye(4)[0]
    quiet = Arrivals(np.full((1, BANDS, COLUMNS), -30.0, np.float32), steady(moments).directions)
    decoder = AmbisonicDecoder(LONG, ir_samples=SAMPLES)
    assert np.abs(decoder.decode(quiet, between_bands(), np.zeros(1), 1)).max() < 1e-12  # what rounding leaves


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
