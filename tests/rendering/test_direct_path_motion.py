"""The direct path of emitters and heads that move: Doppler shift, and nothing that clicks or sweeps."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import hilbert
from scipy.signal.windows import kaiser
from scipy.spatial.transform import Rotation

from server.acoustics.decibels import power_to_db
from server.rendering.direct_path import PathTarget

SPEED_OF_SOUND = 343.0
RATE = 48_000
BLOCK = 256
FLAT = np.zeros(7)
LEVEL = (0.0, 0.0, 0.0, 1.0)


def tone(frequency_hz, seconds, rate=RATE):
    samples = round(seconds * rate) // BLOCK * BLOCK
    return np.sin(2 * np.pi * frequency_hz * np.arange(samples) / rate).astype(np.float32)


def listen(path, signal, pose, *, jumps=()):
    """(2, samples) of one emitter. `pose(seconds)` at the end of each block gives (offset (3,), quaternion)."""
    size = path.block_size
    out = np.zeros((2, len(signal)), np.float32)
    for start in range(0, len(signal), size):
        offset, orientation = pose((start + size) / path.sample_rate)
        length = np.linalg.norm(offset)
        path.set_target(0, PathTarget(length, offset / length, FLAT), jump=start // size in jumps)
        path.set_orientation(orientation)
        path.process(signal[None, start : start + size], out[:, start : start + size])
    return out


def outside_db(signal, low_hz, high_hz, rate=RATE):
    """Energy of (..., samples) outside a band, relative to all, through a window whose side lobes are below -140 dB."""
    power = np.abs(np.fft.rfft(signal * kaiser(signal.shape[-1], 20))) ** 2
    frequency = np.fft.rfftfreq(signal.shape[-1], 1 / rate)
    outside = (frequency < low_hz) | (frequency > high_hz)
    return power_to_db(power[..., outside].sum(axis=-1) / power.sum(axis=-1)).max()


def level_facing(offset):
    return np.asarray(offset, dtype=float), LEVEL


@pytest.mark.parametrize("speed", [-20.0, -1.5, 1.5, 20.0])
def test_doppler_shift_of_a_steady_approach(make_path, speed):
    """The listener moves: f (1 + v / c). A hundredth of the shift, not of the frequency."""
    path = make_path(head=False)
    heard = listen(path, tone(1000, 2.0), lambda t: level_facing((60 - speed * t, 0, 0)))[0, RATE // 2 :]
    phase = np.unwrap(np.angle(hilbert(heard)))[2000:-2000]
    frequency = np.polyfit(np.arange(len(phase)), phase, 1)[0] * RATE / (2 * np.pi)
    assert frequency - 1000 == pytest.approx(1000 * speed / SPEED_OF_SOUND, rel=0.01)


@pytest.mark.parametrize("head", [False, True])
def test_doppler_shift_of_a_passing_tone(make_path, head):
    """Instantaneous frequency against f c / (c + r'), of an emitter that passes 5 m away at 20 m/s. What is heard
    trails the pose by twice the spring's time constant of 15 ms."""
    path = make_path(head=head)
    speed, aside = 20.0, 5.0

    def pose(t):
        return level_facing((aside, speed * (t - 1.5), 0))

    heard = listen(path, tone(2000, 3.0), pose)[0]
    phase = np.unwrap(np.angle(hilbert(heard)))
    at = np.arange(RATE // 2, len(heard) - RATE // 4, 960)
    frequency = (phase[at + 240] - phase[at - 240]) * RATE / (2 * np.pi * 480)
    seconds = at / RATE - 0.030
    along = speed * (seconds - 1.5)
    recession = speed * along / np.hypot(along, aside)
    theory = 2000 * SPEED_OF_SOUND / (SPEED_OF_SOUND + recession)
    np.testing.assert_allclose(frequency, theory, rtol=0.01)
    # And to a tenth of the shift: a moving listener's law differs from a moving emitter's by (v / c)^2.
    np.testing.assert_allclose(frequency - 2000, theory - 2000, atol=0.1 * 2000 * speed / SPEED_OF_SOUND)


@pytest.mark.parametrize("head", [False, True])
def test_smooth_motion_leaves_a_tone_pure(make_path, head):
    """Passing at 10 m/s, 3 m away: the tone moves by 30 Hz at most. Nothing else may sound."""
    path = make_path(head=head)
    heard = listen(path, tone(1000, 2.0), lambda t: level_facing((3.0, 10 * (t - 1.0), 0.3)))
    assert outside_db(heard[:, RATE // 4 :], 900, 1100) < (-78 if head else -98)


def test_walking_leaves_a_tone_pure_though_poses_come_irregularly(make_path):
    """Poses at 60 per second fall between blocks: each block sees the newest, held."""
    path = make_path()

    def pose(t):
        held = np.floor(t * 60) / 60
        return level_facing((2.0, 1.4 * (held - 1.0), 0.0))

    assert outside_db(listen(path, tone(1000, 2.0), pose)[:, RATE // 4 :], 800, 1200) < -70


def test_a_turning_head_leaves_a_tone_pure(make_path):
    """200 degrees per second."""
    path = make_path()

    def pose(t):
        return np.array([3.0, 0, 0]), Rotation.from_euler("z", 200 * t, degrees=True).as_quat()

    heard = listen(path, tone(997, 2.0), pose)[:, RATE // 4 :]
    assert outside_db(heard, 0, 4000) < -95
    assert outside_db(heard, 850, 1150) < -70


@pytest.mark.parametrize("per_second", [10, 90])
def test_a_head_that_leaps_does_not_click(make_path, per_second):
    """60 degrees to and fro."""
    path = make_path()

    def pose(t):
        yaw = 30 if int(t * per_second) % 2 else -30
        return np.array([3.0, 0, 0]), Rotation.from_euler("z", yaw, degrees=True).as_quat()

    assert outside_db(listen(path, tone(997, 2.0), pose)[:, RATE // 4 :], 0, 4000) < -98


@pytest.mark.parametrize("explicit", [True, False])
def test_a_teleport_neither_clicks_nor_sweeps(make_path, explicit):
    path = make_path(head=False)
    far = 40.0 if not explicit else 4.0
    block = RATE // BLOCK

    def pose(t):
        return level_facing((2.0 if t * RATE / BLOCK <= block + 0.5 else far, 0, 0))

    heard = listen(path, tone(997, 2.0), pose, jumps=(block,) if explicit else ())[0]
    assert outside_db(heard[RATE // 4 :], 0, 4000) < -100
    # At once: the tone's level is the new one as soon as the fade is over, and its frequency never another.
    after = heard[(block + 1) * BLOCK + 64 :].astype(float)
    np.testing.assert_allclose(np.abs(after).max(), 1 / far, rtol=0.01)
    phase = np.unwrap(np.angle(hilbert(after)))[500:-500]
    frequency = np.diff(phase) * RATE / (2 * np.pi)
    np.testing.assert_allclose(frequency, 997, atol=1)


def test_what_moves_little_glides(make_path):
    """A step of 0.3 m, as of a late pose, is no jump: the tone never drops out, as two tones in a fade would."""
    path = make_path(head=False)
    frequency = SPEED_OF_SOUND / 0.6  # half a wavelength: a crossfade would pass through silence

    def pose(t):
        return level_facing((3.0 if t < 1.0 else 3.3, 0, 0))

    heard = listen(path, tone(frequency, 2.0), pose)[0, RATE // 2 :]
    assert np.abs(hilbert(heard))[1000:-1000].min() > 0.99 / 3.3


def test_the_first_target_is_reached_without_a_glide(make_path):
    """Whatever a slot was before: it starts where it is asked to be."""
    signal = np.random.default_rng(0).standard_normal(8 * BLOCK).astype(np.float32)
    new = make_path()
    expected = listen(new, signal, lambda _: level_facing((5.0, 1.0, 0.0)))
    used = make_path()
    listen(used, signal, lambda t: level_facing((1.0, 30 * t, 2.0)))
    used.clear(0)
    used.set_orientation(LEVEL)
    np.testing.assert_array_equal(listen(used, signal, lambda _: level_facing((5.0, 1.0, 0.0))), expected)


def wander(t):
    turn = Rotation.from_euler("zyx", [90 * np.sin(t), 20 * np.sin(2 * t), 10 * t], degrees=True)
    return np.array([2 + np.sin(3 * t), np.cos(2 * t), 0.5 * np.sin(5 * t)]), turn.as_quat()


def test_the_same_again_gives_the_same_bits(make_path):
    signal = np.random.default_rng(0).standard_normal(RATE // 4 // BLOCK * BLOCK).astype(np.float32)
    path = make_path()
    first = listen(path, signal, wander)
    path.reset()
    np.testing.assert_array_equal(listen(path, signal, wander), first)
    np.testing.assert_array_equal(listen(make_path(), signal, wander), first)


def test_emitters_add_up(make_path):
    """Each moves on its own, while the head turns for all of them."""
    signals = np.random.default_rng(0).standard_normal((3, 40 * BLOCK)).astype(np.float32)

    def render(slots):
        path = make_path(slots=3)
        out = np.zeros((2, signals.shape[1]), np.float32)
        for start in range(0, signals.shape[1], BLOCK):
            path.set_orientation(wander(start / RATE)[1])
            for slot in slots:
                offset, _ = wander(start / RATE + slot)
                length = np.linalg.norm(offset)
                path.set_target(slot, PathTarget(length, offset / length, FLAT - slot))
            path.process(signals[:, start : start + BLOCK], out[:, start : start + BLOCK])
        return out

    apart = [render([slot]) for slot in range(3)]
    assert min(np.abs(out).max() for out in apart) > 0.1
    np.testing.assert_allclose(render([0, 1, 2]), sum(apart), atol=1e-5)


@pytest.mark.parametrize("block_size", [32, 100, 128, 512, 1024])
def test_at_rest_the_size_of_blocks_does_not_matter(make_path, block_size):
    signal = np.random.default_rng(0).standard_normal(12_800).astype(np.float32)
    reference = make_path(block_size=256)
    path = make_path(block_size=block_size)
    outputs = []
    for one in (reference, path):
        one.set_target(0, PathTarget(3.3, (0.6, 0.8, 0), np.linspace(0, -12, 7)))
        size = one.block_size
        padded = np.pad(signal, (0, -len(signal) % size))
        out = np.zeros((2, len(padded)), np.float32)
        for start in range(0, len(padded), size):
            one.process(padded[None, start : start + size], out[:, start : start + size])
        outputs.append(out[:, : len(signal)])
    np.testing.assert_allclose(outputs[1], outputs[0], atol=2e-6)


def test_silence_rings_out_and_then_costs_nothing_to_the_ear(make_path):
    path = make_path(max_distance_m=20.0)
    path.set_target(0, PathTarget(15.0, (1, 0, 0), FLAT))
    assert path.is_quiet(0)
    block, silence = np.ones((1, BLOCK), np.float32), np.zeros((1, BLOCK), np.float32)
    path.process(block, np.zeros((2, BLOCK), np.float32))
    assert not path.is_quiet(0)
    heard = []
    while not path.is_quiet(0):
        out = np.zeros((2, BLOCK), np.float32)
        path.process(silence, out)
        heard.append(np.abs(out).max())
    assert max(heard) > 0.01
    assert heard[-1] == 0
    # It begins again where it is then, as if new.
    path.set_target(0, PathTarget(2.0, (0, 1, 0), FLAT))
    new = make_path(max_distance_m=20.0)
    new.set_target(0, PathTarget(2.0, (0, 1, 0), FLAT))
    for _ in range(6):
        outs = np.zeros((2, 2, BLOCK), np.float32)
        path.process(block, outs[0])
        new.process(block, outs[1])
        np.testing.assert_allclose(outs[0], outs[1], atol=1e-7)


def test_hours_lose_nothing(make_path):
    """A signal that repeats every block sounds the same after a hundred seconds as after a tenth, wherever in the
    delay line it is."""
    path = make_path(max_distance_m=5.0)
    path.set_target(0, PathTarget(4.0, (0, 1, 0), FLAT))
    rng = np.random.default_rng(1)
    signal = rng.standard_normal((1, BLOCK)).astype(np.float32)
    out = np.zeros((2, BLOCK), np.float32)
    for block in range(20_000):
        out[:] = 0
        path.process(signal, out)
        if block == 20:
            first = out.copy()
    np.testing.assert_allclose(out, first, atol=1e-6)


def test_further_than_the_line_is_long_is_as_late_as_it_is_long(make_path):
    path = make_path(head=False, max_distance_m=10.0)
    response = path.impulse_response(PathTarget(1000.0, (1, 0, 0), FLAT), LEVEL, 4096)
    assert np.argmax(np.abs(response[0])) == round(10 / SPEED_OF_SOUND * RATE)


@pytest.mark.parametrize("length", [0.0, 1e-9, 0.05, 1e6])
def test_no_length_is_too_short_or_too_long(make_path, length):
    path = make_path()
    out = np.zeros((2, BLOCK), np.float32)
    for at in (length, 3.0, length, 1.0):
        path.set_target(0, PathTarget(at, (0, 1, 0), FLAT))
        for _ in range(5):
            path.process(np.ones((1, BLOCK), np.float32), out)
    assert np.isfinite(out).all()


RENDER_WANDERING = """
import sys
import numpy as np
if sys.argv[1] == "interpreted":
    sys.path.insert(0, "tests/oracles")
    import interpreted
    interpreted.install()
sys.path.insert(0, sys.argv[3])
from conftest import no_head
from test_direct_path_motion import BLOCK, RATE, listen, tone, wander
from server.rendering import direct_path_kernel
from server.rendering.direct_path import DirectPath
from server.rendering.hrtf import KEMAR, HeadFilters, Hrtf

assert hasattr(direct_path_kernel.ask, "py_func") == (sys.argv[1] == "compiled")
filters = HeadFilters.from_hrtf(Hrtf.read(KEMAR, RATE))
path = DirectPath(
    slots=1,
    block_size=BLOCK,
    sample_rate=RATE,
    filters=filters,
    speed_of_sound=343.0,
    air_db_per_m=np.linspace(0, 0.1, 7),
)
signal = np.random.default_rng(3).standard_normal(RATE // 2 // BLOCK * BLOCK).astype(np.float32)
np.save(sys.argv[2], listen(path, signal, wander, jumps=(40,)))
"""


def test_with_nothing_compiled_it_sounds_the_same(tmp_path):
    rendered = {}
    here = Path(__file__).parent
    for kind in ("compiled", "interpreted"):
        file = tmp_path / f"{kind}.npy"
        command = [sys.executable, "-c", RENDER_WANDERING, kind, str(file), str(here)]
        subprocess.run(command, check=True, cwd=here.parents[1])
        rendered[kind] = np.load(file).astype(float)
    error = rendered["interpreted"] - rendered["compiled"]
    assert power_to_db(np.mean(error**2) / np.mean(rendered["compiled"] ** 2)) < -110
