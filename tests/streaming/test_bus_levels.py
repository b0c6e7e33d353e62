"""A quality level whose reflected sound is heard by a bus: a turn of the head is heard at once and asks for nothing."""

import numpy as np
import pytest
from pydantic import ValidationError

from server.acoustics.geometry import Pose, Quaternion
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.offline.render import PathPoint, RenderedEmitter, planned_effects, render
from server.planning.places import place_of_field
from server.protocol.client_messages import PROTOCOL, AddEmitter, Hello, ListenerPose, SetEffects
from server.rendering.convolver import Sharing
from server.responses.direct_sound import DirectSound
from server.responses.ir_request import composed_irs, compute_irs
from server.scene.bundle import Bundle
from server.scene.effects import EffectName
from server.scene.manifest import Manifest, QualityLevel
from server.streaming.calibration import calibrate
from server.streaming.quality_steps import QualityStep
from server.streaming.session import Session
from tests.directional_flat import directional_manifest, write_directional

HERE, THERE = (2.0, 2.5, 1.5), (6.0, 3.0, 1.4)
RATE = 24_000
NOISE = 0.005 * np.random.default_rng(3).standard_normal(6 * RATE).astype(np.float32)  # no limiter acts
ON_ITS_SIDE = Quaternion(np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
EARS, BUS = (QualityStep(name, None, Sharing.NOTHING, 1.0) for name in ("standard", "by-bus"))
ALL_OFF = {"direct_path": False}


@pytest.fixture(scope="module")
def levels(tmp_path_factory):
    bundle = write_directional(tmp_path_factory.mktemp("flat"), order=2, towards=(0.6, 0.64, 0.48))
    ears = AcousticField.load(bundle)
    bus = AcousticField(bundle, QualityLevel(name="by-bus", field="directional", bus=1), ears.graph)
    return FieldsByLevel([ears, bus])


def open_session(levels, filters, quality, clip=NOISE, **rest):
    hello = Hello(protocol=PROTOCOL, scene="flat", effects=rest.pop("effects", {}))
    session = Session(hello, levels, filters, lambda _: clip, quality=quality, window=10_000, **rest)
    session.receive(ListenerPose(pose_id=1, position=HERE))
    session.receive(AddEmitter(id="talker", clip="noise", position=THERE, loop=False))
    return session


def advance(session, levels, blocks):
    """(2, samples) of blocks, with plans and responses answered at once, and how many responses there were."""
    heard, answered = [], 0
    for _ in range(blocks):
        plan = session.take_plan_request()
        if plan is not None:
            session.adopt(plan.plan())
        request = session.take_request()
        if request is not None:
            session.accept(compute_irs(levels, request, session.renderer))
            answered += 1
        heard.append(session.render_block().samples)
    return np.concatenate(heard, axis=1), answered


def reflections_of(levels, filters, quality, orientation, *, turned_later):
    """What is heard of reflections alone, four seconds of it, by a head that had or will come to an orientation."""
    place = place_of_field(levels.default)
    session = open_session(levels, filters, quality, effects=ALL_OFF, place=place)
    if not turned_later:
        session.receive(ListenerPose(pose_id=2, position=HERE, orientation=orientation))
    advance(session, levels, 60)
    if turned_later:
        session.receive(ListenerPose(pose_id=2, position=HERE, orientation=orientation))
    advance(session, levels, 60)
    heard, _ = advance(session, levels, 4 * RATE // 256)
    return heard.astype(np.float64)


def bands(heard):
    """Energies (2, band) and coherences (band,) of octave bands from 250 Hz."""
    spectra = np.fft.rfft(heard[:, : heard.shape[1] // 512 * 512].reshape(2, -1, 512) * np.hanning(512))
    frequency = np.fft.rfftfreq(512, 1 / RATE)
    energies, coherences = [], []
    for centre in (250, 500, 1_000, 2_000, 4_000, 8_000):
        left, right = spectra[..., (frequency > centre / 2**0.5) & (frequency < centre * 2**0.5)]
        powers = np.sum(abs(left) ** 2), np.sum(abs(right) ** 2)
        energies.append(powers)
        # A cross-spectrum per bin, so that a delay between the ears does not count.
        cross = np.abs(np.sum(left * np.conj(right), axis=0)).sum()
        coherences.append(cross / np.sqrt(np.sum(abs(left) ** 2, axis=0) * np.sum(abs(right) ** 2, axis=0)).sum())
    return np.array(energies).T, np.array(coherences)


@pytest.mark.parametrize("orientation", [Pose.from_yaw(HERE, 1.2).orientation, ON_ITS_SIDE], ids=["yaw", "on its side"])
def test_a_turned_bus_is_near_to_responses_asked_anew(levels, filters, orientation):
    """In octave bands: level, level between the ears, and coherence."""
    ears, bus = (
        bands(reflections_of(levels, filters, quality, orientation, turned_later=True)) for quality in (EARS, BUS)
    )
    level_db = 10 * np.log10(bus[0].sum(axis=0) / ears[0].sum(axis=0))
    ild_db = 10 * np.log10(bus[0][0] / bus[0][1]) - 10 * np.log10(ears[0][0] / ears[0][1])
    assert np.abs(level_db).max() < 2.5
    assert abs(level_db.mean()) < 1.5
    assert np.abs(ild_db).max() < 3.5
    assert np.abs(ild_db).mean() < 1.5
    assert np.abs(bus[1] - ears[1]).max() < 0.3


def test_a_bus_that_was_turned_is_one_that_was_there_from_the_start(levels, filters):
    late, early = (
        reflections_of(levels, filters, BUS, ON_ITS_SIDE, turned_later=turned_later) for turned_later in (True, False)
    )
    np.testing.assert_allclose(late, early, atol=1e-7)


def test_a_turn_asks_for_nothing_and_is_heard_in_the_next_block(levels, filters):
    sessions = [open_session(levels, filters, BUS, effects=ALL_OFF, place=place_of_field(levels.default)) for _ in "ab"]
    for session in sessions:
        advance(session, levels, 30)
    turned, still = sessions
    turned.receive(ListenerPose(pose_id=2, position=HERE, orientation=ON_ITS_SIDE))
    assert turned.take_request() is None
    block, other = turned.render_block(), still.render_block()
    assert np.abs(block.samples - other.samples).max() > 0.1 * np.abs(other.samples).max()
    assert (block.pose_id, block.reverberation_pose_id, block.is_exchange) == (2, 2, False)
    # One step, however, asks for a response of the bus.
    turned.receive(ListenerPose(pose_id=3, position=(2.2, 2.5, 1.5), orientation=ON_ITS_SIDE))
    assert turned.take_request().channels == 4


def test_steady_turns_do_not_click(levels, filters):
    tone = 0.02 * np.sin(2 * np.pi * 500 * np.arange(4 * RATE) / RATE).astype(np.float32)
    session = open_session(levels, filters, BUS, clip=tone, effects=ALL_OFF, place=place_of_field(levels.default))
    advance(session, levels, 60)
    heard = []
    for number in range(2, 200):
        session.receive(ListenerPose(pose_id=number, position=HERE, yaw=0.02 * number))
        block, answered = advance(session, levels, 1)
        assert answered == 0
        heard.append(block)
    wet = np.concatenate(heard, axis=1)
    power = np.abs(np.fft.rfft(wet * np.kaiser(wet.shape[1], 20))) ** 2
    high = np.fft.rfftfreq(wet.shape[1], 1 / RATE) > 1_500
    assert 10 * np.log10(power[:, high].sum() / power.sum()) < -80


def test_levels_of_ears_and_of_a_bus_take_turns_without_a_click(levels, filters):
    tone = 0.02 * np.sin(2 * np.pi * 500 * np.arange(6 * RATE) / RATE).astype(np.float32)
    session = open_session(levels, filters, EARS, clip=tone)
    heard = [advance(session, levels, 80)[0]]
    for quality in (BUS, EARS, BUS):
        session.set_quality(quality, "chosen")
        block, answered = advance(session, levels, 100)
        assert (answered, session.quality) == (1, quality)
        assert session.renderer.channels == (4 if quality is BUS else 2)
        heard.append(block)
    wet = np.concatenate(heard[1:], axis=1)
    power = np.abs(np.fft.rfft(wet * np.kaiser(wet.shape[1], 20))) ** 2
    high = np.fft.rfftfreq(wet.shape[1], 1 / RATE) > 2_000
    assert 10 * np.log10(power[:, high].sum() / power.sum()) < -70


def test_without_a_head_there_is_no_bus(levels, filters):
    session = open_session(levels, filters, BUS, place=place_of_field(levels.default))
    advance(session, levels, 10)
    assert session.renderer.channels == 4
    session.receive(SetEffects(effects={"hrtf": False}))
    advance(session, levels, 150)
    assert session.renderer.channels == 1
    session.receive(SetEffects(effects={"hrtf": True}))
    advance(session, levels, 150)
    assert session.renderer.channels == 4


@pytest.mark.parametrize("choice", ["all", "plan"])
def test_an_offline_render_is_the_stream(levels, filters, choice):
    place = place_of_field(levels.default) if choice == "plan" else None
    session = open_session(levels, filters, BUS, place=place)
    streamed, _ = advance(session, levels, 20)
    session.receive(ListenerPose(pose_id=2, position=HERE, orientation=ON_ITS_SIDE))
    streamed = np.concatenate([streamed, advance(session, levels, 20)[0]], axis=1)
    path = [PathPoint.at(0, Pose(HERE)), PathPoint(20 * 256, Pose(HERE, ON_ITS_SIDE), None)]
    planned = planned_effects(choice, levels.default, Pose(HERE), output="headphones")
    direct = DirectSound.of(levels.bundle, filters)
    emitters = [RenderedEmitter(NOISE, Pose(THERE))]
    rendered = render(levels["by-bus"], direct, emitters, path, length=40 * 256, planned=planned, levels=dict(levels))
    np.testing.assert_array_equal(rendered, streamed)


def test_an_offline_render_asks_for_no_response_where_only_the_head_turns_on_a_bus(levels, filters, monkeypatch):
    asked = []
    monkeypatch.setattr("server.offline.render.composed_irs", lambda *args: asked.append(args) or composed_irs(*args))
    path = [PathPoint.at(256 * number, Pose.from_yaw(HERE, 0.1 * number)) for number in range(20)]
    path.append(PathPoint.at(256 * 20, Pose((2.2, 2.5, 1.5))))
    direct = DirectSound.of(levels.bundle, filters)
    render(levels["by-bus"], direct, [RenderedEmitter(NOISE, Pose(THERE))], path, length=40 * 256, levels=dict(levels))
    assert len(asked) == 2  # where the path begins, and one step


def test_a_plan_of_a_turning_head_knows_the_level(levels, filters):
    """Head rotation calls for responses of ears; on a bus it has nothing to ask for."""
    session = open_session(levels, filters, BUS, effects=ALL_OFF, place=place_of_field(levels.default))
    advance(session, levels, 30)

    def turn(first, blocks):
        answered = 0
        for number in range(first, first + blocks):
            session.receive(ListenerPose(pose_id=number, position=HERE, yaw=0.05 * number))
            answered += advance(session, levels, 1)[1]
        (decision,) = session._effects.planned.plan.about(EffectName.HEAD_ROTATION)
        return decision.called_for, answered

    assert turn(2, 40) == (False, 0)
    session.set_quality(EARS, "chosen")
    advance(session, levels, 100)
    is_on, answered = turn(50, 40)
    assert is_on
    assert answered > 30
    session.set_quality(BUS, "chosen")
    advance(session, levels, 100)
    assert turn(100, 40) == (False, 0)


def test_sound_at_rest_keeps_its_direct_sound_off_the_bus(levels, filters):
    """A plan bakes the direct sound of what keeps still into responses; in a bus it would lose its direction."""
    session = open_session(levels, filters, BUS, place=place_of_field(levels.default))
    _, answered = advance(session, levels, 200)
    assert answered == 1
    assert not session._emitters["talker"].heard.bakes_direct
    session.set_quality(EARS, "chosen")
    advance(session, levels, 200)
    assert session._emitters["talker"].heard.bakes_direct == session._emitters["talker"].effects.bakes_direct


def test_calibration_measures_responses_of_the_bus(levels, filters):
    assert calibrate(levels, filters, poses=1).keys() == {"standard", "by-bus"}


def test_a_manifest_has_a_bus_only_for_fields_of_directions():
    manifest = directional_manifest(1)
    level = QualityLevel(name="by-bus", field="directional", bus=1)
    document = manifest.model_copy(update={"levels": (level,)}).model_dump()
    read = Manifest.model_validate(document)
    assert read.levels[0].bus == 1
    assert "bus" not in manifest.levels[0].model_dump()
    for wrong in (0, 4):
        with pytest.raises(ValidationError, match="bus"):
            QualityLevel(name="by-bus", field="directional", bus=wrong)


def test_fields_of_ears_and_scenes_without_fields_have_no_bus(bundle: Bundle):
    document = bundle.manifest.model_dump()
    document["levels"][0]["bus"] = 1
    with pytest.raises(ValidationError, match="bus: is for fields of directions"):
        Manifest.model_validate(document)
