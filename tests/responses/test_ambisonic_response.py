"""Ambisonic responses: plane waves from where paths arrive, and the reflected field of a directional bundle."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from server.acoustics.geometry import Quaternion
from server.acoustics.spherical_harmonics import harmonic_count, mean_squares, real_harmonics, rotation
from server.core.errors import RequestError
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.responses.ambisonic_response import AmbisonicResponse
from server.responses.mono_response import mono_responses
from server.scene.bundle import Bundle, find_bundle, write_bundle
from server.scene.manifest import QualityLevel
from tests.directional_flat import FILE, directional_graph, directional_manifest, write_directional

LISTENER, EMITTER = (2.0, 2.5, 1.5), (6.0, 3.0, 1.4)
LEVEL = (0.0, 0.0, 0.0, 1.0)


@pytest.fixture(scope="module")
def diffuse(tmp_path_factory):
    return AcousticField.load(write_directional(tmp_path_factory.mktemp("scenes") / "flat"))


@pytest.fixture(scope="module")
def from_the_north(tmp_path_factory):
    return AcousticField.load(write_directional(tmp_path_factory.mktemp("scenes") / "flat", towards=(0.0, 1.0, 0.0)))


@pytest.fixture(scope="module")
def open_field():
    return AcousticField.load(Bundle.load(find_bundle("open-field")))


def one(field, order, head=LEVEL, listener=LISTENER, emitter=EMITTER):
    return AmbisonicResponse(field).impulse_responses([listener], [emitter], [head], order)[0]


@pytest.mark.parametrize("order", [0, 1, 2, 3])
@pytest.mark.parametrize("towards", [(3.0, 0.0, 0.0), (0.0, -4.0, 0.0), (1.0, 2.0, 1.2)])
def test_direct_sound_is_a_plane_wave_from_its_emitter(open_field, order, towards):
    listener = np.array((0.0, 0.0, 1.5))
    response = one(open_field, order, listener=listener, emitter=listener + towards)
    harmonics = real_harmonics(np.array(towards) / np.linalg.norm(towards), order)
    assert_allclose(response, harmonics[:, None] * response[0], atol=1e-6)
    first = int(np.argmax(np.abs(response[0])))
    assert first / open_field.sample_rate == pytest.approx(np.linalg.norm(towards) / 343.0, abs=1e-4)
    # A sum over samples is the gain of the lowest frequencies: 1 / r.
    assert response[0].sum() == pytest.approx(1 / np.linalg.norm(towards), rel=0.03)


def test_first_reflections_come_from_their_walls(diffuse):
    """What geometry adds is direct sound and reflections, each by way of its own wall: compared path by path with the
    mirror images of the room."""
    listener = (1.7, 2.2, 1.2)
    whole = one(diffuse, 1, listener=listener) - diffuse.ambisonics([listener], [EMITTER], 1)[0]
    rate, c = diffuse.sample_rate, 343.0
    x, y, z = EMITTER
    images = [EMITTER, (-x, y, z), (16 - x, y, z), (x, -y, z), (x, 10 - y, z), (x, y, -z), (x, y, 5.6 - z)]
    for place in images:
        towards = np.array(place) - listener
        at = np.linalg.norm(towards) / c * rate
        around = slice(round(at) - 2, round(at) + 3)
        heard = whole[1:, around] @ whole[0, around] / np.sum(whole[0, around] ** 2)
        assert_allclose(heard, (towards / np.linalg.norm(towards))[[1, 2, 0]], atol=0.15)


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize(
    "head", [Quaternion.from_yaw(2.0), Quaternion.from_angles(0.4, -1.2, 0.7), Quaternion(1.0, 0.0, 0.0, 0.0)]
)
def test_turning_the_listener_is_rotating_the_channels(from_the_north, order, head):
    level = one(from_the_north, order)
    assert_allclose(one(from_the_north, order, head), rotation(head, order) @ level, atol=1e-6 * np.abs(level).max())


def test_a_head_turned_to_the_left_has_the_sound_of_its_left_ahead(from_the_north):
    y, _, x = one(from_the_north, 1)[1:]
    turned = one(from_the_north, 1, Quaternion.from_yaw(math.pi / 2))
    assert_allclose(turned[3], y, atol=1e-6)
    assert_allclose(turned[1], -x, atol=1e-6)


def test_yaws_and_orientations_are_the_same(from_the_north):
    response = AmbisonicResponse(from_the_north)
    by_yaw = response.impulse_responses([LISTENER], [EMITTER], [0.7], 2)
    assert_array_equal(by_yaw, response.impulse_responses([LISTENER], [EMITTER], [Quaternion.from_yaw(0.7)], 2))


@pytest.mark.parametrize("order", [1, 2, 3])
def test_energy_is_shared_among_degrees_as_for_diffuse_sound(diffuse, order):
    energy = np.sum(diffuse.ambisonics([LISTENER], [EMITTER], order)[0].astype(float) ** 2, axis=-1)
    # A decaying response has some thousand samples of noise, of 24 directions.
    for degree in range(1, order + 1):
        of_degree = slice(degree**2, (degree + 1) ** 2)
        assert energy[of_degree].mean() / energy[0] == pytest.approx(mean_squares(order)[degree**2], rel=0.25)


def test_sound_from_the_north_is_in_the_channel_to_the_left(from_the_north):
    response = from_the_north.ambisonics([LISTENER], [EMITTER], 1)[0].astype(float)
    y, z, x = response[1:] @ response[0] / np.sum(response[0] ** 2)
    assert y > 0.6
    assert abs(z) < 0.2
    assert abs(x) < 0.2


@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_the_first_channel_is_what_one_microphone_hears(from_the_north, order):
    mono = mono_responses(from_the_north, [LISTENER], [EMITTER], [0.3])
    assert_allclose(one(from_the_north, order)[:1], mono[0], atol=1e-6)


def test_its_energy_is_what_the_field_predicts(diffuse):
    """The W channel of the reflected field has the energy that the ears' decoder would give an ideal microphone."""
    graph, codec = diffuse.graph, diffuse.graph.parameters.codec
    # Over places at several distances, which sound with other parts of the noise.
    emitters = np.array([(x, y, 1.4) for x in (3.0, 4.0, 5.0, 6.0, 7.0) for y in (0.5, 1.5, 3.0, 4.5)])
    listeners = np.tile(LISTENER, (len(emitters), 1))
    arrivals = graph.arrivals(listeners, emitters)
    assert (np.ptp(arrivals.log_magnitude, axis=1) < 1e-6).all()  # all bands alike
    per_frame = codec.magnitude(arrivals.log_magnitude[:, 0] @ graph.parameters.frame_axis.spread())
    expected = np.sum(per_frame**2, axis=-1) / codec.window_energy * codec.hop
    found = np.sum(diffuse.ambisonics(listeners, emitters, 0).astype(float) ** 2, axis=(1, 2))
    # A decay as steep as this one loses some energy between frames, for ears and microphones alike.
    poses = listeners, emitters, np.zeros(len(emitters))
    ears = np.sum(diffuse.impulse_responses(*poses).astype(float) ** 2, axis=(1, 2))
    lost_db = np.mean(10 * np.log10(ears / np.sum(diffuse.energy(*poses), axis=-1)))
    # Each has one draw of noise, of which so short a sound uses some two hundred samples.
    assert np.mean(10 * np.log10(found / expected)) == pytest.approx(lost_db, abs=1.0)


