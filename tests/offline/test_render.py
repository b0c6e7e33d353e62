"""Offline rendering: agrees with convolution, with live sessions, and explains what is wrong with a path."""

import math

import numpy as np
import pytest
from scipy.signal import fftconvolve

from server.acoustics.directivity import CARDIOID, FIGURE_OF_EIGHT, OMNIDIRECTIONAL
from server.acoustics.geometry import FloorPlan, Pose, yaws_of
from server.acoustics.surroundings import PlanSurroundings
from server.field.fields_by_level import FieldsByLevel
from server.field.kinds.catalogue import kind_of
from server.offline.render import PathError, PathPoint, RenderedEmitter, read_path, render
from server.protocol.client_messages import PROTOCOL, AddEmitter, Hello, ListenerPose
from server.rendering.fade import raised_cosine
from server.responses.direct_sound import DirectSound
from server.responses.ir_request import compute_irs
from server.scene.manifest import QualityLevel
from server.streaming.quality_steps import QualityStep
from server.streaming.session import Session
from tests.signals import error_db

SAMPLE_RATE = 24_000
SIZE = 256
HERE, THERE = Pose((1.0, 2.0, 1.5)), Pose((6.0, 3.0, 1.5))
SPEED_OF_SOUND = 343.0


class NoiseField:
    """Decaying noise, another for each pair of poses: enough to tell which impulse response was used, and where."""

    ir_samples = 1_500
    channels = 2
    sample_rate = SAMPLE_RATE
    level = QualityLevel(name="noise", field="noise")
    kind = kind_of(level)

    def through(self, filters):  # noqa: ARG002  it knows no head
        return self

    def impulse_responses(self, listeners, emitters, heads, *, remember=False):  # noqa: ARG002  there is no phase
        return np.stack([self.one(*poses) for poses in zip(listeners, emitters, yaws_of(heads), strict=True)])

    def one(self, listener, emitter, yaw):
        seed = np.array([*listener, *emitter, yaw], np.float64).view(np.uint32)
        samples = np.random.default_rng(seed).standard_normal((2, self.ir_samples))
        return (samples * np.exp(-np.arange(self.ir_samples) / 200)).astype(np.float32)


class DeadField(NoiseField):
    """Nothing follows the direct sound."""

    def one(self, *_):
        return np.zeros((2, self.ir_samples), np.float32)


FIELD, DEAD = NoiseField(), DeadField()


@pytest.fixture(scope="module")
def open_hall(filters):
    """A hall in which everyone sees everyone."""
    plan = FloorPlan(((0.0, 0.0), (40.0, 0.0), (40.0, 20.0), (0.0, 20.0)), 5.0)
    return DirectSound(PlanSurroundings(plan), speed_of_sound=SPEED_OF_SOUND, air_db_per_m=np.zeros(7), filters=filters)


def noise(seed, samples):
    """Quiet enough that no limiter acts."""
    return 0.005 * np.random.default_rng(seed).standard_normal(samples).astype(np.float32)


def point(sample, x, yaw_rad=0.0):
    return PathPoint.at(sample, Pose.from_yaw((x, 2.0, 1.5), yaw_rad))


def reverberation(open_hall, emitters, path, **options):
    """What is rendered beside the direct sound."""
    whole = render(FIELD, open_hall, emitters, path, **options).astype(float)
    return whole - render(DEAD, open_hall, emitters, path, **options)


def heard(emitter, at, samples):
    """Oracle of the reverberation: the clip in one room throughout, float64."""
    ir = FIELD.one(at.pose.position, emitter.pose.position, at.pose.yaw).astype(float)
    return fftconvolve(emitter.clip[np.newaxis].astype(float), ir, axes=1)[:, :samples]


def level_db(samples):
    return 10 * np.log10(np.mean(samples.astype(float) ** 2))


def test_standing_still_is_convolution(open_hall):
    emitters = [RenderedEmitter(noise(1, 5_000), HERE), RenderedEmitter(noise(2, 3_000), THERE, gain=0.5)]
    wet = render(FIELD, open_hall, emitters, [point(0, 2.0)])
    assert wet.shape[0] == 2
    assert wet.dtype == np.float32
    assert wet.shape[1] >= 5_000 + FIELD.ir_samples - 1  # the reverberation is not cut off
    expected = np.zeros(wet.shape)
    for emitter in emitters:
        part = emitter.gain * heard(emitter, point(0, 2.0), wet.shape[1])
        expected[:, : part.shape[1]] += part
    assert error_db(reverberation(open_hall, emitters, [point(0, 2.0)]), expected) < -110


