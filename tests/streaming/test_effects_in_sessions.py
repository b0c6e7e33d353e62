"""Sessions that obey a plan of effects: what is off is not asked for and not made, and nobody hears it go."""

import numpy as np
import pytest
from scipy.signal.windows import kaiser

from server.acoustics.geometry import Pose
from server.assets.hrtfs import DEFAULT_HRTF
from server.core.errors import RequestError
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.offline.render import PathPoint, RenderedEmitter, render
from server.planning.motion import REST_S
from server.planning.places import place_of_field
from server.planning.planned_effects import PERIOD_S, PlannedEffects
from server.protocol.client_messages import (
    PROTOCOL,
    AddEmitter,
    Hello,
    ListenerPose,
    ListenerStart,
    MoveEmitter,
    SetEffects,
)
from server.protocol.server_messages import EmitterAdded, Error, PlanChanged
from server.rendering.convolver import Convolver, Sharing
from server.responses.direct_sound import DirectSound
from server.responses.ir_request import composed_irs, compute_irs
from server.scene.bundle import Bundle, find_bundle
from server.scene.effects import EffectName
from server.streaming.quality_steps import QualityStep
from server.streaming.session import Session

SIZE = 256
HERE, THERE, ELSEWHERE = (2.0, 2.0, 1.5), (6.0, 3.0, 1.5), (5.0, 1.0, 1.5)
SWITCHES = [name for name in EffectName if name is not EffectName.PER_SOURCE_TAIL]


def tone(rate):
    return (0.05 * np.sin(2 * np.pi * 997 * np.arange(rate) / rate)).astype(np.float32)


class Stage:
    """A session that is answered at once, plans included."""

    def __init__(self, field, filters, *, clip=None, plans=True, **hello):
        self.field, self.levels = field, FieldsByLevel([field])
        self.rate = field.sample_rate
        self.clip = tone(self.rate) if clip is None else clip
        self.events, self._pose_id, self.asked = [], 0, []
        ask = type(field).impulse_responses

        def counted(listeners, emitters, yaws, **named):
            self.asked.append(len(yaws))
            return ask(field, listeners, emitters, yaws, **named)

        place = place_of_field(field) if plans else None
        field.impulse_responses = counted
        self.session = Session(
            Hello(protocol=PROTOCOL, scene="flat", listener=ListenerStart(position=HERE), **hello),
            self.levels,
            filters,
            lambda _: self.clip,
            quality=QualityStep(field.level.name, None, Sharing.NOTHING, 1.0),
            window=1_000_000,
            place=place,
        )

    def add(self, name="a", position=THERE, **changes):
        self.tell(AddEmitter(id=name, clip="tone", position=position, **changes))

    def tell(self, message):
        self.events += self.session.receive(message)

    def step_to(self, position, orientation=(0.0, 0.0, 0.0, 1.0)):
        self._pose_id += 1
        self.tell(ListenerPose(pose_id=self._pose_id, position=position, orientation=orientation))

    def move(self, name, position):
        self._pose_id += 1
        self.tell(MoveEmitter(id=name, pose_id=self._pose_id, position=position))

    def block(self):
        if (wanted := self.session.take_plan_request()) is not None:
            self.events += self.session.adopt(wanted.plan())
        if (request := self.session.take_request()) is not None:
            self.events += self.session.accept(compute_irs(self.levels, request, self.session.renderer))
        return self.session.render_block().samples

    def hear(self, seconds):
        return np.concatenate([self.block() for _ in range(round(seconds * self.rate / SIZE))], axis=1).astype(float)

    def plan(self):
        return [event for event in self.events if isinstance(event, PlanChanged)][-1]

    def is_on(self, name, emitter=None):
        return any(
            each.called_for for each in self.plan().decisions if each.name == name and emitter in (None, each.emitter)
        )

    @property
    def is_baked(self):
        return [emitter.heard.bakes_direct for emitter in self.session._emitters.values()]