def test_reflected_sound_begins_when_it_can(diffuse):
    response = diffuse.ambisonics([LISTENER], [EMITTER], 3)[0]
    direct_s = np.linalg.norm(np.subtract(LISTENER, EMITTER)) / 343.0
    assert not response[:, : int(direct_s * diffuse.sample_rate)].any()
    assert response.any(axis=-1).all()


def test_equal_poses_give_equal_responses(from_the_north, tmp_path):
    again = AcousticField.load(write_directional(tmp_path / "flat", towards=(0.0, 1.0, 0.0)))
    assert_array_equal(one(from_the_north, 3), one(again, 3))
    both = AmbisonicResponse(again).impulse_responses([LISTENER] * 2, [EMITTER, (1.0, 1.0, 1.0)], [LEVEL] * 2, 3)
    assert_array_equal(both[0], one(again, 3))


@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_a_field_of_any_order_gives_channels_of_any(tmp_path, order):
    field = AcousticField.load(write_directional(tmp_path / "flat", order))
    response = one(field, 3)
    assert response.shape == (16, field.ir_samples)
    assert np.isfinite(response).all()


def test_a_level_of_a_lower_order_tells_less_of_directions(from_the_north):
    blurred = AcousticField(
        from_the_north.bundle, QualityLevel(name="blurred", field="directional", order=0), from_the_north.graph
    )
    w, y, _, _ = blurred.ambisonics([LISTENER], [EMITTER], 1)[0].astype(float)
    assert abs(y @ w) < 0.2 * np.sum(w**2)


def test_a_level_with_fewer_frames_ends_earlier(tmp_path):
    manifest = directional_manifest(2)
    short = QualityLevel(name="short", field="directional", frames=6)
    manifest = manifest.model_copy(update={"levels": (*manifest.levels, short)})
    written = write_directional(tmp_path / "one")
    files = {FILE: directional_graph(2, None), "arrays.npz": (written.folder / "arrays.npz").read_bytes()}
    levels = FieldsByLevel.load(write_bundle(tmp_path / "flat", manifest, files))
    whole, cut = (levels[name].ambisonics([LISTENER], [EMITTER], 1)[0] for name in levels)
    assert cut.any()
    assert not cut[:, -2_000:].any()
    assert whole[:, -2_000:].any()


def test_a_field_that_knows_one_head_gives_none(field, measured_bundle):
    for known, word in ((field, "head"), (AcousticField.load(measured_bundle), "microphone")):
        with pytest.raises(RequestError, match=f"one {word} hears") as refusal:
            AmbisonicResponse(known)
        assert (refusal.value.code, refusal.value.field, refusal.value.status) == ("no_directions", "output", 409)
        with pytest.raises(ValueError, match="knows no directions"):
            known.ambisonics([known.bundle.manifest.start.listener], [known.bundle.manifest.start.emitter], 1)


def test_orders_are_0_to_3_and_poses_finite(diffuse):
    for order in (-1, 4):
        with pytest.raises(ValueError, match="order"):
            one(diffuse, order)
    with pytest.raises(ValueError, match="finite"):
        diffuse.ambisonics([(math.nan, 2.0, 1.5)], [EMITTER], 1)


def test_harmonics_are_as_many_as_channels(diffuse):
    assert [len(one(diffuse, order)) for order in range(4)] == [harmonic_count(order) for order in range(4)]
