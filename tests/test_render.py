"""Offline rendering: agrees with convolution, with the live renderer, and explains what is wrong with a path."""

import math

import numpy as np
import pytest
from scipy.signal import fftconvolve

from server.acoustics.geometry import Pose
from server.render import PathError, PathPoint, RenderedEmitter, read_path, render
from server.rendering.fade import raised_cosine
from server.rendering.renderer import Renderer

SAMPLE_RATE = 24_000
SIZE = 256


class NoiseField:
    """Decaying noise, another for each pair of poses: enough to tell which impulse response was used, and where."""

    ir_samples = 1_500

    def impulse_responses(self, listeners, emitters, yaws):
        return np.stack([self.one(*poses) for poses in zip(listeners, emitters, yaws, strict=True)])

    def one(self, listener, emitter, yaw):
        seed = np.array([*listener, *emitter, yaw], np.float64).view(np.uint32)
        samples = np.random.default_rng(seed).standard_normal((2, self.ir_samples))
        return (samples * np.exp(-np.arange(self.ir_samples) / 200)).astype(np.float32)


FIELD = NoiseField()
HERE, THERE = (1.0, 2.0, 1.5), (6.0, 3.0, 1.5)


def noise(seed, samples):
    return np.random.default_rng(seed).standard_normal(samples).astype(np.float32)


def point(sample, x, yaw_rad=0.0):
    return PathPoint(sample, Pose.from_yaw((x, 2.0, 1.5), yaw_rad))


def heard(emitter, at, samples):
    """Oracle: the clip in one room throughout, float64."""
    ir = FIELD.one(at.pose.position, emitter.position, at.pose.yaw).astype(float)
    return fftconvolve(emitter.clip[np.newaxis].astype(float), ir, axes=1)[:, :samples]


def error_db(actual, expected):
    return 20 * np.log10(np.abs(actual - expected).max() / np.abs(expected).max() + 1e-30)


def test_standing_still_is_convolution():
    emitters = [RenderedEmitter(noise(1, 5_000), HERE), RenderedEmitter(noise(2, 3_000), THERE, gain=0.5)]
    wet = render(FIELD, emitters, [point(0, 2.0)])
    assert wet.shape[0] == 2
    assert wet.dtype == np.float32
    assert wet.shape[1] >= 5_000 + FIELD.ir_samples - 1  # the reverberation is not cut off
    expected = np.zeros(wet.shape)
    for emitter in emitters:
        part = emitter.gain * heard(emitter, point(0, 2.0), wet.shape[1])
        expected[:, : part.shape[1]] += part
    assert error_db(wet, expected) < -120


@pytest.mark.parametrize("length", [1, 255, 256, 1_000])
def test_length_is_as_asked(length):
    emitter = RenderedEmitter(noise(3, 400), HERE, loop=True)
    wet = render(FIELD, [emitter], [point(0, 2.0)], length=length)
    np.testing.assert_array_equal(wet, render(FIELD, [emitter], [point(0, 2.0)], length=2_000)[:, :length])


@pytest.mark.parametrize(("sample", "block"), [(1, 1), (256, 1), (257, 2), (2_560, 10)])
def test_a_pose_is_faded_to_over_the_first_block_at_or_after_its_sample(sample, block):
    emitter = RenderedEmitter(noise(4, 20 * SIZE), HERE)
    before, after = point(0, 2.0), point(sample, 3.0)
    wet = render(FIELD, [emitter], [before, after], length=20 * SIZE)
    weight = np.zeros(20 * SIZE)
    weight[block * SIZE : (block + 1) * SIZE] = raised_cosine(SIZE)
    weight[(block + 1) * SIZE :] = 1
    old, new = heard(emitter, before, 20 * SIZE), heard(emitter, after, 20 * SIZE)
    assert error_db(wet, (1 - weight) * old + weight * new) < -120


def test_of_poses_within_a_block_the_last_counts():
    emitter = RenderedEmitter(noise(5, 20 * SIZE), HERE)
    many = [point(0, 2.0), *(point(1_000 + step, 3.0 + step) for step in range(20))]
    few = [point(0, 2.0), point(1_024, 22.0)]
    np.testing.assert_array_equal(render(FIELD, [emitter], many), render(FIELD, [emitter], few))


