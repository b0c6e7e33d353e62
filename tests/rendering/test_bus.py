"""A listener's bus: ambisonic channels turned with the head and decoded to its ears, against plain convolution."""

import numpy as np
import pytest
from scipy.signal import fftconvolve
from scipy.signal.windows import kaiser

from server.acoustics.geometry import Quaternion
from server.acoustics.spherical_harmonics import even_directions, harmonic_count, real_harmonics, rotation
from server.rendering.bus import Bus
from server.rendering.direct_path import PathTarget
from server.rendering.head_decoder import HeadDecoder
from server.rendering.mixing import Mixer
from server.rendering.renderer import Renderer
from server.rendering.sources import ClipPlayer
from tests.signals import decaying_noise, error_db, noise

RATE = 24_000
LEVEL, TILTED = Quaternion(0.0, 0.0, 0.0, 1.0), Quaternion(0.36, -0.48, 0.0, 0.8)
BLOCK_SIZES = pytest.mark.parametrize("block_size", [64, 256, 1024, 480])
"""The last is for NumPy."""


@pytest.fixture(scope="module")
def head(kemar_at):
    return kemar_at(RATE)[1]


def yaw(angle):
    return Quaternion(0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2))


def run(decoder, signal, block_size, orientation_at=lambda _: LEVEL):
    """(2, samples) of channels (k, samples), in a mixer of its own, with the orientation of each block."""
    mixer = Mixer(channels=4, slots=1, block_size=block_size, direct=None, bus=Bus(decoder, block_size=block_size))
    decode = decode_compiled(mixer.bus) if mixer.is_compiled else mixer.bus.process
    heard = np.zeros((2, signal.shape[1]), np.float32)
    for at in range(0, signal.shape[1], block_size):
        mixer.bus.set_orientation(orientation_at(at // block_size))
        out = np.zeros((2, block_size), np.float32)
        decode(np.ascontiguousarray(signal[:, at : at + block_size]), out)
        heard[:, at : at + block_size] = out
    return heard


def decode_compiled(bus):
    from server.rendering.bus_kernel import decode_bus

    return lambda block, out: decode_bus(bus._record[0], block.ctypes.data, out.ctypes.data)


def decoded(decoder, signal):
    """Oracle, float64."""
    convolved = fftconvolve(signal[None].astype(float), decoder.filters.astype(float), axes=-1)
    return convolved.sum(axis=1)[:, : signal.shape[1]]


@BLOCK_SIZES
@pytest.mark.parametrize("order", [1, 2, 3])
def test_channels_are_turned_and_filtered(head, order, block_size):
    decoder = HeadDecoder.of(head, order)
    signal = noise(1, harmonic_count(order), 8 * block_size)
    heard = run(decoder, signal, block_size, lambda _: TILTED)
    assert error_db(heard, decoded(decoder, rotation(TILTED, order) @ signal)) < -110


@BLOCK_SIZES
def test_a_turn_is_a_straight_way_from_one_matrix_to_the_other(head, block_size):
    decoder, signal = HeadDecoder.of(head, 1), noise(2, 4, 6 * block_size)
    heard = run(decoder, signal, block_size, lambda block: yaw(2.0 * block))
    turned, before = np.zeros(signal.shape), rotation(yaw(0.0), 1)
    ramp = np.arange(1, block_size + 1) / block_size
    for block in range(6):
        part, after = np.s_[:, block * block_size : (block + 1) * block_size], rotation(yaw(2.0 * block), 1)
        turned[part] = before @ signal[part] * (1 - ramp) + after @ signal[part] * ramp
        before = after
    assert error_db(heard, decoded(decoder, turned)) < -110


@pytest.mark.parametrize("turns_per_s", [0.5, 2.0])
def test_a_steady_turn_does_not_click(head, turns_per_s):
    """A tone from one direction, while the head turns in steps of a block: hardly anything lies beside the tone."""
    tone = np.sin(2 * np.pi * 700 * np.arange(150 * 256) / RATE)
    signal = (real_harmonics((0.6, 0.8, 0.0), 1)[:, None] * tone).astype(np.float32)
    heard = run(HeadDecoder.of(head, 1), signal, 256, lambda block: yaw(2 * np.pi * turns_per_s * block * 256 / RATE))
    power = np.abs(np.fft.rfft(heard[:, 512:] * kaiser(heard.shape[1] - 512, 20))) ** 2
    beside = np.abs(np.fft.rfftfreq(heard.shape[1] - 512, 1 / RATE) - 700) > 100
    assert 10 * np.log10(power[:, beside].sum() / power.sum()) < -70


def test_a_turn_keeps_the_energy_of_sound_from_all_sides(head):
    """Diffuse sound, up to three quarters of a turn a second: the level in both ears stays as it is at rest."""
    directions = even_directions(100)
    signal = (real_harmonics(directions, 1).T @ noise(5, 100, 300 * 256) / 10).astype(np.float32)
    decoder = HeadDecoder.of(head, 1)
    still, turning = (
        run(decoder, signal, 256, lambda block, speed=speed: yaw(speed * block * 256 / RATE)) for speed in (0.0, 4.7)
    )
    np.testing.assert_allclose(10 * np.log10(np.mean(turning**2, axis=1) / np.mean(still**2, axis=1)), 0, atol=0.2)


def renderer(head, **options):
    defaults = {"filters": head, "speed_of_sound": 343.0, "air_db_per_m": np.zeros(7), "block_size": 256}
    return Renderer(ir_samples=3_000, sample_rate=RATE, **(defaults | options))


@pytest.mark.parametrize("block_size", [256, 480])
def test_emitters_are_heard_by_one_bus_beside_their_direct_sound(head, block_size):
    decoder = HeadDecoder.of(head, 1)
    engine = renderer(head, block_size=block_size, decoders=[decoder])
    clips, irs = noise(3, 2, 2_000), [decaying_noise(seed, 3_000, 4, decay_samples=500) for seed in (1, 2)]
    for ir in irs:
        ir[:, :200] = 0  # what is reflected comes after the direct sound
    engine.set_channels(4)
    engine.set_orientation(TILTED)
    for number in range(2):
        engine.add_emitter(str(number), ClipPlayer(clips[number], loop=False))
        engine.set_path(str(number), PathTarget(2.0, (0.0, 1.0, 0.0), np.zeros(7)))
        engine.enable_direct(str(number), is_heard=False)
        engine.set_ir(str(number), irs[number])
    blocks = -(-(2_000 + 3_000 + 600) // block_size)
    heard = np.concatenate([engine.process() for _ in range(blocks)], axis=1)
    sent = sum(fftconvolve(clip[None].astype(float), ir, axes=1) for clip, ir in zip(clips, irs, strict=True))
    sent = np.pad(sent, ((0, 0), (0, heard.shape[1])))[:, : heard.shape[1]]
    expected = decoded(decoder, rotation(TILTED, 1) @ np.roll(sent, -decoder.delay, axis=1))
    assert error_db(heard, expected) < -100


def test_a_bus_rings_out_to_its_end_and_is_let_go(head):
    """Its emitter has gone and others are heard by ears: responses and decoder still play what they have."""
    decoder = HeadDecoder.of(head, 1)
    engine = renderer(head, decoders=[decoder])
    clip, ir = noise(1, 256), decaying_noise(1, 3_000, 4, decay_samples=500)
    ir[:, : decoder.delay] = 0
    engine.set_channels(4)
    engine.add_emitter("a", ClipPlayer(clip, loop=False))
    engine.set_path("a", PathTarget(2.0, (0.0, 1.0, 0.0), np.zeros(7)))
    engine.enable_direct("a", is_heard=False)
    engine.set_ir("a", ir)
    heard = [engine.process() for _ in range(2)]
    engine.remove_emitter("a")
    engine.set_channels(2)
    heard = np.concatenate([*heard, *(engine.process() for _ in range(100))], axis=1)
    sent = np.zeros((4, heard.shape[1]))
    convolved = fftconvolve(clip[None].astype(float), ir, axes=1)[:, decoder.delay :]
    sent[:, : convolved.shape[1]] = convolved
    assert error_db(heard, decoded(decoder, sent)) < -100
    assert (len(list(engine._mixers)), engine.convolvers) == (1, 0)


def test_a_head_has_room_for_two_ways_to_hear_at_a_time(head):
    engine = renderer(head, decoders=[HeadDecoder.of(head, 1)])
    engine.add_emitter("a", ClipPlayer(noise(1, 300), loop=True))
    engine.set_path("a", PathTarget(2.0, (0.0, 1.0, 0.0), np.zeros(7)))
    engine.set_ir("a", decaying_noise(1, 3_000, 2, decay_samples=500))
    engine.process()
    engine.set_channels(4)
    engine.set_ir("a", decaying_noise(1, 3_000, 4, decay_samples=500))
    engine.process()
    assert not engine.can_set_channels(1)
    for _ in range(100):
        engine.process()
    assert engine.can_set_channels(1)