@pytest.fixture
def open_stage(field, mirrored_field, filters):
    def make(kind="flat", **options):
        chosen = {"flat": field, "mirrored": mirrored_field}.get(kind)
        if chosen is None:
            chosen = AcousticField.load(Bundle.load(find_bundle(kind)))
        return Stage(chosen, filters, **options)

    return make


@pytest.fixture
def open_field(hrtfs):
    def make(**options):
        field = AcousticField.load(Bundle.load(find_bundle("open-field")))
        return Stage(field, type(hrtfs)((), [field.sample_rate]).filters(DEFAULT_HRTF, field.sample_rate), **options)

    return make


def splatter_db(heard, rate):
    power = np.abs(np.fft.rfft(heard * kaiser(heard.shape[-1], 20))) ** 2
    above = np.fft.rfftfreq(heard.shape[-1], 1 / rate) > 4_000
    return 10 * np.log10(power[..., above].sum() / power.sum())


def level_db(signal):
    return 10 * np.log10(np.mean(np.square(signal)) + 1e-30)


def test_in_the_open_no_field_is_asked_and_no_convolver_made(open_field, monkeypatch):
    monkeypatch.setattr(Convolver, "__init__", lambda *_args, **_named: pytest.fail("a convolver was made"))
    stage = open_field()
    stage.add()
    heard = stage.hear(0.3)
    assert level_db(heard) > -60
    assert stage.asked == []
    assert [event.id for event in stage.events if isinstance(event, EmitterAdded)] == ["a"]
    for step in range(20):
        stage.step_to((2.0 + 0.1 * step, 2.0, 1.5))
        stage.hear(0.02)
    assert stage.asked == []
    assert not stage.is_on(EffectName.LATE_REVERBERATION)


def test_what_stands_still_is_part_of_the_response_and_follows_at_once_when_it_moves(open_stage):
    """Against the same session whose effects are all on: nobody hears the difference, nor the moment."""
    noise = 0.005 * np.random.default_rng(5).standard_normal(7_000).astype(np.float32)
    heard = {}
    for plans in (True, False):
        # But for delays, the plan has no say: what else it leaves out is not what is compared here.
        wishes = {name.value: True for name in EffectName if name is not EffectName.PROPAGATION_DELAY}
        stage = open_stage("mirrored", clip=noise, plans=plans, effects=wishes)
        stage.add()
        parts = [stage.hear(1.0)]
        if plans:
            assert stage.is_baked == [True]
            state = next(iter(stage.session.renderer._mixers)).direct.state
            windows = state.heard.copy()
            parts.append(stage.hear(0.2))
            np.testing.assert_array_equal(state.heard, windows)
        else:
            parts.append(stage.hear(0.2))
        for step in range(40):
            stage.step_to((2.0 + 0.01 * step, 2.0, 1.5))
            parts.append(stage.block())
        if plans:
            assert stage.is_baked == [False]
            assert stage.is_on(EffectName.PROPAGATION_DELAY)
        parts.append(stage.hear(0.5))
        heard[plans] = np.concatenate(parts, axis=1)
        if plans:
            stage.hear(REST_S + 2 * PERIOD_S)
            assert stage.is_baked == [True]
    error = heard[True] - heard[False]
    # In the block in which it starts to move, the response that stood still fades out.
    assert level_db(error) - level_db(heard[False]) < -55
    before = error[:, : stage.rate]
    assert level_db(before) - level_db(heard[False]) < -120


def test_a_switch_is_heard_of_direct_sound_that_is_held_in_a_response(open_stage):
    """Nothing moves, and nothing else would have it computed anew."""
    stage = open_stage(effects={"propagation_delay": False})
    stage.add()
    stage.hear(1.0)
    assert stage.is_baked == [True]
    before_db = level_db(stage.hear(0.5))
    stage.tell(SetEffects(effects={"distance_attenuation": False, "propagation_delay": False}))
    stage.hear(1.5)
    assert level_db(stage.hear(0.5)) > before_db + 3