def test_the_direct_sound_arrives_when_it_can_and_fades_with_distance(open_hall):
    clip = noise(12, 12_000)
    levels = []
    for distance_m in (1.0, 2.0, 8.0):
        emitter = RenderedEmitter(clip, Pose((2.0 + distance_m, 2.0, 1.5)))
        wet = render(DEAD, open_hall, [emitter], [point(0, 2.0)], length=13_000)
        onset = np.argmax(np.abs(wet).max(axis=0) > 0.05 * np.abs(wet).max())
        # Both ears are a head's radius behind the plane through its middle, at most; half a millisecond of filters.
        assert onset / SAMPLE_RATE == pytest.approx(distance_m / SPEED_OF_SOUND, abs=0.0007)
        levels.append(level_db(wet[:, 2_000:12_000]))
    np.testing.assert_allclose(np.diff(levels), [-6.02, -12.04], atol=0.05)


def test_an_emitter_that_looks_away_is_heard_by_its_reverberation(open_hall):
    clip = noise(13, 12_000)
    towards, away = (Pose.from_yaw((6.0, 2.0, 1.5), yaw) for yaw in (math.pi, 0.0))

    def level(field, pose, directivity):
        emitter = RenderedEmitter(clip, pose, directivity)
        return level_db(render(field, open_hall, [emitter], [point(0, 2.0)], length=12_000)[:, 2_000:])

    assert level(DEAD, towards, CARDIOID) == pytest.approx(level(DEAD, towards, OMNIDIRECTIONAL), abs=0.1)
    assert level(DEAD, away, CARDIOID) < level(DEAD, towards, CARDIOID) - 40
    # A third of the power of an omnidirectional emitter goes into the room, whichever way it looks.
    whole = reverberation(open_hall, [RenderedEmitter(clip, away)], [point(0, 2.0)], length=12_000)
    for directivity in (CARDIOID, FIGURE_OF_EIGHT):
        part = reverberation(open_hall, [RenderedEmitter(clip, away, directivity)], [point(0, 2.0)], length=12_000)
        assert error_db(part, whole / math.sqrt(3)) < -60


@pytest.mark.parametrize("length", [1, 255, 256, 1_000])
def test_length_is_as_asked(open_hall, length):
    emitter = RenderedEmitter(noise(3, 400), HERE, loop=True)
    wet = render(FIELD, open_hall, [emitter], [point(0, 2.0)], length=length)
    whole = render(FIELD, open_hall, [emitter], [point(0, 2.0)], length=2_000)
    np.testing.assert_array_equal(wet, whole[:, :length])


@pytest.mark.parametrize(("sample", "block"), [(1, 1), (256, 1), (257, 2), (2_560, 10)])
def test_a_pose_is_faded_to_over_the_first_block_at_or_after_its_sample(open_hall, sample, block):
    emitter = RenderedEmitter(noise(4, 20 * SIZE), HERE)
    before, after = point(0, 2.0), point(sample, 3.0)
    wet = reverberation(open_hall, [emitter], [before, after], length=20 * SIZE)
    weight = np.zeros(20 * SIZE)
    weight[block * SIZE : (block + 1) * SIZE] = raised_cosine(SIZE)
    weight[(block + 1) * SIZE :] = 1
    old, new = heard(emitter, before, 20 * SIZE), heard(emitter, after, 20 * SIZE)
    assert error_db(wet, (1 - weight) * old + weight * new) < -110


def test_of_poses_within_a_block_the_last_counts(open_hall):
    emitter = RenderedEmitter(noise(5, 20 * SIZE), HERE)
    many = [point(0, 2.0), *(point(1_000 + step, 3.0 + step) for step in range(20))]
    few = [point(0, 2.0), point(1_024, 22.0)]
    np.testing.assert_array_equal(render(FIELD, open_hall, [emitter], many), render(FIELD, open_hall, [emitter], few))


