"""Laws against rooms and decays whose answers are known."""

import numpy as np
import pytest

from server.acoustics.codec import Codec
from server.health import laws
from server.health.energies import Predictions
from server.health.poses import EMITTER, LISTENER, YAW, scattered
from server.scene.geometry import Geometry, Material, Materials
from server.scene.manifest import DataReference
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


def test_a_decay_of_two_slopes_does_not_rise():
    """As in a dry room beside a live one."""
    time_s = 0.02 * np.arange(60)
    assert laws.decay_rise_db(energies(10 ** (-20 * time_s) + 1e-3 * 10 ** (-3 * time_s))) == 0


def flutter(windows=40, echo=4.0):
    """Between two hard walls in an absorbent room: every fifth window is some six decibels above what lies between."""
    decay = 10 ** (-np.arange(windows) / 12)
    decay[5::5] *= echo
    return decay


def reference(*decays):
    """Of data that decay so."""
    rises = np.max([laws.rises_db(energies(decay))[0, 0] for decay in decays], axis=0)
    return DataReference(responses=len(decays), window_s=0.02, rises_db=tuple(rises))


def test_a_field_may_rise_as_its_data_do_and_no_more():
    windows, usual = 40, reference(flutter())
    allowed = laws.usual_rises_db(usual, windows, 0.02)
    assert laws.decay_rise_db(energies(flutter())) > 3
    assert laws.decay_rise_db(energies(flutter()), allowed) == 0
    louder = laws.decay_rise_db(energies(flutter(echo=40.0)), allowed)
    assert louder == pytest.approx(10, abs=0.01)


def test_a_field_that_rises_when_its_data_do_not_is_refused_all_the_same():
    """A corridor that comes back once, after 0.2 s, does not explain an echo after 0.6 s."""
    plain = 10 ** (-np.arange(40) / 8)
    once, late = plain.copy(), plain.copy()
    once[10] *= 30
    late[30] *= 30
    allowed = laws.usual_rises_db(reference(once), 40, 0.02)
    assert laws.decay_rise_db(energies(once), allowed) == 0
    assert laws.decay_rise_db(energies(late), allowed) > 10


def test_between_places_of_data_an_echo_may_come_a_little_sooner_or_later():
    decay = 10 ** (-np.arange(40) / 8)
    first, moved = decay.copy(), decay.copy()
    first[20] *= 30
    moved[22] *= 30
    assert laws.decay_rise_db(energies(moved), laws.usual_rises_db(reference(first), 40, 0.02)) < 1


def test_data_of_other_windows_are_a_reference_for_the_same_times():
    usual = DataReference(responses=1, window_s=0.01, rises_db=(0.0,) * 40 + (9.0,) + (0.0,) * 39)
    allowed = laws.usual_rises_db(usual, 40, 0.02)
    assert allowed[20] == 9
    assert not allowed[:15].any()
    assert not allowed[27:].any()


def test_without_a_reference_nothing_may_rise():
    assert not laws.usual_rises_db(None, 5, 0.02).any()
    assert laws.usual_excess_db(None) == 0


@pytest.mark.parametrize(("data_db", "allowed_db"), [(-20.0, 0.0), (-1.0, 2.0), (5.0, 8.0)])
def test_a_field_may_be_3_db_louder_than_its_data(data_db, allowed_db):
    usual = DataReference(responses=1, window_s=0.02, rises_db=(), energy_excess_db=data_db)
    assert laws.usual_excess_db(usual) == allowed_db


def test_a_centimetre_near_an_emitter_changes_the_direct_sound_by_the_distance_law():
    before = np.array([[0.04, 0, 0, 0, 0, 0, 0], [1.0, 0, 0, 0, 0, 0, 0], [0.001, 0, 0, 0, 0, 0, 0]])
    after = before + np.array([0.01, 0, 0, 0, 0, 0, 0])
    measured = MANIFEST.model_copy(update={"direct_sound": "field", "channels": ("mono",)})
    found = laws.spreading_db(measured, before, after)
    np.testing.assert_allclose(found[:2], [1.938, 0.0864], atol=0.001)
    assert found[2] == 0  # within the emitter itself
    np.testing.assert_allclose(laws.spreading_db(measured, after, before), found)
    assert not laws.spreading_db(MANIFEST, before, after).any()


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