def test_a_pose_that_is_sent_again_moves_nothing(open_stage):
    stage = open_stage()
    stage.add()
    stage.hear(0.5)
    asked = len(stage.asked)
    for _ in range(5):
        stage.step_to(HERE)
        stage.hear(0.2)
    assert len(stage.asked) == asked
    assert stage.is_baked == [True]


def test_a_mono_loudspeaker_has_one_channel_and_no_head(open_stage):
    stage = open_stage("mirrored", output="mono")
    stage.add()
    heard = stage.hear(0.5)
    assert heard.shape[0] == 1
    assert level_db(heard) > -70
    assert [mixer.channels for mixer in stage.session.renderer._mixers] == [1]
    assert not stage.is_on(EffectName.HRTF)
    stage.step_to(HERE, (0.0, 0.0, 1.0, 0.0))
    asked = len(stage.asked)
    stage.hear(0.3)
    assert len(stage.asked) == asked, "turning is nothing to one ear"


def test_one_ear_hears_what_two_do_in_the_mean(open_stage):
    """Of a field that was simulated with a head, which one ear hears without."""
    noise = 0.01 * np.random.default_rng(6).standard_normal(24_000).astype(np.float32)
    levels = {}
    for output in ("headphones", "mono"):
        stage = open_stage("apartment", clip=noise, output=output)
        stage.add(position=(6.0, 2.0, 1.5))
        levels[output] = level_db(stage.hear(1.5)[:, 12_000:])
    assert levels["mono"] == pytest.approx(levels["headphones"], abs=1.0)


@pytest.mark.parametrize("name", SWITCHES)
def test_switching_while_a_tone_sounds_does_not_splatter(open_stage, name):
    stage = open_stage("mirrored")
    stage.add(directivity={"pattern": "cardioid"}, position=THERE, yaw=2.0)
    stage.hear(0.8)
    heard = []
    for number in range(8):
        stage.tell(SetEffects(effects={name: number % 2 == 1}))
        heard.append(stage.hear(0.25))
    assert splatter_db(np.concatenate(heard, axis=1), stage.rate) < -90
    assert not [event for event in stage.events if isinstance(event, Error)]


@pytest.mark.parametrize(
    "name",
    [
        EffectName.DIRECT_PATH,
        EffectName.DISTANCE_ATTENUATION,
        EffectName.DIRECTIVITY,
        EffectName.HRTF,
        EffectName.EARLY_REFLECTIONS,
        EffectName.LATE_REVERBERATION,
    ],
)
def test_an_effect_that_is_switched_off_is_not_heard(open_stage, name):
    noise = 0.01 * np.random.default_rng(7).standard_normal(24_000).astype(np.float32)
    heard = []
    for is_on in (True, False):
        stage = open_stage("mirrored", clip=noise, effects={name.value: is_on})
        stage.add(position=THERE, **({"directivity": {"pattern": "cardioid"}} if name == "directivity" else {}))
        heard.append(stage.hear(1.0))
        assert stage.is_on(name) == is_on
    difference = level_db(heard[0] - heard[1]) - level_db(heard[0])
    assert difference > -25


def test_without_late_reverberation_no_field_is_asked(open_stage):
    stage = open_stage("mirrored", effects={"late_reverberation": False})
    stage.add()
    stage.hear(0.5)
    assert stage.asked == []
    assert stage.session.renderer.convolvers == 1, "the first reflections are there"
    stage.tell(SetEffects(effects={"early_reflections": False}))
    stage.hear(2.0)
    assert stage.session.renderer.convolvers == 0
    stage.tell(SetEffects(effects={"early_reflections": None, "late_reverberation": None}))
    stage.hear(0.5)
    assert stage.asked
    assert stage.session.renderer.convolvers == 1


