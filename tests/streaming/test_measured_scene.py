"""A scene of which one microphone's responses are known and no walls: served whole, and heard with two ears."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydantic import ValidationError

from server.acoustics.decay import onset_sample
from server.acoustics.geometry import Pose
from server.core.errors import RequestError
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.offline.render import PathPoint, RenderedEmitter, render
from server.planning.places import place_of_field
from server.planning.planner import make_plan
from server.planning.scene_acoustics import Emitter, Listener, Situation
from server.protocol.client_messages import PROTOCOL, AddEmitter, DirectivityPattern, Hello, ListenerPose
from server.rendering.convolver import Sharing
from server.rendering.hrtf import HeadFilters
from server.rendering.sphere import fill_gaps, triangulate
from server.responses.binaural import DIRECT_S, Binauralization
from server.responses.direct_sound import DirectSound
from server.responses.full_response import FullResponse
from server.responses.impulse_response import ImpulseResponse, IrQuery
from server.responses.ir_request import compute_irs
from server.responses.loudness import loudness_map
from server.scene.effects import EffectName
from server.scene.manifest import Manifest
from server.streaming.quality_steps import QualityStep
from server.streaming.session import Session
from tests.conftest import CODEC, MANIFEST, MEASURED, measured_response

RATE = CODEC.sample_rate
HERE, THERE = (0.0, 0.4, 0.0), (1.5, 0.4, 0.0)
CLIP = 0.005 * np.random.default_rng(3).standard_normal(2_000).astype(np.float32)  # no limiter acts


@pytest.fixture
def field(measured_bundle):
    return AcousticField.load(measured_bundle)


@pytest.fixture(scope="module")
def no_head():
    """Ears that are points in the air, both at the head's centre."""
    directions, _ = fill_gaps(np.concatenate([np.eye(3), -np.eye(3)]))
    count = len(directions)
    return HeadFilters(
        RATE, directions, np.zeros((count, 2, 64), np.float32), np.zeros((count, 2)), triangulate(directions)
    )


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"image_order": 1}, "without geometry"),
        ({"image_order": 1, "geometry": MANIFEST.geometry, "bounds": MANIFEST.bounds}, "hold the direct sound"),
        ({"direct_sound": "geometry"}, "for two ears only"),
        ({"start": {"listener": (0.0, 0.4, 0.2), "emitter": THERE}}, "start.listener"),
    ],
)
def test_what_cannot_be_computed_is_refused(changes, told):
    document = {**MEASURED.model_dump(), **{name: _plain(value) for name, value in changes.items()}}
    with pytest.raises(ValidationError, match=told):
        Manifest.model_validate(document)


def _plain(value):
    return value.model_dump() if hasattr(value, "model_dump") else value


def test_a_response_is_what_was_measured(field):
    """One channel, the direct sound where distance has it, at any heading of the head."""
    response = ImpulseResponse.compute(field, IrQuery(HERE, THERE, 70.0))
    assert response.samples.shape == (1, CODEC.samples)
    assert response._document()["channels"] == ["mono"]
    delay = 1.5 / 343.0 * RATE
    arrival = round(delay) + np.arange(-8, 9)
    expected = np.exp(-0.5 * ((arrival - delay) / 3.0) ** 2) / 1.5
    assert_allclose(response.samples[0, arrival], expected, atol=2e-3)


def test_what_arrives_before_geometry_has_it_is_kept(field):
    """The pulse rises over ten samples before its peak, where the fields of simulated scenes are silent."""
    response = field.impulse_responses([HERE], [THERE], [0.0])[0, 0]
    delay = 1.5 / 343.0 * RATE
    before = np.arange(round(delay) - 12, round(delay) - 4)
    assert_allclose(response[before], np.exp(-0.5 * ((before - delay) / 3.0) ** 2) / 1.5, atol=2e-3)


def test_only_what_is_out_of_bounds_is_out_of_bounds(measured_bundle):
    measured_bundle.require_inside((1.8, -0.2, -0.1), "listener")
    with pytest.raises(RequestError, match=r"listener .* is outside"):
        measured_bundle.require_inside((0.0, 0.4, 0.2), "listener")


def test_a_map_is_of_the_whole_response(field):
    energy = float(np.square(measured_response(), dtype=np.float64).sum())
    drawn = loudness_map(FullResponse.through_kemar(field), THERE, listener_height_m=0.0, spacing_m=0.2)
    assert drawn.levels_db.shape == (6, 10)
    assert np.isfinite(drawn.levels_db).all()
    x, y = drawn.origin
    distance = np.hypot(x - THERE[0], y - THERE[1])
    assert_allclose(drawn.levels_db[0, 0], 10 * np.log10(energy / distance**2), atol=0.01)


def test_without_a_head_both_ears_hear_what_was_measured(field, no_head):
    measured = field.impulse_responses([HERE], [THERE], [0.0])
    heard = Binauralization(no_head, speed_of_sound=343.0).binauralize(measured, Pose(HERE), [THERE])
    assert_allclose(heard, measured.repeat(2, axis=1), atol=1e-5 * np.abs(measured).max())