def test_direct_sound_and_reverberation_follow_the_path_each_at_its_own_sample(open_hall):
    emitter = RenderedEmitter(noise(14, 40 * SIZE), HERE)
    length = 40 * SIZE
    moved = [point(0, 2.0), PathPoint(10 * SIZE, point(0, 6.0).pose, 20 * SIZE)]
    never = [point(0, 2.0), PathPoint(10 * SIZE, point(0, 6.0).pose, None)]
    direct_only = render(DEAD, open_hall, [emitter], [point(0, 2.0), point(10 * SIZE, 6.0)], length=length)
    for path, at in ((moved, 20 * SIZE), (never, None)):
        wet = render(FIELD, open_hall, [emitter], path, length=length).astype(float)
        stays = [point(0, 2.0)] if at is None else [point(0, 2.0), point(at, 6.0)]
        assert error_db(wet - direct_only, reverberation(open_hall, [emitter], stays, length=length)) < -110


def test_nothing_sounds_before_the_path_begins_and_the_clip_begins_with_it(open_hall):
    emitter = RenderedEmitter(noise(6, 3_000), HERE)
    late, prompt = (
        render(FIELD, open_hall, [emitter], [point(start, 2.0)], length=20 * SIZE) for start in (5 * SIZE, 0)
    )
    assert not late[:, : 5 * SIZE].any()
    assert error_db(late[:, 5 * SIZE :], prompt[:, : 15 * SIZE]) < -120


class OtherField(NoiseField):
    """A level of its own: shorter, a tail for all, and another noise."""

    ir_samples = 1_100
    level = QualityLevel(name="other", field="noise", shared_tail=True)
    kind = kind_of(level)

    def one(self, listener, emitter, yaw):
        return super().one(listener, emitter, yaw + 10)


def test_a_level_is_faded_to_with_the_reverberation_of_its_point_and_stays(open_hall):
    emitter = RenderedEmitter(noise(15, 40 * SIZE), HERE)
    levels = {"noise": FIELD, "other": OtherField()}
    path = [point(0, 2.0), PathPoint(0, point(0, 2.0).pose, 10 * SIZE, "other"), point(20 * SIZE, 3.0)]
    direct = [point(0, 2.0), point(20 * SIZE, 3.0)]
    wet = render(FIELD, open_hall, [emitter], path, length=40 * SIZE, levels=levels).astype(float)
    wet -= render(DEAD, open_hall, [emitter], direct, length=40 * SIZE)
    expected = np.zeros(wet.shape)
    for begin, end, field, x in ((-1, 10, FIELD, 2.0), (10, 20, levels["other"], 2.0), (20, 99, levels["other"], 3.0)):
        ir = field.one(point(0, x).pose.position, HERE.position, 0.0).astype(float)
        weight = np.zeros(100 * SIZE)
        weight[max(begin, 0) * SIZE : (end + 1) * SIZE] = 1
        if begin >= 0:
            weight[begin * SIZE : (begin + 1) * SIZE] = raised_cosine(SIZE)
        weight[end * SIZE : (end + 1) * SIZE] -= raised_cosine(SIZE)
        heard_there = fftconvolve(emitter.clip[np.newaxis].astype(float), ir, axes=1)[:, : 40 * SIZE]
        expected += weight[: 40 * SIZE] * heard_there
    assert error_db(wet, expected) < -110


def test_a_level_that_there_is_not_is_not_rendered(open_hall):
    path = [PathPoint(0, HERE, 0, "fine")]
    with pytest.raises(KeyError, match="fine"):
        render(FIELD, open_hall, [RenderedEmitter(noise(11, 9), HERE)], path)


