"""First reflections in whole responses, against mirrored emitters in the free field."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from pydantic import ValidationError

from server.acoustics.directivity import CARDIOID, FIGURE_OF_EIGHT, Cardioid
from server.acoustics.geometry import Pose
from server.field.fields_by_level import FieldsByLevel
from server.protocol.client_messages import PROTOCOL, AddEmitter, Hello, MoveEmitter
from server.rendering.still_paths import StillPaths
from server.responses.early_reflections import EarlyReflections
from server.responses.emitter_state import EmitterState
from server.responses.full_response import FullResponse
from server.responses.ir_request import compute_irs
from server.responses.radiation import reverberation_gain
from server.scene.manifest import Manifest
from server.streaming.quality_steps import QualityStep
from server.streaming.session import Session

SIZE = np.array((8.0, 5.0, 2.8))
SURFACE_DB = 10 * math.log10(0.8 * 0.9)  # a fifth is absorbed, a tenth scattered
LISTENER, EMITTER = np.array((2.0, 2.5, 1.5)), np.array((5.0, 3.2, 1.2))
SAMPLES = 4_000


@pytest.fixture
def early(mirrored_bundle, filters):
    return EarlyReflections.of(mirrored_bundle, filters)


def images(emitter):
    """(6, 3)"""
    return np.array(
        [np.where(np.arange(3) == axis, 2 * wall - emitter, emitter) for axis in range(3) for wall in (0.0, SIZE[axis])]
    )


def free_field(bundle, filters, places, listener, gain_db):
    """(2, sample) of emitters at `places` (n, 3)."""
    paths = StillPaths(filters, speed_of_sound=343.0, air_db_per_m=bundle.manifest.air.filter_db_per_m)
    offsets = places - listener.position
    lengths = np.linalg.norm(offsets, axis=-1)
    gains = np.broadcast_to(np.reshape(gain_db, (-1, 1)), (len(places), 7))
    out = np.zeros((2, SAMPLES), np.float32)
    paths.add(lengths, offsets / lengths[:, None], gains, listener.orientation, out)
    return out


def test_whole_responses_are_those_of_the_field_and_of_six_mirrored_emitters(
    field, mirrored_field, mirrored_bundle, filters
):
    poses = ([LISTENER], [EMITTER], [0.6])
    listener = Pose.from_yaw(tuple(LISTENER), 0.6)
    # The two fields' own sound sets in differently; what is added to it differs by the reflections alone.
    mirrored, plain = (
        FullResponse(each, filters).impulse_responses(*poses)[0] - each.impulse_responses(*poses)[0]
        for each in (mirrored_field, field)
    )
    difference = mirrored - plain
    expected = free_field(mirrored_bundle, filters, images(EMITTER), listener, SURFACE_DB)
    assert np.abs(expected).max() > 0.1
    assert_allclose(difference, expected, atol=1e-5)


def test_a_scene_whose_fields_hold_them_gets_none(bundle, filters):
    assert EarlyReflections.of(bundle, filters) is None


def test_heads_may_nod_and_each_emitter_has_its_own(early, mirrored_bundle, filters):
    listener = Pose(tuple(LISTENER), (0.2, 0.3, 0.1, 0.9))
    places = [EMITTER, np.array((1.0, 1.0, 1.9))]
    responses = np.zeros((2, 2, SAMPLES), np.float32)
    early.add(responses, listener, [EmitterState(Pose(tuple(place))) for place in places])
    for response, place in zip(responses, places, strict=True):
        assert_allclose(response, free_field(mirrored_bundle, filters, images(place), listener, SURFACE_DB), atol=1e-5)


def test_a_head_that_only_turned_has_paths_that_are_found_once(early, mirrored_bundle, monkeypatch):
    """For every emitter, however it is turned and whatever its directivity; where doors moved, they are found anew."""
    asked = []
    find = early._finder.find
    monkeypatch.setattr(early._finder, "find", lambda at, places: asked.append(len(places)) or find(at, places))
    turned = Pose.from_yaw(tuple(EMITTER), 2.0)
    emitters = [
        EmitterState(Pose(tuple(EMITTER))),
        EmitterState(turned, CARDIOID),
        EmitterState(turned, FIGURE_OF_EIGHT),
    ]

    def heard(reflections, listener, some, *, remember):
        responses = np.zeros((len(some), 2, SAMPLES), np.float32)
        reflections.add(responses, listener, some, remember=remember)
        return responses

    def assert_same(listener, some):
        assert_array_equal(
            heard(early, listener, some, remember=True), heard(early, listener, some, remember=False), strict=True
        )
        asked.pop()

    for yaw in (0.0, 1.0):
        assert_same(Pose.from_yaw(tuple(LISTENER), yaw), emitters[1:])
    assert asked == [2]
    assert_same(Pose(tuple(LISTENER)), emitters)
    assert asked == [2, 1]
    elsewhere = Pose.from_yaw(tuple(EMITTER), 2.1)
    for listener, emitter in (
        (Pose((2.0, 2.5, 1.6)), emitters[0]),
        (Pose(tuple(LISTENER)), EmitterState(Pose((5.0, 3.2, 1.3)))),
        (Pose(tuple(LISTENER)), EmitterState(elsewhere, CARDIOID)),
        (Pose(tuple(LISTENER)), EmitterState(turned, Cardioid(0.4))),
    ):
        assert_same(listener, [emitter])
        assert asked.pop() == 1
    assert_same(Pose(tuple(LISTENER)), [EmitterState(elsewhere)])
    assert asked == [2, 1]
    moved = early.within(mirrored_bundle.surroundings)
    found = []
    monkeypatch.setattr(moved._finder, "find", lambda *poses: found.append(poses) or find(*poses))
    heard(moved, Pose(tuple(LISTENER)), emitters, remember=True)
    assert len(found) == 1


@pytest.mark.parametrize("directivity", [CARDIOID, FIGURE_OF_EIGHT])
def test_a_reflection_has_the_gain_of_the_direction_it_leaves_in(early, mirrored_bundle, filters, directivity):
    """As it is heard: played at the gain by which the emitter fills the room."""
    listener, emitter = Pose(tuple(LISTENER)), EmitterState(Pose.from_yaw(tuple(EMITTER), 2.0), directivity)
    ahead = np.array((math.cos(2.0), math.sin(2.0), 0.0))
    # To the listener's image: the same mirror seen from the other side.
    leaves = images(LISTENER) - EMITTER
    amplitudes = np.abs(
        directivity.omni_share + (1 - directivity.omni_share) * (leaves @ ahead) / np.linalg.norm(leaves, axis=-1)
    )
    response = np.zeros((1, 2, SAMPLES), np.float32)
    early.add(response, listener, [emitter])
    expected = free_field(
        mirrored_bundle, filters, images(EMITTER), listener, SURFACE_DB + 20 * np.log10(np.maximum(amplitudes, 1e-3))
    )
    assert_allclose(response[0] * reverberation_gain(directivity), expected, atol=1e-5)


def test_power_is_that_of_the_responses(field, mirrored_field, filters):
    """Over as many places as it takes for interference to cancel out."""
    rng = np.random.default_rng(0)
    listeners = rng.uniform((0.5, 0.5, 0.6), (7.5, 4.5, 2.2), (60, 3))
    emitters, yaws = np.tile(EMITTER, (60, 1)), rng.uniform(-math.pi, math.pi, 60)
    powers, energies = [], []
    for each in (field, mirrored_field):
        whole = FullResponse(each, filters)
        powers.append(whole.path_power(listeners, EMITTER))
        paths = whole.impulse_responses(listeners, emitters, yaws) - each.impulse_responses(listeners, emitters, yaws)
        energies.append(np.sum(paths.astype(float) ** 2, axis=-1).mean(axis=-1))
    (direct, both), (direct_energy, both_energy) = powers, energies
    assert (both > direct).all()
    assert 10 * np.log10(both.mean() / both_energy.mean()) == pytest.approx(0, abs=0.7)
    assert 10 * np.log10((both - direct).mean() / (both_energy - direct_energy).mean()) == pytest.approx(0, abs=1)


@pytest.mark.parametrize(("name", "turned"), [("field", []), ("mirrored_field", [CARDIOID])])
def test_a_directive_emitter_that_turns_is_mirrored_anew(name, turned, filters, request):
    field = request.getfixturevalue(name)
    levels = FieldsByLevel([field])
    hello = Hello(protocol=PROTOCOL, scene="flat")
    quality = QualityStep.full(field.level, 1.0)
    session = Session(hello, levels, filters, lambda _: np.ones(9, np.float32), quality=quality)
    place = tuple(EMITTER)
    for identifier, pattern in (("all-round", None), ("ahead", {"pattern": "cardioid"})):
        session.receive(AddEmitter(id=identifier, clip="click", position=place, directivity=pattern))
    session.accept(compute_irs(levels, session.take_request(), session.renderer))
    for pose_id, identifier in enumerate(("all-round", "ahead"), 1):
        session.receive(MoveEmitter(pose_id=pose_id, id=identifier, position=place, yaw=1.0))
    wanted = session.take_request()
    assert ([] if wanted is None else [each.state.directivity for each in wanted.asked]) == turned


def test_order_is_none_or_one_and_none_by_default(bundle):
    document = bundle.manifest.model_dump()
    assert document.pop("image_order") == 0
    assert Manifest.model_validate(document).image_order == 0
    with pytest.raises(ValidationError, match="image_order"):
        Manifest.model_validate(document | {"image_order": 2})