def test_the_direct_sound_comes_from_the_emitter_and_the_rest_from_nowhere(field, filters):
    """Looking north, the emitter is to the right: its sound is there first, and louder."""
    measured = field.impulse_responses([HERE], [THERE], [0.0])
    ears = Binauralization(filters, speed_of_sound=343.0)
    heard = ears.binauralize(measured, Pose.from_yaw(HERE, np.pi / 2), [THERE])[0]
    passed = round((1.5 / 343.0 + 2 * DIRECT_S) * RATE)
    left, right = np.square(heard[:, :passed]).sum(axis=-1)
    assert right > 4 * left
    onset = onset_sample(heard[:, :passed])
    assert 0.4e-3 < (onset[0] - onset[1]) / RATE < 0.9e-3
    late = slice(passed + round(0.006 * RATE), None)
    assert_allclose(heard[0, late], heard[1, late], atol=1e-6)


def test_sound_from_everywhere_keeps_its_energy(filters):
    """Heads are levelled to unit energy in a diffuse field below 12 kHz."""
    noise = np.random.default_rng(0).standard_normal((1, 1, 30_000)).astype(np.float32)
    noise[..., :2_000] = 0  # no direct sound
    heard = Binauralization(filters, speed_of_sound=343.0).binauralize(noise, Pose(HERE), [THERE])
    ratio = np.square(heard).sum(axis=-1) / np.square(noise).sum(axis=-1)
    assert_allclose(10 * np.log10(ratio), 0.0, atol=0.7)


@pytest.fixture
def session(field, filters):
    hello = Hello(protocol=PROTOCOL, scene="measured")
    quality = QualityStep("standard", None, Sharing.NOTHING, 1.0)
    return Session(hello, FieldsByLevel([field]), filters, lambda _: CLIP, quality=quality, window=1_000)


def test_a_stream_plays_the_clip_through_what_the_ears_hear(session, field, filters):
    session.receive(ListenerPose(pose_id=1, position=HERE, orientation=Pose.from_yaw(HERE, 1.0).orientation))
    session.receive(AddEmitter(id="talker", clip="noise", position=THERE, loop=False))
    session.accept(compute_irs(FieldsByLevel([field]), session.take_request(), session.renderer))
    streamed = np.concatenate([session.render_block().samples for _ in range(20)], axis=1)
    measured = field.impulse_responses([HERE], [THERE], [0.0])
    response = Binauralization(filters, speed_of_sound=343.0).binauralize(measured, Pose.from_yaw(HERE, 1.0), [THERE])[
        0
    ]
    expected = np.stack([np.convolve(CLIP, ear)[: streamed.shape[1]] for ear in response])
    assert_allclose(streamed, expected, atol=1e-4 * np.abs(expected).max())


def test_an_offline_render_is_the_stream(session, field, filters):
    session.receive(AddEmitter(id="talker", clip="noise", position=THERE, loop=False))
    session.accept(compute_irs(FieldsByLevel([field]), session.take_request(), session.renderer))
    streamed = np.concatenate([session.render_block().samples for _ in range(12)], axis=1)
    start = MEASURED.start
    path = [PathPoint.at(0, Pose.from_yaw(start.listener, np.radians(start.listener_yaw_deg)))]
    rendered = render(
        field, DirectSound.of(field.bundle, filters), [RenderedEmitter(CLIP, Pose(THERE))], path, length=12 * 256
    )
    np.testing.assert_array_equal(rendered, streamed)


def test_what_is_heard_does_not_depend_on_the_unit_of_the_measurement(field, filters):
    """Responses twice as large, and a reference that says so."""
    quiet = np.square(_heard(field, filters)).sum()
    manifest = field.bundle.manifest.model_copy(update={"reference_level_db": 20 * np.log10(2.0)})
    field.bundle = dataclasses.replace(field.bundle, manifest=manifest)
    drawn = loudness_map(FullResponse.through_kemar(field), THERE, listener_height_m=0.0, spacing_m=0.2)
    halved = np.square(_heard(field, filters)).sum()
    assert_allclose(halved, quiet / 4, rtol=1e-4)
    energy = float(np.square(measured_response(), dtype=np.float64).sum())
    distance = np.hypot(drawn.origin[0] - THERE[0], drawn.origin[1] - THERE[1])
    assert_allclose(drawn.levels_db[0, 0], 10 * np.log10(energy / 4 / distance**2), atol=0.01)


def _heard(field, filters):
    path = [PathPoint.at(0, Pose(HERE))]
    return render(field, DirectSound.of(field.bundle, filters), [RenderedEmitter(CLIP, Pose(THERE))], path)


def test_a_plan_keeps_the_head_that_gives_the_place_its_ears(field):
    listener = Listener(Pose(HERE), turns=True)
    plan = make_plan(Situation(place_of_field(field), listener, {"talker": Emitter(Pose(THERE))}))
    called_for = {decision.name for decision in plan.decisions if decision.called_for}
    assert {EffectName.HRTF, EffectName.HEAD_ROTATION, EffectName.LATE_REVERBERATION} <= called_for
    assert not called_for & {EffectName.DIRECT_PATH, EffectName.EARLY_REFLECTIONS, EffectName.PROPAGATION_DELAY}


def test_loudspeakers_keep_the_directivity_they_were_measured_with(session):
    pattern = DirectivityPattern(pattern="cardioid")
    (error,) = session.receive(AddEmitter(id="talker", clip="noise", position=THERE, directivity=pattern))
    assert (error.code, error.field) == ("fixed_directivity", "directivity")