@pytest.mark.parametrize("name", ["field", "mirrored_field", "field_at_nodes", "whole_at_nodes"])
def test_a_live_session_replayed_is_equal_to_the_bit(name, filters, request):
    """Live: IRs arrive when they arrive, some poses are never heard. The replay gets what the blocks' headers say."""
    field = request.getfixturevalue(name)
    rng = np.random.default_rng(7)
    clips = {"a": noise(8, 2_000), "b": noise(9, 5_000)}
    session = Session(
        Hello(protocol=PROTOCOL, scene="flat"),
        FieldsByLevel([field]),
        filters,
        clips.get,
        quality=QualityStep.full(field.level, 1.0),
        window=1_000,
    )
    places = {"a": Pose.from_yaw((1.0, 2.0, 1.5), 1.0), "b": THERE}
    session.receive(ListenerPose(pose_id=1, position=(2.0, 2.0, 1.5)))
    poses = {1: Pose((2.0, 2.0, 1.5))}
    pattern = {"pattern": "cardioid"}
    position = places["a"].position
    session.receive(AddEmitter(id="a", clip="a", position=position, yaw=1.0, directivity=pattern))
    session.receive(AddEmitter(id="b", clip="b", position=THERE.position))
    blocks, request = [], None
    for number in range(80):
        for _ in range(rng.integers(0, 3) if number > 3 else 0):
            pose_id = len(poses) + 1
            poses[pose_id] = Pose.from_yaw((rng.uniform(0.5, 7.5), 2.0, 1.5), rng.uniform(-math.pi, math.pi))
            session.receive(
                ListenerPose(pose_id=pose_id, position=poses[pose_id].position, orientation=poses[pose_id].orientation)
            )
        if request is not None and rng.random() < 0.5:
            session.accept(compute_irs(FieldsByLevel([field]), request, session.renderer))
            request = None
        request = session.take_request() or request
        blocks.append(session.render_block())

    def first_clocks(pose_of_block):
        clocks = {}
        for block in blocks:
            clocks.setdefault(pose_of_block(block), block.sample_clock)
        return clocks

    direct = first_clocks(lambda block: block.pose_id)
    later = first_clocks(lambda block: block.reverberation_pose_id)
    del later[0]
    assert 1 < len(later) < len(direct) < len(poses)
    # A pose that was superseded within its block was never heard directly, but may have been in the reverberation.
    newest = sorted(direct)
    superseded = {
        pose_id: direct[min(other for other in newest if other > pose_id)] for pose_id in later.keys() - direct
    }
    path = [
        PathPoint((direct | superseded)[pose_id], poses[pose_id], later.get(pose_id))
        for pose_id in sorted(direct | superseded)
        if pose_id
    ]
    start = min(later.values())
    path = [PathPoint(max(start, each.sample), each.pose, each.reverberation_sample) for each in path]
    emitters = [
        RenderedEmitter(clips["a"], places["a"], CARDIOID, loop=True),
        RenderedEmitter(clips["b"], places["b"], loop=True),
    ]
    replay = render(field, DirectSound.of(field.bundle, filters), emitters, path, length=80 * SIZE)
    np.testing.assert_array_equal(replay, np.concatenate([block.samples for block in blocks], axis=1))


def test_progress_rises_to_one(open_hall):
    told = []
    render(FIELD, open_hall, [RenderedEmitter(noise(10, 2_000), HERE)], [point(0, 2.0)], progress=told.append)
    assert told == sorted(told)
    assert told[-1] == 1


@pytest.mark.parametrize(("emitters", "path"), [([], [point(0, 2.0)]), ([RenderedEmitter(noise(11, 9), HERE)], [])])
def test_nothing_to_render_is_refused(open_hall, emitters, path):
    with pytest.raises(ValueError, match="a path and an emitter"):
        render(FIELD, open_hall, emitters, path)


@pytest.fixture
def write(tmp_path):
    def write(content):
        path = tmp_path / "path.csv"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


def test_reads_samples_and_quaternions(write):
    half = math.sqrt(0.5)
    path = write(f"sample,x,y,z,qx,qy,qz,qw\n0,1,2,1.5,0,0,0,1\n512,1.5,2,1.5,0,0,{half},{half}\n")
    first, second = read_path(path, SAMPLE_RATE)
    assert first == PathPoint(0, Pose((1, 2, 1.5)), 0)
    assert (second.sample, second.pose.position) == (512, (1.5, 2, 1.5))
    assert second.pose.yaw == pytest.approx(math.pi / 2)


def test_reads_seconds_and_degrees_in_any_order_as_a_spreadsheet_writes_them(write):
    path = write("\ufeffyaw_deg, z ,y,x,time_s\r\n\r\n90,1.5,2,1,0\r\n-30,1.5,2.5,1,0.25\r\n")
    assert read_path(path, SAMPLE_RATE) == [
        PathPoint.at(0, Pose.from_yaw((1, 2, 1.5), math.radians(90))),
        PathPoint.at(6_000, Pose.from_yaw((1, 2.5, 1.5), math.radians(-30))),
    ]


def test_reads_when_the_reverberation_followed_if_it_did(write):
    path = write("sample,reverberation_sample,x,y,z,yaw_deg\n0,512,1,2,1.5,0\n256,,1,2,1.5,0\n256,512,1,2,1.5,0\n")
    points = read_path(path, SAMPLE_RATE)
    assert [(point.sample, point.reverberation_sample) for point in points] == [(0, 512), (256, None), (256, 512)]