def test_nothing_sounds_before_the_path_begins_and_the_clip_begins_with_it():
    emitter = RenderedEmitter(noise(6, 3_000), HERE)
    late, prompt = (render(FIELD, [emitter], [point(start, 2.0)], length=20 * SIZE) for start in (5 * SIZE, 0))
    assert not late[:, : 5 * SIZE].any()
    np.testing.assert_array_equal(late[:, 5 * SIZE :], prompt[:, : 15 * SIZE])


def test_a_live_session_replayed_is_equal_to_the_bit():
    """Live: IRs arrive when they arrive, some never heard. Its log of (sample clock, pose) is all the replay gets."""
    rng = np.random.default_rng(7)
    emitters = [RenderedEmitter(noise(8, 2_000), HERE, loop=True), RenderedEmitter(noise(9, 5_000), THERE, gain=0.7)]
    live = Renderer(block_size=SIZE, ir_samples=FIELD.ir_samples)
    for name, emitter in enumerate(emitters):
        live.add_emitter(str(name), emitter.clip, gain=emitter.gain, loop=emitter.loop)
    poses, log, blocks = {}, [], []
    for number in range(60):
        for _ in range(rng.integers(0, 3) if number > 3 else 0):
            poses[len(poses)] = Pose.from_yaw((rng.uniform(0, 8), 2.0, 1.5), rng.uniform(-math.pi, math.pi))
            pose = poses[len(poses) - 1]
            for name, emitter in enumerate(emitters):
                ir = FIELD.one(pose.position, emitter.position, pose.yaw)
                live.set_ir(str(name), live.prepare(ir), token=len(poses) - 1)
        clock = live.sample_clock
        blocks.append(live.process())
        token = live.applied("0")
        assert live.applied("1") == token
        if token is not None and (not log or log[-1][1] != token):
            log.append((clock, token))
    assert 1 < len(log) < len(poses)

    replay = render(FIELD, emitters, [PathPoint(clock, poses[token]) for clock, token in log], length=60 * SIZE)
    np.testing.assert_array_equal(replay, np.concatenate(blocks, axis=1))


def test_progress_rises_to_one():
    told = []
    render(FIELD, [RenderedEmitter(noise(10, 2_000), HERE)], [point(0, 2.0)], progress=told.append)
    assert told == sorted(told)
    assert told[-1] == 1


@pytest.mark.parametrize(("emitters", "path"), [([], [point(0, 2.0)]), ([RenderedEmitter(noise(11, 9), HERE)], [])])
def test_nothing_to_render_is_refused(emitters, path):
    with pytest.raises(ValueError, match="a path and an emitter"):
        render(FIELD, emitters, path)


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
    assert first == PathPoint(0, Pose((1, 2, 1.5)))
    assert (second.sample, second.pose.position) == (512, (1.5, 2, 1.5))
    assert second.pose.yaw == pytest.approx(math.pi / 2)


def test_reads_seconds_and_degrees_in_any_order_as_a_spreadsheet_writes_them(write):
    path = write("\ufeffyaw_deg, z ,y,x,time_s\r\n\r\n90,1.5,2,1,0\r\n-30,1.5,2.5,1,0.25\r\n")
    assert read_path(path, SAMPLE_RATE) == [
        PathPoint(0, Pose.from_yaw((1, 2, 1.5), math.radians(90))),
        PathPoint(6_000, Pose.from_yaw((1, 2.5, 1.5), math.radians(-30))),
    ]


YAW = "sample,x,y,z,yaw_deg\n"
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
            YAW + "256,1,2,1.5,0\n256,1,2,1.5,0\n",
            "path.csv: line 3, column 'sample': must be later than on the line before",
        ),
        (
            "time_s,x,y,z,yaw_deg\n0.5,1,2,1.5,0\n0.25,1,2,1.5,0\n",
            "path.csv: line 3, column 'time_s': must be later than on the line before",
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
            "path.csv: line 2, columns 'qx' to 'qw': orientation must be a quaternion of non-zero length",
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
