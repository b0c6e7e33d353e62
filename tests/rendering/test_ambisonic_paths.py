"""The direct path and first reflections as ambisonic channels: each sound in its direction, and nothing that clicks."""

import numpy as np
import pytest
from scipy.signal.windows import kaiser

from server.acoustics.spherical_harmonics import even_directions, real_harmonics
from server.rendering.direct_path import DirectPath, PathTarget
from server.rendering.harmonics_kernel import write_harmonics
from server.rendering.hrtf import NoHead
from server.rendering.renderer import Renderer
from server.rendering.sources import ClipPlayer
from server.rendering.still_paths import StillPaths
from tests.signals import error_db, noise

RATE, BLOCK, SPEED_OF_SOUND = 48_000, 256, 343.0
FLAT = np.zeros(7)
LEVEL, TURNED = (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 1.0, 0.0)
SIDE = np.array([0.48, 0.6, -0.64])
AIR = np.array([0.001, 0.003, 0.005, 0.01, 0.02, 0.05, 0.1])
ORDERS = pytest.mark.parametrize("order", [1, 2, 3])


def path_of(order, **rest):
    settings = {"slots": 2, "block_size": BLOCK, "sample_rate": RATE, "speed_of_sound": SPEED_OF_SOUND}
    return DirectPath(**settings, filters=None, air_db_per_m=AIR, order=order, **rest)


def play(path, signal, target_at):
    """(channel, samples) of one emitter, whose target is set before each block of a signal."""
    out = np.zeros((path.channels, len(signal)), np.float32)
    blocks = np.zeros((path.slots, BLOCK), np.float32)
    for start in range(0, len(signal), BLOCK):
        path.set_target(0, target_at(start / RATE))
        blocks[0] = signal[start : start + BLOCK]
        path.process(blocks, out[:, start : start + BLOCK])
    return out


def tone(frequency_hz, seconds):
    samples = round(seconds * RATE) // BLOCK * BLOCK
    return np.sin(2 * np.pi * frequency_hz * np.arange(samples) / RATE).astype(np.float32)


@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_compiled_harmonics_are_those_of_the_formulas(order):
    expected = real_harmonics(even_directions(40), order)
    for direction, harmonics in zip(even_directions(40), expected, strict=True):
        written = np.zeros(len(harmonics))
        write_harmonics(direction, written)
        np.testing.assert_allclose(written, harmonics, atol=1e-14)


@ORDERS
def test_a_wave_is_what_one_microphone_hears_times_the_harmonics_of_its_direction(order):
    signal, target = noise(1, 20 * BLOCK), PathTarget(3.3, SIDE, np.linspace(-6, 0, 7))
    one = DirectPath(
        slots=1, block_size=BLOCK, sample_rate=RATE, filters=None, speed_of_sound=SPEED_OF_SOUND, air_db_per_m=AIR
    )
    expected = real_harmonics(SIDE, order)[:, None] * play(one, signal, lambda _: target)
    assert error_db(play(path_of(order), signal, lambda _: target), expected) < -110