def test_reads_which_level_is_heard_where_one_is_named(write):
    path = write("sample,level,x,y,z,yaw_deg\n0,,1,2,1.5,0\n256, rough ,1,2,1.5,0\n512,,1,2,1.5,0\n")
    points = read_path(path, SAMPLE_RATE, ["fine", "rough"])
    assert [point.level for point in points] == [None, "rough", None]


def test_a_path_of_a_level_that_there_is_not_names_its_line(write):
    path = write("sample,level,x,y,z,yaw_deg\n0,fine,1,2,1.5,0\n256,best,1,2,1.5,0\n")
    with pytest.raises(PathError) as caught:
        read_path(path, SAMPLE_RATE, ["fine", "rough"])
    problem = "the scene has no quality level 'best', only fine, rough"
    assert str(caught.value) == f"path.csv: line 3, column 'level': {problem}"


YAW = "sample,x,y,z,yaw_deg\n"
LATER = "sample,reverberation_sample,x,y,z,yaw_deg\n"
QUATERNION = "sample,x,y,z,qx,qy,qz,qw\n"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "path.csv: line 1: expected a header line such as sample,x,y,z,yaw_deg"),
        ("\n0,1,2,1.5,0\n", "path.csv: line 1: expected a header line such as sample,x,y,z,yaw_deg"),
        ("0,1,2,1.5,0\n", "path.csv: line 1: unknown column '0'"),
        ("sample,x,y,z,yaw\n", "path.csv: line 1: unknown column 'yaw'"),
        ("sample,x,x,y,z,yaw_deg\n", "path.csv: line 1: column 'x' is there twice"),
        ("x,y,z,yaw_deg\n", "path.csv: line 1: expected either column 'sample' or column 'time_s'"),
        ("sample,time_s,x,y,z,yaw_deg\n", "path.csv: line 1: expected either column 'sample' or column 'time_s'"),
        ("sample,x,y,yaw_deg\n", "path.csv: line 1: column 'z' is missing"),
        ("sample,x,y,z\n", "path.csv: line 1: column 'qx' (or 'yaw_deg') is missing"),
        ("sample,x,y,z,qx,qy,qz\n", "path.csv: line 1: column 'qw' (or 'yaw_deg') is missing"),
        (
            "sample,x,y,z,yaw_deg,qw\n",
            "path.csv: line 1: expected either column 'yaw_deg' or a quaternion, not both",
        ),
        (YAW, "path.csv: no poses below the header line"),
        (YAW + "0,1,2,1.5\n", "path.csv: line 2: 4 values for 5 columns"),
        (YAW + "0,1,2,1.5,0\n\n256,1,two,1.5,0\n", "path.csv: line 4, column 'y': 'two' is not a number"),
        (YAW + "0,1,,1.5,0\n", "path.csv: line 2, column 'y': '' is not a number"),
        (YAW + "0,1,2,nan,0\n", "path.csv: line 2, column 'z': 'nan' is not finite"),
        (YAW + "0,1,2,1.5,-inf\n", "path.csv: line 2, column 'yaw_deg': '-inf' is not finite"),
        (YAW + "0.5,1,2,1.5,0\n", "path.csv: line 2, column 'sample': 0.5 is not a whole number"),
        (YAW + "-256,1,2,1.5,0\n", "path.csv: line 2, column 'sample': must not be negative"),
        (
            YAW + "256,1,2,1.5,0\n255,1,2,1.5,0\n",
            "path.csv: line 3, column 'sample': must not be earlier than on the line before",
        ),
        (
            LATER + "0,512,1,2,1.5,0\n256,511,1,2,1.5,0\n",
            "path.csv: line 3, column 'reverberation_sample': must not be earlier than on the line before",
        ),
        (
            LATER + "256,255,1,2,1.5,0\n",
            "path.csv: line 2, column 'reverberation_sample': must not be before 'sample'",
        ),
        (LATER + "0,x,1,2,1.5,0\n", "path.csv: line 2, column 'reverberation_sample': 'x' is not a number"),
        (
            LATER + "0,0.5,1,2,1.5,0\n",
            "path.csv: line 2, column 'reverberation_sample': 0.5 is not a whole number",
        ),
        (
            LATER + "0,172800001,1,2,1.5,0\n",
            "path.csv: line 2, column 'reverberation_sample': 1.728e+08 is beyond the 7200 s that a render may last",
        ),
        (
            "time_s,x,y,z,yaw_deg\n0.5,1,2,1.5,0\n0.25,1,2,1.5,0\n",
            "path.csv: line 3, column 'time_s': must not be earlier than on the line before",
        ),
        (
            "time_s,x,y,z,yaw_deg\n0,1,2,1.5,0\n1e9,1,2,1.5,0\n",
            "path.csv: line 3, column 'time_s': 1e+09 is beyond the 7200 s that a render may last",
        ),
        (
            "time_s,x,y,z,yaw_deg\n1e308,1,2,1.5,0\n",
            "path.csv: line 2, column 'time_s': 1e+308 is beyond the 7200 s that a render may last",
        ),
        ("time_s,x,y,z,yaw_deg\n-1e308,1,2,1.5,0\n", "path.csv: line 2, column 'time_s': must not be negative"),
        (
            YAW + "172800001,1,2,1.5,0\n",
            "path.csv: line 2, column 'sample': 1.728e+08 is beyond the 7200 s that a render may last",
        ),
        (
            QUATERNION + "0,1,2,1.5,0,0,0,0\n",
            "path.csv: line 2, columns 'qx' to 'qw': orientation must be a quaternion of non-zero length, not of 0",
        ),
    ],
)
def test_a_path_that_cannot_be_followed_names_line_and_column(write, content, message):
    with pytest.raises(PathError) as caught:
        read_path(write(content), SAMPLE_RATE)
    assert str(caught.value) == message