def test_output_can_change_while_it_plays(open_stage):
    stage = open_stage("mirrored")
    stage.add()
    stage.hear(0.5)
    stage.tell(SetEffects(output="mono"))
    mono = stage.hear(2.0)
    np.testing.assert_array_equal(*mono[:, -5_000:])
    stage.tell(SetEffects(output="headphones"))
    stereo = stage.hear(2.0)
    assert not np.array_equal(*stereo[:, -5_000:])
    assert [mixer.channels for mixer in stage.session.renderer._mixers] == [2]


def test_output_can_change_while_nobody_sounds(open_stage):
    stage = open_stage("mirrored")
    stage.tell(SetEffects(output="mono"))
    stage.hear(0.5)
    stage.add()
    mono = stage.hear(0.5)
    assert mono.any()
    np.testing.assert_array_equal(*mono)
    assert not [event for event in stage.events if isinstance(event, Error)]


@pytest.mark.parametrize("channels", [1, 2])
def test_nobody_has_no_response(mirrored_field, filters, channels):
    """A session asks so where only its output is about to change."""
    sound = DirectSound.of(mirrored_field.bundle, filters)
    irs = composed_irs(mirrored_field, sound, Pose(HERE), [], channels)
    assert irs.shape == (0, channels, mirrored_field.ir_samples)


def test_somebody_who_shifts_about_does_not_make_it_flutter(open_stage):
    """A step every second: the direct sound follows all the while, and is not baked and unbaked in turn."""
    stage = open_stage()
    stage.add()
    stage.hear(1.0)
    stage.step_to((2.01, 2.0, 1.5))
    stage.hear(0.1)
    changes = len([event for event in stage.events if isinstance(event, PlanChanged)])
    for step in range(6):
        stage.step_to((2.0 + 0.01 * (step % 2), 2.0, 1.5))
        stage.hear(1.0)
        assert stage.is_baked == [False]
    assert len([event for event in stage.events if isinstance(event, PlanChanged)]) <= changes + 1


def test_emitters_whose_tails_nobody_tells_apart_share_one(open_stage):
    stage = open_stage()
    for number in range(3):
        stage.add(str(number), position=(5.0 + 0.2 * number, 3.0, 1.5))
    stage.hear(0.5)
    convolver = next(iter(stage.session.renderer._mixers)).convolver
    assert (convolver._sharing is Sharing.TAIL) is not stage.is_on(EffectName.PER_SOURCE_TAIL)


@pytest.mark.parametrize("effects", [{"echo": True}, {"hrtff": False}])
def test_an_unknown_effect_is_refused_by_name(open_stage, effects):
    with pytest.raises(RequestError, match="there is no effect") as refused:
        open_stage(effects=effects)
    assert refused.value.field == "effects"
    stage = open_stage()
    stage.tell(SetEffects(effects=effects))
    assert [(event.code, event.field) for event in stage.events] == [("unknown_effect", "effects")]


@pytest.mark.parametrize("output", ["headphones", "mono"])
def test_a_render_has_the_samples_of_a_stream_with_the_same_plan(open_stage, mirrored_field, filters, output):
    """Of a listener at rest: plan and responses at the first block."""
    noise = 0.01 * np.random.default_rng(8).standard_normal(9_000).astype(np.float32)
    stage = open_stage("mirrored", clip=noise, output=output)
    stage.add()
    live = stage.hear(1.0)
    planned = PlannedEffects(place_of_field(mirrored_field), Pose(HERE), output=output)
    path = [PathPoint.at(0, Pose(HERE))]
    emitter = RenderedEmitter(noise, Pose(THERE), loop=True)
    direct = DirectSound.of(mirrored_field.bundle, filters)
    rendered = render(mirrored_field, direct, [emitter], path, length=live.shape[1], planned=planned)
    np.testing.assert_array_equal(rendered, live.astype(np.float32))