def test_the_first_channel_has_unit_pressure_at_one_metre():
    path = DirectPath(
        slots=1, block_size=BLOCK, sample_rate=RATE, filters=None, speed_of_sound=343.0, air_db_per_m=FLAT, order=1
    )
    heard = play(path, tone(1_000, 0.2), lambda _: PathTarget(2.0, SIDE, FLAT))[:, RATE // 20 :]
    np.testing.assert_allclose(np.sqrt(2 * np.mean(heard**2, axis=1)), np.abs([1, *SIDE[[1, 2, 0]]]) / 2, rtol=1e-3)


@ORDERS
def test_an_orientation_changes_nothing(order):
    signal = noise(2, 6 * BLOCK)
    level, turned = path_of(order), path_of(order)
    turned.set_orientation(TURNED)
    target = PathTarget(2.0, SIDE, FLAT)
    np.testing.assert_array_equal(play(level, signal, lambda _: target), play(turned, signal, lambda _: target))


@ORDERS
def test_a_passing_emitter_goes_round_and_keeps_its_pitch_in_all_channels(order):
    """An emitter that circles round the listener at 10 m/s keeps its distance. The channels follow the harmonics of its
    direction, which trails by at most a block, and nothing lies beside the tone."""
    signal, per_second = tone(2_000, 1.5), 5.0

    def arrival(seconds):
        return np.array([np.cos(per_second * seconds), np.sin(per_second * seconds), 0.0])

    heard = play(path_of(order), signal, lambda seconds: PathTarget(2.0, arrival(seconds), FLAT))
    quadrature = np.exp(-2j * np.pi * 2_000 * np.arange(len(signal)) / RATE)
    for at in range(RATE // 4, len(signal) - RATE // 8, 5_000):
        part = slice(at, at + 24 * 8)
        amplitude = heard[:, part] @ quadrature[part]
        towards = real_harmonics(arrival((at + 96 - BLOCK / 2) / RATE), order)
        np.testing.assert_allclose((amplitude / amplitude[0]).real, towards, atol=0.03)
    steady = heard[:, RATE // 4 :]
    power = np.abs(np.fft.rfft(steady * kaiser(steady.shape[1], 20))) ** 2
    beside = np.abs(np.fft.rfftfreq(steady.shape[1], 1 / RATE) - 2_000) > 150
    assert 10 * np.log10(power[:, beside].sum() / power.sum()) < -70


def test_a_leap_from_one_side_to_the_other_does_not_click():
    signal = tone(500, 1.0)
    ways = SIDE, -SIDE
    heard = play(path_of(1), signal, lambda seconds: PathTarget(2.0, ways[int(seconds * 20) % 2], FLAT))
    steady = heard[:, RATE // 4 :] * kaiser(heard.shape[1] - RATE // 4, 20)
    power = np.abs(np.fft.rfft(steady)) ** 2
    assert 10 * np.log10(power[:, np.fft.rfftfreq(steady.shape[1], 1 / RATE) > 5_000].sum() / power.sum()) < -80


def test_a_muted_emitter_fades_out_of_all_channels_and_comes_back():
    path, signal = path_of(2), tone(500, 0.5)

    def target(seconds):
        path.set_muted(0, 0.1 < seconds < 0.3)
        return PathTarget(2.0, SIDE, FLAT)

    heard = play(path, signal, target)
    assert not heard[:, RATE // 5 : RATE // 4].any()
    assert np.abs(np.diff(heard)).max() < 1.05 * np.abs(np.diff(signal)).max() / 2
    np.testing.assert_allclose(heard, real_harmonics(SIDE, 2)[:, None] * heard[0], atol=1e-5)


def test_ambisonic_channels_are_heard_through_no_head(kemar_at):
    with pytest.raises(ValueError, match="no head"):
        DirectPath(
            slots=1,
            block_size=BLOCK,
            sample_rate=RATE,
            filters=kemar_at(RATE)[1],
            speed_of_sound=343.0,
            air_db_per_m=FLAT,
            order=1,
        )


@ORDERS
def test_static_waves_add_up_in_their_directions(order):
    waves = StillPaths(NoHead(RATE), speed_of_sound=SPEED_OF_SOUND, air_db_per_m=AIR)
    lengths, arrivals, gains = np.array([2.0, 7.5]), np.stack([SIDE, -SIDE[::-1]]), np.full((2, 7), -3.0)
    together = np.zeros(((order + 1) ** 2, 2_000), np.float32)
    waves.add(lengths, arrivals, gains, LEVEL, together)
    expected = np.zeros(together.shape)
    for row in range(2):
        one = np.zeros((1, 2_000), np.float32)
        waves.add(lengths[row, None], arrivals[row, None], gains[row, None], LEVEL, one)
        expected += real_harmonics(arrivals[row], order)[:, None] * one
    assert error_db(together, expected) < -120


@pytest.mark.parametrize("block_size", [256, 480], ids=["compiled", "any size"])
def test_a_renderer_of_ambisonics_convolves_encodes_and_limits(block_size, kemar_at):
    filters = kemar_at(RATE)[1]
    renderer = Renderer(
        block_size=block_size,
        ir_samples=2_000,
        sample_rate=RATE,
        filters=filters,
        speed_of_sound=SPEED_OF_SOUND,
        air_db_per_m=FLAT,
        ceiling=0.5,
        order=1,
    )
    assert (renderer.outputs, renderer.channels) == (4, 4)
    dry, ir = 0.2 * noise(7, 8 * block_size), np.zeros((4, 500), np.float32)
    ir[:, 300] = 0.5, 0.1, -0.2, 0.3
    renderer.add_emitter("a", ClipPlayer(dry, loop=False))
    renderer.set_ir("a", ir, token=3)
    renderer.set_path("a", PathTarget(343.0 * 120 / RATE, SIDE, FLAT))
    renderer.set_orientation(TURNED)
    heard = np.concatenate([renderer.process() for _ in range(12)], axis=1)
    expected = np.zeros((4, 12 * block_size))
    for channel, gain in enumerate(real_harmonics(SIDE, 1) * RATE / (343.0 * 120)):
        expected[channel, 120 : 120 + dry.size] += gain * dry
        expected[channel, 300 : 300 + dry.size] += ir[channel, 300] * dry
    loud = np.abs(expected).max() > 0.5
    assert loud
    # All channels have the same gain at every sample, where it acts too.
    gain = np.sum(heard * expected, axis=0) / np.maximum(np.sum(expected**2, axis=0), 1e-12)
    np.testing.assert_allclose(heard, gain * expected, atol=2e-3)
    assert np.abs(heard).max() <= 0.5
    for wrong in (np.zeros((2, 10), np.float32), np.zeros((9, 10), np.float32)):
        with pytest.raises(ValueError, match=r"expected an IR \(4,"):
            renderer.prepare(wrong)
