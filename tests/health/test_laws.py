"""Laws against rooms and decays whose answers are known."""

import numpy as np
import pytest

from server.acoustics.codec import Codec
from server.health import laws
from server.health.energies import Predictions
from server.health.poses import EMITTER, LISTENER, YAW, scattered
from server.scene.geometry import Geometry, Material, Materials
from tests.conftest import CODEC, MANIFEST


def room(absorption):
    plain = Material(absorption=(absorption,) * 7, scattering=(0.1,) * 7)
    materials = Materials(walls=plain, floor=plain, ceiling=plain)
    return Geometry(height_m=3.0, corners=((0, 0), (5, 0), (5, 4), (0, 4)), materials=materials)


def energies(decay, *, channels=2, bands=7):
    """(1, channel, band, window) alike in all bands, and one window that was cut short."""
    one = np.append(np.asarray(decay, float), 1e-30)
    return np.broadcast_to(one, (1, channels, bands, one.size)).copy()


def test_the_diffuse_energy_of_a_room_is_that_of_the_textbook():
    surface = 2 * (5 * 4 + 5 * 3 + 4 * 3)
    assert laws.diffuse_energy(room(0.2)) == pytest.approx(16 * np.pi * 0.8 / (surface * 0.2))


def test_a_room_without_absorption_has_a_bound_all_the_same():
    assert np.isfinite(laws.diffuse_energy(room(0.0)))
    assert laws.diffuse_energy(room(1.0)) == 0


def test_the_energy_law_is_broken_by_as_much_as_there_is_too_much():
    pose = np.array([[1, 1, 1.5, 4, 3, 1.5, 0.0]])
    geometric = MANIFEST.model_copy(update={"image_order": 1})
    most = 16 * laws.diffuse_energy(room(0.2))
    some = np.zeros((1, 2, 7, 3))
    some[0, 1, 2, 0] = 4 * most
    assert laws.energy_excess_db(geometric, room(0.2), pose, some) == pytest.approx(10 * np.log10(4))


def test_fields_that_hold_first_reflections_may_have_those_of_a_corner_on_top():
    pose = np.array([[1, 1, 1.5, 3, 1, 1.5, 0.0]])
    some = energies([1.0])
    with_images, without = (
        laws.energy_excess_db(MANIFEST.model_copy(update={"image_order": order}), room(0.9), pose, some)
        for order in (0, 1)
    )
    diffuse = 8 * laws.diffuse_energy(room(0.9))
    assert without - with_images == pytest.approx(10 * np.log10((diffuse + 3 / 2**2) / diffuse))


def test_energies_by_band_and_window_add_up_to_the_energy_of_the_response(bundle, field):
    poses = scattered(bundle, 9, seed=1)
    found = Predictions(field.graph).energies(poses)
    expected = field.energy(poses[:, LISTENER], poses[:, EMITTER], poses[:, YAW])
    np.testing.assert_allclose(found.sum(axis=(-1, -2)), expected, rtol=1e-4)


def test_an_exponential_decay_does_not_rise_and_a_bump_does_by_its_height():
    decay = 10 ** (-np.arange(20) / 4)
    assert laws.decay_rise_db(energies(decay)) == 0
    decay[8] *= 10**1.1  # 11 dB, of which 2.5 are the decay since the window before
    assert laws.decay_rise_db(energies(decay)) == pytest.approx(11 - 2.5)


def test_what_rises_before_the_loudest_window_or_beneath_60_db_is_no_fault():
    late = 10 ** np.r_[-1.0, 0.0, -2.0, -4.0, -6.5, -8.0, -6.2]
    assert laws.decay_rise_db(energies(late)) == 0
    assert laws.decay_rise_db(energies(late * 10 ** np.r_[0, 0, 0, 0, 0, 0, 0.7])) == pytest.approx(5)


@pytest.mark.parametrize("channels", [1, 2])
def test_changes_are_those_of_one_ear_and_one_band(channels):
    before = energies(np.ones(4), channels=channels)
    after = before.copy()
    after[:, 0] *= 2
    assert laws.level_change_db(before, after) == pytest.approx(10 * np.log10(2))
    after = before.copy()
    after[:, -1, 3] *= 2
    assert laws.spectral_change_db(before, after) == pytest.approx(10 * np.log10(2), rel=0.02)
    assert laws.level_change_db(before, after) == pytest.approx(10 * np.log10(8 / 7))


def test_a_band_that_is_masked_counts_for_little():
    before = energies(np.ones(4))
    before[:, :, 5] *= 1e-5
    after = before.copy()
    after[:, :, 5] *= 1e-5
    assert laws.spectral_change_db(before, after) < 0.1


def test_advances_that_were_not_demodulated_sit_on_the_branch_cut_in_every_fourth_bin():
    """Which is what the codec's subtraction is for."""
    codec: Codec = CODEC.codec
    plain = np.angle(np.exp(1j * np.broadcast_to(codec.nominal_advance, (codec.bins, 9))))
    assert laws.branch_cut_share(plain) == pytest.approx(25, abs=1)
    assert laws.branch_cut_share(np.zeros_like(plain)) == 0
    chance = np.random.default_rng(0).uniform(-np.pi, np.pi, (400, 400))
    assert laws.branch_cut_share(chance) == pytest.approx(100 * 0.1 / np.pi, rel=0.05)
    assert laws.branch_cut_share(plain[:, :1]) == 0
