"""Laws of streaming convolution, against SciPy's one-shot FFT convolution in float64.

Each holds for the compiled convolver and for that of any block size.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.rendering.convolver import CHANNELS, Convolver
from server.rendering.partitions import Partitioning
from tests.rendering.streams import BLOCK_SIZES, BOTH_KINDS, convolve, decaying_ir, stream
from tests.signals import error_db, noise

pytestmark = BOTH_KINDS


@pytest.mark.parametrize("block_size", [64, 128, 256, 512, 1024])
@pytest.mark.parametrize("ir_samples", [1, 200, 256, 257, 4_001, 24_000])
def test_streaming_equals_convolution(any_size, block_size, ir_samples):
    dry = noise(1, 1, 20 * block_size + 2 * ir_samples // block_size * block_size)
    ir = decaying_ir(2, ir_samples)
    convolver = Convolver(sources=1, channels=2, block_size=block_size, ir_samples=ir_samples, any_size=any_size)
    convolver.set_ir(0, ir)
    assert error_db(stream(convolver, dry), convolve(dry[0], ir)) < -120


@pytest.mark.parametrize("sources", [1, 4, 16, 64])
def test_a_second_of_response_stays_exact_however_many_sources(any_size, sources):
    ir_samples = 48_000
    dry = noise(3, sources, 220 * 256)
    irs = [decaying_ir(seed, ir_samples) for seed in range(sources)]
    convolver = Convolver(sources=sources, channels=2, block_size=256, ir_samples=ir_samples, any_size=any_size)
    for source, ir in enumerate(irs):
        convolver.set_ir(source, ir)
    expected = sum(convolve(dry[source], ir) for source, ir in enumerate(irs))
    assert error_db(stream(convolver, dry), expected) < -120


def test_many_sources_are_added_up_as_exactly_as_few(any_size):
    """None of their products is lost beside the sum of all others."""
    if any_size:
        pytest.skip("NumPy adds spectrum by spectrum")
    errors_db = []
    for sources in (4, 64):
        dry, irs = noise(3, sources, 520 * 128), noise(4, sources, 2, 48_000)
        convolver = Convolver(sources=sources, channels=2, block_size=128, ir_samples=48_000)
        for source, ir in enumerate(irs):
            convolver.set_ir(source, ir)
        expected = sum(convolve(dry[source], ir) for source, ir in enumerate(irs))
        errors_db.append(error_db(stream(convolver, dry), expected))
    few_db, many_db = errors_db
    assert many_db < few_db + 3


@given(
    seed=st.integers(0, 2**32 - 1),
    sources=st.integers(1, 4),
    channels=st.sampled_from(CHANNELS),
    block_size=st.sampled_from(BLOCK_SIZES),
    ir_samples=st.integers(1, 6_000),
    blocks=st.integers(1, 80),
)
def test_any_layout_equals_convolution(any_size, seed, sources, channels, block_size, ir_samples, blocks):
    rng = np.random.default_rng(seed)
    dry = noise(seed, sources, blocks * block_size)
    irs = [decaying_ir(seed + source, rng.integers(1, ir_samples + 1), channels) for source in range(sources)]
    convolver = Convolver(
        sources=sources, channels=channels, block_size=block_size, ir_samples=ir_samples, any_size=any_size
    )
    for source, ir in enumerate(irs):
        convolver.set_ir(source, ir)
    expected = sum(convolve(dry[source], ir) for source, ir in enumerate(irs))
    assert error_db(stream(convolver, dry), expected) < -120


@pytest.mark.parametrize("channels", [4, 9, 16])
def test_ambisonic_channels_are_those_of_convolvers_with_one(any_size, channels):
    dry, ir = noise(5, 1, 120 * 64), decaying_ir(6, 3_000, channels)
    together = Convolver(sources=1, channels=channels, block_size=64, ir_samples=3_000, any_size=any_size)
    heard = stream(together, dry, [(0, 0, ir), (40, 0, ir[::-1])])
    for channel in (0, 1, channels - 1):
        alone = Convolver(sources=1, channels=1, block_size=64, ir_samples=3_000, any_size=any_size)
        changes = [(0, 0, ir[channel, None]), (40, 0, ir[::-1][channel, None])]
        np.testing.assert_allclose(heard[channel], stream(alone, dry, changes)[0], rtol=0, atol=1e-5)


def test_an_impulse_in_every_partition_comes_out_where_it_is(any_size):
    """One IR sample at a time, in each partition's first, middle and last sample, against an impulse fed in."""
    size, ir_samples = 64, 3_000
    convolver = Convolver(sources=1, channels=1, block_size=size, ir_samples=ir_samples, any_size=any_size)
    dry = np.zeros((1, 55 * size), np.float32)
    dry[0, 37] = 1
    for stage in Partitioning(size, ir_samples).stages:
        for partition in range(stage.partitions):
            for offset in (0, stage.size // 2 + 1, stage.size - 1):
                at = stage.start + partition * stage.size + offset
                if at >= ir_samples:
                    continue
                ir = np.zeros((1, ir_samples), np.float32)
                ir[0, at] = 1
                convolver.reset()
                convolver.set_ir(0, ir)
                expected = np.zeros_like(dry)
                expected[0, 37 + at] = 1
                np.testing.assert_allclose(stream(convolver, dry), expected, atol=2e-6)


def test_a_unit_impulse_passes_at_once_and_unchanged(any_size):
    convolver = Convolver(sources=1, channels=1, block_size=64, ir_samples=1_000, any_size=any_size)
    convolver.set_ir(0, np.ones((1, 1), np.float32))
    dry = noise(6, 1, 64)
    np.testing.assert_allclose(convolver.process(dry), dry, atol=2e-6)


@given(a=st.floats(-4, 4), b=st.floats(-4, 4), seed=st.integers(0, 2**32 - 1))
def test_linear(any_size, a, b, seed):
    x, y = noise(seed, 2, 1, 30 * 64)
    ir = decaying_ir(seed, 1_000)

    def wet(dry):
        convolver = Convolver(sources=1, channels=2, block_size=64, ir_samples=1_000, any_size=any_size)
        convolver.set_ir(0, ir)
        return stream(convolver, dry.astype(np.float32))

    np.testing.assert_allclose(wet(a * x + b * y), a * wet(x) + b * wet(y), atol=2e-4)


@pytest.mark.parametrize("late_blocks", [1, 3, 17, 40])
def test_time_invariant(any_size, late_blocks):
    """Whatever the phase of the stages; to the last bit where it is the same."""
    dry = noise(7, 1, 60 * 256)
    ir = decaying_ir(8, 13_000)

    def wet(x):
        convolver = Convolver(sources=1, channels=2, block_size=256, ir_samples=13_000, any_size=any_size)
        convolver.set_ir(0, ir)
        return stream(convolver, x)

    late = np.concatenate([np.zeros((1, late_blocks * 256), np.float32), dry], axis=1)
    assert error_db(wet(late)[:, late_blocks * 256 :], wet(dry)) < -120
    very_late = np.concatenate([np.zeros((1, 64 * 256), np.float32), dry], axis=1)
    np.testing.assert_array_equal(wet(very_late)[:, 64 * 256 :], wet(dry))


def test_blocks_handed_out_belong_to_the_caller(any_size):
    convolver = Convolver(sources=1, channels=2, block_size=64, ir_samples=500, any_size=any_size)
    convolver.set_ir(0, decaying_ir(32, 500))
    first = convolver.process(noise(33, 1, 64))
    copy = first.copy()
    mine = np.empty((2, 64), np.float32)
    assert convolver.process(noise(34, 1, 64), mine) is mine
    np.testing.assert_array_equal(first, copy)
    assert first.dtype == np.float32
    assert first.flags.c_contiguous


def test_blocks_and_room_for_the_mix_may_lie_in_memory_as_they_like(any_size):
    ir = decaying_ir(47, 500)
    dry = noise(48, 2, 64)

    def wet(blocks, out=None):
        convolver = Convolver(sources=2, channels=2, block_size=64, ir_samples=500, any_size=any_size)
        for source in range(2):
            convolver.set_ir(source, ir)
        return convolver.process(blocks, out)

    expected = wet(dry)
    np.testing.assert_array_equal(wet(np.asfortranarray(dry)), expected)
    np.testing.assert_array_equal(wet(np.repeat(dry, 2, axis=1)[:, ::2]), expected)
    np.testing.assert_array_equal(wet(dry, np.empty((64, 2), np.float32).T), expected)
    for wrong in (dry[:1], dry[:, :32]):
        with pytest.raises(ValueError):
            wet(wrong)


@pytest.mark.parametrize("shape", [(2,), (1, 100), (3, 100), (2, 0), (2, 101), (1, 2, 100)])
def test_an_ir_of_another_shape_is_refused(any_size, shape):
    convolver = Convolver(sources=1, channels=2, block_size=64, ir_samples=100, any_size=any_size)
    with pytest.raises(ValueError, match="shape"):
        convolver.set_ir(0, np.zeros(shape, np.float32))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_an_ir_that_is_not_finite_is_refused_and_the_old_one_stays(any_size, bad):
    convolver = Convolver(sources=1, channels=2, block_size=64, ir_samples=100, any_size=any_size)
    convolver.set_ir(0, decaying_ir(35, 100))
    ir = decaying_ir(36, 100)
    ir[1, 50] = bad
    with pytest.raises(ValueError, match="finite"):
        convolver.set_ir(0, ir)
    assert np.isfinite(convolver.process(noise(37, 1, 64))).all()
    assert convolver.exchanged == ()


@pytest.mark.parametrize("where", [0, 700, 1_199])
def test_an_ir_is_refused_for_its_loudest_sample_and_not_for_its_energy(any_size, where):
    convolver = Convolver(sources=2, channels=2, block_size=64, ir_samples=4_000, shared_tail=True, any_size=any_size)
    loud = np.full((2, 1_200), 1e6)
    assert np.isfinite(convolver.prepare(loud.astype(np.float32)).energies[0])
    for sample in (1.1e6, 1e30, -1e300):
        loud[1, where] = sample
        with pytest.raises(ValueError, match="finite, or beyond 1e\\+06"):
            convolver.prepare(loud)


@pytest.mark.parametrize(("samples", "channels", "block_size"), [(100, 2, 128), (100, 1, 64), (101, 2, 64)])
def test_an_ir_prepared_for_another_convolver_is_refused(any_size, samples, channels, block_size):
    convolver = Convolver(sources=1, channels=2, block_size=64, ir_samples=100, any_size=any_size)
    other = Convolver(sources=1, channels=channels, block_size=block_size, ir_samples=samples, any_size=any_size)
    with pytest.raises(ValueError, match="another convolver"):
        convolver.set_ir(0, other.prepare(np.zeros((channels, samples), np.float32)))


@pytest.mark.parametrize(
    "wrong",
    [{"sources": 0}, {"channels": 0}, {"channels": 3}, {"block_size": 0}, {"block_size": 90}, {"ir_samples": 0}],
)
def test_impossible_sizes_are_refused(any_size, wrong):
    sizes = {"sources": 1, "channels": 1, "block_size": 64, "ir_samples": 1}
    with pytest.raises(ValueError):
        Convolver(**(sizes | wrong), any_size=any_size)


@pytest.mark.parametrize("block_size", [96, 480])
def test_only_the_convolver_of_any_size_takes_blocks_that_are_no_power_of_two(any_size, block_size):
    if any_size:
        dry, ir = noise(40, 1, 40 * block_size), decaying_ir(41, 5_000)
        convolver = Convolver(sources=1, channels=2, block_size=block_size, ir_samples=5_000, any_size=True)
        convolver.set_ir(0, ir)
        assert error_db(stream(convolver, dry), convolve(dry[0], ir)) < -120
    else:
        with pytest.raises(ValueError, match="power of two"):
            Convolver(sources=1, channels=2, block_size=block_size, ir_samples=5_000)