@pytest.mark.parametrize(
    "content", [b"\xff\xfe\x00sample", b'sample,x,y,z,yaw_deg\n"0,1,2,3,4\n', b"\x89PNG\r\n\x1a\n"]
)
def test_a_file_that_is_no_csv_says_so(write, content):
    with pytest.raises(PathError, match=r"path\.csv: not a CSV file"):
        read_path(write(content), SAMPLE_RATE)


def test_a_path_file_that_is_absent_says_so(tmp_path):
    with pytest.raises(PathError, match=r"absent\.csv: No such file"):
        read_path(tmp_path / "absent.csv", SAMPLE_RATE)


@pytest.mark.parametrize("size", [80, 240, 480, 960, 1024])
def test_every_block_size_that_is_allowed_agrees_with_convolution(open_hall, size):
    """480 is what engines use; nothing of it is a power of two."""
    emitter = RenderedEmitter(noise(3, 9_000), THERE)
    path = [point(0, 1.0)]
    wet = reverberation(open_hall, [emitter], path, block_size=size)
    expected = heard(emitter, path[0], wet.shape[1])
    short = min(wet.shape[1], expected.shape[1])
    error = np.abs(wet[:, :short] - expected[:, :short]).max() / np.abs(expected).max()
    assert 20 * np.log10(error) < -100


def test_poses_take_effect_at_multiples_of_the_block_size(open_hall):
    """A pose of sample 4,000 is heard from 4,320 on with blocks of 480, and what came before is the same."""
    emitter = RenderedEmitter(noise(3, 9_000), THERE)
    stays, turns = [point(0, 1.0)], [point(0, 1.0), point(4_000, 1.0, 1.0)]
    first, second = (render(FIELD, open_hall, [emitter], path, block_size=480, length=9_000) for path in (stays, turns))
    differs = np.flatnonzero(np.any(first != second, axis=0))
    assert 4_320 <= differs[0] < 4_320 + 16


def test_what_moves_is_heard_alike_whatever_the_block_size(open_hall):
    """Fades are as long as blocks, so what is far from a change is the same."""
    emitter = RenderedEmitter(noise(3, 12_000), THERE)
    path = [point(0, 1.0), point(3_840, 1.2)]
    odd, even = (render(FIELD, open_hall, [emitter], path, block_size=size, length=12_000) for size in (480, 256))
    for stretch in (slice(0, 3_840), slice(10_000, 12_000)):
        error = np.abs(odd[:, stretch] - even[:, stretch]).max() / np.abs(even).max()
        assert 20 * np.log10(error) < -80


@pytest.mark.parametrize("size", [16, 17, 48, 100, 441, 8_208, 1_000_000])
def test_other_block_sizes_are_refused(open_hall, size):
    emitter = RenderedEmitter(noise(3, 100), THERE)
    with pytest.raises(ValueError, match="block_size is a multiple of 16 from 64 to 8192, not"):
        render(FIELD, open_hall, [emitter], [point(0, 1.0)], block_size=size)
