"""Laws of streaming convolution, against SciPy's one-shot FFT convolution in float64."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import fftconvolve

from server.rendering.convolver import Convolver, partition_ir
from server.rendering.fade import raised_cosine

SAMPLE_RATE = 24_000


def noise(seed, *shape):
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


def decaying_ir(seed, samples, channels=2, t60_s=0.4):
    decay = 10 ** (-3 * np.arange(samples) / (t60_s * SAMPLE_RATE))
    return (noise(seed, channels, samples) * decay).astype(np.float32)


def convolve(dry, ir):
    """Oracle: (n,) with (c, m) to the first n samples, float64."""
    return fftconvolve(dry[np.newaxis].astype(float), ir.astype(float), axes=1)[:, : dry.size]


def stream(convolver, dry, changes=()):
    """Feed (s, n) block by block; `changes` are (block, source, ir), made before that block."""
    size = convolver.block_size
    blocks = []
    for index in range(dry.shape[1] // size):
        for block, source, ir in changes:
            if block == index:
                convolver.set_ir(source, ir)
        blocks.append(convolver.process(dry[:, index * size : (index + 1) * size]))
    return np.concatenate(blocks, axis=1)


def error_db(actual, expected):
    """Largest error, relative to the largest sample."""
    return 20 * np.log10(np.abs(actual - expected).max() / np.abs(expected).max() + 1e-30)


@pytest.mark.parametrize("block_size", [128, 256, 512, 1024])
@pytest.mark.parametrize("ir_samples", [1, 200, 256, 257, 4_001])
def test_streaming_equals_convolution(block_size, ir_samples):
    dry = noise(1, 1, 20 * block_size)
    ir = decaying_ir(2, ir_samples)
    convolver = Convolver(sources=1, channels=2, block_size=block_size, ir_samples=ir_samples)
    convolver.set_ir(0, ir)
    assert error_db(stream(convolver, dry), convolve(dry[0], ir)) < -120


def test_a_long_room_response_stays_exact():
    dry = noise(3, 2, 300 * 256)
    irs = [decaying_ir(seed, 16_800) for seed in (4, 5)]
    convolver = Convolver(sources=2, channels=2, block_size=256, ir_samples=16_800)
    for source, ir in enumerate(irs):
        convolver.set_ir(source, ir)
    expected = convolve(dry[0], irs[0]) + convolve(dry[1], irs[1])
    assert error_db(stream(convolver, dry), expected) < -120


@settings(deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    sources=st.integers(1, 4),
    channels=st.integers(1, 3),
    block_size=st.sampled_from([1, 3, 16, 64, 100]),
    ir_samples=st.integers(1, 400),
    blocks=st.integers(1, 40),
)
def test_any_layout_equals_convolution(seed, sources, channels, block_size, ir_samples, blocks):
    rng = np.random.default_rng(seed)
    dry = noise(seed, sources, blocks * block_size)
    irs = [decaying_ir(seed + source, rng.integers(1, ir_samples + 1), channels) for source in range(sources)]
    convolver = Convolver(sources=sources, channels=channels, block_size=block_size, ir_samples=ir_samples)
    for source, ir in enumerate(irs):
        convolver.set_ir(source, ir)
    expected = sum(convolve(dry[source], ir) for source, ir in enumerate(irs))
    assert (
        error_db(stream(convolver, dry), expected) < -115
    )  # extremes of few samples; see above for the bound on rooms


def test_a_unit_impulse_passes_at_once_and_unchanged():
    convolver = Convolver(sources=1, channels=1, block_size=64, ir_samples=1_000)
    convolver.set_ir(0, np.ones((1, 1), np.float32))
    dry = noise(6, 1, 64)
    np.testing.assert_allclose(convolver.process(dry), dry, atol=1e-6)


@settings(deadline=None)
@given(a=st.floats(-4, 4), b=st.floats(-4, 4), seed=st.integers(0, 2**32 - 1))
def test_linear(a, b, seed):
    x, y = noise(seed, 2, 1, 10 * 64)
    ir = decaying_ir(seed, 300)

    def wet(dry):
        convolver = Convolver(sources=1, channels=2, block_size=64, ir_samples=300)
        convolver.set_ir(0, ir)
        return stream(convolver, dry.astype(np.float32))

    np.testing.assert_allclose(wet(a * x + b * y), a * wet(x) + b * wet(y), atol=1e-4)


@pytest.mark.parametrize("late_blocks", [1, 3, 17, 40])
def test_time_invariant_to_the_bit(late_blocks):
    dry = noise(7, 1, 30 * 256)
    ir = decaying_ir(8, 3_000)

    def wet(x):
        convolver = Convolver(sources=1, channels=2, block_size=256, ir_samples=3_000)
        convolver.set_ir(0, ir)
        return stream(convolver, x)

    late = np.concatenate([np.zeros((1, late_blocks * 256), np.float32), dry], axis=1)
    np.testing.assert_array_equal(wet(late)[:, late_blocks * 256 :], wet(dry))


def test_time_invariant_within_a_block():
    ir = decaying_ir(9, 1_000)
    for position in (0, 1, 100, 255, 256):
        dry = np.zeros((1, 8 * 256), np.float32)
        dry[0, position] = 1
        convolver = Convolver(sources=1, channels=2, block_size=256, ir_samples=1_000)
        convolver.set_ir(0, ir)
        np.testing.assert_allclose(stream(convolver, dry)[:, position : position + 1_000], ir, atol=2e-6)


def test_exchange_is_a_crossfade_of_two_full_convolutions():
    size, at = 256, 9
    dry = noise(10, 1, 20 * size)
    old, new = decaying_ir(11, 2_000), decaying_ir(12, 2_000)
    convolver = Convolver(sources=1, channels=2, block_size=size, ir_samples=2_000)
    wet = stream(convolver, dry, [(0, 0, old), (at, 0, new)])

    weight = np.zeros(dry.shape[1])
    weight[at * size : (at + 1) * size] = raised_cosine(size)
    weight[(at + 1) * size :] = 1
    expected = (1 - weight) * convolve(dry[0], old) + weight * convolve(dry[0], new)
    assert error_db(wet, expected) < -120


@settings(deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    changes=st.lists(st.tuples(st.integers(0, 24), st.integers(0, 2)), max_size=30),
)
def test_any_sequence_of_exchanges_is_a_sequence_of_crossfades(seed, changes):
    size, blocks, sources = 64, 25, 3
    dry = noise(seed, sources, blocks * size)
    irs = [decaying_ir(seed + index, 500) for index in range(len(changes) + sources)]
    schedule = [(0, source, irs[source]) for source in range(sources)]
    schedule += [(block, source, irs[sources + index]) for index, (block, source) in enumerate(changes)]
    convolver = Convolver(sources=sources, channels=2, block_size=size, ir_samples=500)
    wet = stream(convolver, dry, schedule)

    expected = np.zeros((2, blocks * size))
    for source in range(sources):
        current = None
        for block in range(blocks):
            handed_in = [ir for at, to, ir in schedule if (at, to) == (block, source)]
            span = slice(block * size, (block + 1) * size)
            if current is None:
                current = handed_in.pop()
                handed_in.clear()
            old = convolve(dry[source], current)[:, span]
            if handed_in:
                current = handed_in[-1]
                fade = raised_cosine(size)
                expected[:, span] += (1 - fade) * old + fade * convolve(dry[source], current)[:, span]
            else:
                expected[:, span] += old
    assert error_db(wet, expected) < -115


def test_newest_ir_wins_and_flags_tell_which_block_exchanged():
    convolver = Convolver(sources=2, channels=2, block_size=64, ir_samples=100)
    dry = noise(13, 2, 64)
    for source in (0, 1):
        convolver.set_ir(source, decaying_ir(14, 100))
    assert not convolver.is_fading(1)  # a first IR is not faded to
    convolver.process(dry)
    assert convolver.exchanged == ()

    convolver.set_ir(1, decaying_ir(15, 100))
    convolver.set_ir(1, np.zeros((2, 1), np.float32))
    assert convolver.is_fading(1)
    assert not convolver.is_fading(0)
    convolver.process(dry)
    assert convolver.exchanged == (1,)
    assert not convolver.is_fading(1)

    only_second = dry * np.array([[0], [1]], np.float32)
    for _ in range(3):
        wet = convolver.process(only_second)
        assert convolver.exchanged == ()
    np.testing.assert_array_equal(wet, 0)


@pytest.mark.parametrize("block_size", [128, 256, 512])
@pytest.mark.parametrize("blocks_between", [1, 5])
def test_exchange_does_not_splatter(block_size, blocks_between):
    """Energy above 4 kHz of a 997 Hz tone, while every exchange is to an entirely unrelated room: the worst case.

    Measured with an exchange in every block: -96 dB at 128 samples, -111 dB at 256, -126 dB at 512; with none, -140 dB.
    """
    ir_samples = 2_400
    blocks = 2 * SAMPLE_RATE // block_size
    tone = np.sin(2 * np.pi * 997 * np.arange(blocks * block_size) / SAMPLE_RATE).astype(np.float32)[np.newaxis]
    convolver = Convolver(sources=1, channels=1, block_size=block_size, ir_samples=ir_samples)
    changes = [(block, 0, decaying_ir(block, ir_samples, 1)) for block in range(0, blocks, blocks_between)]
    wet = stream(convolver, tone, changes)[0, ir_samples + block_size :].astype(float)
    power = np.abs(np.fft.rfft(wet * np.kaiser(wet.size, 20))) ** 2
    high = np.fft.rfftfreq(wet.size, 1 / SAMPLE_RATE) > 4_000
    assert 10 * np.log10(power[high].sum() / power.sum()) < -95


def test_exchange_to_the_same_ir_is_inaudible():
    dry = noise(16, 1, 20 * 256)
    ir = decaying_ir(17, 2_000)
    convolver = Convolver(sources=1, channels=2, block_size=256, ir_samples=2_000)
    wet = stream(convolver, dry, [(block, 0, ir) for block in range(20)])
    assert error_db(wet, convolve(dry[0], ir)) < -120


def test_others_are_bit_equal_after_a_source_has_come_and_gone():
    size, blocks, samples = 256, 60, 2_000
    dry = noise(18, 3, blocks * size)
    irs = [decaying_ir(seed, samples) for seed in (19, 20, 21)]

    def wet(guest):
        convolver = Convolver(sources=3, channels=2, block_size=size, ir_samples=samples)
        convolver.set_ir(0, irs[0])
        convolver.set_ir(2, irs[2])
        output = []
        for index in range(blocks):
            block = dry[:, index * size : (index + 1) * size].copy()
            if guest and index == 10:
                convolver.set_ir(1, irs[1])
            if guest and index == 20:
                convolver.set_ir(1, irs[0])
            if guest and index == 30:
                convolver.clear(1)
            output.append(convolver.process(block))
        return np.concatenate(output, axis=1)

    with_guest, without = wet(True), wet(False)
    np.testing.assert_array_equal(with_guest[:, : 10 * size], without[:, : 10 * size])
    np.testing.assert_array_equal(with_guest[:, 30 * size :], without[:, 30 * size :])
    assert not np.array_equal(with_guest[:, 10 * size : 30 * size], without[:, 10 * size : 30 * size])


def test_a_source_that_rang_out_and_sounds_again_remembers_nothing():
    """Guards the shortcut for silence: no stale spectrum may be heard when the source is fed again, however late."""
    size, samples = 64, 300
    ir = decaying_ir(22, samples)
    for pause in range(14):
        dry = noise(23, 1, 40 * size)
        dry[:, 10 * size : (10 + pause) * size] = 0
        convolver = Convolver(sources=1, channels=2, block_size=size, ir_samples=samples)
        convolver.set_ir(0, ir)
        assert error_db(stream(convolver, dry), convolve(dry[0], ir)) < -120


def test_quiet_means_exactly_nothing_more():
    size, samples = 64, 300
    convolver = Convolver(sources=1, channels=2, block_size=size, ir_samples=samples)
    assert convolver.is_quiet(0)
    convolver.set_ir(0, decaying_ir(24, samples))
    convolver.process(noise(25, 1, size))
    assert not convolver.is_quiet(0)
    silence = np.zeros((1, size), np.float32)
    for _ in range(100):
        wet = convolver.process(silence)
        if convolver.is_quiet(0):
            break
    else:
        pytest.fail("never rang out")
    assert not wet.any()
    convolver.set_ir(0, decaying_ir(26, samples))
    assert not convolver.process(silence).any()
    assert convolver.exchanged == (0,)


def test_a_source_starts_from_silence_with_its_first_ir():
    """What was fed before the first IR is not heard, and joining late is the same as being new."""
    dry = noise(27, 1, 30 * 64)
    ir = decaying_ir(28, 500)
    convolver = Convolver(sources=1, channels=2, block_size=64, ir_samples=500)
    wet = stream(convolver, dry, [(12, 0, ir)])
    assert not wet[:, : 12 * 64].any()
    assert error_db(wet[:, 12 * 64 :], convolve(dry[0, 12 * 64 :], ir)) < -120


def test_reset_is_as_good_as_new():
    dry = noise(29, 2, 20 * 64)
    ir = decaying_ir(30, 500)
    used = Convolver(sources=2, channels=2, block_size=64, ir_samples=500)
    stream(used, dry, [(0, 0, ir), (3, 1, ir), (19, 1, ir)])
    used.set_ir(0, ir)
    used.reset()
    assert not used.is_fading(0)
    fresh = Convolver(sources=2, channels=2, block_size=64, ir_samples=500)
    changes = [(0, 1, decaying_ir(31, 400)), (5, 1, ir), (7, 0, ir)]
    np.testing.assert_array_equal(stream(used, dry, changes), stream(fresh, dry, changes))


def test_blocks_handed_out_belong_to_the_caller():
    convolver = Convolver(sources=1, channels=2, block_size=64, ir_samples=500)
    convolver.set_ir(0, decaying_ir(32, 500))
    first = convolver.process(noise(33, 1, 64))
    copy = first.copy()
    convolver.process(noise(34, 1, 64))
    np.testing.assert_array_equal(first, copy)
    assert first.dtype == np.float32
    assert first.flags.c_contiguous


@pytest.mark.parametrize("shape", [(2,), (1, 100), (3, 100), (2, 0), (2, 101), (1, 2, 100)])
def test_an_ir_of_another_shape_is_refused(shape):
    convolver = Convolver(sources=1, channels=2, block_size=64, ir_samples=100)
    with pytest.raises(ValueError, match="shape"):
        convolver.set_ir(0, np.zeros(shape, np.float32))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_an_ir_that_is_not_finite_is_refused_and_the_old_one_stays(bad):
    convolver = Convolver(sources=1, channels=2, block_size=64, ir_samples=100)
    convolver.set_ir(0, decaying_ir(35, 100))
    ir = decaying_ir(36, 100)
    ir[1, 50] = bad
    with pytest.raises(ValueError, match="finite"):
        convolver.set_ir(0, ir)
    assert not convolver.is_fading(0)
    assert np.isfinite(convolver.process(noise(37, 1, 64))).all()


@pytest.mark.parametrize(("samples", "channels", "block_size"), [(100, 2, 128), (100, 1, 64), (101, 2, 64)])
def test_an_ir_prepared_for_another_convolver_is_refused(samples, channels, block_size):
    convolver = Convolver(sources=1, channels=2, block_size=64, ir_samples=100)
    with pytest.raises(ValueError, match="another convolver"):
        convolver.set_ir(0, partition_ir(np.zeros((channels, samples), np.float32), block_size))


@pytest.mark.parametrize("zero", ["sources", "channels", "block_size", "ir_samples"])
def test_a_convolver_of_nothing_is_refused(zero):
    sizes = {"sources": 1, "channels": 1, "block_size": 1, "ir_samples": 1, zero: 0}
    with pytest.raises(ValueError):
        Convolver(**sizes)
